"""What the runs of a ladder say of one clinical number: its limit, the limit's uncertainty, the error of each setting.

The number of a setting (mesh m, steps t, solver s) is taken as Q* + e_m + e_t + e_s, each part measured alone: e_m on the meshes
with the base's steps, e_t with the steps on the base's mesh, e_s with the solvers on the base, each against the limit of
its own ladder. What the parts do to one another is seen in the runs that vary two at once. Q* comes from the run with
the smallest errors (the anchor) less its parts; its uncertainty is the sum of those of the ladders and of the coupling.
A ladder of one level is not examined: its error is taken as 0 in the sums, and said to be missing wherever they are shown.
"""
import math
from dataclasses import dataclass, field, replace

from .extrapolate import ROUNDING, Limit, limit
from .settings import ORDERS, Setting

LOOSE = 1e-8  # a tolerance below that of the solver files is taken as exact


@dataclass(frozen=True)
class Axes:
    """The three ladders; the first solver and the base's steps and mesh are what is held while another ladder is run."""
    meshes: list
    steps: list
    solvers: list
    base: Setting

    def singles(self):
        """Settings that differ from the base in one ladder at most, the base first."""
        b = self.base
        found = [b, *(Setting(b.mesh, t, b.solver) for t in self.steps), *(Setting(m, b.steps, b.solver) for m in self.meshes),
                 *(Setting(b.mesh, b.steps, s) for s in self.solvers)]
        return list(dict.fromkeys(found))

    def joint(self):
        """Settings that differ from the base in space and time; with the base's solver."""
        return [Setting(m, t, self.base.solver) for m in self.meshes for t in self.steps
                if m != self.base.mesh and t != self.base.steps]


@dataclass
class Errors:
    """Of one number. parts: signed error of each mesh, steps and solver alone; limits: of the ladders, by name."""
    key: str
    value: float = math.nan          # Q*
    uncertainty: float = math.inf
    shares: dict = field(default_factory=dict)   # of the uncertainty: time, space, solver, coupling; NaN: not examined
    limits: dict = field(default_factory=dict)
    parts: dict = field(default_factory=dict)
    anchor: Setting | None = None

    def known(self, setting):
        return all(part in self.parts for part in (setting.mesh, setting.steps, setting.solver))

    def relative(self, part):
        """|error| of a mesh, steps or solver alone as a share of the limit."""
        return abs(self.parts[part] / self.value) if self.value else abs(self.parts[part])

    def smallest(self, ladder):
        """The smallest of these; infinite if no level of the ladder was run."""
        return min((self.relative(part) for part in ladder if part in self.parts), default=math.inf)

    def single(self, setting):
        """|e_m|, |e_t|, |e_s| as shares of the value."""
        return [self.relative(part) for part in (setting.mesh, setting.steps, setting.solver)]

    def unexamined(self):
        """Ladders of a single level: their error is not known and in no sum."""
        return [name for name, share in self.shares.items() if math.isnan(share)]

    def predicted(self, setting):
        """Sum of the single errors' moduli: errors that happen to cancel do not count as accuracy."""
        return sum(self.single(setting)) if self.known(setting) else math.inf

    def of(self, value):
        """Error of a number, a share of the limit."""
        return (value - self.value) / abs(self.value) if self.value else value - self.value

    @property
    def doubt(self):
        """Uncertainty as a share of the limit."""
        return self.uncertainty / abs(self.value) if self.value else self.uncertainty

    def worst(self, setting, value):
        """The error that a run may have: measured or summed, whichever is larger, and the limit's uncertainty."""
        return max(abs(self.of(value)), self.predicted(setting)) + self.doubt


def in_time(values, axes):
    """Limits in time of each scheme on the base's mesh, and the surest of them; schemes that differ by more than both doubts
    widen it, unless only one shows an order: where the other still wanders its limit says nothing. Levels of one scheme that agree
    while those of the other do not are no limit either: long steps that all end at the same kink agree."""
    limits = {}
    for scheme in ORDERS:
        ladder = sorted(((t.dt, values[s]) for t in axes.steps if t.scheme == scheme and not t.tolerance
                         if (s := Setting(axes.base.mesh, t, axes.base.solver)) in values), reverse=True)
        if ladder:
            limits[scheme] = limit(*zip(*ladder), ORDERS[scheme])
    made = [values[s] for t in axes.steps if not t.tolerance and (s := Setting(axes.base.mesh, t, axes.base.solver)) in values]
    spread = max(made) - min(made)
    still = ROUNDING * max(map(abs, made))
    for scheme, found in limits.items():
        if found.uncertainty <= still < spread and found.order is None:
            limits[scheme] = Limit(found.value, spread, None, 1, found.how + ", not so the other scheme's")
    return limits, surest(limits.values(), "schemes")


