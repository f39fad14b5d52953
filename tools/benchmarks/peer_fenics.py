#!/usr/bin/python3
"""A breath of the whole-lung model as one would write it in FEniCS: the peer of `tools/benchmark breath --peer`.

    peer_fenics.py SCENE.json MESH.msh SOLVER.opts DIR

DOLFINx 0.5 (Debian package python3-dolfinx-real), one rank. P2-P1, backward Euler with the exactly conservative
(J_new - J_old)/dt, law of Birzle et al. 2019, springs with the full displacement vector, pressure-controlled
ventilation. Forms, tangent and code come from UFL and FFCx; nothing of pulmo is used. Rows are scaled as in pulmo
(momentum 1/(modulus h^2), mass dt/h^3), so that -snes_rtol and -snes_atol mean the same.

Reads SCENE.json (mm, s, kPa): mesh_scale, dt, stop (last time that is solved), pressure, ramp, inspiration,
permeability, springs (surface: kPa/mm), tissue (c, beta, c1, c3, d1, d3). Writes DIR/signals.csv and, at the end,
DIR/summary.json. Time of compiling the forms is reported apart from the rest.
"""
import csv
import json
import sys
import time
from pathlib import Path

import petsc4py

petsc4py.init(["peer_fenics.py", "-options_file", sys.argv[3]])

import dolfinx
import gmsh
import numpy as np
import ufl
from dolfinx import fem
from dolfinx.io import gmshio
from mpi4py import MPI
from petsc4py import PETSc

# Quadrature of degree 3 with 8 points, the one pulmo uses: two orbits of barycentric (a, a, a, 1 - 3a), each with the
# weight of a point relative to the volume. (FFCx's own rule of degree 4 has 11.)
ORBITS = [(0.32868114666534905, 0.12749131155750642), (0.11192072750929141, 0.12250868844249358)]


def cell_rule():
    """Metadata of the quadrature in the cells."""
    points, weights = [], []
    for a, weight in ORBITS:
        for corner in range(4):
            barycentric = [a] * 4
            barycentric[corner] = 1 - 3 * a
            points.append(tuple(barycentric[1:]))
            weights.append(weight / 6)
    return {"quadrature_rule": "custom", "quadrature_degree": 3, "quadrature_points": tuple(points),
            "quadrature_weights": tuple(weights)}


def read_mesh(path, scale):
    """The tetrahedra of a gmsh file in mm, tags of the facets, number of each physical surface."""
    gmsh.initialize()
    gmsh.option.setNumber("General.Terminal", 0)
    gmsh.open(path)
    surfaces = {gmsh.model.getPhysicalName(2, tag): tag for _, tag in gmsh.model.getPhysicalGroups(2)}
    mesh, _, facets = gmshio.model_to_mesh(gmsh.model, MPI.COMM_SELF, 0)
    gmsh.finalize()
    mesh.geometry.x[:] *= scale
    return mesh, facets, surfaces


def birzle(F, k):
    """Energy per reference volume, kPa."""
    J = ufl.det(F)
    I1, I3 = ufl.inner(F, F), J**2
    return (k["c"] * (I1 - 3) + k["c"] / k["beta"] * (I3**(-k["beta"]) - 1)
            + k["c1"] * (I1 * I3**(-1 / 3) - 3)**int(k["d1"]) + k["c3"] * (I3**(1 / 3) - 1)**int(k["d3"]))


def modulus(k):
    """Largest diagonal entry of the tangent of `birzle` at F = I, kPa (d1 and d3 above 2: c1 and c3 add nothing)."""
    return 4 * k["c"] * (1 + k["beta"])


