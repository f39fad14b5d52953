"""Reads meshes of other programs: MSH, DOLFIN's HDF5, Exodus, and what meshio reads (VTU, XDMF, ...)."""
import contextlib
import io
import os

import numpy as np

from .foreign import joined, read_msh
from .mesh import MeshError

TAGS = ["gmsh:physical", "medit:ref", "cell_tags", "CellEntityIds"]  # cell data of programs that hold groups
EXODUS = (".e", ".exo", ".ex2")
SAME_PLACE = 1e-7       # of the mesh's extent, within which points of two files are the same


def read_raw(paths):
    """The Raw of a mesh that lies in one file, or in one with the cells and others with the groups of faces or cells."""
    raws = [read_one(path) for path in paths]
    whole = next((raw for raw in raws if len(raw.tets)), None)
    if whole is None:
        raise MeshError(f"{' and '.join(paths)} {'hold' if len(paths) > 1 else 'holds'} no tetrahedra.")
    if not np.isfinite(whole.points).all():
        raise MeshError(f"{paths[0]} holds nodes whose coordinates are no numbers.")
    for path, raw in zip(paths, raws):
        if raw is not whole:
            add_groups(whole, raw, path)
    return whole


def read_one(path):
    """The Raw of one file."""
    if not os.path.isfile(path):
        raise MeshError(f"there is no file {path}.")
    ending = os.path.splitext(path)[1].lower()
    if ending == ".msh":
        return read_msh(path)
    if ending in (".h5", ".hdf5"):
        return read_dolfin(path)
    return read_exodus(path) if ending in EXODUS else read_meshio(path)


def named_by_number(parts, names):
    """The names, with those of groups that have none: their number."""
    for dimension in parts:
        for _, groups in parts[dimension]:
            for tag in np.unique(groups[groups != 0]):
                names.setdefault((dimension, int(tag)), str(tag))
    return names


def read_meshio(path):
    """The Raw of a file that meshio reads."""
    import meshio

    try:
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(io.StringIO()) as said:
            read = meshio.read(path)
    except (Exception, SystemExit) as error:  # each format of meshio's raises kinds of its own, and some end the program
        why = " ".join((said.getvalue() if isinstance(error, SystemExit) else str(error)).split()).rstrip(".")
        raise MeshError(f"{path} is no mesh that meshio reads ({why or type(error).__name__}).") from error
    whole = {name: data for name, data in read.cell_data.items() if all(is_whole(values) for values in data)}
    chosen = next((name for name in TAGS if name in whole), next(iter(whole)) if len(whole) == 1 else None)
    notes, lost = [], []
    if whole and chosen is None:
        notes.append(f"{path} holds several whole numbers for each cell ({', '.join(whole)}): none is taken for groups.")
    parts = {2: [], 3: []}
    for number, block in enumerate(read.cells):
        dimension = {"triangle": 2, "tetra": 3}.get(block.type)
        if dimension:
            groups = np.asarray(whole[chosen][number]).ravel().astype(int) if chosen else np.zeros(len(block.data), int)
            parts[dimension].append((block.data, groups))
        elif block.type not in ("vertex", "line"):
            notes.append(f"elements that are no tetrahedra or triangles are there ({block.type}): left out.")
            lost.append(f"it has elements of the kind {block.type}, which are left out")
    points = np.zeros((len(read.points), 3))
    points[:, :read.points.shape[1]] = read.points[:, :3]
    names = {(int(dimension), int(tag)): name for name, (tag, dimension) in read.field_data.items()}
    raw = joined(points, parts, named_by_number(parts, names), list(dict.fromkeys(notes)))
    raw.lost = list(dict.fromkeys(lost))
    return raw


def is_whole(values):
    """Whether cell data are one whole number for each cell."""
    values = np.asarray(values)
    return values.size == len(values) and np.issubdtype(values.dtype, np.number) and np.array_equal(values, np.round(values))


