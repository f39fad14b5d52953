"""Table 3 and Figure 9: compliances of lung and chest wall against the spring stiffness."""
import matplotlib

from .cases import PIP
from .drawing import plt, save, write_csv
from .tables import difference, markdown, stop_text


def compliance_of(outcome):
    """Fitted compliance, ml/cmH2O; None of a run that stopped."""
    return outcome["compliance_ml_per_cmH2O"] if outcome.finished else None


def compliances(results):
    """law -> (C_l, [(K_s, C_rs, C_cw)]): eq. 53 from the runs with and without springs; None where a run stopped."""
    table = {}
    for law in results.cases.laws:
        C_l = compliance_of(results[f"ks0_{law.name}"])
        table[law] = (C_l, [])
        for stiffness in results.plan.springs:
            C_rs = compliance_of(results[f"ks{stiffness:g}_{law.name}"])
            C_cw = 1 / (1 / C_rs - 1 / C_l) if C_l and C_rs and C_rs < C_l else None
            table[law][1].append((stiffness, C_rs, C_cw))
    return table


def figure9(results, folder):
    figure, axes = plt.subplots(figsize=(6.2, 4.2))
    rows = []
    for law, (C_l, points) in compliances(results).items():
        label = law.label + ("*" if law.label == "CM1" else "")
        known = [(0, C_l, None)] + points
        curve = [(1000 * K, C) for K, C, _ in known if C]
        wall = [(1000 * K, C) for K, _, C in known if C]
        if curve:
            axes.semilogy(*zip(*curve), "-o", ms=3.5, color=law.colour, label=label)
        if wall:
            axes.semilogy(*zip(*wall), "-.s", ms=3, mfc="none", lw=1.0, color=law.colour)
        rows += [(label, K, C if C else "", W if W else "") for K, C, W in known]
    axes.plot([], [], "-o", ms=3.5, color="#777777", label="$C_{rs}$ ($C_l$ at $K_s$ = 0)")
    axes.plot([], [], "-.s", ms=3, mfc="none", lw=1.0, color="#777777", label="$C_{cw}$, eq. 53")
    axes.plot([80, 200], [200, 77], "k+", ms=9, mew=1.6, ls="none", label="$C_{cw}$ in the paper's text")
    axes.set(xlabel="spring stiffness $K_s$ (10$^{-3}$ kPa/mm)", ylabel="compliance (ml/cmH$_2$O)", xlim=(-4, None))
    axes.yaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), handlelength=2)
    save(figure, folder / "figure9.png")
    write_csv(folder / "figure9.csv", ["law", "spring_stiffness_kPa_per_mm", "compliance_ml_per_cmH2O",
                                       "chest_wall_compliance_ml_per_cmH2O"], rows)


def figure9_page(results):
    table = compliances(results)
    rows = []
    for i, stiffness in enumerate(results.plan.springs):
        walls = [points[i][2] for _, points in table.values()]
        rows.append((f"{1000 * stiffness:g}", {80: "200", 200: "77"}.get(round(1000 * stiffness), "–"),
                     *(f"{wall:.0f}" if wall else "–" for wall in walls)))
    return markdown(["K_s, 10⁻³ kPa/mm", "C_cw paper"] + [law.label for law in table], rows)


def table3(results, folder):
    rows = [(law.label, law.lung_compliance, compliance_of(results[f"ks0_{law.name}"]) or "") for law in results.cases.laws]
    write_csv(folder / "table3.csv", ["law", "lung_compliance_paper_ml_per_cmH2O", "lung_compliance_ml_per_cmH2O"], rows)


def table3_page(results):
    """Lung compliances beside the paper's and beside what a lung of this volume holds in the end at 6 cmH2O."""
    rows = []
    for law in results.cases.laws:
        outcome = results[f"ks0_{law.name}"]
        C_l = compliance_of(outcome)
        if not C_l:
            rows.append((law.label, law.lung_compliance, stop_text(outcome), "–", "–", "–"))
            continue
        at_rest = outcome["reference_volume_ml"] * (law.inflation - 1) / PIP
        rows.append((law.label, law.lung_compliance, f"{C_l:.1f}", difference(C_l, law.lung_compliance),
                     f"{outcome['tidal_volume_ml']:.0f}", f"{at_rest:.0f}"))
    return markdown(["law", "C_l paper", "C_l pulmo", "difference", "V(1 s) ml", "V(∞)/P"], rows)