class Breath:
    """Unknowns, forms and Newton solver."""

    def __init__(self, scene, path):
        self.scene, self.seconds = scene, {"residual": 0.0, "jacobian": 0.0, "compile": 0.0}
        self.mesh, facets, surfaces = read_mesh(path, scene["mesh_scale"])
        mesh, k = self.mesh, scene["tissue"]
        missing = [name for name in [*scene["springs"], "airway"] if name not in surfaces]
        if missing:
            sys.exit(f"peer_fenics: error: the mesh has no surface {missing[0]}")
        W = fem.FunctionSpace(mesh, ufl.MixedElement(ufl.VectorElement("CG", mesh.ufl_cell(), 2),
                                                     ufl.FiniteElement("CG", mesh.ufl_cell(), 1)))
        self.state, self.before = fem.Function(W), fem.Function(W)
        dx = ufl.Measure("dx", domain=mesh, metadata=cell_rule())
        ds = ufl.Measure("ds", domain=mesh, subdomain_data=facets, metadata={"quadrature_degree": 4})

        u, p = ufl.split(self.state)
        eta, q = ufl.TestFunctions(W)
        F = ufl.variable(ufl.Identity(3) + ufl.grad(u))
        J, J_before = ufl.det(F), ufl.det(ufl.Identity(3) + ufl.grad(ufl.split(self.before)[0]))
        cof = ufl.diff(J, F)  # J F^-T
        stress = ufl.diff(birzle(F, k), F) - p * cof
        darcy = scene["permeability"] / J * ufl.inner(cof * ufl.grad(p), cof * ufl.grad(q))  # Q = -k J F^-1 F^-T Grad p
        cells = mesh.topology.index_map(3).size_local
        one = fem.Constant(mesh, PETSc.ScalarType(1))
        h = np.cbrt(fem.assemble_scalar(fem.form(one * dx)) / cells)
        momentum = ufl.inner(stress, ufl.grad(eta)) * dx
        for name, stiffness in scene["springs"].items():
            momentum += stiffness * ufl.inner(u, eta) * ds(surfaces[name])
        mass = ((J - J_before) * q + scene["dt"] * darcy) * dx
        form = 1 / (modulus(k) * h**2) * momentum + 1 / h**3 * mass

        begin, cpu = time.perf_counter(), time.process_time()
        options = {"cffi_extra_compile_args": ["-O3", "-march=native", "-g0"]}
        self.residual_form = fem.form(form, jit_params=options)
        self.jacobian_form = fem.form(ufl.derivative(form, self.state), jit_params=options)
        self.volume_form = fem.form((J - 1) * dx, jit_params=options)
        self.seconds["compile"] = time.perf_counter() - begin
        self.compile_cpu = time.process_time() - cpu

        pressures, _ = W.sub(1).collapse()
        self.airway_pressure = fem.Function(pressures)
        dofs = fem.locate_dofs_topological((W.sub(1), pressures), 2, facets.find(surfaces["airway"]))
        self.conditions = [fem.dirichletbc(self.airway_pressure, dofs, W.sub(1))]
        self.matrix = fem.petsc.create_matrix(self.jacobian_form)
        self.vector = fem.petsc.create_vector(self.residual_form)
        self.snes = PETSc.SNES().create(MPI.COMM_SELF)
        self.snes.setFunction(self.residual, self.vector)
        self.snes.setJacobian(self.jacobian, self.matrix)
        self.snes.setFromOptions()
        self.facts = {"cells": cells, "dofs": W.dofmap.index_map.size_local * W.dofmap.index_map_bs}

    def residual(self, _, x, f):
        begin = time.perf_counter()
        x.copy(self.state.vector)
        with f.localForm() as local:
            local.set(0)
        fem.petsc.assemble_vector(f, self.residual_form)
        fem.set_bc(f.array_w, self.conditions, x.array_r, -1.0)
        self.seconds["residual"] += time.perf_counter() - begin

    def jacobian(self, _, x, __, matrix):
        begin = time.perf_counter()
        x.copy(self.state.vector)
        matrix.zeroEntries()
        fem.petsc.assemble_matrix(matrix, self.jacobian_form, self.conditions)
        matrix.assemble()
        self.seconds["jacobian"] += time.perf_counter() - begin

    def step(self, t):
        """Solves for time t; its Newton iterations and volume (ml)."""
        s = self.scene
        p = 0.0 if t > s["inspiration"] + 1e-9 else s["pressure"] * min(1, t / s["ramp"] if s["ramp"] > 0 else 1)
        self.airway_pressure.x.array[:] = p
        x = self.state.vector.copy()
        fem.set_bc(x.array_w, self.conditions)
        self.snes.solve(None, x)
        if self.snes.getConvergedReason() <= 0:
            sys.exit(f"peer_fenics: error: Newton failed at {t:g} s (SNES reason {self.snes.getConvergedReason()})")
        x.copy(self.state.vector)
        self.before.x.array[:] = self.state.x.array
        return self.snes.getIterationNumber(), fem.assemble_scalar(self.volume_form) / 1000, p


def main():
    begin, cpu = time.perf_counter(), time.process_time()
    scene, folder = json.loads(Path(sys.argv[1]).read_text()), Path(sys.argv[4])
    folder.mkdir(parents=True, exist_ok=True)
    breath = Breath(scene, sys.argv[2])
    seconds = breath.seconds
    seconds["setup"] = time.perf_counter() - begin - seconds["compile"]
    setup_cpu = time.process_time() - cpu - breath.compile_cpu
    newton, steps = 0, round(scene["stop"] / scene["dt"])
    with open(folder / "signals.csv", "w", newline="") as f:
        rows = csv.writer(f)
        rows.writerow(["time_s", "airway_pressure_cmH2O", "volume_ml", "newton_iterations", "wall_s"])
        rows.writerow([0, 0, 0, 0, 0])
        for i in range(1, steps + 1):
            start = time.perf_counter()
            iterations, volume, p = breath.step(i * scene["dt"])
            newton += iterations
            rows.writerow([f"{i * scene['dt']:.12g}", f"{p / 0.0980665:.12g}", f"{volume:.15g}", iterations,
                           f"{time.perf_counter() - start:.3f}"])
            f.flush()
            print(f"{i * scene['dt']:8.4f} s  Newton {iterations:2d}  V {volume:10.4f} ml", flush=True)
    seconds["total"] = time.perf_counter() - begin - seconds["compile"]
    seconds["solve"] = seconds["total"] - seconds["setup"] - seconds["residual"] - seconds["jacobian"]
    seconds["output"] = 0.0
    summary = {"finished": True, "steps": steps, "rejected_steps": 0, "newton_iterations": newton,
               "krylov_iterations": newton, "wall_seconds": seconds,
               "cpu_seconds": time.process_time() - cpu - breath.compile_cpu, "setup_cpu_seconds": setup_cpu,
               "dolfinx": dolfinx.__version__, **breath.facts}
    (folder / "summary.json").write_text(json.dumps(summary, indent=1))


if __name__ == "__main__":
    main()