def read_dolfin(path):
    """The Raw of DOLFIN's HDF5 file: a mesh, and MeshFunctions with topology and values, whose groups are called NAME_NUMBER."""
    import h5py

    try:
        with h5py.File(path) as file:
            groups = {name: group for name, group in file.items() if isinstance(group, h5py.Group) and "topology" in group}
            mesh = next(group for group in [groups.get("mesh"), *groups.values()]
                        if group is not None and "coordinates" in group and group["topology"].shape[1] == 4)
            points, tets = mesh["coordinates"][()], mesh["topology"][()].astype(int)
            functions = {name: (group["topology"][()].astype(int), group["values"][()].ravel().astype(int))
                         for name, group in groups.items() if "values" in group and group["topology"].shape[1] in (3, 4)}
    except (OSError, StopIteration, KeyError, AttributeError, IndexError, ValueError) as error:
        why = str(error) or "no group with coordinates and topology"
        raise MeshError(f"{path} is no HDF5 file of DOLFIN with a mesh of tetrahedra ({why}).") from error
    parts, names = {2: [], 3: [(tets, np.zeros(len(tets), int))]}, {}
    raw = joined(points, parts, names, [])
    for name, (cells, values) in functions.items():
        dimension = cells.shape[1] - 1
        used = max([tag for d, tag in raw.names if d == dimension], default=0)  # numbers of two functions may be the same
        tags = np.where((values > 0) & (values < 2**31), values + used, 0)  # 0 and DOLFIN's largest number: no group
        for tag in np.unique(tags[tags > 0]):
            raw.names[dimension, int(tag)] = f"{name}_{tag - used}"
        attach(raw, dimension, cells, tags)
    return raw


def attach(raw, dimension, cells, tags):
    """Gives the faces or tetrahedra of a Raw their groups."""
    cells, tags = cells[tags != 0], tags[tags != 0]
    if dimension == 2:
        raw.triangles = np.concatenate([raw.triangles, cells])
        raw.groups = np.concatenate([raw.groups, tags])
        return
    both = np.sort(np.concatenate([raw.tets, cells]), axis=1)
    _, number = np.unique(both, axis=0, return_inverse=True)
    tag_of = np.zeros(number.max() + 1, int)
    tag_of[number[len(raw.tets):]] = tags
    found = tag_of[number[:len(raw.tets)]]
    raw.regions = np.where(found != 0, found, raw.regions)


def add_groups(whole, raw, path):
    """Adds the groups of another file of the same mesh, whose points are found by their places."""
    from scipy import spatial

    if not len(raw.triangles) and not len(raw.tets):
        raise MeshError(f"{path} holds neither triangles nor tetrahedra.")
    distance, node = spatial.cKDTree(whole.points).query(raw.points)
    used = np.unique(np.concatenate([raw.triangles.ravel(), raw.tets.ravel()]))
    if distance[used].max() > SAME_PLACE * np.ptp(whole.points, axis=0).max():
        raise MeshError(f"{path} is of another mesh: some of its points are {distance[used].max():.3g} away from all nodes of the cells.")
    for dimension, cells, groups in ((2, raw.triangles, raw.groups), (3, raw.tets, raw.regions)):
        used = max([tag for d, tag in whole.names if d == dimension], default=0)
        shift = used if any((dimension, tag) in whole.names for tag in np.unique(groups[groups != 0])) else 0
        whole.names |= {(dimension, tag + shift): name for (d, tag), name in raw.names.items() if d == dimension}
        attach(whole, dimension, node[cells], np.where(groups != 0, groups + shift, 0))
    whole.notes += raw.notes
    whole.refused += raw.refused


