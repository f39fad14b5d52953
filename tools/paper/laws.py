"""The five tissue laws of the paper and its numbers for each."""
from dataclasses import dataclass

from benchmarks.plots import LAW_COLOURS


@dataclass(frozen=True)
class Law:
    """A tissue law of the paper: its name there and here, and the paper's numbers.

    compliance, lung_compliance: C_rs of Table 2 and C_l of Table 3, ml/cmH2O. resistance: cmH2O s/l.
    inflation: J of the unrestrained lung in equilibrium with 6 cmH2O: p = dW/dJ at F = J^(1/3) I, solved from Table 1.
    """

    label: str
    name: str
    compliance: float
    resistance: float
    lung_compliance: float
    inflation: float

    @property
    def colour(self):
        return LAW_COLOURS[self.name]


LAWS = [Law("CM1", "berger", 123, 4.19, 358, 2.7032), Law("CM2", "ma", 100, 4.35, 256, 1.7671),
        Law("CM3", "birzle", 84, 4.38, 195, 4.2169), Law("CM4", "yoshihara", 38, 4.47, 57, 1.1325),
        Law("CM5", "rausch", 15, 4.55, 17, 1.0363)]
BY_LABEL = {law.label: law for law in LAWS}
