"""Hard cases of load and time: jumps, floods, long and tiny steps, extreme springs, scaled lungs, a thousand breaths."""
import threading
from pathlib import Path

import numpy as np

from .lab import case, case_meshes, pulmo, resident
from .laws import inflated

REUSE = pulmo.options_file("solvers/reuse.opts")
ITERATIVE = pulmo.options_file("solvers/iterative.opts")
ITERATIVE_FLAT = pulmo.options_file("solvers/iterative_flat.opts")
# bytes that a step leaves in memory: SignalRow, EnergyBalance with six accounts, and RegionState with one region (vectors of their own)
ROW = 152 + (48 + 64) + (24 + 48)


def static_limit(lab, law):
    """The largest gas pressure that the lung on its springs holds, cmH2O: where the pressure of a slow inflation by volume turns."""
    run = lab.run(pulmo.DIRECT + pulmo.SCENE + pulmo.LUNG + ["-tissue", law] + pulmo.STILL + pulmo.programme("inflation 1 flow 3000"))
    pressure = run.signals(run.signals_file)["airway_pressure_cmH2O"]
    lab.below(f"{law}: pressure falls behind the largest under flow control without airflow (cmH2O)", pressure[-1], pressure.max())
    return pressure.max()


def beyond(lab, name, run, limit):
    """A run that may stop, but only where no equilibrium is left: past the largest pressure that the lung holds at rest. Gas that
    still flows may bring it through."""
    largest = run.signals(run.signals_file)["airway_pressure_cmH2O"].max()
    lab.demand(f"{name}: finishes, or stops beyond the largest pressure that has an equilibrium (cmH2O)",
               "finished" if run.finished else f"stopped, {largest:.6g}", f"finished, or > {limit:.6g}", run.finished or largest > limit)


@case("A jump to 40 cmH2O", "pressure reaches 40 cmH2O by the end of the first 50 ms, cut or not; V beside rest (small), order 1 of V in the step; without airflow "
      "CM4 stops at the limit that flow control shows",
      "the lung, the other four laws, -lumen_pressure, halved steps, the limit")
def jump(lab):
    """The whole pressure meets a lung at rest in its first step (50 ms): no equilibrium is near the start of Newton's method.
    A step that has to be cut takes a share of the jump only, a linear rise within the 50 ms (docs/ventilator.md). CM4 has no
    equilibrium at 40 cmH2O: flow control shows that the lung on its springs holds half of it."""
    def jumped(name, run):
        rows = run.signals()
        lab.below(f"{name}: pressure beside a rise within the first 50 ms, cut or not (cmH2O)",
                  np.abs(rows["airway_pressure_cmH2O"] - 40 * np.minimum(1, rows["time_s"] / 0.05)).max(), 1e-9)

    if lab.small:
        cube = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-tissue", "rausch", "-ventilator_pip", 40, "-airflow_permeability", 1e4]
        once = lab.finished(cube + ["-ventilator_ramp", 0, "-ts_max_time", 0.3], "rausch on a cube")
        still = lab.finished(cube + ["-ventilator_ramp", 0.3, "-ts_max_time", 0.3, "-airflow", "off"], "at rest")
        if once:
            jumped("rausch on a cube", once)
        if once and still:
            lab.within("V beside that at rest (ml)", once.signals()["volume_ml"][-1], still.signals()["volume_ml"][-1], 1e-6)
        return
    def scene(law, pip=40):
        return pulmo.DIRECT + pulmo.PCV + pulmo.LUNG + ["-ventilator_pip", pip, "-tissue", law]

    for law, wall in (("berger", True), ("ma", True), ("birzle", True), ("rausch", False)):
        name = law + (" with -lumen_pressure" if wall else "")
        at_once = scene(law) + ["-lumen_pressure"] * wall + ["-ventilator_ramp", 0, "-ts_max_time", 0.3]
        volumes = []
        for dt in (0.05, 0.025, 0.0125):
            run = lab.finished(at_once + ["-ts_dt", dt], f"{name}, Δt {dt} s")
            if run is None:
                break
            volumes.append(run.signals()["volume_ml"][-1])
            if dt == 0.05:
                jumped(name, run)
        if len(volumes) == 3:
            a, b, c = volumes
            lab.above(f"{name}: order in Δt of V after 0.3 s ({a:.1f}, {b:.1f}, {c:.1f} ml; backward Euler's: 1)",
                      np.log2((b - a) / (c - b)), 0.7)
    limit = static_limit(lab, "yoshihara")
    still = lab.stopped(scene("yoshihara") + pulmo.STILL + ["-ventilator_ramp", 1, "-ts_max_time", 1],
                        "a limit point. There is no equilibrium above ", what="yoshihara, 40 cmH2O in 1 s without airflow")
    if still:
        lab.within("yoshihara: last pressure held beside the largest under flow control (cmH2O)",
                   still.signals(still.signals_file)["airway_pressure_cmH2O"][-1], limit, 0.02)
    for wall in (False, True):
        beyond(lab, "yoshihara" + " with -lumen_pressure" * wall,
               lab.run(scene("yoshihara") + ["-lumen_pressure"] * wall + ["-ventilator_ramp", 0, "-ts_max_time", 0.3]), limit)