def surest(limits, of):
    """The surest of several limits of one thing, wider if they contradict one another."""
    converging = [found for found in limits if found.order is not None] or list(limits)
    chosen = min(converging, key=lambda found: found.uncertainty)
    for other in converging:
        apart = abs(other.value - chosen.value)
        if apart > other.uncertainty + chosen.uncertainty:
            chosen = Limit(chosen.value, apart, chosen.order, chosen.levels, f"{chosen.how}; the {of}' limits differ")
    return chosen


def in_space(values, axes):
    """The surest of the element pairs' limits in space; of each pair a ladder of its own."""
    limits = []
    for elements in dict.fromkeys(m.elements for m in axes.meshes):
        ladder = [(m.size(), values[s]) for m in axes.meshes
                  if m.elements == elements and (s := Setting(m, axes.base.steps, axes.base.solver)) in values]
        if ladder:
            found = limit(*zip(*ladder), 2)
            limits.append(replace(found, how=f"{elements}: {found.how}") if elements else found)
    if len({m.cells for m in axes.meshes}) == 1 and limits:
        return Limit(limits[0].value, math.nan, None, 1, "one mesh given: not examined")
    return surest(limits, "elements")


def of_solver(values, axes):
    """The tightest solver's number; what the Newton steps left there is below rounding."""
    made = [(t.tolerance, values[s]) for t in axes.solvers if t.tolerance < LOOSE
            if (s := Setting(axes.base.mesh, axes.base.steps, t)) in values]
    base = values[axes.base]
    if not made:
        return Limit(base, math.nan, None, 1, "not examined")
    tight = min(made)[1]
    return Limit(tight, abs(tight - base) * 1e-2, None, 1, "the tightest tolerance")


def estimate(key, values, axes):
    """`Errors` of the number `key` from the values of the runs so far by setting; the base has to be among them."""
    base = axes.base
    schemes, time = in_time(values, axes)
    ladders = {"time": time, "space": in_space(values, axes), "solver": of_solver(values, axes)}
    errors = Errors(key, limits=ladders | {f"time {scheme}": found for scheme, found in schemes.items()})
    for setting in axes.singles():
        if setting in values:
            if setting.mesh == base.mesh and setting.solver == base.solver:
                errors.parts[setting.steps] = values[setting] - time.value
            if setting.steps == base.steps and setting.solver == base.solver:
                errors.parts[setting.mesh] = values[setting] - ladders["space"].value
            if setting.mesh == base.mesh and setting.steps == base.steps:
                errors.parts[setting.solver] = values[setting] - ladders["solver"].value

    def total(setting):
        return errors.parts[setting.mesh] + errors.parts[setting.steps] + errors.parts[setting.solver]

    def ratio(part, of_base):
        return min(1.0, abs(errors.parts[part] / errors.parts[of_base])) if errors.parts[of_base] else 1.0

    known = [s for s in values if errors.known(s)]
    e_m, e_t = errors.parts[base.mesh], errors.parts[base.steps]
    joint = [s for s in known if s.mesh != base.mesh and s.steps != base.steps]
    limit_alone = values[base] - total(base)
    if joint:
        anchor = min(joint, key=lambda s: ratio(s.mesh, base.mesh) + ratio(s.steps, base.steps))
        errors.value = values[anchor] - total(anchor)
        # coupling goes with the product of the parts: of what the anchor shows, this is left in its own parts
        coupling = abs(errors.value - limit_alone) * (ratio(anchor.mesh, base.mesh) + ratio(anchor.steps, base.steps))
    else:
        anchor, errors.value = base, limit_alone
        coupling = 2 * abs(e_m * e_t / limit_alone) if limit_alone else 0
    errors.anchor = anchor
    errors.shares = {name: found.uncertainty for name, found in ladders.items()} | {"coupling": coupling}
    errors.uncertainty = sum(share for share in errors.shares.values() if not math.isnan(share))
    return errors
