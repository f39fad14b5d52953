"""The runs of the paper: how long and fine each is, its options, and which part of the paper needs it."""
from dataclasses import dataclass, field

from .laws import BY_LABEL, LAWS

PIP = 6.0        # cmH2O, of the paper's PCV
PAPER = ["-options_file", "petsc_options/scenes/paper.opts"]
LUMEN = "lumen"  # ending of a run with -lumen_pressure


@dataclass(frozen=True)
class Run:
    """One run of the program: name of its folder, mesh, options, and its extent for the progress lines."""

    name: str
    mesh: str
    options: tuple
    duration: float  # s of simulated time
    dt: float        # s


@dataclass(frozen=True)
class Plan:
    """How long and fine everything is: the full plan, and a quick one for tests.

    laws: labels. springs: K_s of Figure 9, kPa/mm. meshes: name -> path, or arguments of tools/lung_mesh.
    """

    laws: tuple = tuple(law.label for law in LAWS)
    springs: tuple = (0.03, 0.08, 0.14, 0.2)
    dt: float = 0.05
    inspiration: float = 1
    pause: float = 0.25
    expiration: float = 2
    breaths: int = 2          # of VCV
    volume: float = 500       # ml, VCV
    syringe_dt: float = 0.15
    syringe_steps: int = 8
    syringe_pause: float = 2
    step_volume: float = 100  # ml
    field_times: float = 0.1  # s between snapshots
    meshes: dict = field(default_factory=lambda: {
        "pair": "meshes/lung_pair.msh",
        "coarse": "--side both --size 30 --airway-size 6",
        "fine": "--side both --size 17 --airway-size 2"})


QUICK = Plan(laws=("CM1", "CM3"), springs=(0.08,), dt=0.1, inspiration=0.2, pause=0.1, expiration=0.2, breaths=1, volume=100,
             syringe_dt=0.15, syringe_steps=1, syringe_pause=0.15, step_volume=30, field_times=0.1,
             meshes=dict.fromkeys(("pair", "coarse", "fine"), "meshes/lung_test.msh"))


class Cases:
    """The runs of a plan, by name, and what each part of the paper needs of them."""

    def __init__(self, plan):
        self.plan = plan
        self.laws = [BY_LABEL[label] for label in plan.laws]
        self.runs, self.parts = {}, {}
        for law in self.laws:
            self.pcv(law)
            self.springs(law)
            self.flow_modes(law)
        self.variants()
        pcv = self.named("pcv_")
        self.parts = {
            "table2": pcv, "table3": self.named("ks0_"), "figure3": pcv,
            "figure4": [self.runs["pcv_birzle"]], "figure5": pcv, "figure6": pcv, "figure7": self.named("vcv_"),
            "figure8": self.named("syringe_") + self.named("static_"), "figure9": self.named("ks"),
            "tried": self.named("tried_") + [self.runs["ks0.08_birzle"], self.runs["pcv_birzle"]]}

    def named(self, start):
        return [run for name, run in self.runs.items() if name.startswith(start)]

    def add(self, name, mesh, options, duration, dt):
        self.runs[name] = Run(name, mesh, tuple(map(str, options)), duration, dt)

    def pcv(self, law):
        """Tables and fields on the default pair; CM1 with the gas on the airway wall too."""
        keep = ["-output_fields_every", self.plan.field_times]
        self.breath(f"pcv_{law.name}", "pair", law, keep)
        if law.label == "CM1":
            self.breath(f"pcv_{law.name}_{LUMEN}", "pair", law, keep + ["-lumen_pressure"])

    def breath(self, name, mesh, law, options, dt=None):
        plan, dt = self.plan, dt or self.plan.dt
        self.add(name, mesh, ["-options_file", "petsc_options/scenes/pcv.opts", *PAPER, "-tissue", law.name, "-ts_dt", dt,
                              "-ventilator_pip", PIP, "-ventilator_inspiration", plan.inspiration,
                              "-ventilator_expiration", plan.expiration, *options],
                 plan.inspiration + plan.expiration, dt)

    def springs(self, law):
        """PCV against K_s; without springs the gas must not press on the open airway alone, so never with -lumen_pressure."""
        # CM5 has no shear stiffness at F = I: without springs its tangent is singular there, and old factors mislead
        fresh = ["-snes_lag_jacobian", 1, "-snes_lag_preconditioner", 1, "-snes_max_it", 100] if law.label == "CM5" else []
        self.breath(f"ks0_{law.name}", "coarse", law, ["-chest_wall", "off", "-support", "-support_rigid"] + fresh)
        wall = ["-lumen_pressure"] if law.label == "CM1" else []
        for stiffness in self.plan.springs:
            self.breath(f"ks{stiffness:g}_{law.name}", "coarse", law, ["-chest_wall_stiffness", stiffness] + wall)

    def flow_modes(self, law):
        """VCV, supersyringe, and the supersyringe without airflow; CM1 and CM2 with the gas on the airway wall too."""
        plan = self.plan
        vcv = ["-options_file", "petsc_options/scenes/vcv.opts", *PAPER, "-tissue", law.name,
               "-ventilator_tidal_volume", plan.volume, "-ventilator_inspiration", plan.inspiration,
               "-ventilator_pause", plan.pause, "-ventilator_expiration", plan.expiration,
               "-ventilator_breaths", plan.breaths, "-ts_dt", plan.dt]
        syringe = ["-options_file", "petsc_options/scenes/supersyringe.opts", *PAPER, "-tissue", law.name,
                   "-ventilator_steps", plan.syringe_steps, "-ventilator_step_volume", plan.step_volume]
        slow = ["-ventilator_pause", plan.syringe_pause, "-ts_dt", plan.syringe_dt]
        at_once = ["-airflow", "off", "-ventilator_pause", 0.3, "-ts_dt", 0.3]
        variants = {"": []} | ({f"_{LUMEN}": ["-lumen_pressure"]} if law.label in ("CM1", "CM2") else {})
        for ending, wall in variants.items():
            self.add(f"vcv_{law.name}{ending}", "coarse", vcv + wall,
                     plan.breaths * (plan.inspiration + plan.pause + plan.expiration), plan.dt)
            self.add(f"syringe_{law.name}{ending}", "coarse", syringe + slow + wall,
                     2 * plan.syringe_steps * (0.3 + plan.syringe_pause), plan.syringe_dt)
            self.add(f"static_{law.name}{ending}", "coarse", syringe + at_once + wall,
                     2 * plan.syringe_steps * 0.6, 0.3)

    def variants(self):
        """Other readings and resolutions, each against ks0.08_birzle (or alone for CM1)."""
        birzle, berger = BY_LABEL["CM3"], BY_LABEL["CM1"]
        normal = ["-chest_wall_direction", "normal"]
        self.breath("tried_normal", "coarse", birzle, normal)
        self.breath("tried_lumen", "coarse", birzle, ["-lumen_pressure"])
        self.breath("tried_half_dt", "coarse", birzle, [], self.plan.dt / 2)
        self.breath("tried_fine", "fine", birzle, [])
        self.breath("tried_normal_berger", "coarse", berger, normal)
