"""From an answer that leaves much unexplained to the law that is missing, or to the reason why there is none."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..augmented import AugmentedModel
from ..discovery.limits import Limits
from ..discovery.result import Discovery
from ..discovery.settings import DiscoverySettings
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .choice import best_of, harmful, not_told_apart, taken_away, to_fit, worthless
from .curve_fit import Fitted, Laws, RunWindows
from .exchange import exchanged
from .next_drive import next_drives, thin_ranges
from .places import driven
from .readings import readings
from .result import Proposal, Proposals
from .screening import POINTS, Screened, chances_of, screen
from .scrutiny import cosine, held_out_positions, refused, shares

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
    finds as much anywhere with a probability below `limits.false_alarm`, and if on runs it was not fitted to it takes
    away `limits.worth` of the size of the errors, or `limits.worth_position`, surely something, betters the path with
    a chance below `limits.false_alarm` that it does not (not asked of a sensor's law), and harms none. Those the drives
    do not tell from it stand beside it, and the effects of the answer it makes needless.
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
        return Proposals(None, "no law changes any prediction of these drives: drive to both sides, with pedals, at "
                         "more than one speed", {})
    chances = chances_of(screened, laws.blocks)
    number = laws.loss.number
    tried = {s.candidate.name: (s.gain / number, chances[s.candidate.name])
             for s in sorted(screened, key=lambda s: -s.gain)}
    visible = {s.candidate.name: s.visible(limits.false_alarm / len(screened), laws.blocks) for s in screened}
    sure = sorted((s for s in screened if chances[s.candidate.name] <= limits.false_alarm), key=lambda s: -s.gain)
    if not sure:
        name, (gain, chance) = next(iter(tried.items()))
        return Proposals(None, f"no law is sure. The best, {name}, lowers the loss on held-out driving by {gain:.3f} "
                         f"for each error, and chance finds as much with probability {chance:.2g}; less than "
                         f"{limits.false_alarm:g} is asked for", tried, visible)
    fits, worthy, against = _tried(laws, without, sure, vehicle, limits, tick)
    if not worthy:
        return Proposals(None, next(iter(against.values())), tried, visible)
    said = _judged(best_of(worthy, limits.worth * number), fits, without, laws, chances, settings, tried, vehicle,
                   [e.name for e in found.effects])
    return replace(said, visible=visible)


Fits = dict[Screened, Fitted]


def _tried(laws: Laws, without: Fitted, sure: Sequence[Screened], vehicle: VehicleParameters, limits: Limits,
           tick: Callable[[], None]) -> tuple[Fits, Fits, dict[Screened, str]]:
    """Laws fitted through the simulator: those with nothing wrong about them, of them those that are worth it, and what
    speaks against the others."""
    fits: Fits = {}
    worthy: Fits = {}
    against: dict[Screened, str] = {}
    before = held_out_positions(laws, without)
    for one in to_fit(sure):
        tick()
        fit = laws.fit(one.candidate, without, one.smooth)
        name, after = one.candidate.name, held_out_positions(laws, fit)
        wrong = refused(laws, fit, vehicle) or harmful(laws, name, before, after, limits)
        little = worthless(laws, one.candidate, without.held_out - fit.held_out, before - after, limits)
        if wrong or little:
            against[one] = wrong or little
        else:
            worthy[one] = fit
        if not wrong:
            fits[one] = fit  # may be what it is, though it is not sure to be worth it by itself
    return fits, worthy, against


def _too_little(windows: RunWindows, settings: DiscoverySettings) -> str:
    """Why these drives can show no law at all; "" where they may."""
    if len(set(windows.run)) == 1:
        return "one run was driven; whether a law holds on another drive cannot be seen: give two or more"
    blocks = int(windows.block.max()) + 1 if len(windows) else 0
    if len(windows) < 3 or blocks < FEWEST:
        return (f"{blocks} blocks of {settings.block:g} s were driven; a curve asks for {FEWEST}: drive longer, or "
                "give more runs")
    return ""


def _judged(best: Screened, fits: Fits, without: Fitted, laws: Laws, chances: Mapping[str, float],
            settings: DiscoverySettings, tried: Mapping[str, tuple[float, float]], vehicle: VehicleParameters,
            stated: Sequence[str]) -> Proposals:
    fit, limits = fits[best], settings.limits
    chance = chances[best.candidate.name]
    falls = without.held_out - fit.held_out
    gain = float(falls.sum()) / laws.loss.number
    before, after = (held_out_positions(laws, f) for f in (without, fit))
    rivals = [one for one in fits if one is not best]
    apart = not_told_apart(np.array([fits[one].held_out - fit.held_out for one in rivals]), limits.doubt, settings.seed)
    alike = {one.candidate.name: fits[one] for one, near in zip(rivals, apart, strict=True) if near}
    others = {name: cosine(laws, fit, other) for name, other in alike.items()}
    needless = exchanged(laws, best.candidate, fit, without, stated, limits)
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
    drives = next_drives(laws, c, fit, alike, best.design, at, deviation, thin_ranges(at, density, c.parity))
    proposal = Proposal(c, fit.coefficients, at, value, deviation, density, gain, chance,
                        (float(np.nanmean(before)), float(np.nanmean(after))), runs, _beside(laws, fit), others,
                        readings(c, fit.coefficients, laws.seen(fit), laws.fold),
                        shares(laws, fit), needless, drives)
    return Proposals(proposal, f"it {taken_away(laws, falls, before - after, limits)}", tried)


def _beside(laws: Laws, fit: Fitted) -> AugmentedModel:
    """The model without the law, at the values fitted beside it."""
    assert fit.candidate is not None
    whole = laws.space_of(fit.candidate).at(fit.vector)
    return whole.only(e for e in whole.effects if e.name != fit.candidate.effect)


def _channels(found: Discovery, settings: DiscoverySettings) -> DiscoverySettings:
    used = tuple(c for c in settings.channels if c in found.noise)
    return replace(settings, channels=used or settings.channels)
