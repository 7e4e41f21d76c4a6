"""From an answer that leaves much unexplained to the law that is missing, or to the reason why there is none."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from ..augmented import AugmentedModel
from ..discovery.limits import Limits
from ..discovery.result import Discovery
from ..discovery.settings import DiscoverySettings
from ..effects._law import COUNT
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .curve_fit import Fitted, Laws, RunWindows
from .places import NEITHER, driven
from .readings import readings
from .result import Proposal, Proposals
from .screening import POINTS, Screened, chances_of, screen
from .scrutiny import refused, shares

REFITTED = 6  # laws fitted through the simulator
FEWEST = 10  # blocks: with fewer a curve of eight numbers cannot be held out


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
    too_little = _too_little(windows, settings)
    if too_little:
        return Proposals(None, too_little, {})
    names = [e.name for e in (*found.effects, *found.minor)]
    laws = Laws(windows, found.model or found.base, found.acceleration_gain, names, settings, threads)
    tick()
    without = laws.without()
    screened = screen(laws, without, vehicle, settings.seed, tick)
    if not screened:
        return Proposals(None, "no law changes any prediction of these drives", {})
    chances = chances_of(screened, laws.blocks)
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
    said = _judged(_best(kept, limits.worth * number), kept, without, laws, chances, limits, tried, vehicle)
    return replace(said, visible=visible)


def _too_little(windows: RunWindows, settings: DiscoverySettings) -> str:
    """Why these drives can show no law at all; "" where they may."""
    if len(set(windows.run)) == 1:
        return "one run was driven; whether a law holds on another drive cannot be seen: give two or more"
    blocks = int(windows.block.max()) + 1 if len(windows) else 0
    if len(windows) < 3 or blocks < FEWEST:
        return f"{blocks} blocks of {settings.block:g} s were driven; a curve asks for {FEWEST}"
    return ""


def _best(fits: dict[Screened, Fitted], worth: float) -> Screened:
    """The law that holds out best; one of two quantities has to be worth it beside the best of one."""
    return min(fits, key=lambda s: float(fits[s].held_out.sum()) + (worth if s.candidate.by else 0.0))


def _judged(best: Screened, fits: dict[Screened, Fitted], without: Fitted, laws: Laws, chances: Mapping[str, float],
            limits: Limits, tried: Mapping[str, tuple[float, float]], vehicle: VehicleParameters) -> Proposals:
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
    assert fit.candidate is not None
    whole = laws.space_of(fit.candidate).at(fit.vector)
    return whole.only(e for e in whole.effects if e.name != fit.candidate.effect)


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
