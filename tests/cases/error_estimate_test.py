#!/usr/bin/python3
"""-error_estimate: error bars hold the numbers of a run far finer, on any number of ranks, and cost nothing of the run."""
import functools
import os
import shutil
import unittest

import pulmo_case as pc

# a block of 1000 ml, 24 cells, one face airway; a breath whose pressure rises and falls over 0.2 s
SCENE = (pc.BLOCK + pc.DIRECT + pc.QUIET + pc.PAPER +
         ["-tissue", "yoshihara", "-airflow", "-airflow_permeability", "100", "-airflow_surfaces", "x1", "-chest_wall",
          "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-ventilator", "pcv", "-ventilator_pip", "8", "-ventilator_inspiration", "0.8",
          "-ventilator_expiration", "0.8", "-ventilator_ramp", "0.2", "-ventilator_ramp_down", "0.2", "-energy_audit", "off"])
STEPS = ["-ts_dt", "0.05"]
ESTIMATE = ["-error_estimate", "-error_estimate_method", "runs"]
SWEEP = ["-error_estimate", "-error_estimate_method", "sweep"]
BDF2 = ["-ts_type", "bdf"]
NUMBERS = ["tidal_volume_ml", "peak_flow_ml_per_s", "peak_expiratory_flow_ml_per_s", "compliance_ml_per_cmH2O",
           "resistance_cmH2O_s_per_l", "time_constant_s", "work_j", "auto_peep_cmH2O",
           "trapped_volume_ml"]  # none is another one up to a factor


@functools.cache
def estimated(*scheme):
    """The scene's run with its bars, made once: the tests only read it."""
    return pc.finished(SCENE + STEPS + list(scheme) + ESTIMATE)


def bars(case):
    return case.json()["error_estimate"]["numbers"]


