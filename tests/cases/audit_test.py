#!/usr/bin/python3
"""Energy balance and regions of whole runs against numpy's own integrals over the fields of every step."""
import unittest

import numpy as np

import case_meshes
import pulmo_case as pulmo
from output_test import quadratic_shapes, read_fields, tetrahedron_rule

DT, PIP = 0.05, 8.0
BREATHS = ["-ventilator_pip", PIP, "-ventilator_peep", 2, "-ventilator_inspiration", 0.2, "-ventilator_pause", 0.1,
           "-ventilator_expiration", 0.2, "-ventilator_breaths", 2, "-ventilator_ramp", 0.1, "-ts_dt", DT]
EXACT = ["-quadrature_degree", 6]
EVERY_STEP = ["-output_fields_every", 1e-6]
PERMEABILITY, STIFFNESS = 300.0, {"pleura": 0.08, "airway": 0.05}
GAS = ["-airflow_permeability", PERMEABILITY, "-chest_wall_stiffness_airway", STIFFNESS["airway"]]
ENERGY = ["ventilator_work", "external", "elastic_tissue", "elastic_springs", "resistive", "resistive_tube",
          "numerical_dissipation", "residual"]
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
EDGE_PAIRS = ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))


def two_bodies(volume_names):
    """Options of two boxes of different size beside each other; the airway is the lower face of each.

    @param volume_names function of (body, centroid) that gives the physical name of a cell, or None.
    """
    boxes = [case_meshes.kuhn((2, 2, 2), (12, 10, 9)), case_meshes.kuhn((2, 2, 3), (10, 10, 14))]
    points = np.vstack([boxes[0][0] + [30, 0, 0], boxes[1][0]])
    parts = [boxes[0][1], boxes[1][1] + len(boxes[0][0])]
    cells = np.vstack(parts)
    facets = case_meshes.boundary(cells)
    tags = {None: (99, 3), "airway": (1, 2), "pleura": (2, 2)}
    volumes = [volume_names(b, points[c].mean(axis=0)) for b, part in enumerate(parts) for c in part]
    for name in volumes:
        tags.setdefault(name, (len(tags), 3))
    surface = np.where(np.abs(points[facets][:, :, 2]).max(axis=1) < 1e-9, 1, 2)
    return case_meshes.save(points, [("triangle", facets, surface), ("tetra", cells, [tags[name][0] for name in volumes])],
                            {name: tag for name, tag in tags.items() if name})


