"""Table 2: compliance and resistance under PCV; and other readings and resolutions."""
from .drawing import write_csv
from .tables import difference, end_text, markdown, stop_text


def table2(results, folder):
    rows = []
    for label, law, o in results.all("pcv"):
        numbers = ([o[key] for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l", "tidal_volume_ml",
                                       "trapped_volume_ml", "min_jacobian")] if o.finished else [""] * 5)
        rows.append((label, law.compliance, numbers[0], law.resistance, *numbers[1:], end_text(o)))
    write_csv(folder / "table2.csv", ["law", "compliance_paper_ml_per_cmH2O", "compliance_ml_per_cmH2O",
                                      "resistance_paper_cmH2O_s_per_l", "resistance_cmH2O_s_per_l", "tidal_volume_ml",
                                      "trapped_volume_ml", "min_J", "outcome"], rows)


def table2_page(results):
    why = {"CM1": "the tissue at the airway's rim turns inside out",
           "CM1*": "another traction than the paper's: the gas presses on the airway wall (`-lumen_pressure`)"}
    rows = []
    for label, law, o in results.all("pcv"):
        if o.finished:
            C, R = o["compliance_ml_per_cmH2O"], o["resistance_cmH2O_s_per_l"]
            rows.append((label, f"{law.compliance:g}", f"{C:.1f}", difference(C, law.compliance),
                         f"{law.resistance:g}", f"{R:.2f}", difference(R, law.resistance), f"{o['tidal_volume_ml']:.0f}",
                         f"{o['min_jacobian']:.3f}", why.get(label, "geometry and mesh: see below")))
        else:
            fit = o.numbers["breaths"][-1].get("fit_until_cut", {}) if o.numbers["breaths"] else {}
            until = [f"({fit[key]:.{digits}f})" if fit.get(key) else "–" for key, digits in
                     (("compliance_ml_per_cmH2O", 1), ("resistance_cmH2O_s_per_l", 2))]
            rows.append((label, f"{law.compliance:g}", until[0], "–", f"{law.resistance:g}", until[1], "–", "–",
                         f"{o['min_jacobian']:.3f}",
                         f"{why.get(label, '')}: {stop_text(o)}; in brackets: the fit until there"))
    return markdown(["law", "C_rs paper", "C_rs pulmo", "difference", "R paper", "R pulmo", "difference", "V_T ml", "min J",
                     "why"], rows)


def tried_rows(results):
    """(what, outcome) of the variants, the reference first."""
    default, dt = results["pcv_birzle"], results.plan.dt
    names = {"ks0.08_birzle": "CM3, full springs, the paper's traction", "tried_normal": "CM3, normal springs",
             "tried_lumen": "CM3, gas on the airway wall", "tried_half_dt": f"CM3, Δt {dt / 2:g} s instead of {dt:g} s",
             "tried_fine": "CM3, finer mesh, 2 mm at the airway"}
    yield "CM3, default mesh, 3 mm at the airway", default
    for name, what in names.items():
        yield what, results[name]
    yield "CM1, normal springs", results["tried_normal_berger"]


def tried(results, folder):
    rows = []
    for what, o in tried_rows(results):
        numbers = [o[k] if o.finished else "" for k in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l")]
        rows.append((what, o["cells"], o["airway_area_mm2"] / 100, *numbers, end_text(o)))
    write_csv(folder / "tried.csv", ["what", "cells", "airway_area_cm2", "compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l",
                                     "outcome"], rows)


def tried_page(results):
    rows = []
    for what, o in tried_rows(results):
        numbers = ([f"{o['compliance_ml_per_cmH2O']:.1f}", f"{o['resistance_cmH2O_s_per_l']:.2f}", f"{o['tidal_volume_ml']:.0f}"]
                   if o.finished else [stop_text(o), "–", "–"])
        rows.append((what, o["cells"], *numbers))
    return markdown(["reading or resolution", "tets", "C_rs", "R", "V_T ml"], rows)


def coarse_text(results):
    """Size of the mesh of the studies, and how far CM3 is off the default mesh there."""
    pair, coarse = results["pcv_birzle"], results["ks0.08_birzle"]
    C, R = (coarse[key] / pair[key] - 1 for key in ("compliance_ml_per_cmH2O", "resistance_cmH2O_s_per_l"))
    return f"{coarse['cells']} tetrahedra; CM3 under PCV there: C_rs {C:+.1%}, R {R:+.1%} against the default mesh"
