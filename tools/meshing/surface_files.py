"""Closed surfaces of lungs (STL, OBJ, PLY, VTP) as a label image, so that they are meshed like a mask."""
import os

import numpy as np

from .geometry import enclosed_volume, triangle_edges
from .label_image import LabelImage
from .labels import PARTS, part_of
from .mask import GRID, GRID_VOLUME
from .mesh import MeshError

READERS = {".stl": "vtkSTLReader", ".obj": "vtkOBJReader", ".ply": "vtkPLYReader", ".vtp": "vtkXMLPolyDataReader"}
FINER = 2               # voxels to a step of the grid that the lungs are worked out on
PAIRS = 400_000         # of triangles that are held against each other at a time


def files_of(words):
    """{part: file} of --surface PART=FILE words."""
    files = {}
    for word in words:
        name, equals, path = word.partition("=")
        part = name if name in PARTS else part_of(name)
        if not equals or not part or part == "lungs" or part in files:
            raise MeshError(f"--surface {word} is no PART=FILE, or the part is there twice; parts are "
                            f"{', '.join(p for p in PARTS if p != 'lungs')}.")
        if os.path.splitext(path)[1].lower() not in READERS:
            raise MeshError(f"--surface {word}: the file's name must end in {', '.join(READERS)}.")
        if not os.path.isfile(path):
            raise MeshError(f"--surface {word}: there is no such file.")
        files[part] = path
    return files


def read_surface(path, say):
    """Points (n, 3) in mm, RAS, and triangles seen from outside of a file that holds one or more closed surfaces."""
    import vtkmodules.all as vtk
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vtk.vtkObject.GlobalWarningDisplayOff()
    reader = getattr(vtk, READERS[os.path.splitext(path)[1].lower()])()
    reader.SetFileName(path)
    flat = vtk.vtkTriangleFilter()
    flat.SetInputConnection(reader.GetOutputPort())
    flat.PassLinesOff()
    flat.PassVertsOff()
    flat.Update()
    surface = flat.GetOutput()
    if surface.GetNumberOfPolys() == 0:
        raise MeshError(f"--surface {path} holds no triangles that can be read.")
    points = vtk_to_numpy(surface.GetPoints().GetData()).astype(float)
    triangles = vtk_to_numpy(surface.GetPolys().GetConnectivityArray()).reshape(-1, 3).astype(int)
    if not np.isfinite(points).all():
        raise MeshError(f"--surface {path} holds points that are no numbers.")
    extent = np.ptp(points, axis=0).max()
    _, first, number = np.unique(np.round(points / (1e-7 * extent)), axis=0, return_index=True, return_inverse=True)
    points, triangles = points[first], number.reshape(-1)[triangles]  # STL files give each triangle points of its own
    triangles = triangles[(np.sort(triangles, axis=1)[:, 1:] > np.sort(triangles, axis=1)[:, :-1]).all(axis=1)]
    if stored_lps(path):
        say(f"{path} says that its axes are LPS (as 3D Slicer writes): turned to RAS.")
        points = points * (-1, -1, 1)
    check_surface(path, points, triangles)
    return points, triangles[:, ::-1] if enclosed_volume(points, triangles) < 0 else triangles


def stored_lps(path):
    """Whether a file's head says that x grows to the left and y to the back."""
    with open(path, "rb") as file:
        return b"SPACE=LPS" in file.read(2000)


def check_surface(path, points, triangles):
    """Refuses a surface that is open, branches or cuts through itself."""
    _, count = np.unique(triangle_edges(triangles), axis=0, return_counts=True)
    if (count == 1).any():
        raise MeshError(f"--surface {path} is open: {np.sum(count == 1)} edges have a triangle on one side only; close its holes first.")
    if (count != 2).any():
        raise MeshError(f"--surface {path} branches: {np.sum(count != 2)} edges have more than two triangles.")
    place = cut(points, triangles)
    if place is not None:
        raise MeshError(f"--surface {path} cuts through itself near ({', '.join(f'{x:.1f}' for x in place)}); mend it first.")


