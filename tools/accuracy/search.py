"""Which runs to make: the ladders one by one, then settings of like errors jointly, cheapest first; and what they answer."""
import math
from dataclasses import dataclass

from shared.common import fail

from .errors import LOOSE, estimate
from .numbers import percent, short
from .settings import ORDERS, Setting

SPACE = 1 / 4     # a mesh comes before steps that cost as much: there are fewer, and fewer than three tell little
SINGLES = 2 / 3   # share of the budget that the ladders alone may take before joint runs had their turn
EVIDENCE = 3      # levels that a limit has to stand on for a question to be answered, where the ladder has as many
LIKE = 8          # joint settings whose single errors differ by more than this factor waste the smaller one


@dataclass
class Answer:
    """The cheapest setting that meets a tolerance (a share) for all asked numbers; `run` None: none of those made."""
    share: float
    keys: list
    run: object = None
    expected: object = None   # without a run: the cheapest setting that the single errors promise
    seconds: float = math.nan


class Search:
    """Makes the runs of a ladder. asked: key -> share of a question; without one the numbers `keys` at the default levels.
    named: keys that the user gave; the others are dropped where the scene does not have them."""

    def __init__(self, ladder, keys, asked, levels, named=()):
        self.ladder, self.axes = ladder, ladder.axes
        self.keys, self.asked, self.levels, self.named = keys, asked, levels, named
        self.dropped = []
        self._errors = (None, {})

    # ------------------------------------------------------------ what is known

    def errors(self):
        """`Errors` of every asked number that the base run has."""
        state = len(self.ladder.done)
        if self._errors[0] != state:
            base = self.ladder.done.get(self.axes.base)
            found = {key: estimate(key, self.ladder.values(key), self.axes) for key in (base.numbers if base else {})}
            self._errors = (state, found)
        return {key: self._errors[1][key] for key in self.keys if key in self._errors[1]}

    def all_errors(self):
        self.errors()
        return self._errors[1]

    def demands(self):
        """Tolerance by number: the question's, or each level for all numbers."""
        return [dict(self.asked)] if self.asked else [dict.fromkeys(self.keys, share) for share in self.levels]

    def worst(self, run, demand):
        """The largest error that a run may have in units of what is demanded."""
        errors = self.errors()
        return max((errors[k].worst(run.setting, run.numbers[k]) / share if k in run.numbers else math.inf
                    for k, share in demand.items() if k in errors), default=math.inf)

    def promised(self, setting, demand):
        """The same from the single errors alone."""
        errors = self.errors()
        return max(((errors[k].predicted(setting) + errors[k].doubt) / share for k, share in demand.items() if k in errors),
                   default=math.inf)

    def cheapest_run(self, demand):
        met = [run for run in self.ladder.done.values() if self.worst(run, demand) <= 1]
        return min(met, key=self.ladder.seconds, default=None)

    def candidates(self):
        """All settings whose single errors are known."""
        errors = list(self.errors().values())
        settings = dict.fromkeys([*self.axes.singles(), *self.axes.joint()])
        return [s for s in settings if s not in self.ladder.failed and errors and errors[0].known(s)]

    def cost(self, setting):
        done = self.ladder.done.get(setting)
        return self.ladder.seconds(done) if done else self.ladder.predict(setting)

    def promising(self, demand):
        """The cheapest setting that the single errors promise to meet the demand and that is not known to miss it."""
        met = [s for s in self.candidates() if self.promised(s, demand) <= 1
               and not (s in self.ladder.done and self.worst(self.ladder.done[s], demand) > 1)]
        return min(met, key=self.cost, default=None)

    def enough(self):
        """Whether the limits in space and time stand on three levels, or on all that there are: two show no order."""
        a = self.axes
        least = {"space": min(EVIDENCE, max(sum(m.elements == one.elements for m in a.meshes) for one in a.meshes)),
                 "time": min(EVIDENCE, max(sum(t.scheme == s and not t.tolerance for t in a.steps) for s in ORDERS))}
        return all(e.limits[name].levels >= n for e in self.errors().values() for name, n in least.items())

    def known(self):
        """Whether a question has its answer: a run meets it and nothing that is cheaper promises to."""
        run, best = self.cheapest_run(self.demands()[0]), self.promising(self.demands()[0])
        return run is not None and self.enough() and (best is None or self.cost(best) >= self.ladder.seconds(run))

    def answers(self):
        found = []
        for demand in self.demands():
            run, best = self.cheapest_run(demand), self.promising(demand)
            share = max(demand.values())
            found.append(Answer(share, list(demand), run, None if run else best, self.cost(best) if best and not run else math.nan))
        return found

    # ------------------------------------------------------------ what to run

    def explore(self):
        """Makes the runs."""
        if not self.ladder.attempt(self.axes.base):
            return
        self.check_numbers()
        if self.asked:
            self.tighten()
            self.solve()
            return
        self.singles(SINGLES * self.ladder.budget)
        for demand in self.demands():
            self.close_in(demand)
        self.joints()
        self.singles(self.ladder.budget)

    def check_numbers(self):
        """Ends the program if a number that the user named is none of the base run's or 0 there; drops defaults that are."""
        numbers = self.ladder.done[self.axes.base].numbers
        usable = ", ".join(short(k) for k, value in numbers.items() if value)
        if unknown := [short(k) for k in self.named if k not in numbers]:
            fail(f"the scene has no {', '.join(unknown)}; it has {usable}")
        if zero := [short(k) for k in self.named if not numbers[k]]:
            fail(f"{', '.join(zero)} is 0 in this scene and has no relative error; ask for one of {usable}")
        self.dropped = [k for k in self.keys if not numbers.get(k)]
        self.keys = [k for k in self.keys if k not in self.dropped]
        if not self.keys:
            fail(f"the scene has none of the default numbers; name some with --numbers: it has {usable}")

    def tighten(self):
        """Runs the base with the tightest solver tolerance, so that the solver's part is known."""
        base = self.axes.base
        tight = min((s for s in self.axes.solvers if s.tolerance < LOOSE), key=lambda s: s.tolerance, default=None)
        if tight and self.ladder.fits(setting := Setting(base.mesh, base.steps, tight)):
            self.ladder.attempt(setting)

    def untried(self, settings):
        rest = (s for s in settings if s not in self.ladder.done and s not in self.ladder.failed)
        return sorted(rest, key=lambda s: self.ladder.predict(s) * (SPACE if s.mesh != self.axes.base.mesh else 1))

    def singles(self, allowed):
        while rest := [s for s in self.untried(self.axes.singles()) if self.ladder.fits(s, allowed)]:
            self.ladder.attempt(rest[0])

    def close_in(self, demand):
        """Runs the cheapest promising setting until it is a run that meets the demand."""
        while (best := self.promising(demand)) and best not in self.ladder.done and self.ladder.fits(best):
            run = self.cheapest_run(demand)
            if run and self.ladder.seconds(run) <= self.cost(best):
                return
            self.ladder.attempt(best)

    def like(self, setting):
        """Whether the errors in space and time of a setting are of like size for one asked number at least."""
        for errors in self.errors().values():
            e_m, e_t, _ = errors.single(setting)
            small, large = sorted((max(e_m, errors.doubt), max(e_t, errors.doubt)))
            if large > 0 and large <= LIKE * small:
                return True
        return False

    def joints(self):
        """Settings of like errors that no cheaper one beats by what the single errors promise."""
        demand, best = dict.fromkeys(self.keys, 1.0), math.inf
        for setting in sorted(self.candidates(), key=self.cost):
            promised = self.promised(setting, demand)
            if promised >= best:
                continue
            best = promised
            if setting not in self.ladder.done and self.like(setting) and self.ladder.fits(setting):
                self.ladder.attempt(setting)

    def solve(self):
        """Answers a question: the ladders cheapest first; a setting that promises to meet it is tried as soon as it is the next
        cheapest thing to do."""
        demand = self.demands()[0]
        while not self.known():
            best = self.promising(demand)
            if best and self.enough() and best not in self.ladder.done and self.ladder.fits(best):
                self.ladder.attempt(best)
                continue
            rest = [s for s in self.untried(self.useful()) if self.ladder.fits(s)]
            if not rest:
                return
            self.ladder.attempt(rest[0])

    def useful(self):
        """Single runs that can still bring an answer: of ladders whose limit stands on less than three levels or is in doubt,
        or which lack a level that is good enough."""
        base, demand = self.axes.base, self.demands()[0]
        errors, found = self.errors(), []
        for setting in self.axes.singles():
            name = "space" if setting.mesh != base.mesh else "time" if setting.steps != base.steps else "solver"
            ladder = {"space": self.axes.meshes, "time": self.axes.steps, "solver": self.axes.solvers}[name]
            for key, share in demand.items():
                if key not in errors:
                    continue
                e = errors[key]
                if name != "solver" and e.limits[name].levels < EVIDENCE:
                    found.append(setting)
                    break
                good = e.smallest(ladder)
                if e.shares[name] > 0.15 * share * abs(e.value) or good > 0.4 * share or e.shares["coupling"] > 0.2 * share * abs(e.value):
                    found.append(setting)
                    break
        return found

    def sentences(self):
        """What is answered, in words."""
        texts = []
        for demand, answer in zip(self.demands(), self.answers()):
            what = ", ".join(f"{short(k)} within {percent(share)}" for k, share in demand.items())
            if self.asked:
                question = what
            else:
                question = f"{percent(answer.share)} in each of {', '.join(short(k) for k in demand)}"
            if answer.run:
                run = answer.run
                texts.append(f"**{question}**: {run.setting.name}; {run.cpu:.3g} s CPU, {run.wall:.3g} s wall, {run.memory:.0f} MB. "
                             f"Error with the reference's uncertainty at most "
                             + ", ".join(f"{short(k)} {100 * self.errors()[k].worst(run.setting, run.numbers[k]):.2g} %"
                                         for k in demand if k in run.numbers) + self.missing() + ".")
            elif answer.expected:
                texts.append(f"**{question}**: no run meets it within the budget; {answer.expected.name} promises to "
                             f"(about {answer.seconds:.3g} s){self.missing()}.")
            else:
                texts.append(f"**{question}**: nothing within the budget meets or promises it; a larger --budget or finer levels "
                             "are needed. " + self.obstacle(demand))
        return texts

    def missing(self):
        """Says which ladders no error was taken of."""
        names = dict.fromkeys(name for e in self.errors().values() for name in e.unexamined())
        return f" ({', '.join(names)} not examined)" if names else ""

    def obstacle(self, demand):
        """What stands in the way, of the number that is furthest off."""
        worst = []
        for key, share in demand.items():
            if key not in self.errors():
                worst.append((math.inf, f"{short(key)} is not defined in this scene"))
                continue
            e = self.errors()[key]
            parts = {"the uncertainty of the limit": e.doubt}
            for name, ladder in (("space", self.axes.meshes), ("time", self.axes.steps)):
                if name not in e.unexamined():
                    parts[f"the smallest error in {name}"] = e.smallest(ladder)
            name = max(parts, key=parts.get)
            size = f"{100 * parts[name]:.2g} %" if math.isfinite(parts[name]) else "not known: one level alone was run"
            worst.append((sum(parts.values()) / share, f"Furthest off is {short(key)}: {name} is {size}"))
        return max(worst)[1] + self.missing() + "."