@case("Square flow of 500 ml in 50 ms", "the volume set is in, to 10⁻⁹; CM4 may stop beyond the pressure that has an equilibrium",
      "the lung (a cube instead, where CM4 takes it), CM2 and CM3, the smaller step")
def flood(lab):
    """10 l/s through an airway of 7 cm² into a lung of 1350 ml, in one step or in ten: twenty times the usual flow."""
    mesh = ["-dm_plex_filename", pulmo.mesh("cube_lung.msh"), "-mesh_scale", 11] if lab.small else pulmo.LUNG
    largest, limit = {}, None if lab.small else static_limit(lab, "yoshihara")
    for law, dt in [("yoshihara", 0.05)] if lab.small else [("ma", 0.05), ("birzle", 0.05), ("yoshihara", 0.05), ("yoshihara", 0.005)]:
        run = lab.run(pulmo.DIRECT + pulmo.VCV + mesh + [
            "-tissue", law, "-ventilator_inspiration", 0.05, "-ts_dt", dt, "-ts_max_time", 0.1, "-lumen_pressure"])
        if law == "yoshihara" and not lab.small:
            beyond(lab, f"{law}, Δt {dt} s", run, limit)
        else:
            lab.demand(f"{law}, Δt {dt} s", "finished" if run.finished else f"stopped: {run.sentence}", "finished", run.finished)
        rows = run.signals(run.signals_file)
        largest[law, dt] = rows["airway_pressure_cmH2O"].max()
        if rows["time_s"][-1] > 0.05 - 1e-9:
            at = int(np.abs(rows["time_s"] - 0.05).argmin())
            lab.within(f"volume in after 50 ms, {law}, Δt {dt} s (ml)", rows["volume_ml"][at], 500, 1e-9)
    if not lab.small:
        lab.within("largest pressure, yoshihara, first step 50 ms beside 5 ms (cmH2O)", largest["yoshihara", 0.05], largest["yoshihara", 0.005], 0.01)


@case("Time steps from 10⁻⁵ to 1 s", "first order in Δt; the volume at rest, to 10⁻⁶", "Δt = 10⁻⁵ s")
def steps(lab):
    """The mass balance is ill conditioned for tiny steps (the flow hides behind storage) and stiff for long ones."""
    lung = pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-tissue", "yoshihara", "-airflow_permeability", 30, "-ventilator_ramp", 0.01]
    ladder = [1e-4, 5e-4, 2.5e-3] if lab.small else [1e-5, 1e-4, 1e-3]
    volumes = []
    for dt in ladder:
        run = lab.finished(lung + ["-ts_dt", dt, "-ts_max_time", 0.01, "-output_fields_every", 1], f"Δt {dt} s")
        volumes.append(run.signals()["volume_ml"][-1] if run else np.nan)
    ratio = ladder[1] / ladder[0]
    a, b, c = volumes
    order = np.log((c - b) / (b - a)) / np.log(ratio)
    lab.within("order in Δt of V(10 ms), backward Euler's", order, 1, 0.15)
    still = lab.finished(lung + ["-airflow", "off", "-ventilator_ramp", 0.5, "-ts_max_time", 1], "at rest")
    for dt in (0.05, 1):
        run = lab.finished(lung + ["-ts_dt", dt, "-ventilator_inspiration", 20, "-ts_max_time", 20], f"Δt {dt} s to rest")
        if run and still:
            lab.within(f"V after 20 s at Δt {dt} s beside that at rest (ml)", run.signals()["volume_ml"][-1],
                       still.signals()["volume_ml"][-1], 1e-6)


@case("Springs: K_s = 0 and K_s = 10⁴ kPa/mm", "free motions refused; closed forms without springs and for stiff ones; Krylov count",
      "the lung (a cube instead)")