def cut(points, triangles):
    """A place where a triangle's edge goes through another triangle, or None."""
    from scipy import spatial

    corners = points[triangles]
    centres = corners.mean(axis=1)
    radius = np.linalg.norm(corners - centres[:, None], axis=2).max(axis=1)
    order = np.argsort(radius, kind="stable")
    # each triangle against those that are not larger: within the sum of both radii
    tree = spatial.cKDTree(centres)
    for chunk in np.array_split(order, max(1, len(order) * 30 // PAIRS)):
        near = tree.query_ball_point(centres[chunk], 2 * radius[chunk])
        a = np.repeat(chunk, [len(n) for n in near])
        b = np.concatenate([np.asarray(n, dtype=int) for n in near])
        wanted = (radius[b] <= radius[a]) & (a != b) & (np.linalg.norm(centres[a] - centres[b], axis=1) < radius[a] + radius[b])
        wanted &= ~(triangles[a][:, :, None] == triangles[b][:, None, :]).any(axis=(1, 2))
        a, b = a[wanted], b[wanted]
        for one, other in ((a, b), (b, a)):
            for i in range(3):
                start, end = corners[one, i], corners[one, (i + 1) % 3]
                hit = through(start, end - start, corners[other])
                if hit.any():
                    return (start[hit][0] + end[hit][0]) / 2
    return None


def through(start, along, corners):
    """Whether segments (n, 3) from start go through triangles (n, 3, 3) (after Moeller and Trumbore)."""
    u, v = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(along, v)
    volume = np.sum(u * p, axis=1)
    flat = np.abs(volume) < 1e-12 * np.linalg.norm(u, axis=1) * np.linalg.norm(v, axis=1) * np.linalg.norm(along, axis=1)
    volume = np.where(flat, 1, volume)
    t = start - corners[:, 0]
    q = np.cross(t, u)
    a, b, c = np.sum(t * p, axis=1) / volume, np.sum(along * q, axis=1) / volume, np.sum(v * q, axis=1) / volume
    return ~flat & (a >= 0) & (b >= 0) & (a + b <= 1) & (c >= 0) & (c <= 1)


def voxels(points, triangles, origin, spacing, shape):
    """Which voxels (boolean) have their middle inside a closed surface."""
    import vtkmodules.all as vtk
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy

    surface, cells, places = vtk.vtkPolyData(), vtk.vtkCellArray(), vtk.vtkPoints()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points), deep=True))
    cells.SetData(3, numpy_to_vtkIdTypeArray(np.ascontiguousarray(triangles.ravel(), dtype=np.int64), deep=True))
    surface.SetPoints(places)
    surface.SetPolys(cells)
    stencil, image = vtk.vtkPolyDataToImageStencil(), vtk.vtkImageStencilToImage()
    stencil.SetInputData(surface)
    stencil.SetTolerance(0)
    stencil.SetOutputOrigin(*origin)
    stencil.SetOutputSpacing(*(spacing,) * 3)
    stencil.SetOutputWholeExtent(*np.stack([np.zeros(3, int), shape - 1], axis=1).ravel())
    image.SetInputConnection(stencil.GetOutputPort())
    image.SetInsideValue(1)
    image.SetOutputScalarTypeToUnsignedChar()
    image.Update()
    return vtk_to_numpy(image.GetOutput().GetPointData().GetScalars()).reshape(shape[::-1]).T > 0


def read_surfaces(words, say):
    """The LabelImage of --surface words, {part: [number]}."""
    files = files_of(words)
    found = {part: read_surface(path, say) for part, path in files.items()}
    say("the surfaces' coordinates are taken as mm in RAS (x to the subject's right) unless a file says LPS.")
    volumes = {part: enclosed_volume(*surface) / 1e3 for part, surface in found.items()}
    lungs = [part for part in found if part != "airway"]
    if not lungs:
        raise MeshError("--surface: the airway alone is no lung; give --surface right=FILE or left=FILE, too.")
    spacing = GRID * (max(volumes[part] for part in lungs) / GRID_VOLUME) ** (1 / 3) / FINER
    points = np.concatenate([points for points, _ in found.values()])
    origin = points.min(axis=0) - 4 * spacing
    shape = np.ceil((np.ptp(points, axis=0) + 8 * spacing) / spacing).astype(int)
    values = np.zeros(shape, np.uint8)
    for number, (part, surface) in reversed(list(enumerate(found.items(), 1))):
        inside = voxels(*surface, origin, spacing, shape)
        measured = inside.sum() * spacing**3 / 1e3
        if part != "airway" and abs(measured / volumes[part] - 1) > 0.01:
            raise MeshError(f"--surface {files[part]} encloses {volumes[part]:.4g} ml by its triangles but {measured:.4g} ml by points inside, "
                            "so parts of it lie in one another or face the wrong way; mend it first.")
        values[inside] = number
    return LabelImage(values, np.full(3, spacing), np.eye(3), origin, {}), {part: [n] for n, part in enumerate(found, 1)}
