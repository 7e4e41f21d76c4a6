"""A constructed discovery, for tests of reports."""

from collections.abc import Mapping, Sequence

from st_core.augmented import AugmentedModel, augment
from st_core.discovery import decision
from st_core.discovery.result import (
    BudgetLine,
    CandidateEffect,
    Change,
    ChannelError,
    Discovery,
    FittedParameter,
    FoundEffect,
    LargeErrorRegion,
    LocalEstimate,
    NextManoeuvre,
    Power,
    PowerAnalysis,
    Reason,
    Run,
    Separability,
    Step,
    UntestableEffect,
    VaryingEffect,
)
from st_core.effects import get_effect
from st_core.log import DriveLog

HALF = 0.02  # half width of an interval, as share of the distance to null


def fitted(effect: str, values: Mapping[str, float]) -> dict[str, FittedParameter]:
    found = {}
    for p in (p for p in get_effect(effect).parameters if p.fit):
        value, half = values[p.name], HALF * abs(values[p.name] - p.null)
        found[p.name] = FittedParameter(value, p.unit, (value - half, value + half), p.null)
    return found


def discovery(runs: Sequence[DriveLog], steps: Sequence[tuple[str, Mapping[str, float], float]], base: float, *,
              varying: Sequence[VaryingEffect] = (), alternatives: Mapping[str, tuple[str, ...]] | None = None,
              outcome: str | None = None, reference: Sequence[DriveLog] = (),
              start: AugmentedModel | None = None) -> Discovery:
    """steps: (effect, values, 5 s position error [m] with it), from `base` [m] on."""
    start = start or augment("nonlinear", {})
    model = augment(start, {name: values for name, values, _ in steps}) if steps else None
    totals = [base, *(after for *_, after in steps)]
    names = [log.name for log in runs]
    waterfall, effects = [], []
    for (name, values, after), before in zip(steps, totals, strict=False):
        kind = get_effect(name).kind
        change = Change(before, after, (0.8 * (before - after), 1.2 * (before - after)), "m")
        waterfall.append(Step(
            name, kind, fitted(name, values), change,
            {"acceleration_y": Change(0.6, 0.3 if after == before else 0.59, (0.0, 0.3), "m/s^2")},
            {n: (before * (1 + 0.1 * k), after * (1 + 0.1 * k)) for k, n in enumerate(names)}))
        agreement = {"run": tuple(LocalEstimate(n, 1.0 + 0.05 * (-1) ** k, 0.1) for k, n in enumerate(names)),
                     "site": (LocalEstimate("site 1", 1.0, 0.05), LocalEstimate("site 2", 0.97, 0.08))}
        effects.append(FoundEffect(name, kind, fitted(name, values), (alternatives or {}).get(name, ()),
                                   0.9 * (before - after), agreement, other_causes=get_effect(name).imitated_by))
    parts = {part: sum(b - a for (n, _, a), b in zip(steps, totals, strict=False) if get_effect(n).kind == part)
             for part in ("sensors", "vehicle parameters", "physics", "environment")}
    parts |= {"place or time": sum(b.position_5s_reduction for b in varying), "unexplained": totals[-1]}
    budget = tuple(BudgetLine(part, 0.8 * size, size, 0.8 * size / base, size / base, 0.7 * size / base, size / base)
                   for part, size in parts.items())
    reduction = base - totals[-1]
    errors = {"position_5s": ChannelError(base, totals[-1], (0.8 * reduction, 1.2 * reduction), "m", 0.06, names[0],
                                          1.3 * totals[-1]),
              "yaw_rate": ChannelError(0.02, 0.01, (0.005, 0.012), "rad/s", 0.002)}
    outcome = outcome or ("none" if not steps else "named" if len(steps) == 1 else "several")
    powers = tuple(Power(effect, parameter, unit, size * k, found, 20, 2.0 * size * k)
                   for effect, parameter, unit, size, low in (("steering_ratio", "factor", "1", 0.015, 0.6),
                                                               ("friction", "factor", "1", 0.1, 0.05),
                                                               ("heading_misalignment", "angle", "rad", 0.002, 0.9))
                   for k, found in ((1, low), (2, min(1.0, 1.6 * low)), (4, min(1.0, 2.5 * low))))
    candidates = [CandidateEffect(e.name, e.kind, {k: p.value for k, p in e.parameters.items()}, 0.3, "named", "p = 0")
                  for e in effects]
    candidates.append(CandidateEffect("mass", "vehicle parameters", {"factor": 1.02}, 0.006, decision.IRRELEVANT,
                                      "it is significant, but reduces the errors by 0.6 %; 2.5 % is required"))
    return Discovery(
        outcome=outcome, effects=tuple(effects), minor=(), varying=tuple(varying), steps=tuple(waterfall),
        errors=errors, budget=budget,
        reasons=(Reason("significant", "outcome", {"score": 44.0, "threshold": 12.0},
                        "the gain is 44; by chance it is at most 12"),
                 *(Reason(decision.ACCEPTED, e.name, {"share": 0.2}, "it reduces the errors by 20.0 %")
                   for e in effects)),
        candidates=tuple(candidates),
        large_error_regions=(LargeErrorRegion("yaw_rate", "lateral acceleration above 3 m/s^2", 4.2, (3.1, 5.5)),),
        not_testable=(UntestableEffect("friction", "no drive reaches the friction limit", "ramp_to_limit"),),
        next_manoeuvre=NextManoeuvre("sweep", ("steering_ratio", "front_stiffness"), 5.5, {"sweep": 5.5, "step": 2.0},
                                     3, 30.0, 14.0, "their effects differ most in it"),
        separability=(Separability("steering_ratio", "front_stiffness", 0.97, 2.2),),
        power_analysis=PowerAnalysis(powers, 0, 0, False),
        signature=("it increases with speed",) * (outcome == "unknown"),
        runs=tuple(Run(log.name, "suspect", log.duration, k % 2, 40) for k, log in enumerate(runs))
        + tuple(Run(log.name, "reference", log.duration, 0, 40) for log in reference),
        start="reference" if reference else "vehicle file", base=start, model=model,
        named=model, named_errors=errors,
        noise={"position": 0.02, "yaw": 0.001, "yaw_rate": 0.002, "velocity_y": 0.02, "acceleration_y": 0.1})