def springs(lab):
    """Without springs six rigid motions are free; with springs of 10⁵ times the usual stiffness the surface rows outweigh the
    tissue's by six decades."""
    lung = pulmo.LUNG if not lab.small else pulmo.CUBE
    refused = lab.run(pulmo.DIRECT + pulmo.PCV + lung + ["-chest_wall_stiffness", 0])
    lab.true("K_s = 0 with nothing else to hold the lung is refused in a sentence",
             not refused.finished and "nothing holds the lung" in refused.err)
    still = pulmo.DIRECT + pulmo.PCV + lung + ["-tissue", "yoshihara", "-airflow", "off", "-ventilator_ramp", 1,
                                               "-ventilator_pip", 6, "-ts_max_time", 1]
    free = lab.finished(still + ["-chest_wall", "off"] + pulmo.PINS, "K_s = 0 on pins")
    if free:
        J = inflated("yoshihara", 6, 1, 2)
        V0 = free.json()["reference_volume_ml"]
        lab.within("V on pins (ml)", free.signals()["volume_ml"][-1], (J - 1) * V0, 1e-8)
    volumes = {}
    for K in (1e2, 1e3, 1e4):
        run = lab.finished(still + ["-chest_wall_stiffness", K], f"K_s {K:g}")
        if run:
            volumes[K] = run.signals()["volume_ml"][-1]
            area = run.json()["surface_area_mm2"]
    if len(volumes) == 3:
        lab.below("V(K_s = 10⁴) over a rigid piston's p A/K_s", volumes[1e4] / (6 * pulmo.KPA_PER_CMH2O * area / 1e4 / 1000), 1)
        a, b, c = (K * volume for K, volume in volumes.items())
        lab.within("K_s V tends to a limit as 1/K_s: ratio of its changes over two decades", (b - a) / (c - b), 10, 0.3)
    iterative = lab.finished(ITERATIVE + still[2:] + ["-chest_wall_stiffness", 1e4, "-airflow", "on"], "K_s 10⁴, iterative.opts")
    if iterative:
        numbers = iterative.json()
        lab.below("Krylov per Newton iteration", numbers["krylov_iterations"] / numbers["newton_iterations"], 30)


def breath(name, size, more):
    """VCV and PCV options of a lung `size` times as large, all else scaled so that the waveforms are the same."""
    common = ["-airflow_permeability", 1e4 * size**2, "-chest_wall_stiffness", 0.08 / size, "-ts_max_time", 0.3] + more
    if name == "vcv":
        return pulmo.VCV + ["-ventilator_tidal_volume", 250 * size**3] + common
    return pulmo.PCV + common


@case("The same lung as a mouse's (0.1), three times as large, and in metres", "P, V/size³ and J the same to 10⁻¹⁰, Newton and Krylov counts",
      "the lung (a cube instead)")
def scales(lab):
    """Dimensional slips and absolute tolerances show: with k ∝ size² and K_s ∝ 1/size the problem is the same, so are
    iteration counts, pressures, J, and volumes over size³."""
    mesh = "cube_lung.msh" if lab.small else "lung_test.msh"
    base = 10 if lab.small else 1  # the cube as a litre
    for kind in ("pcv", "vcv"):
        for solver, file in (("direct", pulmo.DIRECT), ("iterative", ITERATIVE)):
            def run(size, mesh_options):
                return lab.finished(file + mesh_options + breath(kind, size, []), f"{kind}, {solver}, size {size}")
            one = run(1, case_meshes.scaled(mesh, base))
            if one is None:
                continue
            reference, counts = one.signals(), one.json()
            for size, options in ((0.1, case_meshes.scaled(mesh, 0.1 * base)), (3, case_meshes.scaled(mesh, 3 * base)),
                                  (1, case_meshes.scaled(mesh, base / 1000) + ["-mesh_scale", 1000])):
                name = "in metres" if size == 1 else f"× {size}"
                other = run(size, options)
                if other is None:
                    continue
                rows, numbers = other.signals(), other.json()
                same = len(rows["time_s"]) == len(reference["time_s"])
                worst = max(np.abs(rows[c] / scale - reference[c]).max() / np.abs(reference[c]).max() for c, scale in (
                    ("airway_pressure_cmH2O", 1), ("volume_ml", size**3), ("min_J", 1))) if same else np.inf
                lab.below(f"{kind}, {solver}, {name}: largest relative difference of P, V, J", worst,
                          1e-10 if solver == "direct" else 1e-6)
                # no power of two: rounding may tip a step at the tolerance
                newton, krylov = (abs(numbers[key] - counts[key]) for key in ("newton_iterations", "krylov_iterations"))
                lab.demand(f"{kind}, {solver}, {name}: Newton and Krylov iterations",
                           f"{numbers['newton_iterations']}, {numbers['krylov_iterations']}",
                           f"{counts['newton_iterations']} ± 1, {counts['krylov_iterations']} ± 2 %",
                           newton <= 1 and krylov <= 0.02 * counts["krylov_iterations"])


