"""tools/lung_mesh --check and --convert: a mesh of any program in the words of a mesh of its own."""
import numpy as np

from .foreign import mesh_of
from .formats import read_raw, renamed
from .geometry import facet_areas
from .report import bodies, measures, print_report, regions
from .surfaces import patches


def check(paths, names, mended):
    """Prints what a mesh's files hold and how good it is; returns the Mesh, the checks that it fails, and the notes.

    names: --names or None. mended: whether the Mesh will be written, without what pulmo refuses of the files.
    """
    raw = read_raw(paths)
    if names:
        renamed(raw, names)
    mesh = mesh_of(raw)
    failures = print_report(mesh, measures(mesh))
    areas = facet_areas(mesh.points, mesh.facets) / 100
    print("bodies                 volume (ml), cells; area (cm2) and patches of each surface")
    for one in bodies(mesh):
        words = [f"{name} {area:.1f} in {patches_of(mesh, one, name)}" for name, area in one.areas.items() if area > 0]
        print(f"{one.name:<22} {one.volume:.1f} ml, {np.sum(one.cells)}; {', '.join(words) or 'no names'}")
    print("volumes                " + (", ".join(f"{name} {volume:.1f} ml" for name, volume in regions(mesh).items()) or "none has a name"))
    nameless = areas[mesh.surfaces == 0].sum()
    if nameless > 0:
        raw.notes.append(f"{nameless:.3g} cm2 of the surface have no name.")
    tagless = np.sum(mesh.regions == 0)
    if tagless:
        raw.notes.append(f"{tagless} tetrahedra belong to no named volume.")
    present = {name for (dimension, _), name in mesh.names.items() if dimension == 2}
    for name in ("airway", "pleura"):
        if name not in present:
            raw.notes.append(f"no surface is called {name}" + (f"; there are {', '.join(sorted(present))}" if present else "") + ". pulmo's "
                             f"scenes mean it by that name: rename it, or name yours in the options -..._surfaces.")
    if mended:
        raw.notes += [fault + "." for fault in raw.refused]
    else:
        failures += raw.refused
    for note in raw.notes:
        print("note: " + note)
    return mesh, failures, raw.notes


def patches_of(mesh, one, name):
    """Words for the pieces that a body's surface of a name is in."""
    tags = [tag for (dimension, tag), other in mesh.names.items() if dimension == 2 and other == name]
    count, _ = patches(mesh.facets[one.facets & np.isin(mesh.surfaces, tags)])
    return f"{count} patch{'es' if count > 1 else ''}"


def with_whole_volume(mesh):
    """The Mesh with a name for those cells that have none: a file holds what has a name only."""
    nameless = ~np.isin(mesh.regions, [tag for dimension, tag in mesh.names if dimension == 3])
    if nameless.any():
        tag = max([tag for _, tag in mesh.names] + [int(mesh.regions.max())]) + 1
        name = "lung" if nameless.all() else "rest"
        mesh.regions = np.where(nameless, tag, mesh.regions)
        mesh.names[3, tag] = name
    return mesh
