"""By how many percent each number changes where a parameter grows by one."""
from ..charts import number
from ..read import Missing
from .numbers import ROWS

NAME, TITLE = "sensitivities", "What the numbers hang on"


def build(run):
    told = run.summary.get("sensitivities")
    if not told:
        raise Missing("The run was not asked for derivatives: -sensitivities C_rs,R,V_T gives them from one sweep back over it.")
    if told["failure"]:
        raise Missing(f"There are none: {told['failure']}.")
    numbers = told["numbers"]
    if not numbers:
        raise Missing("The run defines none of the numbers that were asked for.")
    options = list(next(iter(numbers.values()))["parameters"])
    shown = {key: given for key, given in numbers.items() if given["value"] != 0}  # there are no percents of nothing
    if not shown:
        raise Missing("The numbers that were asked for are zero.")
    rows = []
    for option in options:
        of = [given["parameters"][option] for given in shown.values()]
        percent = [one["percent_for_one_percent_more"] for one in of]
        rows.append({"option": option, "value": number(of[0]["value"]), "unit": of[0]["unit"].replace("H2O", "H₂O"),
                     "values": ["differs by place" if p is None else f"{p:+.2f}".replace("-", "−") for p in percent]})
    return {"heads": [ROWS[key][0] for key in shown], "rows": rows, "seconds": number(told["seconds"], 3),
            "left_out": {option: why for option, why in told.get("left_out", {}).items() if why != "it is zero"}}
