"""README.md of the reproduction."""
from shared.common import SOURCE

from .breaths import coarse_text, table2_page, tried_page
from .cases import QUICK
from .compartment import figure4_text
from .messages import say
from .springs import figure9_page, table3_page
from .syringe import syringe_page
from .waveforms import vcv_page


def write_page(results, folder):
    """README.md: the text of docs/paper/page.md.in with the numbers of the runs; parts not run yet are named as such."""
    plan, pair = results.plan, results["pcv_birzle"]

    def if_done(part, text):
        return text(results) if results.done(part) else f"*Not run yet: `tools/reproduce_paper --only {part}`.*"

    area = pair["surface_areas_mm2"]
    quick = "" if plan.laws != QUICK.laws else "**A quick run on a small lung to test the tool: the numbers mean nothing.**\n\n"
    balance = max((o["mass_balance_error_ml"] for _, _, o in results.all("pcv")), default=0) if results.done("table2") else 0
    (folder / "README.md").write_text((SOURCE / "docs/paper/page.md.in").read_text().format(
        quick=quick, volume=pair["reference_volume_ml"], pleura=area["pleura"] / 100, airway=area["airway"] / 100,
        cells=pair["cells"], coarse=if_done("tried", coarse_text), coarse_recipe=plan.meshes["coarse"], dt=plan.dt,
        syringe_dt=plan.syringe_dt, breaths=plan.breaths, tidal=plan.volume, balance=balance, figure4=figure4_text(results),
        table2=if_done("table2", table2_page), table3=if_done("table3", table3_page), vcv=if_done("figure7", vcv_page),
        syringe=if_done("figure8", syringe_page), figure9=if_done("figure9", figure9_page), tried=if_done("tried", tried_page)))
    say(f"wrote {folder / 'README.md'}")
