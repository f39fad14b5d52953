"""Charts of the page as data: what Chart.js draws in the browser, and the same numbers as a table."""
from .read import phase_spans

COLOURS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#8a6d00", "#000000"]  # Okabe & Ito, the yellow darker
DASHES = [[], [6, 3], [2, 2], [8, 3, 2, 3]]
SHADES = {"settle": "#eeeeee", "inspiration": "#dbe9f6", "expiration": "#fdf0e3", "pause": "#e8e1f2", "hold": "#e8e1f2",
          "inflation": "#dbe9f6", "deflation": "#fdf0e3"}
OTHER_SHADES = ["#e3f1e6", "#f3ecd2", "#dff0f2", "#f4e1ea"]  # of phases with names of their own
ROWS_OF_A_TABLE = 120
POINTS_OF_A_CURVE = 3000


def number(value, digits=4):
    """A number for readers: four digits that count, no exponent for everyday sizes."""
    if value is None:
        return "–"
    if value == 0:
        return "0"
    size = abs(value)
    if 1e-3 <= size < 1e6:
        text = f"{value:.{digits}g}"
        return f"{value:.0f}" if "e" in text else text
    return f"{value:.{digits}g}"


def thinned(count, keep=()):
    """Rows to draw of so many, those in `keep` among them: all, or every n-th."""
    step = -(-count // POINTS_OF_A_CURVE)
    return sorted({*range(0, count, step), count - 1, *keep}) if step > 1 else range(count)


def series(label, x, y, index=0, **more):
    """One curve; None in y leaves a gap."""
    return {"label": label, "x": [short(v) for v in x], "y": [short(v) for v in y],
            "colour": COLOURS[index % len(COLOURS)], "dash": DASHES[index % len(DASHES)]} | more


def short(value):
    """Seven digits are enough to draw and to hover over; they keep the page small."""
    return None if value is None else float(f"{value:.7g}")


def chart(name, title, x, y, curves, about="", *, x_unit="", y_unit="", height=15, **more):
    """`name` is the id on the page; `about` tells a reader who cannot see it what it shows."""
    return {"name": name, "title": title, "about": about, "height": height, "data": {
        "x": x, "y": y, "xUnit": x_unit, "yUnit": y_unit, "curves": curves} | more, "table": table(x, y, x_unit, y_unit, curves)}


def table(x, y, x_unit, y_unit, curves):
    """The drawn numbers: a column of x and one of y for curves that share x, else a block of rows for each curve."""
    def head(name, unit):
        return f"{name} ({unit})" if unit else name

    shared = all(c["x"] == curves[0]["x"] for c in curves)
    if shared:
        rows = list(zip(curves[0]["x"], *[c["y"] for c in curves]))
        heads = [head(x, x_unit)] + [c["label"] if len(curves) > 1 else head(y, y_unit) for c in curves]
    else:
        rows = [(c["label"], *point) for c in curves for point in zip(c["x"], c["y"])]
        heads = ["curve", head(x, x_unit), head(y, y_unit)]
    rows = [row for row in rows if row[-1] is not None or shared]
    step = -(-len(rows) // ROWS_OF_A_TABLE)
    return {"heads": heads, "rows": [[v if isinstance(v, str) else number(v, 5) for v in row] for row in rows[::max(step, 1)]],
            "every": step}


def shades(run):
    """[(phase, begin, end, colour)] of a run's phases."""
    spans = phase_spans(run.signals) if "phase" in run.signals else []
    others = [name for name in dict.fromkeys(span[0] for span in spans) if name not in SHADES]
    colour = SHADES | {name: OTHER_SHADES[i % len(OTHER_SHADES)] for i, name in enumerate(others)}
    return [[name, short(begin), short(end), colour[name]] for name, begin, end in spans]


def jumps(run, column):
    """Rows before which a signal jumps: the first step of a phase moves it far more than the steps beside that one do."""
    values, phase = run.signals[column], run.signals.get("phase")
    found = []
    if phase is None:
        return found
    for i in range(1, len(values)):
        if i > 1 and phase[i] == phase[i - 1]:
            continue
        beside = [abs(values[j] - values[j - 1]) for j in (i - 1, i + 1) if 0 < j < len(values)]
        if abs(values[i] - values[i - 1]) > 2 * max(beside, default=0) + 1e-9 * max(map(abs, values)):
            found.append(i)
    return found
