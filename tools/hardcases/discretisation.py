"""Hard cases of mesh and coefficients: permeabilities far apart, incompressible response, bad cells."""
import json
import subprocess

import numpy as np
import scipy.sparse as sp
from scipy.sparse.linalg import spsolve

from . import meshes
from .lab import case, case_meshes, pulmo
from .laws import inflated
from .loads import ITERATIVE, ITERATIVE_FLAT

C, BETA = 1.298, 0.75  # Yoshihara's law
MODULUS = 2 * C * (1 + (2 * BETA + 1))  # W'' of uniaxial strain at rest, kPa
LOAD = 1e-4  # kPa: strains of 1e-5


def column(mesh, sides, k, dt, end, solver=pulmo.TIGHT, load=LOAD):
    """A column on rollers, drained and loaded at x1, sealed at x0 (Terzaghi)."""
    rollers = ["-support", "-support_surfaces", ",".join(["x0", *sides])] + ["-support_components_x0", "x"]
    for side in sides:
        rollers += [f"-support_components_{side}", "y" if "y" in side else "z"]
    return solver + mesh + rollers + ["-tissue", "yoshihara", "-airflow", "-airflow_surfaces", "x1", "-airflow_permeability", k,
                                      "-traction", "-traction_surfaces", "x1", "-traction_value", f"{-load},0,0",
                                      "-ts_dt", dt, "-ts_max_time", end]


BOX_SIDES = ["y0", "y1", "z0", "z1"]
COLUMN = (["-dm_plex_filename", pulmo.mesh("column.msh"), "-mesh_scale", 100], ["sides_y", "sides_z"])


def first_step(x, length, k, dt):
    """p/p0 after one step of backward Euler from rest: 1 − cosh(x/l)/cosh(L/l), l² = c_v Δt; small strains."""
    layer = np.sqrt(k * MODULUS * dt)
    return 1 - np.exp((x - length) / layer) * (1 + np.exp(-2 * x / layer)) / (1 + np.exp(-2 * length / layer))


def mass(x, cells):
    """Volumes of the cells and P1's mass matrix."""
    corners = x[cells]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    return volume, matrix(volume[:, None, None] * (np.ones((4, 4)) + np.eye(4)) / 20, cells, len(x))


def matrix(local, cells, n):
    rows, columns = np.repeat(cells, 4, axis=1).ravel(), np.tile(cells, 4).ravel()
    return sp.coo_matrix((local.ravel(), (rows, columns)), shape=(n, n)).tocsr()


def inner_solution(A, load, cells, drained):
    """x of A x = load with x = 0 at the drained nodes."""
    inner = ~drained & np.isin(np.arange(len(load)), cells)
    p = np.zeros(len(load))
    p[inner] = spsolve(A[inner][:, inner].tocsc(), load[inner])
    return p


def projected(x, cells, drained):
    """P1 projection (L2) of p/p0 = 1 with p = 0 at the drained nodes: what the mesh can show of a layer without thickness."""
    volume, M = mass(x, cells)
    return inner_solution(M, np.bincount(cells.ravel(), np.repeat(volume / 4, 4), minlength=len(x)), cells, drained)


def pressure_alone(x, cells, drained, c_dt):
    """p/p0 after the first step by P1 elements with the displacement eliminated, p − c_v Δt Δp = p0: of all P1 functions on
    this mesh the nearest to the closed form in the norm of that equation."""
    volume, M = mass(x, cells)
    inverse = np.linalg.inv(x[cells[:, 1:]] - x[cells[:, :1]])
    slopes = np.concatenate([-inverse.sum(axis=2)[:, :, None], inverse], axis=2)
    A = M + c_dt * matrix(volume[:, None, None] * np.einsum("cdi,cdj->cij", slopes, slopes), cells, len(x))
    return inner_solution(A, M @ np.isin(np.arange(len(x)), cells), cells, drained)


def pressures(run):
    """Vertices' coordinates, p over the load, corners of the cells and the vertices' numbers."""
    x, cells, values = pulmo.fields(run)
    corners = cells[:, :4]
    vertices = np.unique(corners)
    return x, values["alveolar_pressure_cmH2O"] * pulmo.KPA_PER_CMH2O / LOAD, corners, vertices


@case("Very low permeability: 10⁴ to 10⁻⁶, first step far below h²/(6 c_v)",
      "the first step's closed form away from the layer; at every k no overshoot beyond the projection of the jump; with damping none above 1.27",
      "eight permeabilities, iterative.opts")
