"""Words and rows of the page's tables."""
import re

from shared import common

from .outcome import reason


def difference(value, paper):
    """Relative difference in percent, as text."""
    return f"{100 * (value / paper - 1):+.0f} %"


def markdown(header, rows):
    """A Markdown table."""
    return "\n".join(common.markdown(header, rows))


def end_text(outcome):
    """`finished`, or the program's reason for a stop."""
    return "finished" if outcome.finished else reason(outcome.numbers)


def stop_text(outcome):
    """When and where a run stopped."""
    words = reason(outcome.numbers)
    place = re.search(r"in the cell at \(([^)]*)\) mm", words)
    where = ", cell at ({}) mm".format(", ".join(f"{float(x):.0f}" for x in place[1].split(","))) if place else ""
    return f"stops at {outcome['end_time_s']:.2f} s{where}"
