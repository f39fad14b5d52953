"""A bar made of the lines that pulmo prints while it runs."""
import re
import sys
import time

ROW = re.compile(r"\s*([\d.]+)\s+(\S+)\s+(\d+)\s+(\d+)\s+(\S+)\s+(\S+)\s+(\S+)\s+(\d+)\s+(\w*)\s*$")
WIDTH = 30


class Progress:
    """On a terminal one line that changes; elsewhere a line for each tenth of the run. Warnings and errors are passed on."""

    def __init__(self, out=sys.stdout):
        self.out, self.terminal, self.begun, self.shown = out, out.isatty(), time.monotonic(), -1

    def take(self, line):
        if re.match(r"pulmo: (warning|error|note)", line):
            self.clear()
            self.out.write("  " + line)
            self.out.flush()
        row = ROW.match(line)
        if row:
            self.show(float(row[1]), row[5], row[6], float(row[8]), row[9])

    def show(self, t, pressure, volume, left, phase):
        spent = time.monotonic() - self.begun
        share = spent / (spent + left) if t > 0 else 0
        text = f"t {t:.3f} s {phase}: {pressure} cmH2O, {volume} ml; {spent:.0f} s spent, about {left:.0f} s left"
        if self.terminal:
            self.out.write("\r\033[K  [" + ("#" * round(WIDTH * share)).ljust(WIDTH) + "] " + text)
            self.out.flush()
        elif int(10 * share) > self.shown:
            self.shown = int(10 * share)
            self.out.write(f"  {100 * share:3.0f} %, {text}\n")
            self.out.flush()

    def clear(self):
        if self.terminal:
            self.out.write("\r\033[K")

    def end(self):
        self.clear()
