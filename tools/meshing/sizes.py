"""Element sizes as fields of gmsh: near places, as another mesh has them, the least of several."""
import gmsh
import numpy as np

from .geometry import boundary_facets, orient

SIZE_GROWTH = 0.4       # of the element size per mm of distance


def limit_near(places, small, size, reach):
    """A gmsh field: the element size grows from small, within reach of the places (n, 3), to size; all in mm."""
    fields = gmsh.model.mesh.field
    marks = [gmsh.model.geo.addPoint(*place) for place in places]
    gmsh.model.geo.synchronize()
    distance, limit = fields.add("Distance"), fields.add("Threshold")
    fields.setNumbers(distance, "NodesList", marks)
    for name, value in (("IField", distance), ("LcMin", small), ("LcMax", size), ("DistMin", reach),
                        ("DistMax", reach + max(size - small, 0.01) / SIZE_GROWTH)):
        fields.setNumber(limit, name, value)
    return limit


def follow(points, tets, sizes):
    """A gmsh field: element sizes given at the nodes of another mesh, mm; outside they go on for one element."""
    def add(kind, corners, values):
        gmsh.view.addListData(view, kind, len(values), np.hstack(
            [np.moveaxis(corners, 2, 1).reshape(len(values), -1), values]).ravel())

    facets = boundary_facets(orient(points, tets))
    a, b, c = (points[facets[:, i]] for i in range(3))
    outwards = np.zeros_like(points)
    for corner in facets.T:
        np.add.at(outwards, corner, np.cross(b - a, c - a))
    outwards /= np.maximum(np.linalg.norm(outwards, axis=1, keepdims=True), 1e-12)
    outer = points + sizes[:, None] * outwards
    view = gmsh.view.add("sizes")
    add("SS", points[tets], sizes[tets])
    add("SI", np.concatenate([points[facets], outer[facets]], axis=1), np.tile(sizes[facets], 2))
    field = gmsh.model.mesh.field.add("PostView")
    gmsh.model.mesh.field.setNumber(field, "ViewTag", view)
    gmsh.option.setNumber("Mesh.CharacteristicLengthMax", sizes.max())
    return field


def take_smallest(limits):
    """Let the least of some gmsh fields be the element size."""
    fields = gmsh.model.mesh.field
    smallest = fields.add("Min")
    fields.setNumbers(smallest, "FieldsList", limits)
    fields.setAsBackgroundMesh(smallest)
    for option in ("CharacteristicLengthExtendFromBoundary", "CharacteristicLengthFromPoints"):
        gmsh.option.setNumber("Mesh." + option, 0)
