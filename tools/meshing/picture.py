"""A picture of a lung mesh."""
import numpy as np

from .report import cells_of

PLEURA = (0.93, 0.62, 0.58)
LOBE_COLOURS = [PLEURA, (0.94, 0.85, 0.55), (0.60, 0.80, 0.70), (0.80, 0.68, 0.85), (0.80, 0.78, 0.72)]


def picture(mesh, path):
    """Save a picture of a lung Mesh."""
    figure(mesh).savefig(path)


def figure(mesh):
    """A lung Mesh from the front with the airway seen through, and obliquely from below."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 5), dpi=84)
    FigureCanvasAgg(drawn)
    axes = drawn.subplots(1, 2)
    draw(axes[0], mesh, (0, 1, 0.08), 0.5)
    draw(axes[1], mesh, (-0.75, 0.6, -0.25), 1.0)
    drawn.subplots_adjust(0.01, 0.01, 0.99, 0.99, 0.02)
    return drawn


def draw(axes, mesh, towards_eye, opacity):
    """Paint the surface triangles from back to front, in parallel projection.

    towards_eye: direction from the lungs to the eye (RAS). opacity: of the pleura nearest to the eye.
    """
    from matplotlib.collections import PolyCollection

    eye = np.asarray(towards_eye) / np.linalg.norm(towards_eye)
    right = np.cross((0, 0, 1), eye)
    right /= np.linalg.norm(right)
    up = np.cross(eye, right)
    light = eye + 0.6 * up - 0.5 * right
    corners = mesh.points[mesh.facets]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    tags = [tag for (dimension, tag), name in mesh.names.items() if dimension == 2 and name == "airway"]
    airway = np.isin(mesh.surfaces, tags)
    colours = np.where(airway[:, None], (0.16, 0.45, 0.75), pleura_colours(mesh))
    facing = normals @ eye > 0
    shade = 0.55 + 0.45 * np.clip(np.abs(normals @ light) / np.linalg.norm(light), 0, 1)
    depth = np.argsort((corners @ eye).mean(axis=1))
    flat = np.stack([corners @ right, corners @ up], axis=-1)
    for layer, alpha, width in ((~airway & ~facing, 1, 0), (airway, 1, 0.3), (~airway & facing, opacity, 0.3)):
        chosen = depth[layer[depth]]
        fill = colours[chosen] * shade[chosen, None]
        axes.add_collection(PolyCollection(flat[chosen], facecolors=fill, edgecolors=0.8 * fill, linewidths=width,
                                           alpha=alpha))
    axes.autoscale()
    axes.set_aspect("equal")
    axes.axis("off")


def pleura_colours(mesh):
    """The colour of each boundary triangle where it is no airway: one for lungs, one for each lobe where there are lobes."""
    volumes = [tag for dimension, tag in mesh.names if dimension == 3]
    if not any(name.endswith("_lobe") for name in mesh.names.values()):
        return np.array(PLEURA)
    place = np.searchsorted(np.sort(volumes), mesh.regions[cells_of(mesh.tets, mesh.facets)])
    return np.array(LOBE_COLOURS)[place % len(LOBE_COLOURS)]