@case("Two lungs on springs of very different stiffness, one windpipe", "the volume set; each alone under the pressure found takes what it took",
      "uniform flow, iterative.opts")
def two_lungs(lab):
    """With springs a million times apart the stiff lung only opens at its airway and inwards, and strains a sixth of the soft one:
    a bordered Newton step with a poor pressure would push all the gas into the wrong one."""
    K = {"stiff": 1e2, "soft": 1e-4}
    files = {names: case_meshes.bodies(*names) for names in (("stiff", "soft"), ("stiff",), ("soft",))}

    def scene(*names):
        held = ["-chest_wall_surfaces", ",".join(names)]
        for name in names:
            held += [f"-chest_wall_stiffness_{name}", K[name]]
        return pulmo.TIGHT + pulmo.SCENE + held + files[names] + ["-airflow_permeability", 2e3]

    both = lab.finished(scene("stiff", "soft") + pulmo.FLOW_OF_TWO + pulmo.COMMON, "common pressure")
    if both is None:
        return
    rows = both.signals()
    lab.within("volume in (ml)", rows["volume_ml"].max(), 40, 1e-9)
    alone = {name: lab.finished(scene(name) + pulmo.replay(rows), f"{name} alone") for name in K}
    if all(alone.values()):
        volume = {name: run.signals()["volume_ml"] for name, run in alone.items()}
        lab.below("each alone under the pressure found: sum of volumes − both (ml)",
                  np.abs(volume["stiff"] + volume["soft"] - rows["volume_ml"]).max(), 4e-8)
        strain = {name: v.max() / {"stiff": 125, "soft": 64}[name] for name, v in volume.items()}
        lab.above("strain of the soft lung over that of the stiff", strain["soft"] / strain["stiff"], 5)
    for name, options in {} if lab.small else {"uniform": pulmo.UNIFORM, "iterative": pulmo.COMMON}.items():
        more = ITERATIVE[1:] if name == "iterative" else []
        run = lab.finished(scene("stiff", "soft") + (["-options_file"] + more if more else []) +
                           pulmo.FLOW_OF_TWO + options, name)
        if run:
            lab.within(f"volume in, {name} (ml)", run.signals()["volume_ml"].max(), 40, 1e-9)


@case("A thousand breaths", "no drift of volumes to 10⁻⁸ V0; mass and energy balance of the whole run; memory: the rows of the signals and no more",
      "970 breaths, memory")