def tight(lab):
    """The layer that drains in the first step is thinner than a cell. P2–P1 is inf-sup stable, so the pressure stays
    bounded, but a jump that the mesh cannot show leaves oscillations beside it (Vermeer & Verruijt 1981)."""
    length, h, dt = 100.0, 4.5, 0.05  # mm, mm, s
    errors = {}
    for damped in ("", " damped"):
        overshoots = []
        for e in [4, 0, -6] if lab.small else range(4, -7, -1):
            k = 10.0**e
            flags = ["-pressure_damping", "-pressure_damping_modulus", MODULUS] if damped else []
            run = lab.finished(column(*COLUMN, k, dt, dt) + flags, f"k = 1e{e}{damped}")
            if run is None:
                continue
            x, p, corners, vertices = pressures(run)
            exact = first_step(x[:, 0], length, k, dt)
            overshoots.append([dt * k * MODULUS * 6 / h**2, p[vertices].max(), p[vertices].min()])
            errors[e, damped] = np.sqrt(np.mean((p - exact)[vertices] ** 2))
            far = vertices[x[vertices, 0] < length - 4 * h]
            if not damped and e in (4, 0, -6):
                lab.below(f"k = 1e{e}: |p − closed form|/p0 beyond 4 h from the drained end", np.abs(p - exact)[far].max(), 0.01)
            if e != -6:
                continue
            lab.above(f"k = 1e-6{damped}: least p/p0", p[vertices].min(), -1e-9)
            if not damped:
                jump = projected(x, corners, np.abs(x[:, 0] - length) < 1e-6)[vertices].max()
                lab.within("k = 1e-6: largest p/p0 beside that of the P1 projection of the jump (the mesh's, no instability)",
                           p[vertices].max(), jump, 0.01)
            order = vertices[np.argsort(x[vertices, 0])]
            lab.curves["profile" + damped] = [x[order, 0].tolist(), p[order].tolist()]
        lab.curves["overshoot" + damped] = overshoots
        if overshoots:
            _, high, low = np.array(overshoots).T
            if damped:
                lab.below("all k damped: largest p/p0 (1.27: P1 in one dimension)", high.max(), 1.27)
            else:  # beyond 1.27 on this mesh: that is what the damping is for
                lab.below(f"all k: largest p/p0, {high.max():.4g}, over that of the projected jump", high.max() / jump, 1.01)
            lab.above(f"all k{damped}: least p/p0", low.min(), -1e-6)
    for name, flags in (("", []), (" damped", ["-pressure_damping", "-pressure_damping_modulus", MODULUS])):
        run = lab.finished(column(*COLUMN, 1e-6, dt, dt) + ["-elements", "P1-P1", *flags], f"P1-P1, k = 1e-6{name}")
        if run is None:
            continue
        x, p, _, vertices = pressures(run)
        far = np.abs(p - 1)[vertices[x[vertices, 0] < length - 4 * h]].max()
        if name:
            lab.below("P1-P1, k = 1e-6 damped: |p − closed form|/p0 beyond 4 h", far, 0.01)
            lab.below("P1-P1, k = 1e-6 damped with h²/(4M): largest p/p0 (h²/(6M) would leave 1.10)", p[vertices].max(), 1.05)
            lab.above("P1-P1, k = 1e-6 damped: least p/p0", p[vertices].min(), -1e-6)
        else:
            lab.above("P1-P1, k = 1e-6 undamped, which has no inf-sup condition: |p − closed form|/p0 beyond 4 h", far, 0.1)
            lab.above("a warning of it (1: given)", float("-elements P1-P1 is not stable" in run.out), 0.5)
    if (-6, " damped") in errors and (4, " damped") in errors:
        lab.below("k = 1e-6: rms error of p with -pressure_damping over that without", errors[-6, " damped"] / errors[-6, ""], 1)
        lab.below(f"its cost at k = 1e4: rms error of p/p0 with it (without: {errors[4, '']:.3g})", errors[4, " damped"], 1e-3)
    if not lab.small:
        breath = pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + ["-ts_max_time", 0.5]
        plain, damped = lab.finished(breath, "breath"), lab.finished(breath + ["-pressure_damping"], "breath, damped")
        if plain and damped:
            a, b = plain.signals()["volume_ml"], damped.signals()["volume_ml"]
            lab.below("its cost in a usual breath (k = 1e4, cells of 20 mm): largest change of V over the largest V",
                      np.abs(a - b).max() / a.max(), 0.01)
    for name, scene, flags in (("pressure control", pulmo.PCV, []), ("volume control", pulmo.VCV, ["-ventilator_tidal_volume", 0.2])):
        for file in [pulmo.DIRECT] if lab.small else [pulmo.DIRECT, ITERATIVE]:
            run = lab.finished(file + scene + pulmo.LUNG + flags + ["-tissue", "yoshihara", "-airflow_permeability", 1e-6,
                                                                   "-ts_max_time", 0.2, "-lumen_pressure"], f"lung, {name}")
            if run:
                lab.below(f"lung under {name}, {'direct' if file is pulmo.DIRECT else 'iterative'}: mass balance (ml)",
                          run.json()["mass_balance_error_ml"], 1e-6)


