"""Figure 8: the supersyringe, with and without airflow."""
import numpy as np

from .cases import LUMEN
from .drawing import letter_panels, plt, save, write_csv
from .tables import markdown, stop_text


def static_points(outcome):
    """Volume (ml) and pressure (cmH2O) at rest and at the end of each pause of a supersyringe run."""
    rows = np.concatenate([[0], outcome.pauses()])
    return outcome.volume[rows], outcome.pressure[rows]


def figure8(results, folder):
    figure, (left, right) = plt.subplots(1, 2, figsize=(9.4, 4.0))
    rows = []
    for law, outcome, label in results.best("syringe"):
        left.plot(outcome.time, outcome.pressure, color=law.colour, lw=1.0,
                  label=label + ("" if outcome.finished else " (stops)"))
        right.plot(outcome.pressure, outcome.volume, color=law.colour, lw=0.7)
        V, P = static_points(outcome)
        right.plot(P, V, "o", ms=3.5, color=law.colour)
        rows += [(label, "dynamic", float(t), float(p), float(v))
                 for t, p, v in zip(outcome.time, outcome.pressure, outcome.volume)]
        rows += [(label, "end of pause", "", float(p), float(v)) for p, v in zip(P, V)]
    for law, outcome, label in results.best("static"):
        V, P = static_points(outcome)
        right.plot(P, V, ":", color="#222222", lw=1.2, zorder=3)
        rows += [(label, "without airflow", "", float(p), float(v)) for p, v in zip(P, V)]
    right.plot([], [], color="#777777", lw=0.7, label="dynamic")
    right.plot([], [], "o", ms=3.5, color="#777777", label="end of each pause, up and down")
    right.plot([], [], ":", color="#222222", lw=1.2, label="static, scene without airflow")
    left.set(xlabel="time (s)", ylabel="airway pressure (cmH$_2$O)", xlim=(0, None))
    right.set(xlabel="airway pressure (cmH$_2$O)", ylabel="volume above rest (ml)", ylim=(0, None))
    left.legend(loc="upper right", handlelength=1.5)
    right.legend(loc="lower right", handlelength=1.5)
    letter_panels((left, right))
    save(figure, folder / "figure8.png")
    write_csv(folder / "figure8.csv", ["law", "curve", "time_s", "airway_pressure_cmH2O", "volume_ml"], rows)


def syringe_page(results):
    rows = []
    for label, law, o in results.all("syringe"):
        if not o.finished:
            rows.append((label, stop_text(o), "–", "–", "–"))
            continue
        V, P = static_points(o)
        top = int(np.argmax(V))
        gap = np.abs(P[:top + 1] - P[top:][::-1]).max()
        static = results[f"static_{law.name}" + (f"_{LUMEN}" if label.endswith("*") else "")]
        apart = f"{np.abs(static_points(static)[1] - P).max():.3f}" if static.finished else f"static run {stop_text(static)}"
        rows.append((label, f"{P[top]:.2f}", f"{V[top] / P[top]:.1f}", f"{gap:.3f}", apart))
    return markdown(["law", f"static P at {V[top]:.0f} ml" if rows and rows[-1][2] != "–" else "static P at the top",
                     "V/P there, ml/cmH2O", "inflation − deflation, cmH2O", "from the scene without airflow, cmH2O"], rows)