class ErrorEstimate(unittest.TestCase):
    def bracketed(self, estimate, true_run, part):
        """How many of the numbers lie within their bars of those of the true run; prints the effectivities."""
        truth, inside = true_run.json(), 0
        for key in NUMBERS:
            bar = estimate[key]
            error = abs(bar["value"] - truth[key])
            inside += bar[part] >= error
            print(f"  {key:34} {bar['value']:12.6g} error {error:9.3g} bar {bar[part]:9.3g} "
                  f"effectivity {bar[part] / error if error else float('inf'):6.3g}")
        return inside

    def test_bars_in_time(self):
        """Against steps 32 times as short with BDF2: one breath in 1024 steps."""
        fine = pc.finished(SCENE + BDF2 + ["-ts_dt", "0.0015625"])
        for name, scheme in (("backward Euler", []), ("BDF2", BDF2)):
            with self.subTest(scheme=name):
                print(f"\n{name}, 0.05 s, time:")
                self.assertGreaterEqual(self.bracketed(bars(estimated(*scheme)), fine, "time"), 0.9 * len(NUMBERS))

    def test_bars_in_space(self):
        """Against cells a quarter of the size, over two laws; steps are the same."""
        inside, laws = 0, ("birzle", "yoshihara")
        for law in laws:
            print(f"\nspace, 24 cells, {law}:")
            steps = ["-ts_dt", "0.2", "-tissue", law]
            run = pc.finished(SCENE + steps + ESTIMATE)
            inside += self.bracketed(bars(run), pc.finished(SCENE + steps + ["-dm_refine", "2"]), "space")
        self.assertGreaterEqual(inside, 0.9 * len(laws) * len(NUMBERS))

    def test_levels_and_the_run_itself(self):
        plain = pc.finished(SCENE + STEPS)
        with_bars = estimated()
        before, after = plain.json(), with_bars.json()
        for key in NUMBERS:
            self.assertEqual(after[key], before[key])
            self.assertEqual(bars(with_bars)[key]["value"], before[key])
        levels = after["error_estimate"]["runs"]
        self.assertEqual([level["dt_s"] for level in levels], [0.05, 0.2, 0.1, 0.2, 0.2])
        self.assertEqual([level["cells"] for level in levels], [24, 192, 24, 24, 24])
        # a level is what its options give by hand
        by_hand = pc.finished(SCENE + ["-ts_dt", "0.2", "-dm_refine", "1"]).json()
        for key in NUMBERS:
            self.assertAlmostEqual(levels[1]["numbers"][key], by_hand[key], delta=1e-9 * abs(by_hand[key]) + 1e-12)
        self.assertIn("± ", with_bars.out)
        self.assertEqual(plain.files(), with_bars.files())

    def test_another_mesh(self):
        """A coarser mesh of the same block: cells twice as large, so the bar is 1.25 times the difference."""
        other = ["-error_estimate_mesh", pc.mesh("cube_coarse.msh")]
        fine = [pc.mesh("cube.msh") if o == pc.mesh("cube_coarse.msh") else o for o in SCENE]
        run = pc.finished(fine + STEPS + ESTIMATE + other).json()["error_estimate"]
        self.assertEqual([run["runs"][i]["cells"] for i in (0, 1)], [192, 24])
        by_hand = [pc.finished(scene + ["-ts_dt", "0.2"]).json() for scene in (fine, SCENE)]
        for key in NUMBERS:
            difference = abs(by_hand[0][key] - by_hand[1][key])
            self.assertAlmostEqual(run["numbers"][key]["space"], 1.25 * difference, delta=1e-6 * difference + 1e-12)

    def test_refined_once_less(self):
        run = pc.finished(SCENE + ["-ts_dt", "0.2", "-dm_refine", "1"] + ESTIMATE).json()["error_estimate"]
        self.assertEqual([run["runs"][i]["cells"] for i in (0, 1)], [192, 24])

    def test_ranks(self):
        one, two = bars(estimated()), bars(pc.finished(SCENE + STEPS + ESTIMATE, ranks=2))
        for key in NUMBERS:
            for part in ("time", "space"):
                self.assertAlmostEqual(one[key][part], two[key][part], delta=1e-6 * abs(one[key]["value"]) + 1e-9)

    def test_steps_by_their_error(self):
        run = pc.finished(SCENE + BDF2 + ["-step_volume_tolerance", "0.5", "-ts_adapt_dt_max", "0.1"] + ESTIMATE).json()
        steps = [level["steps"] for level in run["error_estimate"]["runs"]]
        self.assertGreater(steps[0], 1.4 * steps[2])
        self.assertGreater(steps[2], 1.2 * steps[3])

    def test_a_level_that_fails(self):
        """Newton steps that suffice for 0.05 s, not for 0.2 s: the run is whole, its bars are empty and say why."""
        case = pc.finished(SCENE + STEPS + ["-snes_max_it", "3", "-ts_adapt_dt_min", "0.051"] + ESTIMATE)
        levels = case.json()["error_estimate"]["runs"]
        self.assertEqual(["failure" in level for level in levels], [False, True, False, True, True])
        self.assertIsNone(bars(case)["tidal_volume_ml"]["error"])
        self.assertIn("?: steps 4 times as long: no step could be accepted", case.out)

    def test_steps_that_cannot_be_longer(self):
        """Phases of one step: no error in time, and the reason."""
        case = pc.finished(pc.LITRE + pc.DIRECT + pc.QUIET + pc.SCENE + ESTIMATE +
                           ["-ventilator", "supersyringe", "-ventilator_inspiration", "0.2", "-ventilator_pause", "0.2",
                            "-ts_dt", "0.2"])
        self.assertIsNone(bars(case)["tidal_volume_ml"]["time"])
        self.assertIn("hardly longer", case.out)

    def test_no_breath(self):
        case = pc.finished(SCENE + ["-ventilator_peep", "5", "-ts_max_time", "0.2"] + STEPS + ESTIMATE)
        self.assertIn("ends before its first breath", case.out)
        self.assertNotIn("error_estimate", case.json())

    def test_names_and_viewers(self):
        """A mesh whose name has blanks and dashes; a level leaves the run's own monitor alone."""
        mesh = os.path.join(os.path.dirname(pc.scratch()), "a block  -v2.msh")
        shutil.copy(pc.mesh("cube_coarse.msh"), mesh)
        log = pc.scratch("newton.txt")
        scene = [mesh if o == pc.mesh("cube_coarse.msh") else o for o in SCENE] + ["-ts_dt", "0.2", "-snes_monitor", "ascii:" + log]
        lines = []
        for more in ([], ESTIMATE):
            pc.finished(scene + more)
            with open(log) as f:
                lines.append(f.read())
        self.assertEqual(*lines)

    def test_restart(self):
        """Asked for at the restart only: the bars of the whole run."""
        first = pc.finished(SCENE + STEPS + ["-checkpoint_every", "0.4"])
        again = pc.finished(SCENE + STEPS + ESTIMATE + ["-restart", first.path("checkpoint_previous.h5")])
        whole = bars(estimated())
        for key in NUMBERS:
            self.assertAlmostEqual(bars(again)[key]["error"], whole[key]["error"], delta=1e-6 * abs(whole[key]["value"]) + 1e-12)

    def test_refused(self):
        def said(options, *words):
            case = pc.Case(options)
            self.assertNotEqual(case.code, 0)
            for word in words:
                self.assertIn(word, case.err)
            return case

        said(SCENE + ["-error_estimate_numbers", "V_T"], "-error_estimate_numbers", "-error_estimate")
        said(SCENE + SWEEP + ["-error_estimate_numbers", "V_T,tau"], "-error_estimate_numbers", "'tau'")
        said(SCENE + ESTIMATE + ["-error_estimate_numbers", "V_T"], "-error_estimate_numbers", "method sweep")
        said(SCENE + SWEEP + ["-elements", "P3-P2"], "-error_estimate_method sweep", "-elements P2-P1")
        said(SCENE + SWEEP + ["-pressure_damping"], "-error_estimate_method sweep", "-pressure_damping")
        said(SCENE + SWEEP + ["-error_estimate_mesh", pc.mesh("cube.msh")], "-error_estimate_method sweep", "-error_estimate_mesh")
        said(SCENE + ["-error_estimate_mesh", "x.msh"], "-error_estimate_mesh x.msh", "-error_estimate")
        case = said(SCENE + ESTIMATE + ["-error_estimate_mesh", "none.msh"], "-error_estimate_mesh none.msh", "no such file")
        self.assertFalse(os.path.exists(case.directory))
        still = pc.BLOCK + pc.DIRECT + pc.QUIET + ["-tissue", "yoshihara", "-chest_wall", "-chest_wall_surfaces", "x0"]
        said(still + ESTIMATE, "-error_estimate", "-ventilator")
        for mesh, words in ((pc.mesh("cube_coarse.msh"), "as large as"), (pc.mesh("cube_msh22_ascii.msh"), "x1")):
            case = said(SCENE + ["-ts_dt", "0.2"] + ESTIMATE + ["-error_estimate_mesh", mesh], words)
            self.assertFalse(os.path.exists(case.directory), "known before the run")