@case("Very high permeability: 10¹⁰", "the lung without airflow, as 1/k; no step cut; Krylov count",
      "volume control")
def open_tissue(lab):
    """The pressure is uniform to 10 digits: the flux is a large number times a small gradient."""
    controls = [("pressure control", pulmo.PCV, [])]
    if not lab.small:
        controls.append(("volume control", pulmo.VCV, pulmo.COMMON + ["-ventilator_tidal_volume", 250]))
    for name, scene, flags in controls:
        base = scene + pulmo.LUNG + flags + ["-tissue", "yoshihara", "-ts_max_time", 0.3]
        still = lab.finished(pulmo.DIRECT + base + ["-airflow", "off"], "no airflow")
        gaps = {}
        for k in (1e8, 1e10):
            run = lab.finished(pulmo.DIRECT + base + ["-airflow_permeability", k], f"k {k:g}")
            if run and still:
                cut = run.json()["rejected_steps"]
                lab.demand(f"{name}, k = {k:g}: steps cut", cut, "0", cut == 0)
                column_name = "volume_ml" if scene is pulmo.PCV else "airway_pressure_cmH2O"
                mine, other = run.signals(), still.signals()
                both = [(i, j) for i, t in enumerate(mine["time_s"]) for j in np.flatnonzero(np.abs(other["time_s"] - t) < 1e-9)]
                a, b = (rows[column_name][list(at)] for rows, at in zip((mine, other), zip(*both)))
                gaps[k] = np.abs(a - b).max() / np.abs(b).max()
        if len(gaps) == 2:
            lab.below(f"{name}: difference from a lung without airflow at 1e10", gaps[1e10], 1e-5)
            lab.within(f"{name}: it falls as 1/k, from 1e8 to 1e10", gaps[1e8] / gaps[1e10], 100, 0.1)
        run = lab.finished(ITERATIVE + base + ["-airflow_permeability", 1e10], f"{name}, iterative.opts")
        if run:
            lab.below(f"{name}: Krylov per Newton iteration",
                      run.json()["krylov_iterations"] / run.json()["newton_iterations"], 15 if scene is pulmo.PCV else 30)


@case("Permeability and stiffness jumps of 10⁶ between regions", "closed forms of two halves in series")
def jumps(lab):
    """Collapsed beside open tissue: coefficients of one matrix six decades apart across one face. pulmo has no parameters by
    region yet; a test effect adds them (tests/cases/jumps.cpp)."""
    program = lab.build / "tests/cases/stability_jumps"
    if not program.exists():
        lab.demand("the test program", "not built", str(program.name), False)
        return
    run = lab.counted(lambda: subprocess.run([program], cwd=pulmo.SOURCE, env=pulmo.ENVIRONMENT, capture_output=True, text=True,
                                             timeout=300))
    for line in run.stdout.splitlines():
        if line.startswith("demand "):
            lab.demands.append(json.loads(line[7:]))
    lab.demand("all its assertions", "hold" if run.returncode == 0 else "fail", "hold", run.returncode == 0)


@case("Undrained limit: a beam that cannot change its volume", "Timoshenko's tip, with one cube over the height too; the tip converges with the mesh",
      "the finest mesh with its rates; of the skeleton of ν = 0.4995 Timoshenko's tip")
