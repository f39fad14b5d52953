#!/usr/bin/python3
"""-sensitivities: the program's table and summary, ranks, states in a file, what is refused, and that a scene without it pays nothing."""
import json
import os
import signal
import subprocess
import unittest

import pulmo_case as pc

SCENE = (pc.BLOCK + pc.QUIET + pc.PAPER + pc.DIRECT + ["-ts_dt", "0.1", "-snes_rtol", "1e-12", "-snes_atol", "1e-12"] +
         ["-tissue", "yoshihara", "-airflow", "-airflow_permeability", "100", "-airflow_surfaces", "x1", "-chest_wall",
          "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-ventilator", "vcv", "-ventilator_tidal_volume", "200", "-ventilator_ramp_down", "0.3",
          "-ventilator_inspiration", "0.5", "-ventilator_expiration", "0.8", "-energy_audit", "off"])
STILL = (pc.BLOCK + pc.QUIET + pc.DIRECT + ["-ts_dt", "0.1", "-snes_rtol", "1e-12", "-snes_atol", "1e-12", "-chest_wall",
                                            "-chest_wall_surfaces", "x0,y0,y1,z0,z1", "-energy_audit", "off"])
GAS = STILL + ["-airflow", "-airflow_permeability", "1000", "-airflow_surfaces", "x1"]
ASK = ["-sensitivities", "C_rs,R,PIP,V_T", "-sweep_rtol", "1e-12"]


def table(case, column="derivative"):
    """{number: {option: derivative}}"""
    return {key: {option: one.get(column) for option, one in given["parameters"].items()}
            for key, given in case.json()["sensitivities"]["numbers"].items()}


