"""The five tissue laws of the paper and its numbers for each."""
from dataclasses import dataclass


@dataclass(frozen=True)
class Law:
    """A tissue law of the paper: its name there and here, its colour in the figures, and the paper's numbers.

    compliance, lung_compliance: C_rs of Table 2 and C_l of Table 3, ml/cmH2O. resistance: cmH2O s/l.
    """

    label: str
    name: str
    colour: str
    compliance: float
    resistance: float
    lung_compliance: float


LAWS = [Law("CM1", "berger", "#c1272d", 123, 4.19, 358), Law("CM2", "ma", "#e08a1e", 100, 4.35, 256),
        Law("CM3", "birzle", "#3b8f4a", 84, 4.38, 195), Law("CM4", "yoshihara", "#2a6fb0", 38, 4.47, 57),
        Law("CM5", "rausch", "#6a4c93", 15, 4.55, 17)]
BY_LABEL = {law.label: law for law in LAWS}
# J of the unrestrained lung in equilibrium with 6 cmH2O: p = dW/dJ at F = J^(1/3) I, solved from Table 1
FREE_INFLATION = {"CM1": 2.7032, "CM2": 1.7671, "CM3": 4.2169, "CM4": 1.1325, "CM5": 1.0363}
