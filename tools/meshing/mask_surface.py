"""Smooth closed surfaces of the lungs of a scan: one each, as large as the mask, apart from each other."""
import numpy as np
from scipy import ndimage
from skimage import measure

from .geometry import enclosed_volume, facet_areas, triangle_edges
from .iso_surface import SMOOTHING_STEPS, taubin
from .mask import signed_distance
from .mesh import MeshError
from .surfaces import patches

BLUR = (0.75, 0.3)      # width of the smoothing: the larger of so many voxels and so much of the cells' size
GAP = 0.25              # between two lungs, of the cells' size at their rims
SAME_VOLUME = 2e-4      # relative difference at which the search for the level ends


def smooth(scan, size):
    """The lungs' and lobes' distances made smooth, as far as cells of a size (mm) can follow them."""
    width = max(BLUR[0] * scan.coarsest, BLUR[1] * size) / scan.step
    for lung in scan.lungs:
        lung.distance = ndimage.gaussian_filter(lung.distance, width)
        lung.lobes = {name: ndimage.gaussian_filter(distance, width / 2) for name, distance in lung.lobes.items()}


def surfaces(scan, size, scale, say):
    """[(points, triangles)] of the Scan's lungs, mm along the image's axes; makes them smooth first.

    size: edge of the cells, mm in the image. scale: of lengths from the image to the mesh, for what is told.
    """
    smooth(scan, size)
    gap = max(scan.step, GAP * size)
    distances = [lung.distance for lung in scan.lungs]
    limits = [None] * len(distances)
    if len(distances) == 2:
        # half way between the lungs, less half the gap
        limits = [(one - other - gap) / 2 for one, other in (distances, distances[::-1])]
        if np.max(sum(distances)) > -gap:
            say(f"the lungs touch or nearly do: held {gap * scale:.2g} mm apart.")
    found = []
    for lung, limit in zip(scan.lungs, limits):
        lung.distance = one_genus(lung, limit, scan.step, say)
        found.append(as_large(lung, limit, scan))
    return found


def one_genus(lung, limit, step, say):
    """The lung's distance with tunnels through it closed, or thin handles cut, if it has any."""
    for radius in (0, 1.5, 3, 4.5):
        for widen in (1, -1) if radius else (1,):
            reach = widen * radius * step
            distance = lung.distance
            if radius:
                distance = signed_distance(distance > -reach, (step,) * 3) - reach
                distance = ndimage.gaussian_filter(distance, 1.0)
            points, triangles = iso_surface(distance, limit, 0.0, step)
            if genus(points, triangles) == 0:
                if radius:
                    say(f"the {lung.side} lung: " + ("tunnels through it" if widen > 0 else "handles of it")
                        + f" of up to {2 * radius * step:.2g} mm " + ("closed." if widen > 0 else "cut."))
                return distance
    raise MeshError(f"the {lung.side} lung is no simple body: it has holes through it that are wider than {9 * step:.2g} mm; "
                    "close them in the mask.")


def genus(points, triangles):
    """Holes through a closed surface of one piece."""
    edges = len(np.unique(triangle_edges(triangles), axis=0))
    return round(1 - (len(points) - edges + len(triangles)) / 2)


def iso_surface(distance, limit, level, step):
    """Triangles where a distance is at a level, or nearer to where the other lung limits it: the largest piece."""
    field = distance - level if limit is None else np.minimum(distance - level, limit)
    if field.max() <= 0:
        raise MeshError("nothing is left of a lung after smoothing: it is too thin for this --size.")
    points, triangles, _, _ = measure.marching_cubes(field, 0, spacing=(step,) * 3)
    count, patch = patches(triangles)
    if count > 1:
        used, triangles = np.unique(triangles[patch == np.argmax(np.bincount(patch))], return_inverse=True)
        points, triangles = points[used], triangles.reshape(-1, 3)
    points = taubin(points.astype(float), triangles, SMOOTHING_STEPS)
    if enclosed_volume(points, triangles) < 0:
        triangles = triangles[:, ::-1]
    return points, triangles


def as_large(lung, limit, scan):
    """The lung's surface at the level that encloses the volume of its voxels."""
    level = 0.0
    for _ in range(6):
        points, triangles = iso_surface(lung.distance, limit, level, scan.step)
        excess = enclosed_volume(points, triangles) - lung.volume * 1e3
        if abs(excess) < SAME_VOLUME * lung.volume * 1e3:
            break
        level += excess / facet_areas(points, triangles).sum()
    if genus(points, triangles) != 0:
        raise MeshError(f"the {lung.side} lung has no simple surface with the volume of its mask; try another --size.")
    lung.distance = lung.distance - level if limit is None else np.minimum(lung.distance - level, limit)
    return points + scan.start, triangles