def undrained(lab):
    """Air that cannot leave makes the tissue incompressible: elements that lock are too stiff by factors in bending. At a clamped
    end that cannot contract Timoshenko's beam is 2 % too soft for ν = 1/2: a skeleton of ν = 0.4995 is held to the limit of the
    undrained tip, of other (mixed) elements. (Cook's membrane and its rates: tests/verification.)"""
    length, width = 10.0, 1.0
    mu, nu = 2 * C, BETA / (2 * BETA + 1)
    inertia, shear_area = width**4 / 12, 5 / 6 * width**2
    force = 1e-4  # kPa mm²: the tip moves by 0.6 % of the length at most
    counts = [(10, 1, 1), (20, 2, 2)] if lab.small else [(10, 1, 1), (20, 2, 2), (40, 4, 4)]
    tip = {}
    soft = ["-tissue", "yoshihara"]
    rigid = ["-tissue", "berger", "-tissue_mu", mu, "-tissue_lambda", 1e3 * mu, "-tissue_phi0", 1]
    gas = ["-airflow", "-airflow_surfaces", "x1", "-airflow_permeability", 1e-12]
    # where volume is 10³ times as stiff as shape the search for a smaller residual allows crawling steps only, and whole Newton
    # steps are the way
    limit = np.nan
    scenes = [("drained", soft, nu, counts), ("undrained", soft + gas, 0.5, counts),
              ("skeleton of ν = 0.4995, drained, -snes_linesearch_type basic", rigid + ["-snes_linesearch_type", "basic"],
               1e3 / (2 * (1e3 + 1)), counts[1:] if lab.small else counts)]

    def bent(law, n, load, name):
        return lab.finished(pulmo.DIRECT + meshes.box_options(n, (length, width, width)) + law + [
            "-support", "-support_surfaces", "x0", "-traction", "-traction_surfaces", "x1", "-traction_value", f"0,0,{load / width**2}",
            "-ts_dt", 1, "-ts_max_time", 1], name)

    def tip_of(run):
        x, _, values = pulmo.fields(run)
        return values["displacement_mm"].reshape(-1, 3)[np.abs(x[:, 0] - length) < 1e-9, 2].mean()

    for name, law, poisson, meshes_of in scenes:
        E = 2 * mu * (1 + poisson)
        exact = force * length**3 / (3 * E * inertia) + force * length / (mu * shear_area)
        for n in meshes_of:
            run = bent(law, n, force, f"{name}, {n}")
            if run:
                tip[name, n] = tip_of(run) / exact
        rigid_skeleton, three = "skeleton" in name, all((name, n) in tip for n in counts)
        if (name, counts[-1]) in tip and not (rigid_skeleton and lab.small):
            beam, expected = ("the limit of the undrained tip", limit) if rigid_skeleton else ("Timoshenko's beam", 1)
            lab.within(f"{name}: tip over {beam}, {counts[-1][0]} × {counts[-1][1]} × {counts[-1][2]} cubes",
                       tip[name, counts[-1]] / expected, 1, 0.05 if lab.small else 0.02 if rigid_skeleton else 0.03)
            lab.above(f"{name}: the same with one cube over the height", tip[name, counts[0]] / expected, 0.9)
        if not lab.small and three:
            a, b, c = (tip[name, n] for n in counts)
            lab.above(f"{name}: rate of the tip, from 1, 2 and 4 cubes over the height ({a:.4f}, {b:.4f}, {c:.4f})",
                      np.log2((b - a) / (c - b)), 1.5)
            end = c + (c - b) / ((b - a) / (c - b) - 1)  # Richardson's
            if "undrained" in name:
                limit = end
            elif rigid_skeleton:
                lab.within(f"{name}: limit of the tip over that of the undrained tip", end / limit, 1, 0.005)
        # ten times the load at once: the dead load is cut with the first step; what the mesh lacks is the same
        run = bent(law, counts[1], 10 * force, f"{name}, ten times the load") if "undrained" not in name else None
        if run and (name, counts[1]) in tip:
            lab.within(f"{name}: tip under ten times the load over ten times the tip, 20 × 2 × 2 cubes", tip_of(run) / exact / 10, tip[name, counts[1]], 0.01)


@case("Stretched cells (100 : 1), slivers, cells with all nodes on the boundary",
      "the first step's closed form within 2 % rms; order of the plates beside that of P1 elements for the pressure alone; Krylov count, of plates with iterative_flat.opts", "finer plates, 200 : 1")