class Sensitivities(unittest.TestCase):
    def same(self, a, b, share):
        """Two runs, to a share of each entry, or of a percent for a percent where that is more."""
        one, other = (table(case, "percent_for_one_percent_more") for case in (a, b))
        self.assertEqual(one.keys(), other.keys())
        for key, derivatives in one.items():
            self.assertEqual(derivatives.keys(), other[key].keys())
            for option, value in derivatives.items():
                self.assertAlmostEqual(other[key][option], value, delta=share * max(abs(value), 1), msg=f"{key} by {option}")

    def test_ranks_file_and_solver(self):
        """Held against a run with another stiffness, then against itself on 2 and 3 ranks, from a file, and with Krylov methods."""
        run = pc.finished(SCENE + ASK)
        one, summary = table(run), run.json()
        self.assertIn("1 % more of it changes", run.out)
        self.assertEqual(list(one), ["compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "peak_inspiratory_pressure_cmH2O", "tidal_volume_ml"])
        self.assertGreater(len(one["tidal_volume_ml"]), 6)
        # the volume is prescribed
        self.assertAlmostEqual(one["tidal_volume_ml"]["-ventilator_tidal_volume"], 1, delta=1e-9)
        self.assertAlmostEqual(one["tidal_volume_ml"]["-tissue_c"], 0, delta=1e-6)
        c = summary["sensitivities"]["numbers"]["compliance_ml_per_cmH2O"]["parameters"]["-tissue_c"]
        moved = [pc.finished(SCENE + ["-tissue_c", repr(c["value"] * (1 + s))]).json() for s in (-1e-3, 1e-3)]
        for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "peak_inspiratory_pressure_cmH2O"):
            self.assertAlmostEqual((moved[1][key] - moved[0][key]) / (2e-3 * c["value"]), one[key]["-tissue_c"],
                                   delta=1e-5 * abs(one[key]["-tissue_c"]), msg=key)
        for ranks in (2, 3):
            with self.subTest(ranks=ranks):
                self.same(run, pc.finished(SCENE + ASK, ranks=ranks), 1e-7)
        file = pc.finished(SCENE + ASK + ["-sweep_memory", "0"])
        self.same(run, file, 1e-12)
        self.assertEqual([name for name in os.listdir(file.directory) if "trajectory" in name], [])
        # old factors are enough for Newton's method, and not for the sweep
        self.same(run, pc.finished(SCENE + pc.options_file("solvers/reuse.opts") + ["-ts_dt", "0.1", "-snes_rtol", "1e-12", "-snes_atol", "1e-12"] + ASK), 1e-6)
        krylov = pc.finished(SCENE[:len(pc.BLOCK + pc.QUIET + pc.PAPER)] + pc.options_file("solvers/iterative.opts") +
                             SCENE[len(pc.BLOCK + pc.QUIET + pc.PAPER + pc.DIRECT):] + ASK)
        self.same(run, krylov, 1e-6)

    def test_effects_that_remember(self):
        """Two that remember at once, under BDF2: held against runs with another gain, on 2 and 3 ranks, and with all states in a file."""
        scene = SCENE + ["-ts_type", "bdf", "-viscoelastic", "-recruitment", "-recruitment_opening_pressure", "1",
                         "-recruitment_closing_pressure", "0.5", "-recruitment_start", "0.3", "-recruitment_gain", "0.2"]
        run = pc.finished(scene + ASK)
        one = table(run)
        moved = [pc.finished(scene + ["-recruitment_gain", repr(0.2 * (1 + s))]).json() for s in (-1e-4, 1e-4)]
        for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "peak_inspiratory_pressure_cmH2O"):
            self.assertAlmostEqual((moved[1][key] - moved[0][key]) / (2e-4 * 0.2), one[key]["-recruitment_gain"],
                                   delta=1e-4 * abs(one[key]["-recruitment_gain"]), msg=key)
        for ranks in (2, 3):
            with self.subTest(ranks=ranks):
                self.same(run, pc.finished(scene + ASK, ranks=ranks), 1e-6)
        self.same(run, pc.finished(scene + ASK + ["-sweep_memory", "0"]), 1e-12)

    def differences(self, scene, options, numbers):
        """Derivatives of a sweep, held against runs with more and less of each option."""
        run = pc.finished(scene + ["-sensitivities", "C_rs,R,PIP,V_T,Q_peak,work", "-sweep_rtol", "1e-12"])
        parameters = {key: one["parameters"] for key, one in run.json()["sensitivities"]["numbers"].items()}
        share = 2e-4
        for option in options:
            value = parameters[numbers[0]][option]["value"]
            moved = [pc.finished(scene + [option, repr(value * (1 + s))]).json() for s in (-share, share)]
            self.assertEqual(moved[0]["steps"], moved[1]["steps"])
            for key in numbers:
                by = parameters[key][option]["derivative"] * value
                self.assertAlmostEqual((moved[1][key] - moved[0][key]) / (2 * share), by,
                                       delta=1e-5 * abs(by) + 1e-8 * abs(run.json()[key]), msg=f"{key} by {option}")
        return run

    def test_airway_tree(self):
        """A trunk and two branches with walls that store gas, a tube before them: against runs with other sizes of all, on 1, 2 and 3 ranks."""
        tree = pc.scratch("tree.csv")
        with open(tree, "w", encoding="utf-8") as f:
            f.write("name,parent,length_mm,diameter_mm,resistance_cmH2O_s_per_l,compliance_ml_per_cmH2O,surface\n"
                    "trunk,,120,9,,0.5,\nright,trunk,30,5,,1,x1\nleft,trunk,,,12,,x0\n")
        scene = (pc.BLOCK + pc.QUIET + pc.options_file("solvers/tight.opts") +
                 ["-ts_dt", "0.1", "-tissue", "yoshihara", "-airflow", "-airflow_permeability", "100", "-airflow_surfaces", "x0,x1", "-chest_wall",
                  "-chest_wall_surfaces", "y0,y1,z0,z1", "-lumen_pressure_surfaces", "x0,x1", "-energy_audit", "off", "-airway_tree", tree,
                  "-tube", "-tube_k1", "5", "-tube_k2", "8"])
        numbers = ["compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "peak_inspiratory_pressure_cmH2O", "tidal_volume_ml", "work_j"]
        options = ["-tissue_c", "-airway_tree_viscosity", "-airway_tree_density", "-tube_k1", "-tube_k2"]
        for more in (["-ventilator", "vcv", "-ventilator_tidal_volume", "200", "-ventilator_inspiration", "0.5", "-ventilator_pause", "0.2",
                      "-ventilator_expiration", "0.8", "-ventilator_ramp_down", "0.3", "-ts_type", "bdf"],
                     ["-ventilator", "pcv", "-ventilator_inspiration", "0.5", "-ventilator_expiration", "0.8", "-ventilator_ramp", "0.1"]):
            with self.subTest(ventilator=more[1]):
                run = self.differences(scene + more, options, numbers)
                for ranks in (2, 3):
                    self.same(run, pc.finished(scene + more + ["-sensitivities", "C_rs,R,PIP,V_T,Q_peak,work", "-sweep_rtol", "1e-12"],
                                               ranks=ranks), 1e-6)

    def test_breathing_effort(self):
        scene = SCENE + ["-breathing_effort", "-breathing_effort_surfaces", "x0", "-breathing_effort_rise", "0.4",
                         "-breathing_effort_period", "1.2", "-breathing_effort_delay", "0.07"]
        self.by_cell(pc.finished(scene + ASK + ["-sensitivities_fields"], ranks=2))
        self.differences(scene, ["-breathing_effort_" + name for name in ("pressure", "rise", "hold", "fall", "delay")],
                         ["resistance_cmH2O_s_per_l", "peak_inspiratory_pressure_cmH2O"])

    def test_a_solver_that_does_not_solve(self):
        """Twelve iterations are enough for Newton's method, and not for a sweep to twelve digits: told, and no derivative is given."""
        short = pc.finished(SCENE[:len(pc.BLOCK + pc.QUIET + pc.PAPER)] + pc.options_file("solvers/iterative.opts") +
                            SCENE[len(pc.BLOCK + pc.QUIET + pc.PAPER + pc.DIRECT):] + ["-ksp_max_it", "12", "-sensitivities_fields"] + ASK)
        self.assertNotIn("sensitivities.h5", short.files(), "sums over some of the steps")
        self.assertIn("warning: no sensitivities: the solver leaves ", short.out)
        self.assertIn("direct.opts", short.json()["sensitivities"]["failure"])
        self.assertEqual(short.json()["sensitivities"]["numbers"], {})

    def test_stopped(self):
        """A signal during the sweep: the run's own results are whole, the exit code is that of a run that could not go on."""
        directory = pc.scratch()
        process = subprocess.Popen([pc.PROGRAM, *map(str, SCENE + ["-dm_refine", "2", "-sensitivities", "C_rs,R"]), "-output_dir", directory],
                                   cwd=pc.SOURCE, env=pc.alone(), text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        said = next(line for line in process.stdout if "a sweep back over" in line)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=120)
        self.assertEqual(process.returncode, 2, said + out + err)
        self.assertIn("stopped by SIGTERM during the sweep", err)
        with open(os.path.join(directory, "summary.json"), encoding="utf-8") as f:
            self.assertNotIn("sensitivities", json.load(f))

    def test_regions(self):
        """A value that changes in one lung alone, where all is alike and where the lungs differ; against runs that differ so."""
        scene = (pc.DIRECT + pc.options_file("scenes/pcv.opts") + pc.QUIET +
                 ["-dm_plex_filename", pc.mesh("lung_pair.msh"), "-elements", "P1-P1", "-ts_dt", "0.2", "-ventilator_inspiration", "0.4",
                  "-ventilator_expiration", "0.4", "-ventilator_ramp", "0.2", "-ventilator_ramp_down", "0.2", "-energy_audit", "off"])
        for given in (0.35, 0.5):
            with self.subTest(right_lung=given):
                run = pc.finished(scene + ["-tissue_c", f"0.35,right_lung={given}" if given != 0.35 else "0.35", "-sensitivities_fields",
                                           "-sensitivities", "C_rs,V_T,V_T:right_lung,V_T:left_lung", *ASK[2:]], ranks=2)
                self.by_cell(run)
                self.of_the_parts(run)
                one = run.json()["sensitivities"]["numbers"]["compliance_ml_per_cmH2O"]["parameters"]["-tissue_c"]
                self.assertEqual(one["percent_for_one_percent_more"] is None, given != 0.35)
                self.assertAlmostEqual(sum(one["regions"].values()), one["derivative"], delta=1e-9 * abs(one["derivative"]))
                moved = [pc.finished(scene + ["-tissue_c", f"0.35,right_lung={given + s}"]).json() for s in (-1e-3, 1e-3)]
                compliance = [m["compliance_ml_per_cmH2O"] for m in moved]
                self.assertAlmostEqual((compliance[1] - compliance[0]) / 2e-3, one["regions"]["right_lung"], delta=1e-5 * abs(one["derivative"]))
                self.assertLess(one["regions"]["right_lung"], -1)
                for lung in ("right_lung", "left_lung"):
                    air = [m["regions"][lung]["ventilation_ml"] for m in moved]
                    swept = table(run, "regions")["ventilation_ml_" + lung]["-tissue_c"]["right_lung"]
                    self.assertAlmostEqual((air[1] - air[0]) / 2e-3, swept, delta=1e-5 * abs(one["regions"]["right_lung"]), msg=lung)

    def by_cell(self, run):
        """Derivatives by the value of one cell add up to that of all, and to those of regions."""
        import h5py

        with h5py.File(run.path("sensitivities.h5")) as file:
            for key, derivatives in table(run).items():
                for option, whole in derivatives.items():
                    if not option.startswith("-ventilator"):
                        cells = file[f"{key}_by_{option[1:]}"][()]
                        self.assertAlmostEqual(cells.sum(), whole, delta=1e-9 * abs(cells).sum(), msg=key + option)

    def of_the_parts(self, run):
        """What the lungs take in is what both do."""
        by = table(run)
        for option, whole in by["tidal_volume_ml"].items():
            parts = [by["ventilation_ml_" + lung][option] for lung in ("right_lung", "left_lung")]
            self.assertAlmostEqual(sum(parts), whole, delta=1e-7 * max(map(abs, parts)), msg=option)

    def test_parameters_of_small_effect(self):
        """A step of 1e-7 of such a value would be lost in the residual: bigger ones are taken, and what rounding hides is left out."""
        def derivatives(offset):
            return table(pc.finished(SCENE + ["-chest_wall_offset", offset] + ASK))

        large, small, none = map(derivatives, ("1e-4", "1e-9", "1e-13"))
        for key, by in large.items():
            right = by["-chest_wall_offset"]
            self.assertAlmostEqual(small[key]["-chest_wall_offset"], right, delta=1e-2 * abs(right) + 1e-6, msg=key)
            self.assertNotIn("-chest_wall_offset", none[key])

    def test_values_of_very_different_size(self):
        """What is given for everywhere may be zero, or far from what parts of the lung have: they alone count."""
        for option, everywhere, body in (("-airflow_permeability", "1e-6", "100"), ("-chest_wall_offset", "0", "1")):
            with self.subTest(option=option):
                one = table(pc.finished(SCENE + [option, body] + ASK))
                other = table(pc.finished(SCENE + [option, f"{everywhere},body={body}"] + ASK))
                for key, by in one.items():
                    self.assertAlmostEqual(other[key][option], by[option], delta=1e-6 * abs(by[option]) + 1e-9, msg=key)

    def test_numbers_of_nothing(self):
        """What a solver leaves of a number has no derivative: work of an elastic lung without airflow, flow out through a closed valve."""
        elastic = pc.finished(STILL + ["-ventilator", "pcv", "-ventilator_inspiration", "0.5", "-ventilator_expiration", "0.5",
                                       "-sensitivities", "work,PIP,Q_exp"])
        self.assertLess(abs(elastic.json()["work_j"]), 1e-9)
        self.assertEqual(elastic.json()["sensitivities"]["not_defined"], ["work"])
        self.assertIn("this run has no work, or no more of it than rounding", elastic.out)
        self.assertNotIn("-ventilator_settle_duration", elastic.json()["sensitivities"]["left_out"])  # no phase hangs on it
        held = pc.finished(GAS + pc.programme("inspiration 0.3 hold\nfill 0.3 flow 200\nexpiration 0.5 pressure 0\n"
                                              "inspiration 0.3 flow 200\nexpiration 0.3 hold\n") + ["-sensitivities", "Q_exp,Q_peak"])
        self.assertEqual(held.json()["sensitivities"]["not_defined"], ["Q_exp"])
        self.assertEqual(list(held.json()["sensitivities"]["numbers"]), ["peak_flow_ml_per_s"])

    def test_numbers_that_are_zero(self):
        """There are no percents of nothing, in the table, the summary and the report."""
        case = pc.finished(GAS + ["-ventilator", "pcv", "-ventilator_pip", "0", "-ventilator_inspiration", "0.4", "-ventilator_expiration", "0.4",
                                  "-breathing_effort", "-breathing_effort_surfaces", "x0", "-breathing_effort_rise", "0.3",
                                  "-breathing_effort_period", "0.8", "-sensitivities", "PIP,V_T"])
        self.assertEqual(set(table(case, "percent_for_one_percent_more")["peak_inspiratory_pressure_cmH2O"].values()), {None})
        row = next(line for line in case.out.splitlines() if line.startswith("  -tissue_c "))
        self.assertEqual(row.split()[2], "-")
        told = pc.tool_called("report", case.directory)
        self.assertEqual(told.returncode, 0, told.stderr)
        with open(case.path("report.html"), encoding="utf-8") as f:
            text = f.read()
        part = text[text.index("One percent more of a parameter"):]
        part = part[:part.index("</table>")]
        self.assertIn("-breathing_effort_pressure", text)
        self.assertNotIn("differs by place", part)
        self.assertEqual(part.count('<th scope="col">'), 3)  # parameter, value, V_T

    def test_what_is_left_out(self):
        case = pc.finished(GAS + ["-ventilator", "pcv", "-ventilator_inspiration", "0.4", "-ventilator_expiration", "0.4", "-tube", "-tube_k1", "3",
                                  "-gravity", "-support", "-support_rigid", "-sensitivities", "V_T"])
        left_out = case.json()["sensitivities"]["left_out"]
        self.assertEqual(left_out["-ventilator_peep"], "it is zero")
        self.assertIn("-tube_k1", table(case)["tidal_volume_ml"])
        for option, why in (("-gravity_acceleration", "no equation reads it"),
                            ("-ventilator_inspiration", "ends of phases or steps move with it")):
            self.assertIn(why, left_out[option])
            self.assertRegex(case.out, f"Not in the table: [^.]*{option}[ ,]")
        self.assertNotIn("-sweep_rtol", left_out)
        self.assertEqual(set(left_out) & set(table(case)["tidal_volume_ml"]), set())

    def test_no_breath(self):
        """No phase begins one: told before the run. The first one is cut: why, once."""
        case = pc.Case(GAS + pc.programme("step 0.5 pressure 4\n") + ["-sensitivities", "V_T"])
        self.assertEqual(case.code, 1, case.tail())
        self.assertIn("no phase of the programme begins one: name one 'inspiration'", case.err)
        cut = pc.finished(SCENE + ["-ts_max_time", "0.3"] + ASK)
        self.assertEqual(cut.out.count("no sensitivities: the run ends within its first breath"), 1)
        self.assertEqual(cut.json()["sensitivities"]["failure"], "the run ends within its first breath")

    def test_notes(self):
        steps = pc.finished(SCENE + ["-step_volume_tolerance", "5", "-sensitivities", "V_T", "-sweep_memory", "1e300"])
        self.assertIn("-sensitivities: steps that are chosen by their error are taken to be as they are now", steps.out)
        self.assertGreater(len(table(steps)["tidal_volume_ml"]), 6)
        self.assertIn("The sweep of -sensitivities comes on top", pc.finished(SCENE + ASK + ["-dry_run"]).out)

    def test_what_is_not_asked_for_is_not_there(self):
        case = pc.finished(SCENE)
        self.assertNotIn("sensitivities", case.json())
        self.assertNotIn("1 % more", case.out)

    def test_numbers_that_the_run_has_not(self):
        case = pc.finished(SCENE + ["-ventilator_pause", "0", "-sensitivities", "P_plat,V_T"])
        self.assertIn("this run has no P_plat", case.out)
        self.assertEqual(list(case.json()["sensitivities"]["numbers"]), ["tidal_volume_ml"])
        self.assertEqual(case.json()["sensitivities"]["not_defined"], ["P_plat"])

    def test_refused(self):
        for options, words in ((["-sensitivities", "C_rs,compliance"], "knows no number 'compliance'"),
                               (["-sensitivities", "C_rs", "-prestress", "-prestress_method", "inverse"], "what -prestress solves for before the run"),
                               (["-sensitivities", "C_rs", "-petscfe_type", "basic"], "-petscfe_type"),
                               (["-sweep_rtol", "1e-3"], "-sensitivities"),
                               (["-sensitivities", "C_rs", "-sweep_rtol", "0"], "out of range")):
            with self.subTest(options=options):
                case = pc.Case(SCENE + options)
                self.assertEqual(case.code, 1, case.tail())
                self.assertIn(words, case.err)
        with self.subTest("no ventilator"):
            case = pc.Case(SCENE + ["-ventilator", "off", "-ventilator_tidal_volume", "1", "-sensitivities", "C_rs"])
            self.assertEqual(case.code, 1, case.tail())
        with self.subTest("restart"):
            half = pc.finished(SCENE + ASK + ["-ts_max_time", "0.4", "-checkpoint_every", "0.1"])
            case = pc.Case(SCENE + ["-restart", os.path.join(half.directory, "checkpoint.h5"), "-sensitivities", "C_rs"])
            self.assertEqual(case.code, 1, case.tail())
            self.assertIn("a restart has not those before it", case.err)
            rest = pc.finished(SCENE + ["-restart", os.path.join(half.directory, "checkpoint.h5")])  # without them it goes on
            self.assertNotIn("sensitivities", rest.json())


if __name__ == "__main__":
    pc.main()