def breaths(lab):
    """What leaks or drifts a little per breath adds up: volume, memory, the clock of the phases. Newton's tolerance is 10⁻¹²
    here, so that its own sum stays below what is asked: with the 10⁻⁸ of reuse.opts 30 breaths lose 1.4·10⁻⁷ V0 of mass balance."""
    count = 30 if lab.small else 1000
    scene = REUSE + ["-snes_rtol", 1e-12, "-snes_atol", 1e-12] + pulmo.SCENE + pulmo.CUBE + ["-airflow_permeability", 1e3, "-ts_dt", 0.5, "-output_fields_every", 1e9] + \
        pulmo.programme(f"repeat {count}\n inspiration 0.5 pressure 6\n expiration 2 pressure 0\nend\n")
    samples, done = [], threading.Event()

    def watch():
        """Bytes of signals that the child of this process, which is pulmo, has written, and its memory: the end is not of the steps."""
        while not done.wait(0.05):
            pids = " ".join(path.read_text() for path in Path("/proc/self/task").glob("*/children")).split()
            for pid in pids:
                try:
                    folder = Path(f"/proc/{pid}/cmdline").read_text().split("\0")[-2]
                    samples.append(((Path(folder) / "signals.csv.part").stat().st_size, resident(pid)))
                except (OSError, IndexError):
                    pass  # it begins or ends

    watcher = threading.Thread(target=watch)
    watcher.start()
    try:
        run = lab.finished(scene, f"{count} breaths", timeout=1200)
    finally:
        done.set()
        watcher.join()
    if run is None:
        return
    rows = run.signals()
    ends = np.array([i for i, t in enumerate(rows["time_s"]) if i and abs(t / 2.5 - round(t / 2.5)) < 1e-9])
    lab.demand("breaths that ended on time", len(ends), str(count), len(ends) == count)
    V0 = run.json()["reference_volume_ml"]
    volume = rows["volume_ml"][ends]
    lab.below("drift of the end-expiratory volume over V0", np.abs(volume[5:] - volume[5]).max() / V0, 1e-8)
    peaks = np.array([breath.max() for breath in np.split(rows["volume_ml"], ends)[:len(ends)]])
    lab.below("drift of the peak volume over V0", np.abs(peaks[5:] - peaks[5]).max() / V0, 1e-8)
    lab.below("mass balance over V0, largest sum over the run", run.json()["mass_balance_error_ml"] / V0, 1e-8)
    lab.below("energy balance, residual over work", run.json()["energy_j"]["residual_relative"], 1e-7)
    if lab.small:
        return
    written, sizes = np.array(samples, float).reshape(-1, 2).T
    written /= Path(run.path("signals.csv")).stat().st_size
    early, late = ((low < written) & (written < low + 0.1) for low in (0.1, 0.8))
    enough = min(early.sum(), late.sum())
    lab.above("samples of its memory in the second and in the ninth tenth of the steps", enough, 9)
    if enough:
        gained = (np.median(sizes[late]) - np.median(sizes[early])) / (0.7 * run.json()["steps"])
        # kept until the end, for summary.json and for checkpoints: a row of signals, energy and regions per step
        lab.demand("memory gained per step between them (bytes)", float(gained), f"< {ROW} (the row kept of each step) + 250",
                   gained < ROW + 250)


@case("A wall that turns", "energy balance with the work of turning; 2 ranks do the same; a sphere's free turns are told; the other directions end elsewhere",
      "three directions on the sphere")
def turning_wall(lab):
    """A shell on springs along its current normal that stiffen 20 times on the way, dragged aside by a load that turns in time
    while the wall pulls and 12 cmH2O come at once: every facet turns and slides, and nothing but the facets holds the shell's own turns."""
    mesh = pulmo.CUBE if lab.small else ["-dm_plex_filename", pulmo.mesh("hollow_sphere.msh"), "-elements", "P1-P1"]
    stiffening, load = (10, 0.02) if lab.small else (1, 0.05)
    scene = pulmo.DIRECT + pulmo.SCENE + mesh + ["-airflow_permeability", 1e4, "-lumen_pressure", "on", "-ts_dt", 0.05, "-ts_max_time", 0.5,
        "-ventilator", "pcv", "-ventilator_pip", 12, "-ventilator_ramp", 0, "-ventilator_settle", "off", "-chest_wall_surfaces", "pleura",
        "-chest_wall_stiffening", stiffening, "-chest_wall_offset", 5, "-traction", "-traction_surfaces", "pleura",
        "-traction_value", f"{load}*cos(2*pi*t),{load}*sin(2*pi*t),1e-4*x"]
    wall = scene + ["-chest_wall_direction", "current_normal"]
    run = lab.finished(wall, "turns")
    two = lab.finished(wall, "the same on 2 ranks", ranks=2)
    other = lab.finished(scene + ["-chest_wall_direction", "full"], "springs in full")
    if run is None or two is None or other is None:
        return
    energy = run.json()["energy_j"]
    lab.below("energy balance, residual over work", energy["residual_relative"], 1e-6)
    lab.above("work of turning (J, absolute)", abs(energy["turning_springs"]), 1e-12)
    volume, rest = run.signals()["volume_ml"], run.json()["reference_volume_ml"]
    lab.below("2 ranks: volume beside that of one, over that at rest", np.abs(two.signals()["volume_ml"] - volume).max() / rest, 1e-7)
    lab.above("springs in full: difference of the last volume, over that at rest", abs(other.signals()["volume_ml"][-1] - volume[-1]) / rest, 1e-4)
    if not lab.small:
        lab.true("the turns that only facets hold are told", "barely against rotation" in run.out + run.err)