class Fields:
    """Gradients and values at the points of a rule in every cell, for one snapshot."""

    def __init__(self, x, cells, step, rule=4):
        u = step[1]["displacement_mm"]
        p = step[1].get("alveolar_pressure_cmH2O", np.zeros(len(x))) * pulmo.KPA_PER_CMH2O
        self.weights, self.F, self.p, self.grad_p = [], [], [], []
        for point, weight in tetrahedron_rule(rule):
            g = quadratic_shapes(point)
            dX = np.einsum("cni,nj->cij", x[cells], g)
            inverse = np.linalg.inv(dX)
            dN = np.einsum("nj,cjk->cnk", g, inverse)
            l = np.array([1 - sum(point), *point])
            self.weights.append(weight * np.linalg.det(dX))
            self.F.append(np.eye(3) + np.einsum("cni,cnk->cik", u[cells], dN))
            self.p.append(p[cells[:, :4]] @ l)
            corner = np.array([[-1, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
            self.grad_p.append(np.einsum("cn,nj,cjk->ck", p[cells[:, :4]], corner, inverse))
        self.J = [np.linalg.det(F) for F in self.F]
        self.u = u

    def integral(self, density, chosen=slice(None)):
        """Integral over the chosen cells of density(q), q the number of a point."""
        return sum((self.weights[q] * density(q))[chosen].sum() for q in range(len(self.weights)))


class EnergyOfTheFields(unittest.TestCase):
    """Yoshihara's law, W = c (I1 - 3) + c/beta (J^(-2 beta) - 1), airflow and springs of two stiffnesses."""
    C, BETA = 1.298, 0.75

    @classmethod
    def setUpClass(cls):
        cls.case = pulmo.finished(pulmo.TIGHT + pulmo.PCV + pulmo.CUBE + BREATHS + GAS + EVERY_STEP +
                                  EXACT + ["-tissue", "yoshihara"])
        cls.rows, cls.summary = cls.case.signals(), cls.case.json()
        cls.energy = cls.case.signals("energy.csv")
        cls.points, cls.cells, steps = read_fields(cls.case)
        assert len(steps) == len(cls.rows["time_s"]), "a snapshot a row"
        cls.fields = [Fields(cls.points, cls.cells, step) for step in steps]

    def increments(self, name):
        return np.diff(self.energy[name + "_j"])

    def close(self, found, expected, tolerance):
        self.assertLess(np.abs(found - expected).max(), tolerance * np.abs(expected).max())
        self.assertGreater(np.abs(expected).max(), 0)

    def energy_density(self, f, q):
        return self.C * (np.einsum("cij,cij->c", f.F[q], f.F[q]) - 3) + self.C / self.BETA * (f.J[q]**(-2 * self.BETA) - 1)

    def stress(self, f, q):
        inverse_transposed = np.swapaxes(np.linalg.inv(f.F[q]), 1, 2)
        return 2 * self.C * f.F[q] - 2 * self.C * (f.J[q]**(-2 * self.BETA))[:, None, None] * inverse_transposed

    def springs(self, u):
        """1/2 K_s |u|^2 over the surfaces: quadratic triangles, exact rule of degree 4 on straight facets."""
        a, b, wa, wb = 0.445948490915965, 0.091576213509771, 0.223381589678011, 0.109951743655322
        rule = [((a, a, 1 - 2 * a), wa), ((a, 1 - 2 * a, a), wa), ((1 - 2 * a, a, a), wa),
                ((b, b, 1 - 2 * b), wb), ((b, 1 - 2 * b, b), wb), ((1 - 2 * b, b, b), wb)]
        total = 0
        faces = {}
        for cell in self.cells:
            for face in FACES:
                faces.setdefault(tuple(sorted(cell[list(face)])), []).append((cell, face))
        for found in faces.values():
            if len(found) > 1:
                continue
            cell, (i, j, k) = found[0]
            x = self.points[cell[[i, j, k]]]
            area = np.linalg.norm(np.cross(x[1] - x[0], x[2] - x[0])) / 2
            edge = {frozenset(pair): 4 + n for n, pair in enumerate(EDGE_PAIRS)}
            middle = [cell[edge[frozenset(pair)]] for pair in ((i, j), (j, k), (i, k))]
            surface = "airway" if np.abs(x[:, 0] - 10).max() < 1e-9 else "pleura"
            for (l0, l1, l2), weight in rule:
                shapes = [l0 * (2 * l0 - 1), l1 * (2 * l1 - 1), l2 * (2 * l2 - 1), 4 * l0 * l1, 4 * l1 * l2, 4 * l0 * l2]
                value = np.array(shapes) @ u[[*cell[[i, j, k]], *middle]]
                total += STIFFNESS[surface] / 2 * weight * area * (value @ value)
        return total

    def test_elastic_rows(self):
        tissue = [f.integral(lambda q, f=f: self.energy_density(f, q)) * 1e-6 for f in self.fields]
        self.close(self.energy["elastic_tissue_j"], np.array(tissue), 1e-6)
        springs = [self.springs(f.u) * 1e-6 for f in self.fields]
        self.close(self.energy["elastic_springs_j"], np.array(springs), 1e-10)

    def test_resistive_row(self):
        """dt times the integral of k J |F^-T Grad p|^2."""
        heat = []
        for f, dt in zip(self.fields[1:], self.rows["dt_s"][1:]):
            heat.append(dt * PERMEABILITY * 1e-6 * f.integral(lambda q, f=f: f.J[q] * (
                np.einsum("cji,cj->ci", np.linalg.inv(f.F[q]), f.grad_p[q])**2).sum(axis=1)))
        self.close(self.increments("resistive"), np.array(heat), 1e-5)

    def test_work_of_the_ventilator(self):
        P, Q, dt = (self.rows[c] for c in ("airway_pressure_cmH2O", "flow_ml_per_s", "dt_s"))
        work = np.cumsum(P * Q * dt) * pulmo.KPA_PER_CMH2O * 1e-3
        self.close(self.energy["ventilator_work_j"], work, 1e-12)

    def test_numerical_row(self):
        """The sum of P' : dF - dW + p (dJ - cof F : dF) and of the springs' 1/2 K_s |du|^2."""
        lost = []
        for before, f in zip(self.fields, self.fields[1:]):
            def density(q):
                D = f.F[q] - before.F[q]
                cofactor = f.J[q][:, None, None] * np.swapaxes(np.linalg.inv(f.F[q]), 1, 2)
                return (np.einsum("cij,cij->c", self.stress(f, q), D) - self.energy_density(f, q) +
                        self.energy_density(before, q) +
                        f.p[q] * (f.J[q] - before.J[q] - np.einsum("cij,cij->c", cofactor, D)))
            lost.append(1e-6 * (f.integral(density) + self.springs(f.u - before.u)))
        self.close(self.increments("numerical_dissipation"), np.array(lost), 1e-5)

    def test_balance_closes(self):
        e = self.energy
        self.assertEqual(self.case.columns("energy.csv"), ["time_s"] + [name + "_j" for name in ENERGY])
        np.testing.assert_array_equal(e["time_s"], self.rows["time_s"])
        residual = (e["ventilator_work_j"] + e["external_j"] - e["elastic_tissue_j"] - e["elastic_springs_j"] -
                    e["resistive_j"] - e["resistive_tube_j"] - e["numerical_dissipation_j"])
        np.testing.assert_allclose(residual, e["residual_j"], atol=1e-14 * e["ventilator_work_j"].max())
        self.assertLess(np.abs(residual).max(), 1e-9 * e["ventilator_work_j"][-1])

    def test_summary(self):
        s = self.summary["energy_j"]
        self.assertEqual(set(s), set(ENERGY) | {"residual_relative"})
        for name in ENERGY:
            self.assertAlmostEqual(s[name], self.energy[name + "_j"][-1], delta=1e-14)
        time = self.rows["time_s"]
        starts = [0.3, 0.8, 1.3]  # settle 0.3 s, breaths of 0.5 s
        self.assertEqual(len(self.summary["breaths"]), 2)
        for number, begin, end in zip(self.summary["breaths"], starts, starts[1:]):
            first, last = (int(np.abs(time - t).argmin()) for t in (begin, end))
            full = first + int(self.rows["volume_ml"][first:last + 1].argmax())
            for block_name, row in (("energy_j", last), ("inspiratory_energy_j", full)):
                for name in ENERGY:
                    column = self.energy[name + "_j"]
                    self.assertAlmostEqual(number[block_name][name], column[row] - column[first], delta=1e-14)
            self.assertGreater(number["inspiratory_energy_j"]["elastic_tissue"], 0)

    def test_alveolar_numbers(self):
        """Auto-PEEP and static compliance from the mean of p over the reference volume."""
        time, V = self.rows["time_s"], self.rows["volume_ml"]
        mean = [f.integral(lambda q, f=f: f.p[q]) / f.integral(lambda q: 1.0) / pulmo.KPA_PER_CMH2O for f in self.fields]
        for number, (begin, end) in zip(self.summary["breaths"], ((0.3, 0.8), (0.8, 1.3))):
            first, last = (int(np.abs(time - t).argmin()) for t in (begin, end))
            self.assertAlmostEqual(number["total_peep_cmH2O"], mean[last], places=9)
            self.assertAlmostEqual(number["auto_peep_cmH2O"], mean[last] - 2, places=9)
            self.assertGreater(number["auto_peep_cmH2O"], 1e-6)
            tidal = V[first:last + 1].max() - V[first]
            self.assertAlmostEqual(number["static_compliance_ml_per_cmH2O"], tidal / (PIP - mean[first]), places=9)

    def test_off(self):
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", 0.1, "-energy_audit", "off"])
        self.assertNotIn("energy.csv", case.files())
        self.assertNotIn("energy_j", case.json())
        self.assertNotIn("energy_j", case.json()["breaths"][0])
        self.assertNotIn("ventilator_work", case.out)


class Regions(unittest.TestCase):
    """Two bodies of different size and two breaths; the numbers of each from the fields."""

    def run_mesh(self, volume_names, ranks=1, more=()):
        return pulmo.finished(pulmo.TIGHT + pulmo.PCV + two_bodies(volume_names) + ["-mesh_scale", "1"] + BREATHS + GAS +
                              list(more), ranks=ranks)

    def check(self, case, name, chosen):
        """The region `name` against the integrals over the cells that chosen(centroid) takes."""
        rows, region = case.signals(), case.json()["regions"][name]
        points, cells, steps = read_fields(case)
        mine = chosen(points[cells[:, :4]].mean(axis=1))
        self.assertTrue(mine.any())
        time = rows["time_s"]
        first, last = (int(np.abs(time - t).argmin()) for t in (0.8, 1.3))
        full = first + int(rows["volume_ml"][first:last + 1].argmax())
        start, end = (Fields(points, cells, steps[row], rule=5) for row in (first, full))  # J^2 is of degree 6
        volume = end.integral(lambda q: 1.0, mine)
        self.assertAlmostEqual(region["reference_volume_ml"], volume / 1000, places=12)
        took = [f.integral(lambda q, f=f: f.J[q] - 1, mine) / 1000 for f in (start, end)]
        self.assertAlmostEqual(region["ventilation_ml"], took[1] - took[0], places=12)
        whole = [f.integral(lambda q, f=f: f.J[q] - 1) / 1000 for f in (start, end)]
        self.assertAlmostEqual(region["ventilation_share"], (took[1] - took[0]) / (whole[1] - whole[0]), places=10)
        p = [value / pulmo.KPA_PER_CMH2O for value in end.p]
        for key, values, unit in (("jacobian", end.J, ""), ("alveolar_pressure", p, "_cmH2O")):
            mean = end.integral(lambda q: values[q], mine) / volume
            square = end.integral(lambda q: (values[q] - mean)**2, mine) / volume
            self.assertAlmostEqual(region[f"{key}_mean{unit}"], mean, places=10, msg=key)
            self.assertAlmostEqual(region[f"{key}_sd{unit}"] / np.sqrt(square), 1, delta=1e-9, msg=key)
            self.assertGreater(square, 0)

    def sums(self, case, names):
        regions = case.json()["regions"]
        for key, whole in (("reference_volume_ml", case.json()["reference_volume_ml"]), ("ventilation_share", 1),
                           ("ventilation_ml", case.json()["tidal_volume_ml"])):
            self.assertAlmostEqual(sum(regions[n][key] for n in names) / whole, 1, delta=1e-12, msg=key)

    def test_named_bodies(self):
        case = self.run_mesh(lambda body, x: ("right_lung", "left_lung")[body], more=EVERY_STEP + EXACT)
        regions = case.json()["regions"]
        self.assertEqual(set(regions), {"right_lung", "left_lung"})
        self.assertTrue(all(r["connected_body"] for r in regions.values()))
        self.check(case, "right_lung", lambda x: x[:, 0] > 20)
        self.check(case, "left_lung", lambda x: x[:, 0] < 20)
        self.sums(case, regions)
        self.assertNotAlmostEqual(regions["right_lung"]["jacobian_mean"], regions["left_lung"]["jacobian_mean"], places=3)
        for name in regions:
            self.assertRegex(case.out, rf"(?m)^  {name} ")

    def test_lobes_and_unnamed_bodies(self):
        """Two names within one body, a number alone for the other: a body of two names is listed beside them."""
        case = self.run_mesh(lambda body, x: None if body else "upper" if x[2] > 4.5 else "lower", more=EVERY_STEP + EXACT)
        regions = case.json()["regions"]
        self.assertEqual(set(regions), {"upper", "lower", "99", "body_1"})
        self.assertEqual({n for n in regions if regions[n]["connected_body"]}, {"99", "body_1"})
        self.check(case, "99", lambda x: x[:, 0] < 20)
        self.check(case, "body_1", lambda x: x[:, 0] > 20)
        self.check(case, "upper", lambda x: (x[:, 0] > 20) & (x[:, 2] > 4.5))
        self.check(case, "lower", lambda x: (x[:, 0] > 20) & (x[:, 2] < 4.5))
        self.sums(case, ["99", "body_1"])
        self.sums(case, ["99", "upper", "lower"])

    def test_any_number_of_ranks(self):
        names = lambda body, x: None if body else "upper" if x[2] > 4.5 else "lower"
        one, three = (self.run_mesh(names, ranks=ranks).json() for ranks in (1, 3))
        self.assertEqual(list(one["regions"]), list(three["regions"]))
        for name, region in one["regions"].items():
            for key, value in region.items():
                self.assertAlmostEqual(three["regions"][name][key], value, places=9, msg=f"{name} {key}")
        for name in ENERGY:
            self.assertAlmostEqual(one["energy_j"][name], three["energy_j"][name], delta=1e-9 * one["energy_j"]["ventilator_work"])

    def test_one_body_is_no_table(self):
        case = pulmo.finished(pulmo.DIRECT + pulmo.PCV + pulmo.CUBE + ["-ts_max_time", 0.1])
        self.assertEqual(list(case.json()["regions"]), ["lung"])
        self.assertNotIn("Region", case.out)

    def test_without_a_gas_pressure(self):
        case = pulmo.finished(pulmo.TIGHT + pulmo.CUBE + [
            "-support", "-support_surfaces", "pleura", "-traction", "-traction_surfaces", "airway", "-traction_value",
            "0.2,0,0", "-ts_max_time", "0.1"])
        region = case.json()["regions"]["lung"]
        self.assertIsNone(region["alveolar_pressure_mean_cmH2O"])
        self.assertGreater(region["jacobian_mean"], 1)
        self.assertIsNone(case.json()["functional_residual_capacity_ml"])


if __name__ == "__main__":
    pulmo.main()