def bad_cells(lab):
    """Gradients across flat cells cancel, smoothers and AMG see couplings 10⁴ apart, and a cell without an inner node has
    little freedom."""
    length, k, n = 1.0, 1 / MODULUS, 10  # c_v = 1 mm²/s
    dt = 0.05
    sliver = meshes.box((n, 3, 3), (length, 0.3, 0.3), flatten=0.93)
    facets = case_meshes.boundary(sliver[1])
    lab.below("quality of the flattest sliver (1: regular)", meshes.quality(*sliver), 1e-2)
    columns = {"cubes": meshes.box_options((n, 2, 2), (length, 0.2, 0.2)),
               "plates 100 : 1": meshes.box_options((n, 2, 2), (length, 20, 20)),
               "plates 100 : 1, finer": None if lab.small else meshes.box_options((2 * n, 4, 4), (length, 20, 20)),
               "slivers": case_meshes.write(*sliver, facets, case_meshes.faces_of_box(sliver[0], facets, (length, 0.3, 0.3))),
               "no inner node": meshes.box_options((n, 1, 1), (length, 0.1, 0.1))}
    errors = {}
    for name, mesh in columns.items():
        if mesh is None:
            continue
        flat = "plates" in name
        files = [("direct", pulmo.TIGHT), ("iterative", ITERATIVE)] + flat * [("iterative_flat", ITERATIVE_FLAT)]
        for solver, file in files:
            run = lab.finished(column(mesh, BOX_SIDES, k, dt, dt, solver=file), f"{name}, {solver}")
            if run is None:
                continue
            x, p, corners, vertices = pressures(run)
            exact = first_step(x[:, 0], length, k, dt)
            error = np.sqrt(np.mean((p - exact)[vertices] ** 2))
            errors[name, solver] = error
            alone = pressure_alone(x, corners, np.isclose(x[:, 0], length), k * MODULUS * dt)
            errors[name, "pressure alone"] = np.sqrt(np.mean((alone - exact)[vertices] ** 2))
            lab.below(f"{name}, {solver}: rms error of p/p0 against the closed form", error, 0.02)
            if solver == ("iterative_flat" if flat else "iterative"):  # the file that is made for such cells
                numbers = run.json()
                lab.below(f"{name}, {solver}: Krylov per Newton iteration", numbers["krylov_iterations"] / numbers["newton_iterations"],
                          15 if flat else 30)
    if not lab.small:
        # cells of 10 and 5 mm across a layer of 0.2 mm: the order is 1.26 for P1 elements without any displacement, too, and
        # nears 2 only with cells as small as the layer. More than these meshes can show is not asked
        names = ["plates 100 : 1", "plates 100 : 1, finer"]
        if all((name, "direct") in errors for name in names):
            orders = {by: np.log2(errors[names[0], by] / errors[names[1], by]) for by in ("direct", "pressure alone")}
            lab.within("plates: order of the rms error of p beside that of P1 elements for the pressure alone, the same mesh",
                       orders["direct"], orders["pressure alone"], 0.02)
            for name in names:
                lab.below(f"{name}: rms error of p over that of P1 elements for the pressure alone, the same mesh",
                          errors[name, "direct"] / errors[name, "pressure alone"], 1)
        for solver, file in (("iterative", ITERATIVE), ("iterative_flat", ITERATIVE_FLAT)):
            lab.finished(column(meshes.box_options((2 * n, 2, 2), (length, 20, 20)), BOX_SIDES, k, dt, dt, solver=file), f"plates 200 : 1, {solver}")
    # one cube of six cells, all nodes on its boundary
    points, tets = meshes.box((1, 1, 1), (10, 10, 10))
    facets = case_meshes.boundary(tets)
    faces = ["airway" if f == "x1" else "pleura" for f in case_meshes.faces_of_box(points, facets, (10, 10, 10))]
    run = lab.finished(pulmo.DIRECT + pulmo.PCV + case_meshes.write(points, tets, facets, faces) + [
        "-tissue", "yoshihara", "-airflow_permeability", 100, "-ts_max_time", 1], "six cells, a breath")
    if run:
        lab.below("six cells: energy balance, residual over work", run.json()["energy_j"]["residual_relative"], 1e-8)
    run = lab.finished(pulmo.DIRECT + pulmo.PAPER + pulmo.STILL + pulmo.PINS + case_meshes.write(points, tets, facets, faces) + [
        "-tissue", "yoshihara", "-ventilator", "pcv", "-ventilator_pip", 12, "-ventilator_ramp", 1, "-ts_max_time", 1], "free")
    if run:
        lab.within("six cells: J at 12 cmH2O, free", run.signals()["max_J"][-1], inflated("yoshihara", 12, 1, 2.53), 1e-7)
