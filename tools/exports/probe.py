"""Values of fields at the voxels of a grid; VTK finds the cells and interpolates within them."""
import numpy as np
from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
from vtkmodules.vtkCommonCore import vtkPoints
from vtkmodules.vtkCommonDataModel import VTK_QUADRATIC_TETRA, VTK_TETRA, vtkCellArray, vtkImageData, vtkUnstructuredGrid
from vtkmodules.vtkFiltersCore import vtkProbeFilter

SLAB = 2_000_000  # voxels at a time: memory
# voxels: VTK counts what lies just on a face as inside, so a cube on the grid's planes would get voxels on both of its sides
ASIDE = np.array([1.0, 0.7, 0.4]) * 1e-6
# a tetrahedron of ten nodes as straight ones between them. VTK looks for a cell in the box of its nodes, which a curved face leaves:
# curved cells would have gaps between them
PIECES = np.array([[0, 4, 6, 7], [4, 1, 5, 8], [6, 5, 2, 9], [7, 8, 9, 3], [6, 4, 5, 8], [6, 5, 9, 8], [6, 9, 7, 8], [6, 7, 4, 8]])


def tetrahedra(points, cells):
    """A vtkUnstructuredGrid of tetrahedra of four or ten nodes."""
    made, places, array = vtkUnstructuredGrid(), vtkPoints(), vtkCellArray()
    places.SetDataTypeToDouble()
    places.SetData(numpy_to_vtk(np.ascontiguousarray(points, float), deep=True))
    count, nodes = cells.shape
    array.SetData(numpy_to_vtkIdTypeArray(np.arange(0, nodes * count + 1, nodes, dtype=np.int64), deep=True),
                  numpy_to_vtkIdTypeArray(np.ascontiguousarray(cells, np.int64).ravel(), deep=True))
    made.SetPoints(places)
    made.SetCells(VTK_TETRA if nodes == 4 else VTK_QUADRATIC_TETRA, array)
    return made


def add(data, name, values):
    """Puts an array under a name into the point or cell data of a grid."""
    array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
    array.SetName(name)
    data.AddArray(array)


def probed(mesh, low, shape, names):
    """(inside, {name: values}) at the points low + (i, j, k) of a box of that shape, with i running fastest."""
    box = vtkImageData()
    box.SetOrigin(*map(float, low))
    box.SetDimensions(*map(int, shape))
    probe = vtkProbeFilter()
    probe.SetInputData(box)
    probe.SetSourceData(mesh)
    probe.Update()
    found = probe.GetOutput().GetPointData()
    inside = vtk_to_numpy(found.GetArray("vtkValidPointMask")) != 0
    return inside, {name: vtk_to_numpy(found.GetArray(name)) for name in names}


def sample(grid, points, cells, on_nodes, on_cells):
    """(inside, {name: values}): whether the voxels' centres lie in the lung, (nx, ny, nz), and fields there, zero elsewhere,
    (nx, ny, nz) or (nx, ny, nz, 3), single precision.

    points: (n, 3) of the nodes in the world, mm. cells: (m, 10). on_nodes, on_cells: {name: values}.
    """
    at = grid.indices(points) + ASIDE  # the grid's axes need not be those of the world
    low = np.maximum(np.floor(at.min(axis=0)).astype(int), 0)
    high = np.minimum(np.ceil(at.max(axis=0)).astype(int) + 1, grid.shape)
    inside = np.zeros(grid.shape, bool)
    fields = {name: np.zeros(grid.shape + values.shape[1:], np.float32) for name, values in (on_nodes | on_cells).items()}
    if (high <= low).any():
        return inside, fields
    mesh = tetrahedra(at, cells[:, PIECES].reshape(-1, 4))
    for name, values in on_nodes.items():
        add(mesh.GetPointData(), name, values.astype(np.float32))
    for name, values in on_cells.items():
        add(mesh.GetCellData(), name, np.repeat(values, len(PIECES)).astype(np.float32))
    thick = max(1, SLAB // int(np.prod(high[:2] - low[:2])))
    for begin in range(low[2], high[2], thick):
        end = min(begin + thick, high[2])
        shape = (*(high[:2] - low[:2]), end - begin)
        part = slice(low[0], high[0]), slice(low[1], high[1]), slice(begin, end)
        here, found = probed(mesh, (low[0], low[1], begin), shape, fields)
        here = here.reshape(shape, order="F")
        inside[part] = here
        for name, values in found.items():
            values = values.reshape(*shape, *values.shape[1:], order="F")
            fields[name][part][here] = values[here]
    return inside, fields
