"""The directory of a run that no program made: a box whose fields are known in closed form."""
import json
import os

import h5py
import numpy as np

import case_meshes
import pulmo_case as pulmo

EDGES = [[0, 1], [1, 2], [0, 2], [0, 3], [1, 3], [2, 3]]  # whose middles are nodes 4 to 9
LOW, LENGTHS = np.array([10.0, -20.0, 5.0]), np.array([60.0, 40.0, 30.0])
GRADIENT = np.array([[0.2, 0.05, 0.0], [-0.03, 0.1, 0.02], [0.0, 0.04, 0.3]])
SHIFT = np.array([3.0, -2.0, 1.0])
TIMES = [0.0, 1.0, 2.0]
SHARES = [0.0, 1.0, 0.25]  # of the displacement, at the times


def displacement(x, share=1.0):
    return share * (x @ GRADIENT.T + SHIFT)


def pressure(x, share=1.0):
    return share * (4 + 0.1 * x[..., 0] - 0.05 * x[..., 2])


def box():
    """(points, cells of ten nodes)."""
    points, tets = case_meshes.kuhn((6, 4, 3), LENGTHS)
    points = points + LOW
    ends = np.sort(tets[:, EDGES].reshape(-1, 2), axis=1)
    edges, which = np.unique(ends, axis=0, return_inverse=True)
    cells = np.concatenate([tets, len(points) + which.reshape(-1, 6)], axis=1)
    return np.concatenate([points, points[edges].mean(axis=1)]), cells


def write(shuffled=False, breaths=True):
    """The path of a new run. shuffled: the last snapshot numbers nodes and cells as a run does that was restarted on other ranks."""
    folder = pulmo.scratch("made")
    os.makedirs(folder)
    points, cells = box()
    J = np.where(points[cells[:, :4]].mean(axis=1)[:, 0] > LOW[0] + LENGTHS[0] / 2, 1.5, 1.1)
    random = np.random.default_rng(3)
    new_node, new_cell = random.permutation(len(points)), random.permutation(len(cells))
    grids = []
    for number, (time, share) in enumerate(zip(TIMES, SHARES)):
        mesh, x, tets, value = "fields.h5", points, cells, J
        if shuffled and number == 2:
            x = np.empty_like(points)
            x[new_node] = points
            turned = cells[:, [1, 2, 0, 3, 5, 6, 4, 8, 9, 7]]  # another corner first
            mesh, tets, value = "fields_00002_mesh.h5", new_node[turned][new_cell], J[new_cell]
        with h5py.File(os.path.join(folder, mesh), "w") as file:
            file["geometry"], file["topology"] = x, tets.astype(np.int32)
            file["region_number"] = np.where(value > 1.2, 2.0, 1.0)
        fields = {"displacement_mm": ("Node", displacement(x, share)), "alveolar_pressure_cmH2O": ("Node", pressure(x, share)),
                  "J_mean": ("Cell", 1 + share * (value - 1)), "ventilation_since_breath_start": ("Cell", share * (value - 1))}
        name = f"fields_{number:05d}.h5"
        with h5py.File(os.path.join(folder, name), "w") as file:
            for field, (_, values) in fields.items():
                file[field] = values
        centers = {field: (center, name) for field, (center, _) in fields.items()} | {"region_number": ("Cell", mesh)}
        grids.append(f'<Grid Name="step" GridType="Uniform"><Time Value="{time}"/><Topology><DataItem>{mesh}:/topology</DataItem></Topology>'
                     f'<Geometry><DataItem>{mesh}:/geometry</DataItem></Geometry>' + "".join(
                         f'<Attribute Name="{field}" Center="{center}"><DataItem>{file}:/{field}</DataItem></Attribute>'
                         for field, (center, file) in centers.items()) + "</Grid>")
    with open(os.path.join(folder, "fields.xdmf"), "w") as out:
        out.write(f'<?xml version="1.0"?><Xdmf><Domain><Grid GridType="Collection">{"".join(grids)}</Grid></Domain></Xdmf>')
    with open(os.path.join(folder, "signals.csv"), "w") as out:
        out.write("time_s,airway_pressure_cmH2O,flow_ml_per_s,volume_ml,phase,dt_s\n0,0,0,0,a,0\n1,9,20,20,a,1\n2,0,-15,5,b,1\n")
    breath = {"complete": True, "start_s": 0.0, "end_of_inspiration_s": 1.0, "end_s": 2.0, "tidal_volume_ml": 20.0}
    summary = {"finished": True, "numbers_of_breath": 1 if breaths else None, "breaths": [breath] if breaths else [],
               "regions": {"left half": {"number": 1}, "right half": {"number": 2}}}
    with open(os.path.join(folder, "summary.json"), "w") as out:
        json.dump(summary, out)
    return folder
