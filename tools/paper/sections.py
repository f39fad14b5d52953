"""Figures 5 and 6: fields in the coronal plane."""
import numpy as np

from .drawing import plt, save, write_csv
from .waveforms import field_instants

# the four edges-to-corner and four inner pieces of a quadratic tetrahedron in VTK's order of nodes
PIECES = np.array([[0, 4, 6, 7], [1, 4, 5, 8], [2, 5, 6, 9], [3, 7, 8, 9],
                   [4, 9, 5, 6], [4, 9, 6, 7], [4, 9, 7, 8], [4, 9, 8, 5]])


def nodal(cells, values, n):
    """Cell values as means over the cells around each node (n nodes)."""
    total, count = np.zeros(n), np.zeros(n)
    np.add.at(total, cells.ravel(), np.repeat(values, cells.shape[1]))
    np.add.at(count, cells.ravel(), 1)
    return total / np.maximum(count, 1)


def section(points, cells, values, y):
    """Cut of quadratic tetrahedra with the plane of height y along the second axis.

    points: (n, 3). values: (k, n) nodal fields. Returns (x, z) of the corners (3 t, 2) of triangles and values (k, 3 t).
    """
    tets = cells[:, PIECES].reshape(-1, 4)
    distance = points[:, 1] - y
    above = distance[tets] > 0
    corners, weights = [], []

    def crossing(mine, i, j):
        a, b = mine[:, i], mine[:, j]
        share = distance[a] / (distance[a] - distance[b])
        return np.stack([a, b], axis=1), share

    for pattern in range(1, 15):
        bits = np.array([pattern >> k & 1 for k in range(4)], dtype=bool)
        mine = tets[(above == bits).all(axis=1)]
        up, down = np.flatnonzero(bits), np.flatnonzero(~bits)
        if len(up) == 2:
            ring = [(up[0], down[0]), (up[0], down[1]), (up[1], down[1]), (up[1], down[0])]
            triangles = [ring[:3], [ring[0], ring[2], ring[3]]]
        else:
            triangles = [[(i, j) for i in up for j in down]]
        for triangle in triangles:
            found = [crossing(mine, i, j) for i, j in triangle]
            corners.append(np.stack([ends for ends, _ in found], axis=1).reshape(-1, 2))
            weights.append(np.stack([share for _, share in found], axis=1).ravel())
    ends, share = np.concatenate(corners), np.concatenate(weights)

    def between(nodal_values):
        return nodal_values[..., ends[:, 0]] * (1 - share) + nodal_values[..., ends[:, 1]] * share

    return np.stack([between(points[:, 0]), between(points[:, 2])], axis=1), between(values)


def airway_height(nodes, cells, pressure):
    """Position of the coronal plane (y, mm): through the middle of the airway surfaces, where p is the airway's."""
    at_airway = np.isclose(pressure, pressure.max(), rtol=0, atol=1e-9 * abs(pressure.max()))
    return float(nodes[at_airway, 1].mean())


def field_figure(results, folder, name, fields):
    """Coronal sections of two fields at t1, t2, t3 for all laws (Figures 5 and 6).

    fields: [(dataset, label, factor, colour map, lowest value)].
    """
    instants = field_instants(results)
    laws = list(results.best("pcv"))
    cuts, rows = {}, []
    for law, outcome, label in laws:
        for k, t in enumerate(instants):
            nodes, cells, data = outcome.fields(t)
            volumes = np.abs(np.linalg.det(nodes[cells[:, 1:4]] - nodes[cells[:, :1]]))
            values = []
            for dataset, title, factor, _, _ in fields:
                raw = data[dataset] * factor
                values.append(raw if len(raw) == len(nodes) else nodal(cells, raw, len(nodes)))
                each = raw if len(raw) == len(cells) else raw[cells[:, :4]].mean(axis=1)
                rows.append((label, f"t{k + 1}", float(t), dataset, *weighted_spread(each, volumes)))
            _, _, at_peak = outcome.fields(instants[1])
            y = airway_height(nodes, cells, at_peak["alveolar_pressure_cmH2O"])
            deformed = nodes + data["displacement_mm"]
            cuts[label, k] = section(deformed, cells, np.array(values), y)
    write_csv(folder / f"{name}.csv", ["law", "instant", "time_s", "field", "mean", "percentile_5", "median",
                                       "percentile_95"], rows)
    figure = plt.figure(figsize=(9.6, 1.45 * len(laws) + 0.9), layout="none")
    everything = np.concatenate([cut[0] for cut in cuts.values()])
    (x0, z0), (x1, z1) = everything.min(axis=0) - 4, everything.max(axis=0) + 4
    left, top, gap = 0.055, 1 - 0.3 / figure.get_figheight(), 0.02
    width = (1 - left - gap) / 6
    height = (top - 0.5 / figure.get_figheight()) / len(laws)
    for f, (dataset, title, _, cmap, low) in enumerate(fields):
        shown = np.concatenate([cut[1][f] for cut in cuts.values()])
        norm = plt.Normalize(np.percentile(shown, 0.2) if low is None else low, np.percentile(shown, 99.7))
        for row, (_, _, label) in enumerate(laws):
            for k in range(3):
                axes = figure.add_axes((left + (3 * f + k) * width + f * gap, top - (row + 1) * height, width, height))
                corners, values = cuts[label, k]
                axes.tripcolor(corners[:, 0], corners[:, 1], np.arange(len(corners)).reshape(-1, 3), values[f],
                               shading="gouraud", cmap=cmap, norm=norm)
                axes.set(xlim=(x1, x0), ylim=(z0, z1), aspect="equal")  # seen from the front: the subject's right is left
                axes.axis("off")
                if row == 0:
                    axes.set_title(f"$t_{k + 1}$ = {instants[k]:g} s", fontsize=9, pad=2)
                if f == 0 and k == 0:
                    axes.text(-0.02, 0.5, label, transform=axes.transAxes, ha="right", va="center", fontsize=10,
                              fontweight="bold")
        bar = figure.add_axes((left + (3 * f + 0.5) * width + f * gap, 0.36 / figure.get_figheight(), 2 * width,
                               0.1 / figure.get_figheight()))
        scale = figure.colorbar(plt.cm.ScalarMappable(norm, cmap), cax=bar, orientation="horizontal", extend="both")
        scale.set_label(title, labelpad=1)
        bar.tick_params(labelsize=8, pad=1)
        figure.text(left + 3 * f * width + f * gap, 1 - 0.05 / figure.get_figheight(), "AB"[f], fontweight="bold",
                    fontsize=11, va="top")
    save(figure, folder / f"{name}.png", [cmap for _, _, _, cmap, _ in fields])


def weighted_spread(values, weights):
    """Mean and percentiles 5, 50, 95 of cell values weighted by volume."""
    order = np.argsort(values)
    share = (np.cumsum(weights[order]) - weights[order] / 2) / weights.sum()
    return (float(np.average(values, weights=weights)), *(float(np.interp(q, share, values[order])) for q in (0.05, 0.5, 0.95)))


def figure5(results, folder):
    field_figure(results, folder, "figure5", [
        ("J_mean", "volume ratio $J$", 1, "viridis", 1), ("alveolar_pressure_cmH2O", "alveolar pressure (cmH$_2$O)", 1, "plasma", 0)])


def figure6(results, folder):
    field_figure(results, folder, "figure6", [
        ("hydrostatic_stress_kPa", "effective hydrostatic stress (kPa)", 1, "cividis", None),
        ("von_mises_stress_kPa", "effective von Mises stress (kPa)", 1, "plasma", 0)])
