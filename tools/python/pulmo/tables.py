"""Tables that a run writes, also while it is at work."""
import csv

import numpy as np


def pandas():
    """pandas, loaded with the first DataFrame: tools that read runs need none."""
    import pandas as loaded

    return loaded


def whole_rows(path):
    """Rows of a table, {column: text}; one that is not written to its end yet is left out."""
    with open(path, newline="") as f:
        text = f.read()
    return list(csv.DictReader(text[:text.rfind("\n") + 1].splitlines()))


def columns(path):
    """Columns of a table: arrays of numbers, and the phases as an array of names."""
    rows = whole_rows(path)
    return {name: np.array([row[name] if name == "phase" else float(row[name]) for row in rows]) for name in rows[0]}
