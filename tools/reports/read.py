"""How the page ends where it cannot be made, and the phases that it shades."""
import sys

import shared  # noqa: F401: where the module pulmo is
from pulmo.errors import Missing  # noqa: F401: of all sections


def fail(message):
    sys.exit(f"report: error: {message}")


def phase_spans(signals):
    """(name, begin, end) of each phase; a row at a switch belongs to the phase that ends."""
    time, phase = signals["time_s"], signals["phase"]
    spans = []
    for i in range(1, len(time)):
        if not spans or phase[i] != spans[-1][0]:
            spans.append([phase[i], time[i - 1], time[i]])
        spans[-1][2] = time[i]
    return spans