def read_exodus(path):
    """The Raw of an Exodus file: its element blocks and side sets by their names."""
    import vtkmodules.all as vtk
    from vtkmodules.util.numpy_support import vtk_to_numpy

    vtk.vtkObject.GlobalWarningDisplayOff()
    reader = vtk.vtkExodusIIReader()
    reader.SetFileName(path)
    with open(path, "rb") as file:
        netcdf = file.read(4)[:3] in (b"CDF", b"\x89HD")
    if not netcdf or not reader.CanReadFile(path):
        raise MeshError(f"{path} is no Exodus file that can be read.")
    reader.UpdateInformation()
    for kind in (reader.ELEM_BLOCK, reader.SIDE_SET):
        for number in range(reader.GetNumberOfObjects(kind)):
            reader.SetObjectStatus(kind, number, 1)
    reader.Update()
    parts, names, places = {2: [], 3: []}, {}, []
    for kind, dimension in ((reader.ELEM_BLOCK, 3), (reader.SIDE_SET, 2)):
        for number in range(reader.GetNumberOfObjects(kind)):
            grid = exodus_part(reader, reader.GetObjectName(kind, number))
            if grid is None or not grid.GetNumberOfCells():
                continue
            cells = vtk_to_numpy(grid.GetCells().GetConnectivityArray())
            if len(cells) != (dimension + 1) * grid.GetNumberOfCells():
                raise MeshError(f"{path}: {reader.GetObjectName(kind, number)} holds cells that are no "
                                f"{'tetrahedra' if dimension == 3 else 'triangles'} with straight edges.")
            tag = len(names) + 1
            names[dimension, tag] = clean_name(reader.GetObjectName(kind, number))
            shift = sum(len(p) for p in places)
            places.append(vtk_to_numpy(grid.GetPoints().GetData()).astype(float))
            parts[dimension].append((cells.reshape(-1, dimension + 1) + shift, np.full(grid.GetNumberOfCells(), tag)))
    if not places:
        raise MeshError(f"{path} holds no blocks of cells.")
    points = np.concatenate(places)
    # blocks and sets each have points of their own: those at one place are one
    _, first, number = np.unique(np.round(points / (SAME_PLACE * np.ptp(points, axis=0).max())), axis=0, return_index=True,
                                 return_inverse=True)
    parts = {d: [(number.reshape(-1)[cells], tags) for cells, tags in parts[d]] for d in parts}
    return joined(points[first], parts, names, [])


def exodus_part(reader, name):
    """The grid of a block or set of a name in an Exodus reader's output."""
    output = reader.GetOutput()
    for i in range(output.GetNumberOfBlocks()):
        kind = output.GetBlock(i)
        for j in range(kind.GetNumberOfBlocks() if kind else 0):
            if kind.GetMetaData(j).Get(kind.NAME()) == name:
                return kind.GetBlock(j)
    return None


def clean_name(name):
    """A name without what VTK adds to it, ' ID: 3' and the like."""
    return name.split(" ID:")[0].strip().removeprefix("Unnamed block").strip() or name


def renamed(raw, words):
    """Gives the groups of a Raw the names of --names OLD=NEW,...; OLD is a name or number, with surface: or volume: before it if both have it."""
    for word in words.split(","):
        old, equals, new = (part.strip() for part in word.partition("="))
        kind, colon, rest = old.partition(":")
        dimensions = {"surface": [2], "volume": [3]}.get(kind, [2, 3]) if colon else [2, 3]
        old = rest if colon else old
        found = [key for key, name in raw.names.items() if key[0] in dimensions and (name == old or str(key[1]) == old)]
        there = ", ".join(f"{'surface' if d == 2 else 'volume'}:{name}" for (d, _), name in raw.names.items()) or "none"
        if not equals or not new or not found:
            raise MeshError(f"--names: '{word}' names no group, or is no OLD=NEW; there are {there}.")
        if len({dimension for dimension, _ in found}) > 1:
            raise MeshError(f"--names: '{old}' is a surface and a volume; write surface:{old}=... or volume:{old}=...")
        for key in found:
            raw.names[key] = new
