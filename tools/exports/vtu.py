"""Fields as a series of VTU files, one for each time, with a PVD file that lists them."""
import os

import numpy as np
from vtkmodules.vtkIOXML import vtkXMLUnstructuredGridWriter

from pulmo.errors import PulmoError

from .probe import add, tetrahedra


def export(run, given, moments, folder, say):
    """Writes the times into a folder; returns the names of the files."""
    fields, made = run.fields, []
    if not run.summary.get("regions"):
        say("the run left no names of regions: the files hold their numbers only")
    for number, snapshot in enumerate(moments):
        mesh = tetrahedra(fields.points, fields.cells)
        for name in fields.names:
            values = fields.values(name, snapshot)
            if values is not None:
                add(mesh.GetPointData() if fields.centers[name] == "Node" else mesh.GetCellData(), name, values)
        add(mesh.GetFieldData(), "TimeValue", np.array([fields.times[snapshot]]))
        for name, region in (run.summary.get("regions") or {}).items():
            add(mesh.GetFieldData(), f"region_number_of_{name}", np.array([region["number"]]))
        writer = vtkXMLUnstructuredGridWriter()
        made.append(f"fields_{number:05d}.vtu")
        writer.SetFileName(os.path.join(folder, made[-1]))
        writer.SetInputData(mesh)
        if not writer.Write():
            raise PulmoError(f"cannot write {made[-1]}")
    entries = "".join(f'    <DataSet timestep="{fields.times[s]:.15g}" part="0" file="{name}"/>\n' for s, name in zip(moments, made))
    with open(os.path.join(folder, "fields.pvd"), "w", encoding="utf-8") as out:
        out.write(f'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n  <Collection>\n{entries}  </Collection>\n</VTKFile>\n')
    return [*made, "fields.pvd"]
