"""From drives to the name of what the model lacks."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from ..errors import ConfigurationError, StCoreError
from ..log import DriveLog
from ..models import Model
from ..vehicle import VehicleParameters
from . import choice, gap, manoeuvres, several, testable
from .floor import ROUNDS, Floor, assumed, astray, learn, noisier, suspicions
from .quadratic import row_errors
from .result import Candidate, Discovery, FittedParameter, FoundEffect, Separability, WhereStatement
from .settings import DiscoverySettings
from .space import Space
from .study import Fit, Study
from .where import where
from .windows import Windows

Progress = Callable[[str, int, int], None]
LEAST_BLOCKS = 4
ASTRAY = 0.2  # share of the windows
TRIED = 7  # hypotheses fitted to the end
DOUBTED = "runs do not agree in it or it explains little alone"
KEPT = 4  # floors of references, for who discovers again and again
_floors: dict[tuple, tuple[tuple, Floor, dict]] = {}


def discover(runs: Sequence[DriveLog], vehicle: VehicleParameters, base: str | Model = "nonlinear",
             reference: Sequence[DriveLog] = (), settings: DiscoverySettings | None = None,
             progress: Progress | None = None) -> Discovery:
    """The effects the base model lacks to explain the runs.

    runs: suspect drives. reference: drives of the healthy car; effects are then changes against it, without they are
    what the base lacks against the vehicle file. vehicle: as in its file. progress(stage, done, total): called as the
    work goes on.

    All hypotheses are simulated through the model and fitted to multi-step errors, weighted as errors on the healthy
    drives go together. One is believed when it gains more than any gains on healthy data; the answer is every name
    not worse than the best. Raises StCoreError for runs in which nothing can be predicted, ConfigurationError for
    settings that do not fit the base. Checked by: test_discovery*.py.
    """
    settings = settings or DiscoverySettings()
    reference = list(reference)
    found = _Work(list(runs), vehicle, base, reference, settings, progress).result()
    if found.outcome != "unknown" or not reference:
        return found
    return _in_part(found, list(runs), vehicle, base, reference, settings, progress) or found


def _in_part(found: Discovery, runs, vehicle, base, reference, settings, progress) -> Discovery | None:
    """What the later or the earlier halves of the runs say alone, where the whole is explained by nothing: an effect
    may have come or gone on the way. What both halves show was there all the time."""
    least = 1_000_000_000 * (2.0 * settings.horizon + 4.0)
    if any(run.end_ns - run.start_ns < 2 * least for run in runs):
        return None
    said = []
    for words, begin, end in (("later", 0.55, 1.0), ("earlier", 0.0, 0.35)):
        parts = [run.slice(*(run.start_ns + round(share * (run.end_ns - run.start_ns)) for share in (begin, end)))
                 for run in runs]
        try:
            part = _Work(parts, vehicle, base, reference, replace(settings, where=False), progress).result()
        except StCoreError:
            continue  # the car stands there, say: nothing is known of that part
        if part.outcome in ("unknown", "several"):
            return None
        if part.effects:
            said.append((part, f"{part.effects[0].name} shows in the {words} part of the runs only; values and gap "
                               f"are those of {begin:.0%} to {end:.0%} of each run"))
    if len(said) != 1:
        return None
    (part, words), = said
    return replace(part, where=found.where, warnings=(*part.warnings, words))


class _Work:
    def __init__(self, runs, vehicle, base, reference, settings, progress):
        self.settings, self.vehicle, self._progress = settings, vehicle, progress
        self.space = Space(base, settings)
        self.rng = np.random.default_rng(settings.seed)
        self.warnings: list[str] = []
        self._explained: dict[tuple[str, ...], tuple[float, float]] = {}
        self.runs, self.reference = self._usable(runs, "run"), self._usable(reference, "reference")
        if not self.runs:
            raise StCoreError("no run is long enough: a run needs "
                              f"{settings.horizon + 2.0:g} s of driving above walking speed with INS and steering")
        self.settings = self._channels()

    def result(self) -> Discovery:
        space, settings = self.space, self.settings
        floor, null_of = self._floor()
        self.floor = floor
        parts = gap.split(self.runs, self.settings)
        windows = self._windows(parts.used, "run")
        study = self.study = Study(windows, space, floor, gap.folds(windows), tick=self._tick("hypotheses", len(space)))
        blocks = int(windows.block.max()) + 1
        if blocks < LEAST_BLOCKS:
            self.warnings.append(f"only {blocks} blocks of {settings.block:g} s: little can be said")
        null = self.null = null_of(blocks, study)
        limit = null.threshold(settings.false_alarm)
        untestable = testable.not_testable(study, limit)
        names = space.hypotheses
        about = study.linear(())[1]
        linear = {n: about - study.linear((n,))[1] for n in names}
        tried = sorted(names, key=linear.get, reverse=True)[:TRIED]
        fits = self.fits = {}
        for i, name in enumerate(tried):
            fits[name] = study.no_worse_than_base((name,))
            self._say("fits", i + 1, len(tried))
            if i >= 2 and linear[name] < 0.1 * (study.base.cost - min(f.cost for f in fits.values())):
                break
        best = min(fits.values(), key=lambda fit: fit.cost)
        gain = study.base.cost - best.cost
        agreed = self._comparable(best)
        p = null.probability(agreed)
        study.rate(fits.values())
        found: list[Fit] = []
        unknown, signature = False, ()
        excess = several.excess(study, study.base, np.mean)
        if null.loss:
            excess /= 1.0 + several.RESTLESS * floor.restless
        sure = self._comparable(best, choice.LITTLE) > several.SURELY * limit or excess > several.UNKNOWN
        if agreed > limit:
            most = min(settings.maximum_effects, several.TOO_MANY) if null.loss else settings.maximum_effects
            found, level = several.search(study, fits, limit, most)
            unknown = several.unexplained(study, found[0], level, fits)
            if not unknown and not study.credible(found[0]):
                unknown = sure
                if not sure:
                    self._leave_open(found.pop(0), "not by itself")
            elif not unknown and len(found[0].names) == 1 and self._comparable(found[0]) <= limit:
                self._leave_open(found.pop(0), DOUBTED)
            elif not unknown and null.loss and len(found[0].names) >= several.TOO_MANY:
                unknown = True
                self.warnings.append(f"{', '.join(found[0].names)} together come closest, but one effect that the "
                                     "library lacks is likelier than so many at once")
            elif not unknown and null.loss and several.incomplete(study, found[0], fits, null.slower):
                unknown = True
                self.warnings.append(f"{', '.join(found[0].names)} comes closest, but all effects together would "
                                     "explain much more: it only resembles what is there")
        elif excess > several.UNKNOWN:
            unknown = True
        elif gain > limit:
            self._leave_open(best, DOUBTED)
        answer = found[0] if found else study.base
        rivals = several.rivals(study, answer, fits, gain) if found and not unknown else {}
        outcome = self._outcome(answer, rivals, unknown, untestable, gain > limit)
        model, vector = None, floor.vector
        if answer.names and not unknown:
            vector = several.alone(study, answer)
            model = space.at(vector)
        effects = tuple(self._effect(n, answer, vector, rivals, fits) for n in answer.names) if model else ()
        gaps = gap.measure(parts, self.vehicle, study, answer if model else study.base, vector, floor)
        if model and not gap.shrinks(gaps, study, answer):
            outcome, model, effects, rivals = "unknown" if sure else "none", None, (), {}
            if sure:
                self.warnings.append(f"{', '.join(answer.names)} fits best, but errors do not shrink with it")
            else:
                self._leave_open(answer, "errors of other drives do not shrink with it")
                answer = study.base
            gaps = gap.measure(parts, self.vehicle, study, study.base, floor.vector, floor)
        stated = {name for e in effects for name in (e.name, *e.alternatives)}
        untestable = tuple(n for n in untestable if n.name not in stated)
        lost = astray(windows, study.rows)
        if lost > ASTRAY and model is None:
            if not self.reference or excess > several.UNKNOWN:
                outcome = "unknown"
            self.warnings.append(f"the base model is lost in {lost:.0%} of the windows: it diverges, is not of this "
                                 "car, or something large is wrong; check base and vehicle file")
        separable = tuple(self._separability(rivals, fits)) if model else ()
        following = manoeuvres.following(study, effects, fits) if separable else None
        if separable and following is None:
            pairs = "; ".join(f"{s.first} and {s.second}" for s in separable)
            self.warnings.append("no drive of the catalogue at speeds like those driven would surely tell the names "
                                 f"apart: {pairs}")
        where = self._where(floor)
        if outcome == "unknown":
            signature = tuple(f"{w.channel}: {w.condition}" for w in where[:6])
        return Discovery(
            outcome=outcome, effects=effects, where=where, gap=gaps, not_testable=untestable, next_manoeuvre=following,
            separability=separable, signature=signature,
            candidates=self._candidates(linear, fits, answer, rivals, study, null, untestable),
            base=space.at(floor.vector), model=model, split=parts.said, p=p, warnings=tuple(self.warnings),
            acceleration_gain=float(floor.vector[-1]), noise=dict(floor.size))

    # What is given

    def _usable(self, runs: list[DriveLog], what: str) -> list[DriveLog]:
        least = self.settings.horizon + 2.0
        good = []
        for run in runs:
            if run.overlap < least:
                self.warnings.append(f"{what} {run.name} left out: {run.overlap:.1f} s with INS and steering, "
                                     f"{least:g} s are needed")
            else:
                good.append(run)
        return good

    def _channels(self) -> DiscoverySettings:
        if self.space.model.base.name == "kinematic":
            # Its v_y and yaw rate are carried along as measured: only where it drives to says something of it.
            left = tuple(c for c in self.settings.channels if c in ("yaw", "position"))
            if not left:
                raise ConfigurationError("channels: of a kinematic base only yaw and position can be judged")
            return replace(self.settings, channels=left)
        everything = [*self.runs, *self.reference]
        if "acceleration_y" in self.settings.channels and any(r.acceleration_y is None for r in everything):
            self.warnings.append("acceleration_y is not in all runs and is not used")
            left = tuple(c for c in self.settings.channels if c != "acceleration_y")
            return replace(self.settings, channels=left)
        return self.settings

    def _windows(self, runs, what: str) -> Windows:
        windows = Windows(runs, self.vehicle, self.settings)
        if not len(windows):
            raise StCoreError(f"no {what} has a stretch that is fast enough to be predicted")
        known = float(np.isfinite(row_errors(windows, self.space, self.space.start)).all(axis=1).mean())
        if known < 0.5:
            raise StCoreError(f"the base model gives no finite prediction for {1.0 - known:.0%} of the windows; it "
                              "diverges or inputs are missing: check base and vehicle file")
        return windows

    def _floor(self):
        """The floor, and what gives the gains of healthy data for a number of blocks."""
        settings, space = self.settings, self.space
        if not self.reference:
            self.warnings.append("no reference drives: effects are counted from the vehicle file, and what a healthy "
                                 "car may differ from it widens every answer")
            windows = self._windows(self.runs, "run")
            floor = assumed(windows, space, tick=self._tick("floor", len(space)))
            return floor, lambda blocks, study: choice.null_of(study.quadratic, None, floor, space, space.hypotheses,
                                                               blocks, self.rng)
        told = replace(settings, seed=0, effects=None, where=True, maximum_effects=1, false_alarm=0.01,
                       confidence=0.95, resamples=1000)
        key = (tuple(id(r) for r in self.reference), self.vehicle.hash, space.key, str(told))
        if key not in _floors:
            windows = self._windows(self.reference, "reference drive")
            floor = learn(windows, space, settings.drift, tick=self._tick("floor", ROUNDS * len(space)))
            while len(_floors) >= KEPT:
                _floors.pop(next(iter(_floors)))
            _floors[key] = (tuple(self.reference), floor, {})
        _, learnt, kept = _floors[key]
        self.warnings += suspicions(learnt, space)
        more = noisier(self.runs, self.reference)
        floor = replace(learnt, inflation=more * learnt.inflation, level=more * learnt.level)

        def null_of(blocks, study):
            case = settings.seed, blocks, space.hypotheses
            if case not in kept:
                kept[case] = choice.null_of(learnt.quadratic, learnt.run, learnt, space, space.hypotheses, blocks,
                                            np.random.default_rng(settings.seed))
            return kept[case]
        return floor, null_of

    # What is said

    def _comparable(self, fit: Fit, explained: float | None = None) -> float:
        """What a fit gains, without what that loses where the runs do not agree in it or it explains little alone."""
        gain = self.study.base.cost - fit.cost
        if not self.null.loss:
            return gain
        if fit.names not in self._explained:
            self._explained[fit.names] = choice.by_chance(fit, self.study), gap.explained(self.study, fit)
        chance, own = self._explained[fit.names]
        return self.null.comparable(gain, fit.names, chance, own if explained is None else explained)

    def _leave_open(self, fit: Fit, why: str) -> None:
        self.warnings.append(f"{', '.join(fit.names)} gains more than effects do on healthy drives, but {why}; "
                             "too little stands out to call it a gap")

    def _outcome(self, answer: Fit, rivals, unknown: bool, untestable, gained: bool):
        if unknown:
            return "unknown"
        if not answer.names:
            names = self.space.hypotheses
            blind = {n.name for n in untestable} & set(names)
            return "not_testable" if not gained and len(blind) > 0.6 * len(names) else "none"
        if len(answer.names) > 1:
            return "several"
        return "ambiguous" if rivals.get(answer.names[0]) else "named"

    def _effect(self, name: str, answer: Fit, vector: np.ndarray, rivals, fits) -> FoundEffect:
        study, space = self.study, self.space
        others = rivals.get(name, [])
        parameters = {}
        for i in space.indices(name):
            free = space.free[i]
            change = float(vector[i] - self.floor.vector[i])
            half = self.settings.deviations * testable.deviation(study, answer, i, change)
            value = free.null + change
            parameters[free.parameter] = FittedParameter(value, free.unit, (value - half, value + half))
        likely = np.exp(-0.5 * np.array([0.0] + [more for more, _ in others]) / choice.CLOSE)
        return FoundEffect(name, parameters, tuple(n for _, n in others), float(likely[0] / likely.sum()))

    def _separability(self, rivals, fits):
        for name, others in rivals.items():
            for _, other in others:
                if name in fits and other in fits:
                    cosine, strength = testable.separable(self.study, fits[name], fits[other])
                    yield Separability(name, other, cosine, strength)

    def _candidates(self, linear, fits, answer, rivals, study, null, untestable):
        blind = {n.name for n in untestable}
        limit = null.threshold(self.settings.false_alarm)
        also = {other for others in rivals.values() for _, other in others}
        rows = []
        for name in sorted(self.space.hypotheses, key=lambda n: fits[n].cost if n in fits else 1e18 - linear[n]):
            fit = fits.get(name)
            gain = study.base.cost - fit.cost if fit else linear[name]
            agreed = self._comparable(fit) if fit else gain
            vector = fit.vector if fit else self.space.inside(
                self.floor.vector + study.linear((name,))[0] * self.space.scale)
            values = {self.space.free[i].parameter: float(self.space.free[i].null + vector[i] - self.floor.vector[i])
                      for i in self.space.indices(name)}
            verdict = ("chosen" if name in answer.names else "alternative" if name in also
                       else "not testable" if name in blind else "explains less" if answer.names
                       else "no more than on healthy drives" if gain <= limit
                       else DOUBTED if agreed <= limit else "too little to be stated")
            share = gain / max(study.base.cost, 1e-9)
            rows.append(Candidate(name, values, float(share), null.probability(agreed), verdict))
        return tuple(rows)

    def _where(self, floor: Floor) -> tuple[WhereStatement, ...]:
        if not self.settings.where:
            return ()
        return where(self.runs, self.space.at(floor.vector), self.vehicle, self.settings, self.reference,
                     dict(floor.size), float(floor.vector[-1]))

    # How far it is

    def _say(self, stage: str, done: int, total: int) -> None:
        if self._progress:
            self._progress(stage, done, total)

    def _tick(self, stage: str, total: int):
        count = 0

        def tick():
            nonlocal count
            count += 1
            self._say(stage, min(count, total), total)
        return tick
