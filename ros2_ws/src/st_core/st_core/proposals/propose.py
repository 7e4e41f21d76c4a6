"""From an answer that leaves much unexplained to the law that is missing, or to the reason why there is none."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..discovery.limits import Limits
from ..discovery.result import Discovery
from ..discovery.settings import DiscoverySettings
from ..effects._law import COUNT
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .curve_fit import SMOOTH, Fitted, Laws, RunWindows
from .places import NEITHER, Candidate, candidates, driven
from .readings import readings
from .result import Proposal, Proposals
from .scrutiny import refused, shares

DRAWS = 999  # signs of the blocks drawn by chance
REFITTED = 6  # laws fitted through the simulator
POINTS = 41  # of a curve that is told
FEWEST = 10  # blocks: with fewer a curve of eight numbers cannot be held out


@dataclass(frozen=True, eq=False)
class _Screened:
    """A law by the slopes about the answer. smooth: the penalty that holds out best. observed, drawn: what its freedom
    gains, and with the signs of the blocks by chance (DRAWS,), both over the mean of the draws. freedom: numbers the
    penalty leaves to the curve. design: what dependent windows make of the variance of its scores, 1 at least, by what
    is left of them with the law. gain: held out. information: (COUNT, COUNT) of the drives on the coefficients, what
    everything beside can do taken out."""

    candidate: Candidate
    smooth: float
    observed: float
    drawn: np.ndarray
    freedom: float
    design: float
    gain: float
    information: np.ndarray

    def visible(self, chance: float, blocks: int) -> float:
        """Size at the end of the range [unit of the curve] from which on a straight line is surer than that chance."""
        c = self.candidate
        at = np.linspace(c.low, c.high, POINTS)
        line = np.linalg.lstsq(c.splines(at).T, at / max(abs(c.low), abs(c.high)), rcond=1e-6)[0]
        wanted = 0.5 * float(stats.f.isf(chance, self.freedom, blocks - 1)) * self.freedom * self.design
        return float(np.sqrt(wanted / max(float(line @ self.information @ line), 1e-30)))


def wanted(found: Discovery) -> bool:
    """Whether an answer leaves so much that a law is to be looked for: unknown, or errors beyond `limits.left` times
    the noise."""
    return found.outcome == "unknown" or bool(found.signature)


def propose(found: Discovery, runs: Sequence[DriveLog], vehicle: VehicleParameters,
            settings: DiscoverySettings | None = None, threads: int = 1,
            tick: Callable[[], None] = lambda: None) -> Proposals:
    """The law that is missing in an answer of `discover`.

    Every law of `places` is put on top of the answer and fitted beside everything found. What a parameter of the
    vehicle file can do as well is no evidence for it: the tests look at what those leave. One is proposed if chance
    finds as much anywhere with a probability below `limits.false_alarm`, and if it takes away `limits.worth` of the
    size of the errors, or `limits.worth_position`, on runs it was not fitted to. Those that do no worse stand beside
    it.
    Raises StCoreError for drives in which nothing can be predicted.
    """
    settings = settings or DiscoverySettings()
    limits = settings.limits
    settings = _channels(found, settings)
    windows = RunWindows(runs, vehicle, settings)
    if len(set(windows.run)) == 1:
        return Proposals(None, "one run was driven; whether a law holds on another drive cannot be seen: give two or "
                         "more", {})
    if len(windows) < 3 or int(windows.block.max()) + 1 < FEWEST:
        return Proposals(None, f"{int(windows.block.max()) + 1 if len(windows) else 0} blocks of {settings.block:g} s "
                         f"were driven; a curve asks for {FEWEST}", {})
    answer = found.model or found.base
    names = [e.name for e in (*found.effects, *found.minor)]
    laws = Laws(windows, answer, found.acceleration_gain, names, settings, threads)
    tick()
    without = laws.without()
    base = laws.promised(without.q, without.penalty, ((without.vector - laws.start) / laws.space.scale)[without.which])
    car = laws.slopes(without.vector, laws.car)
    rng = np.random.default_rng(settings.seed)
    signs = rng.choice([-1.0, 1.0], (DRAWS, laws.blocks))
    screened: list[_Screened] = []
    for candidate in candidates(windows, vehicle):
        tick()
        one = _screen(laws, without, base, car, candidate, signs)
        if one is not None:
            screened.append(one)
    if not screened:
        return Proposals(None, "no law changes any prediction of these drives", {})
    chances = _chances(screened, laws.blocks)
    number = laws.loss.number
    tried = {s.candidate.name: (s.gain / number, chances[s.candidate.name])
             for s in sorted(screened, key=lambda s: -s.gain)}
    visible = {s.candidate.name: s.visible(limits.false_alarm / len(screened), laws.blocks) for s in screened}
    sure = sorted((s for s in screened if chances[s.candidate.name] <= limits.false_alarm), key=lambda s: -s.gain)
    if not sure:
        name, (gain, chance) = next(iter(tried.items()))
        return Proposals(None, f"no law is sure: the best, {name}, gains {gain:.3f} held out, and something gains as "
                         f"much by chance with probability {chance:.2g}", tried, visible)
    fits = {}
    for one in sure[:REFITTED]:
        tick()
        fits[one] = laws.fit(one.candidate, without, one.smooth)
    against = {one: refused(laws, fit, vehicle) for one, fit in fits.items()}
    kept = {one: fit for one, fit in fits.items() if not against[one]}
    if not kept:
        return Proposals(None, next(iter(against.values())), tried, visible)
    # A law of two quantities has to be worth it beside the best of one.
    more = limits.worth * number
    best = min(kept, key=lambda s: float(kept[s].held_out.sum()) + (more if s.candidate.by else 0.0))
    said = _judged(best, kept, without, laws, chances, limits, tried, vehicle)
    return replace(said, visible=visible)


def _chances(screened: Sequence[_Screened], blocks: int) -> dict[str, float]:
    """That any law gains as much where nothing is, by name; the smaller of two tests, as for the library.

    Signs of blocks: the largest of all laws, each refitted in every draw. Likelihood ratio: twice the held-out gain
    over the design effect (of the law, or the median of all laws if larger) and the freedom of the curve, Fisher's F,
    for all laws; needed for what acts in a few blocks only.
    """
    largest = np.max([s.drawn for s in screened], axis=0)
    design = float(np.median([s.design for s in screened]))
    found = {}
    for s in screened:
        flipped = (1 + int((largest >= s.observed).sum())) / (1 + DRAWS)
        ratio = 2.0 * max(s.gain, 0.0) / max(design, s.design) / s.freedom
        found[s.candidate.name] = min(flipped, len(screened) * float(stats.f.sf(ratio, s.freedom, blocks - 1)))
    return found


def _judged(best: _Screened, fits: dict[_Screened, Fitted], without: Fitted, laws: Laws, chances, limits: Limits, tried,
            vehicle: VehicleParameters) -> Proposals:
    fit, number = fits[best], laws.loss.number
    gain = float((without.held_out - fit.held_out).sum()) / number
    before, after = (_held_out_positions(laws, f) for f in (without, fit))
    fall = float(np.nanmean(before - after)) if np.isfinite(before).any() else 0.0
    chance = chances[best.candidate.name]
    if gain < limits.worth and not (gain > 0.0 and fall >= limits.worth_position):
        return Proposals(None, f"{best.candidate.name} is sure, but takes away {-np.expm1(-gain):.1%} of the size of "
                         f"the errors and {100 * fall:.1f} cm after 5 s on runs it was not fitted to", tried)
    others = {}
    for one, other in fits.items():
        worse = other.held_out - fit.held_out
        if one is not best and _no_worse(worse) > limits.doubt:
            others[one.candidate.name] = _cosine(laws, fit, other)
    c = best.candidate
    u = driven(laws.windows, vehicle)[c.quantity]
    at = np.linspace(c.low, c.high, POINTS)
    splines = c.splines(at)
    value = fit.coefficients @ splines
    deviation = np.sqrt(np.maximum(np.einsum("ik,ij,jk->k", splines, fit.covariance(), splines), 0.0))
    edges = np.concatenate([[-np.inf], 0.5 * (at[1:] + at[:-1]), [np.inf]])
    density = np.histogram(np.clip(u, c.low, c.high), edges)[0] / max(len(u), 1)
    runs = {name: (float(np.nanmean(before[mine])), float(np.nanmean(after[mine])))
            for k, name in enumerate(laws.windows.names) if (mine := laws.windows.run == k).any()
            and np.isfinite(before[mine]).any() and np.isfinite(after[mine]).any()}
    proposal = Proposal(c, fit.coefficients, at, value, deviation, density, gain, chance,
                        (float(np.nanmean(before)), float(np.nanmean(after))), runs, _beside(laws, fit), others,
                        readings(c.place, c.quantity, at, value, density, c.by, c.parity != NEITHER, deviation),
                        shares(laws, fit))
    return Proposals(proposal, f"{c.name} takes away {-np.expm1(-gain):.1%} of the size of the errors and "
                     f"{100 * fall:.1f} cm after 5 s on runs it was not fitted to", tried)


def _beside(laws: Laws, fit: Fitted) -> AugmentedModel:
    """The model without the law, at the values fitted beside it."""
    whole = laws.space_of(fit.candidate).at(fit.vector)
    return whole.only(e for e in whole.effects if e.name != fit.candidate.effect)


def _screen(laws: Laws, without: Fitted, base: np.ndarray, car: np.ndarray, candidate: Candidate,
            signs: np.ndarray) -> _Screened | None:
    """Efficient scores of the coefficients: what everything beside explains is taken out of them. base: (b,)
    held-out loss without a law, by the same slopes. car: slopes of the vehicle file's parameters."""
    loss, slopes = laws.linear(candidate, without)
    q = laws.quadratic(loss, without.rows, np.concatenate([without.slopes, slopes]))
    h = q.hessian.sum(axis=0)
    if float(np.trace(h[-COUNT:, -COUNT:])) <= 1e-9 * float(np.trace(h)):
        return None
    q_all = laws.quadratic(loss, without.rows, np.concatenate([without.slopes, car, slopes]))
    away = np.concatenate([((without.vector - laws.start) / laws.space.scale)[without.which], np.zeros(COUNT)])
    best = None
    for smooth in SMOOTH:
        penalty = laws.penalty(candidate, h, smooth)
        gain = float((base - laws.promised(q, penalty, away)).sum())
        if best is None or gain > best[0]:
            best = gain, smooth, penalty
    gain, smooth, penalty = best
    whole = q_all.hessian.sum(axis=0)
    rest = whole[:-COUNT, :-COUNT]
    cross = np.linalg.solve(rest + (1e-6 * np.trace(rest) / max(len(rest), 1) + 1e-9) * np.eye(len(rest)),
                            whole[:-COUNT, -COUNT:])
    own = q_all.gradient[:, -COUNT:] - q_all.gradient[:, :-COUNT] @ cross
    left = whole[-COUNT:, -COUNT:] - whole[-COUNT:, :-COUNT] @ cross + penalty[-COUNT:, -COUNT:]
    inverse = np.linalg.pinv(left)
    drawn = np.einsum("di,ij,dj->d", signs @ own, inverse, signs @ own)
    mean = max(float(drawn.mean()), 1e-30)
    total = own.sum(axis=0)
    freedom = max(float(np.trace(inverse @ (left - penalty[-COUNT:, -COUNT:]))), 1.0)
    step = inverse @ total
    rest_of = q_all.gradient - q_all.hessian @ np.concatenate([-cross @ step, step])
    after = rest_of[:, -COUNT:] - rest_of[:, :-COUNT] @ cross
    design = max(2.0 * float(np.einsum("bi,ij,bj->", after, inverse, after)) / freedom, 1.0)
    return _Screened(candidate, smooth, float(total @ inverse @ total) / mean, drawn / mean, freedom, design, gain,
                     left - penalty[-COUNT:, -COUNT:])