@case("A jump of pressure meets mass", "volume at rest beside that without mass; at no time more energy than was given; energy balance; steps of 10 µs", "the lung")
def blow(lab):
    """Inertia makes waves of what elsewhere is at rest at once: a jump of pressure sets all modes of the mesh swinging, the fastest of them thousands of times a
    second, and in steps of 10 µs the mass outweighs the tissue. A scheme that is not stable for all of them gains energy and blows up."""
    mass = ["-inertia", "-tissue_porosity", 0.75]
    lung = pulmo.DIRECT + pulmo.PCV + (pulmo.LITRE if lab.small else pulmo.LUNG) + pulmo.STILL + [
        "-elements", "P1-P1", "-ventilator_pip", 5, "-ventilator_ramp", 0]
    still = lab.finished(lung + ["-ts_max_time", 0.1], "without mass")
    for dt, end in ((0.02, 3), (1e-3, 0.04)) if lab.small else ((0.02, 3), (1e-3, 0.2), (1e-5, 4e-4)):
        run = lab.finished(lung + mass + ["-ts_dt", dt, "-ts_max_time", end, "-ventilator_inspiration", end], f"Δt {dt:g} s")
        if run is None:
            continue
        energy = run.signals("energy.csv")
        kept = sum(energy[name + "_j"] for name in ("kinetic", "elastic_tissue", "elastic_springs"))
        given = energy["ventilator_work_j"] + energy["external_j"]
        lab.below(f"Δt {dt:g} s: energy kept beyond what was given, over the largest given", (kept - given).max() / given.max(), 1e-9)
        lab.above(f"Δt {dt:g} s: least kinetic energy over the largest", energy["kinetic_j"].min() / energy["kinetic_j"].max(), -1e-9)
        lab.below(f"Δt {dt:g} s: energy balance, residual over work", run.json()["energy_j"]["residual_relative"], 1e-6)
        if dt == 0.02 and still:
            lab.within("volume after 3 s beside that without mass (ml)", run.signals()["volume_ml"][-1], still.signals()["volume_ml"][-1], 1e-6)
        if dt == 1e-3:
            lab.below("Δt 1e-3 s: the lung starts slowly, volume after the first step over that at rest",
                      run.signals()["volume_ml"][1] / still.signals()["volume_ml"][-1], 0.2)


@case("Efforts that flutter", "each phase ends with the first row that meets its condition, or on time; energy balance; 2 ranks do the same")
def flutter(lab):
    """Five efforts a second that rise and fall within a step or two, a trigger that 0.001 ml/s meets, an inspiration that ends soon: phases
    of a few steps, each of which begins with a jump of pressure and moves all that follow."""
    scene = pulmo.DIRECT + pulmo.SCENE + pulmo.LITRE + ["-airflow_permeability", 1e4, "-lumen_pressure", "on", "-ts_dt", 0.02,
        "-breathing_effort", "-breathing_effort_pressure", 6, "-breathing_effort_rise", 0.03, "-breathing_effort_hold", 0.02,
        "-breathing_effort_fall", 0.03, "-breathing_effort_period", 0.2] + pulmo.programme(
        f"repeat {5 if lab.small else 8}\n inspiration 1 pressure 5 cycle 50\n expiration 0.5 pressure 0 trigger 0.001\nend\n")
    run, two = lab.finished(scene, "flutters"), lab.finished(scene, "the same on 2 ranks", ranks=2)
    if run is None or two is None:
        return
    rows = run.signals()
    time, flow, names = rows["time_s"], rows["flow_ml_per_s"], rows["phase"]
    ends = [i for i in range(1, len(names)) if i + 1 == len(names) or names[i + 1] != names[i]]
    late = short = 0
    for begin, end in zip([0] + ends, ends):
        q = flow[begin + 1:end + 1]
        met = q < 0.5 * np.maximum.accumulate(np.maximum(q, 0)) if names[end] == "inspiration" else q > 0.001
        late += met[:-1].any()
        longest = 1 if names[end] == "inspiration" else 0.5
        short += not met[-1] and abs(time[end] - time[begin] - longest) > 1e-9
    lab.above("phases", len(ends), 9)
    lab.demand("phases that went on though their condition was met", int(late), "0", late == 0)
    lab.demand("phases that ended without reason", int(short), "0", short == 0)
    lab.true("2 ranks: the same phases", two.signals()["phase"] == names)
    lab.below("2 ranks: volume beside that of one, over that at rest",
              np.abs(two.signals()["volume_ml"] - rows["volume_ml"]).max() / run.json()["reference_volume_ml"], 1e-7)
    lab.below("energy balance, residual over work", run.json()["energy_j"]["residual_relative"], 1e-7)