class SweptErrors(unittest.TestCase):
    """-error_estimate_method sweep."""

    def compared(self, estimate, truth, part):
        """[(key, value, error, bar)] of the numbers that the estimate has; prints them."""
        rows = []
        for key, bar in estimate.items():
            if truth.get(key) is None or abs(truth[key] - bar["value"]) < 1e-7 * abs(bar["value"]):
                continue  # prescribed
            rows.append((key, bar["value"], abs(truth[key] - bar["value"]), bar[part]))
            print("  {:34} {:12.6g} error {:9.3g} bar {}".format(*rows[-1]))
        return rows

    def test_bars_in_time(self):
        fine = pc.finished(SCENE + BDF2 + ["-ts_dt", "0.0015625"]).json()
        for scheme in ([], BDF2):
            print("\ntime:", *scheme)
            rows = self.compared(bars(pc.finished(SCENE + STEPS + scheme + SWEEP)), fine, "time")
            self.assertGreaterEqual(len(rows), 6)
            held = [bar >= error for *_, error, bar in rows if bar is not None]
            self.assertGreaterEqual(len(held), 5)
            self.assertGreaterEqual(sum(held), 0.8 * len(held))

    def test_bars_in_space(self):
        """On 24 cells: what has a bar is held by it, and what has none is far off."""
        for law in ("yoshihara", "patte"):
            print("\nspace, 24 cells:", law)
            steps = ["-ts_dt", "0.2", "-tissue", law, "-ventilator_pip", "4"]
            truth = pc.finished(SCENE + steps + ["-dm_refine", "2"]).json()
            for key, value, error, bar in self.compared(bars(pc.finished(SCENE + steps + SWEEP)), truth, "space"):
                if bar is None:
                    self.assertGreater(error, 0.1 * abs(value), key)
                else:
                    self.assertGreaterEqual(bar, error, key)

    def test_parts_in_space_of_other_elements(self):
        """A linear displacement against a quadratic one on the same cells (in V_T it is the tissue that counts), both against cells a quarter of the size."""
        scene = SCENE + ["-ts_dt", "0.1", "-airflow_permeability", "1e4", "-ventilator_pip", "2", "-elements"]
        coarse = {elements: bars(pc.finished(scene + [elements, "-dm_refine", "1"] + SWEEP + ["-error_estimate_numbers", "V_T,R"]))
                  for elements in ("P1-P1", "P2-P1")}
        fine = pc.finished(scene + ["P2-P1", "-dm_refine", "3"] + pc.options_file("solvers/iterative.opts")).json()
        linear, quadratic = (coarse[elements]["tidal_volume_ml"] for elements in coarse)
        between, found = quadratic["value"] - linear["value"], linear["lacks"]["tissue_in_space"] / 0.75
        print(f"V_T: P2-P1 has {between:.4g} more, found {found:.4g}")
        self.assertAlmostEqual(found, between, delta=0.15 * between)
        for elements, numbers in coarse.items():
            bar = numbers["resistance_cmH2O_s_per_l"]
            error = fine["resistance_cmH2O_s_per_l"] - bar["value"]
            found = (bar["lacks"]["flow_in_space"] + bar["lacks"]["tissue_in_space"]) / 0.75
            print(f"R, {elements}: error {error:.4g}, found {found:.4g}")
            self.assertAlmostEqual(found, error, delta=0.3 * abs(error))

    def test_peak_pressure_of_a_prescribed_flow(self):
        """The airway's pressure is an unknown, with a tube before it; both parts against finer runs."""
        flow = [o for o in SCENE if o not in ("-ventilator_pip", "8")]
        flow[flow.index("pcv")] = "vcv"
        for more in (["-ventilator_flow_split", "common_pressure"], ["-tube", "-tube_k1", "2", "-tube_k2", "5"]):
            scene = flow + ["-ventilator_tidal_volume", "30", *more, "-dm_refine", "1"]
            estimate = bars(pc.finished(scene + STEPS + SWEEP + ["-error_estimate_numbers", "PIP"]))["peak_inspiratory_pressure_cmH2O"]
            value, lacks = estimate["value"], estimate["lacks"]
            finer_runs = [("steps", BDF2 + ["-ts_dt", "0.0125"])]
            if "-tube" not in more:  # in space a tube is nothing new
                finer_runs.append(("flow_in_space", STEPS + ["-dm_refine", "2"]))
            for lack, finer in finer_runs:
                error = pc.finished(scene + finer).json()["peak_inspiratory_pressure_cmH2O"] - value
                found = lacks["steps"] + lacks["rows"] if lack == "steps" else lacks["flow_in_space"] + lacks["tissue_in_space"]
                print(f"PIP {value:.6g}, {lack}: error {error:.4g}, found {found:.4g}", *more)
                if abs(error) > 1e-4 * value:
                    self.assertGreater(found / error, 0.5)
                    self.assertLess(found / error, 2)

    def test_what_the_solver_left(self):
        """A run that hardly solves its equations: the solver's part is what a tight run has more."""
        loose = pc.finished(SCENE + STEPS + SWEEP + ["-snes_rtol", "1e-2", "-snes_atol", "1e-4", "-snes_stol", "0"])
        tight = pc.finished(SCENE + STEPS + ["-snes_rtol", "1e-12", "-snes_atol", "1e-12"]).json()
        for key in ("tidal_volume_ml", "compliance_ml_per_cmH2O", "peak_flow_ml_per_s"):
            bar = bars(loose)[key]
            error = tight[key] - bar["value"]
            self.assertGreater(abs(error), 1e-7 * tight[key], "the run is loose")
            self.assertAlmostEqual(bar["lacks"]["solver"], error, delta=0.1 * abs(error))

    def test_airway_tree(self):
        """A trunk whose wall stores gas, a branch, a tube: each part against a finer run, on 2 ranks as on one."""
        tree = pc.scratch("tree.csv")
        with open(tree, "w", encoding="utf-8") as f:
            f.write("name,parent,resistance_cmH2O_s_per_l,compliance_ml_per_cmH2O,surface\ntrunk,,20,5,\nbranch,trunk,10,,x1\n")
        scene = SCENE[:len(pc.BLOCK + pc.DIRECT + pc.QUIET)] + SCENE[len(pc.BLOCK + pc.DIRECT + pc.QUIET + pc.PAPER):] + ["-airway_tree", tree, "-tube", "-tube_k1", "5", "-tube_k2", "4", "-airflow_permeability", "3000"]
        keys = {"V_T": "tidal_volume_ml", "Q_peak": "peak_flow_ml_per_s"}
        asked = SWEEP + ["-error_estimate_numbers", ",".join(keys)]
        steps = ["-ts_dt", "0.025"]
        run = pc.finished(scene + steps + asked)
        finer = {"time": pc.finished(scene + ["-ts_dt", "0.003125"]).json(), "space": pc.finished(scene + steps + ["-dm_refine", "1"]).json()}
        loose = pc.finished(scene + steps + asked + ["-snes_rtol", "1e-3", "-snes_atol", "1e-4", "-snes_stol", "0"])
        tight = pc.finished(scene + steps + ["-snes_rtol", "1e-12", "-snes_atol", "1e-12"]).json()
        more = pc.finished(scene + steps + asked, ranks=2)
        for key in keys.values():
            value, lacks = bars(run)[key]["value"], bars(run)[key]["lacks"]
            found = {"time": lacks["steps"] + lacks["rows"], "space": lacks["flow_in_space"] + lacks["tissue_in_space"]}
            for part, truth in finer.items():
                error = truth[key] - value
                print(f"{key} {value:.6g}, {part}: error {error:.4g}, found {found[part]:.4g}")
                if abs(error) > 1e-4 * value:
                    self.assertGreater(found[part] / error, 0.5)
                    self.assertLess(found[part] / error, 2)
            error = tight[key] - bars(loose)[key]["value"]
            self.assertGreater(abs(error), 1e-8 * value, "the run is loose")
            self.assertAlmostEqual(bars(loose)[key]["lacks"]["solver"], error, delta=0.1 * abs(error))
            for name, lack in lacks.items():
                self.assertAlmostEqual(lack, bars(more)[key]["lacks"][name], delta=1e-6 * abs(value), msg=key + name)

    def test_ranks_and_cells(self):
        """The same on any number of ranks; the cells of errors.xdmf add up to the part in space."""
        import h5py

        one = pc.finished(SCENE + STEPS + SWEEP)
        for ranks in (2, 3):
            more = pc.finished(SCENE + STEPS + SWEEP, ranks=ranks)
            for key, bar in bars(one).items():
                for name, lack in bar["lacks"].items():
                    self.assertAlmostEqual(lack, bars(more)[key]["lacks"][name], delta=1e-6 * abs(bar["value"]), msg=key + name)
        with h5py.File(one.path("errors.h5")) as file:
            for key, bar in bars(one).items():
                cells = file["lacks_in_space_" + key][()]
                self.assertEqual(len(cells), 24)
                whole = bar["lacks"]["flow_in_space"] + bar["lacks"]["tissue_in_space"]
                self.assertAlmostEqual(cells.sum(), whole, delta=1e-9 * abs(bar["value"]))

    def test_without_airflow(self):
        """No gas to flow: the tissue's part alone."""
        scene = pc.BLOCK + pc.DIRECT + pc.QUIET + [
            "-tissue", "birzle", "-chest_wall", "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-lumen_pressure", "off", "-ventilator", "pcv",
            "-ventilator_pip", "8", "-ventilator_inspiration", "0.8", "-ventilator_expiration", "0.8", "-ventilator_ramp", "0.2",
            "-ventilator_ramp_down", "0.2", "-ts_dt", "0.2", "-energy_audit", "off"]
        bar = bars(pc.finished(scene + ["-dm_refine", "1"] + SWEEP))["tidal_volume_ml"]
        error = pc.finished(scene + ["-dm_refine", "2"]).json()["tidal_volume_ml"] - bar["value"]
        self.assertEqual(bar["lacks"]["flow_in_space"], 0)
        print(f"tissue: error {error:.4g}, found {bar['lacks']['tissue_in_space']:.4g} of {bar['value']:.6g}")
        self.assertGreater(bar["lacks"]["tissue_in_space"] / error, 0.4)
        self.assertLess(bar["lacks"]["tissue_in_space"] / error, 2)

    def test_more_breaths(self):
        """Breaths that trap gas: what one more breath changes, exact where all is linear, and the limit, against runs of more."""
        short = SCENE + ["-airflow_permeability", "30", "-ventilator_expiration", "0.3", "-ts_dt", "0.1"]
        for pip, share in (("0.01", 1e-3), ("8", 0.04)):
            scene = short + ["-ventilator_pip", pip, "-ventilator_breaths"]
            many = pc.finished(scene + ["60"]).json()
            for breaths in (1, 3, 6):
                run, following = pc.finished(scene + [str(breaths)] + SWEEP), pc.finished(scene + [str(breaths + 1)]).json()
                for key in ("tidal_volume_ml", "peak_expiratory_flow_ml_per_s", "work_j"):
                    bar = bars(run)[key]
                    change, told = following[key] - bar["value"], bar["more_breaths"]
                    self.assertAlmostEqual(told["next"], change, delta=share * abs(change), msg=f"{key}, {pip} cmH2O, {breaths}")
                    if breaths < 6:
                        self.assertIsNone(told["periodic"], "the terms are no geometric series yet")
                    elif told["periodic"] is not None or (key, pip) == ("tidal_volume_ml", "8"):
                        left = many[key] - bar["value"]
                        self.assertAlmostEqual(told["periodic"], left, delta=0.1 * abs(left), msg=f"{key}, {pip} cmH2O")
                self.assertIsNone(bars(run)["compliance_ml_per_cmH2O"]["more_breaths"]["periodic"], "it doubles")
                self.assertIn("Breaths are not periodic yet", run.out)
        two = pc.finished(scene + ["2"] + SWEEP, ranks=2)  # the same on any number of ranks
        for key, bar in bars(pc.finished(scene + ["2"] + SWEEP)).items():
            self.assertAlmostEqual(bars(two)[key]["more_breaths"]["next"], bar["more_breaths"]["next"], delta=1e-6 * abs(bar["value"]), msg=key)
        settled = pc.finished(SCENE + STEPS + ["-airflow_permeability", "1e5", "-ventilator_breaths", "2"] + SWEEP)
        self.assertNotIn("not periodic", settled.out)
        self.assertLess(abs(bars(settled)["tidal_volume_ml"]["more_breaths"]["periodic"]), 1e-4)

    def test_a_flow_that_is_prescribed(self):
        """More breaths do not change the flow that the ventilator gives, though the lung's volume follows its state along a curve."""
        scene = [o for o in SCENE if o not in ("-ventilator_pip", "8")] + ["-airflow_permeability", "30", "-ventilator_expiration", "0.3"]
        scene[scene.index("pcv")] = "vcv"
        run = pc.finished(scene + ["-ventilator_tidal_volume", "20", "-ventilator_flow_split", "common_pressure", "-ts_dt", "0.1"] + SWEEP)
        for key in ("tidal_volume_ml", "peak_flow_ml_per_s"):
            self.assertLess(abs(bars(run)[key]["more_breaths"]["next"]), 1e-9 * bars(run)[key]["value"], key)

    def test_names_that_files_cannot_have(self):
        """Regions whose names XML keeps for itself, or that are one name once a path in a file has them."""
        import h5py
        from xml.etree import ElementTree

        with open(pc.mesh("lung_pair.msh"), encoding="utf-8") as f:
            text = f.read().replace('"right_lung"', '"a/b <R&D>"').replace('"left_lung"', '"a_b <R&D>"')
        mesh = pc.scratch("names.msh")
        with open(mesh, "w", encoding="utf-8") as f:
            f.write(text)
        numbers = "V_T:a/b <R&D>,V_T:a_b <R&D>"
        case = pc.finished(pc.options_file("solvers/iterative.opts") + pc.options_file("scenes/pcv.opts") + pc.QUIET + [
            "-dm_plex_filename", mesh, "-elements", "P1-P1", "-ts_dt", "0.2", "-ventilator_inspiration", "0.4", "-ventilator_expiration", "0.4",
            "-energy_audit", "off", "-error_estimate_numbers", numbers, "-sensitivities", numbers, "-sensitivities_fields"] + SWEEP)
        for name in ("errors", "sensitivities"):
            items = [item.text.split(":/")[1] for item in ElementTree.parse(case.path(name + ".xdmf")).iter("DataItem")][2:]
            with h5py.File(case.path(name + ".h5")) as file:
                self.assertEqual(sorted(items), sorted(file), name)
            self.assertIn("ventilation_ml_a_b <R&D>", items[-1])

    def test_a_breath_that_differs(self):
        """The last breath of a programme is a larger one: nothing to repeat."""
        breath = "inspiration 0.4 pressure {} ramp 0.2\nexpiration 0.4 pressure 0 ramp 0.2\n"
        scene = SCENE[:SCENE.index("-ventilator")] + ["-energy_audit", "off"]
        for last, told in ((8, True), (10, False)):
            case = pc.finished(scene + pc.programme(breath.format(8) + breath.format(last)) + ["-ts_dt", "0.1"] + SWEEP)
            self.assertEqual(bars(case)["tidal_volume_ml"]["more_breaths"] is not None, told)

    def test_loads_that_differ(self):
        """Breaths of 1.6 s under loads of another period: the next breath is none of those before."""
        effort = ["-breathing_effort", "-breathing_effort_surfaces", "y0", "-breathing_effort_rise", "0.2", "-breathing_effort_hold", "0.1",
                  "-breathing_effort_fall", "0.2", "-breathing_effort_period"]
        pull = ["-traction", "-traction_surfaces", "y0", "-traction_value"]
        for load, told in ((effort + ["0.8"], True), (effort + ["1.1"], False),
                           (pull + ["0,0.01*sin(2*pi*t/1.6),0"], True), (pull + ["0,0.01*t,0"], False), (pull + ["0,0.01*x,0"], True)):
            case = pc.finished(SCENE + ["-ts_dt", "0.2", "-ventilator_breaths", "2"] + load + SWEEP)
            self.assertEqual(bars(case)["tidal_volume_ml"]["more_breaths"] is not None, told, load)

    def test_parts_of_the_lung(self):
        """The air of each lung, as regions have it, with bars of its own: what both lack is what the whole lacks."""
        names = ["-error_estimate_numbers", "V_T,V_T:right_lung,V_T:left_lung"]
        case = pc.finished(pc.DIRECT + pc.options_file("scenes/pcv.opts") + pc.QUIET + [
            "-dm_plex_filename", pc.mesh("lung_pair.msh"), "-elements", "P1-P1", "-ts_dt", "0.2", "-ventilator_inspiration", "0.4",
            "-ventilator_expiration", "0.4", "-ventilator_ramp", "0.2", "-ventilator_ramp_down", "0.2", "-energy_audit", "off"] + SWEEP + names)
        whole, *lungs = (bars(case)[key] for key in ("tidal_volume_ml", "ventilation_ml_right_lung", "ventilation_ml_left_lung"))
        for lung, name in zip(lungs, ("right_lung", "left_lung")):
            self.assertAlmostEqual(lung["value"], case.json()["regions"][name]["ventilation_ml"], delta=1e-9 * lung["value"])
        for part, share in (("steps", 1e-5), ("flow_in_space", 1e-5), ("tissue_in_space", 1e-2)):  # that of samples, solved to 1 %
            parts = [lung["lacks"][part] for lung in lungs]
            self.assertAlmostEqual(sum(parts), whole["lacks"][part], delta=share * max(map(abs, parts)), msg=part)
        bad = pc.Case(SCENE + SWEEP + ["-error_estimate_numbers", "V_T:upper_lobe"])
        self.assertNotEqual(bad.code, 0)
        self.assertIn("-error_estimate_numbers V_T:upper_lobe: the mesh has no region 'upper_lobe'", bad.err)

    def test_chosen_where_it_holds(self):
        case = pc.finished(SCENE + STEPS + ["-error_estimate", "-error_estimate_numbers", "C_rs"])
        self.assertEqual(list(bars(case)), ["compliance_ml_per_cmH2O"])
        self.assertIn("one sweep back", case.out)
        other = pc.finished(SCENE + ["-ts_dt", "0.2", "-elements", "P3-P2", "-error_estimate", "-error_estimate_mesh", pc.mesh("cube.msh")])
        self.assertEqual(other.json()["error_estimate"]["method"], "runs")

    def test_a_jump_has_no_largest_flow(self):
        """Pressure released at once: the flow of the first step has no limit, and no bar."""
        scene = [o for o in SCENE]
        del scene[scene.index("-ventilator_ramp_down"):scene.index("-ventilator_ramp_down") + 2]
        bar = bars(pc.finished(scene + STEPS + SWEEP))["peak_expiratory_flow_ml_per_s"]
        self.assertIsNone(bar["time"])
        self.assertIn("steps too long", bar["not_resolved"])
        self.assertIn("few_steps_in_a_phase", bar["not_resolved_because"])

    def test_a_sweep_that_fails(self):
        """Linear systems that are not solved: the reason, and no bars of the steps that were."""
        case = pc.finished(SCENE + STEPS + SWEEP + ["-ksp_type", "gmres", "-pc_type", "jacobi", "-ksp_max_it", "60", "-ksp_rtol", "1e-3",
                                                    "-sweep_rtol", "1e-10"])
        estimate = case.json()["error_estimate"]
        self.assertIn("linear system of the sweep", estimate["failure"])
        self.assertEqual(estimate["numbers"], {})
        self.assertIn("no error estimate", case.out)
        self.assertNotIn("errors.h5", case.files())

    def test_phases_that_end_early(self):
        """A phase that cycling ends does so up to a step late: V_T is off by more than its rates tell, and has no part in time."""
        air = [o for o in SCENE]
        del air[air.index("-ventilator"):air.index("-energy_audit")]
        breath = "inspiration 1.5 pressure 5 ramp 0.2 cycle {0}\nexpiration 1 pressure 2 ramp 0.2\n"
        text = "settle 1 pressure 2 ramp 0.5\n" + 2 * breath
        for method in (SWEEP, ESTIMATE):
            case = pc.finished(air + pc.programme(text.format(30)) + STEPS + method)
            for key in ("tidal_volume_ml", "compliance_ml_per_cmH2O"):
                self.assertIsNone(bars(case)[key]["time"])
                if method is SWEEP:
                    self.assertIn("phase_ended_early", bars(case)[key]["not_resolved_because"])
                self.assertIsNone(bars(case)[key]["error"])
            self.assertIn("phases ended by a trigger or by cycling", case.out)
        late = bars(pc.finished(air + pc.programme(text.format(0.01)) + STEPS + SWEEP))["tidal_volume_ml"]
        self.assertIsNotNone(late["time"], "no phase ended early")

    def test_flow_against_a_jump(self):
        """BDF2 through a pressure that is released at once: rows of gas that flows in, which a fit takes for a lung's."""
        scene = [o for o in SCENE if o not in ("-ventilator_pip", "8")]
        scene[scene.index("pcv")] = "vcv"
        scene[scene.index("-airflow_permeability") + 1] = "1000"
        for option in ("-ventilator_ramp", "-ventilator_ramp_down"):
            del scene[scene.index(option):scene.index(option) + 2]
        scene += ["-ventilator_tidal_volume", "20", "-ventilator_inspiration", "0.6", "-ventilator_pause", "0.3"] + STEPS
        two = pc.finished(scene + BDF2 + SWEEP)
        rows = two.signals()
        self.assertGreater(rows["flow_ml_per_s"][rows["phase"].index("expiration")], 1, "the wrong way")
        for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"):
            self.assertIsNone(bars(two)[key]["time"])
            self.assertIn("steps too long", bars(two)[key]["not_resolved"])
        # a flow that is prescribed has no peak between its rows
        one = bars(pc.finished(scene + SWEEP))["peak_flow_ml_per_s"]
        self.assertEqual(one["lacks"]["rows"], 0)
        self.assertLess(one["time"], 1e-6 * one["value"])

    def test_cells_far_too_large(self):
        """Gas that goes nowhere within a cell: R of the run is a fiftieth of the true one, and C_rs, whose own parts are small, twice it."""
        scene = [o for o in SCENE]
        scene[scene.index("-airflow_permeability") + 1] = "1"
        case = pc.finished(scene + ["-ts_dt", "0.1", "-ventilator_pip", "4"] + SWEEP)
        for key in ("resistance_cmH2O_s_per_l", "compliance_ml_per_cmH2O"):
            self.assertIsNone(bars(case)[key]["space"])
            self.assertIn("cells too large", bars(case)[key]["not_resolved"])
            self.assertIn("cells_too_large", bars(case)[key]["not_resolved_because"])
        self.assertIsNotNone(bars(case)["peak_inspiratory_pressure_cmH2O"]["error"], "prescribed")
        alone = bars(pc.finished(scene + ["-ts_dt", "0.1", "-ventilator_pip", "4"] + SWEEP + ["-error_estimate_numbers", "C_rs"]))
        self.assertEqual(list(alone), ["compliance_ml_per_cmH2O"])
        self.assertIsNone(alone["compliance_ml_per_cmH2O"]["space"])

    def test_numbers_that_the_run_has_not(self):
        some = pc.finished(SCENE + STEPS + SWEEP + ["-error_estimate_numbers", "P_plat,V_T"])
        self.assertEqual(list(bars(some)), ["tidal_volume_ml"])
        self.assertIn("this run has no P_plat", some.out)
        none = pc.finished(SCENE + STEPS + SWEEP + ["-error_estimate_numbers", "P_plat"])
        self.assertIn("no error estimate", none.out)
        self.assertIn("none of the numbers", none.json()["error_estimate"]["failure"])

    def test_dry_run(self):
        for method, words in ((SWEEP, "The sweep of -error_estimate comes on top"), (ESTIMATE, "The four more runs of -error_estimate")):
            self.assertIn(words, pc.finished(SCENE + STEPS + method + ["-dry_run"]).out)


if __name__ == "__main__":
    pc.main()