def _channels(found: Discovery, settings: DiscoverySettings) -> DiscoverySettings:
    used = tuple(c for c in settings.channels if c in found.noise)
    return replace(settings, channels=used or settings.channels)


def _held_out_positions(laws: Laws, fit: Fitted) -> np.ndarray:
    """(n,) position error at the end of the horizon under values fitted to other driving [m]."""
    rows = fit.rows.copy()
    for k, d in fit.steps.items():
        mine = laws.fold[laws.block] == k
        rows[mine] -= np.einsum("p,pnm->nm", d, fit.slopes[:, mine])
    if "position_lateral" not in laws.windows.columns:
        return np.full(len(rows), np.nan)
    return laws.problem.position(rows)


def _no_worse(worse: np.ndarray) -> float:
    """Chance of blocks that differ so much, if the other law were as good."""
    spread = float(worse.std(ddof=1)) * np.sqrt(len(worse))
    return float(stats.norm.sf(worse.sum() / max(spread, 1e-12)))


def _cosine(laws: Laws, one: Fitted, other: Fitted) -> float:
    """Of what two laws change in the predictions, what the parameters of the car can do taken out."""
    effects = []
    for fit in (one, other):
        change = np.einsum("p,pnm->nm", fit.coefficients, fit.slopes[-COUNT:]) / laws.loss.scale
        beside = (fit.slopes[:-COUNT] / laws.loss.scale).reshape(len(fit.slopes) - COUNT, -1)
        change = np.where(laws.loss.known, change, 0.0).ravel()
        beside = np.nan_to_num(beside * laws.loss.known.ravel())
        effects.append(change - np.linalg.lstsq(beside.T, change, rcond=None)[0] @ beside)
    return float(effects[0] @ effects[1] / max(np.linalg.norm(effects[0]) * np.linalg.norm(effects[1]), 1e-30))
