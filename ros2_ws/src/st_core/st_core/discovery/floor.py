"""What a healthy car teaches: the base's own values, how large its errors are and how they go together."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ..log import DriveLog
from .quadratic import Quadratic, Whitening, by_condition, costs, jacobian, quadratic, row_errors, whitened, whitening
from .space import ALWAYS, GAIN, LIFTED, Space
from .windows import CHANNEL_OF, Windows

# What the errors of a car nobody measured may be: at once and per second of horizon. SI.
USUAL_ERRORS = {"velocity_y": (0.03, 0.02), "yaw_rate": (0.008, 0.003), "acceleration_y": (0.15, 0.05),
                "yaw": (0.001, 0.006), "position_lateral": (0.01, 0.04), "position_longitudinal": (0.01, 0.02)}
LEAST = {"velocity_y": 0.003, "yaw_rate": 0.0008, "acceleration_y": 0.02, "yaw": 0.0004, "position_lateral": 0.002,
         "position_longitudinal": 0.002}
HARDNESS = np.array([1.0, 1.0, 1.5, 2.5, 4.0, 1.5, 1.5, 2.0, 3.0, 5.0])  # how much larger in each kind of driving
HEALTHY = 1.0  # usual sizes of each effect a car may have before anything is wrong with it, with a reference to say so
UNKNOWN = 0.35  # the same without a reference
# Usual sizes: 1.5 m/s of wind, 1 mrad of bank, 0.5 mrad the heading of an INS wanders, 4 mm/s^2 its accelerometer and
# 0.25 mrad/s its gyroscope; some fuel, 1 % of the mass.
SURROUNDINGS = {"crosswind": 0.3, "road_bank": 0.05, "heading_misalignment": 0.1, "lateral_acceleration_bias": 0.04,
                "yaw_rate_bias": 0.05, "mass": 0.1}
# What any effect gains on a healthy run not seen before, mean over effects and runs: up to SAME, runs are of one car on
# one day; from CHANGING on, car and road differ from run to run, and by MORE times as much.
SAME, CHANGING, MORE = 0.9, 1.25, 3.0
UNTOLD = 0.5  # how restless, where one run cannot tell
GUESSED = ("lateral_load_transfer",)  # what a guessed sideslip looks like near the limit
DOUBTFUL = 4.0  # usual sizes
ROUNDS = 4
LOST = 20.0
FRESH = 1.4  # cost of a window of a new run over one of a run the floor was learnt from, where there is no other run
NOISIER, NOISIEST = 1.3, 4.0  # ratios of variances: from where on it counts, and how far


@dataclass(frozen=True, eq=False)
class Floor:
    """vector: values of the healthy base. spread: (p, p) covariance of what healthy suspect drives may deviate from
    it, in usual sizes. inflation: cost per independent piece of data; windows overlap and errors last. quadratic: of
    the reference drives, and run of each of its blocks; None without one. level: cost per window of their blocks.
    size: by channel at the end of the horizon [SI]. restless: how far healthy runs differ from each other, 0 to 1."""

    vector: np.ndarray
    how: Whitening
    spread: np.ndarray
    inflation: float
    quadratic: Quadratic | None
    run: np.ndarray | None
    level: np.ndarray
    size: Mapping[str, float]
    restless: float


def usual(windows: Windows, table: Mapping[str, tuple[float, float]] = USUAL_ERRORS) -> np.ndarray:
    """(m,) in the order of a row of errors."""
    return np.array([[table[c][0] + table[c][1] * t for c in windows.columns] for t in windows.time]).ravel()


def least(windows: Windows) -> np.ndarray:
    noise = windows.settings.noise or {}
    by = [max(LEAST[c], noise.get(CHANNEL_OF.get(c, c), 0.0)) for c in windows.columns]
    return np.tile(by, len(windows.time))


def astray(windows: Windows, rows: np.ndarray) -> float:
    """Share of the windows at whose end an error is LOST times as large as usual."""
    last = slice(-len(windows.columns), None)
    return float((np.abs(rows[:, last]) > LOST * usual(windows)[last]).any(axis=1).mean())


def default_whitening(windows: Windows) -> Whitening:
    size = usual(windows)
    return by_condition(size, np.eye(len(size)), HARDNESS, windows.scored)


def prior(space: Space, spread: float) -> np.ndarray:
    """(p,) standard deviations of a healthy car about the vehicle file, in usual sizes."""
    result = np.full(len(space), spread)
    result[space.indices(*LIFTED)] = 1e-6
    result[space.indices(*ALWAYS)] = 0.1 * spread
    result[-1] = 1.0
    return result


def drifts(space: Space, drift: float, with_vy: bool, restless: float) -> np.ndarray:
    """(p,) what a healthy car and its surroundings change from one day to the next, in usual sizes."""
    result = np.full(len(space), drift)
    for name, share in SURROUNDINGS.items():
        result[space.indices(name)] = np.maximum(drift, share)
    if not with_vy:
        result[space.indices(*GUESSED)] = np.maximum(drift, 0.07)
    return (1.0 + restless * (MORE - 1.0)) * result


def precision(spread: np.ndarray, free: np.ndarray) -> np.ndarray:
    """Of the deviations from the floor when those in `free` may be anything."""
    rest = np.setdiff1d(np.arange(len(spread)), free)
    result = np.zeros_like(spread)
    result[np.ix_(rest, rest)] = np.linalg.inv(spread[np.ix_(rest, rest)])
    result[free, free] = 1e-6
    return result


def precisions(spread: np.ndarray, groups: Sequence[np.ndarray]) -> np.ndarray:
    """(1 + groups, p, p) `precision` with nothing free, then with each group."""
    return np.stack([precision(spread, free) for free in (np.array([], int), *groups)])


def gains(gradient: np.ndarray, hessian: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """(groups,) what data gain with a group free. gradient, hessian: over the inflation; weights: `precisions`."""
    each = np.linalg.solve(hessian + weights, np.broadcast_to(gradient, (len(weights), len(gradient)))[..., None])
    explained = each[..., 0] @ gradient
    return explained[1:] - explained[0]


def solve_map(hessian: np.ndarray, gradient: np.ndarray, deviation: np.ndarray, at: np.ndarray,
              low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The step from `at` (deviations from the prior mean) to the most likely point with low <= step <= high."""
    weight = np.diag(1.0 / deviation**2)
    a, b = hessian + weight, gradient - weight @ at
    held, step = np.zeros(len(b), bool), np.zeros(len(b))
    for _ in range(8):
        rest = ~held
        step[rest] = np.linalg.solve(a[np.ix_(rest, rest)], b[rest] - a[np.ix_(rest, held)] @ step[held])
        out = rest & ((step < low) | (step > high))
        if not out.any():
            break
        held |= out
        step = np.clip(step, low, high)
    return step


def inflation_of(q: Quadratic) -> np.ndarray:
    """(p,) how much more the blocks' gradients scatter than errors of size 1, each its own, would make them."""
    scatter = np.square(q.gradient).sum(axis=0)
    return scatter / np.maximum(np.einsum("bii->i", q.hessian), 1e-12)


def learn(windows: Windows, space: Space, drift: float, tick=None) -> Floor:
    """Fit the base to healthy drives: all parameters, held by what is usual, a few rounds of Gauss-Newton."""
    start = space.healthy.copy()
    x = start.copy()
    deviation, how, inflation = prior(space, HEALTHY), default_whitening(windows), 4.0
    rows = row_errors(windows, space, x)
    q = None
    for turn in range(ROUNDS):
        slopes = jacobian(windows, space, x, rows, tick=tick)
        for _ in range(2 if turn == ROUNDS - 1 else 1):
            if turn > 0:
                how = whitening(rows, windows.condition, least(windows), windows.scored)
            q = quadratic(rows, slopes, windows, how)
            if turn > 0:
                inflation = max(float(np.median(inflation_of(q))), 1.0)
        step = solve_map(q.hessian.sum(0) / inflation, q.gradient.sum(0) / inflation, deviation,
                         (x - start) / space.scale, (space.low - x) / space.scale, (space.high - x) / space.scale)
        x, rows = _search(windows, space, x, step, rows, how, inflation, start, deviation)
    how = whitening(rows, windows.condition, least(windows), windows.scored)
    q = quadratic(rows, slopes, windows, how)
    inflation = max(float(np.median(inflation_of(q))), 1.0)
    posterior = np.linalg.inv(q.hessian.sum(0) / inflation + np.diag(1.0 / deviation**2))
    run, fresh = windows.run[np.unique(windows.block, return_index=True)[1]], FRESH

    def spread(restless: float) -> np.ndarray:
        return posterior + np.diag(drifts(space, drift, "velocity_y" in windows.columns, restless)**2)
    restless = UNTOLD
    if len(np.unique(run)) > 1:
        q, fresh = of_a_new_run(windows, space, x, rows, slopes, q, run, inflation, start, deviation), 1.0
        inflation = max(float(np.median(inflation_of(q))), 1.0)
        groups = [space.indices(n) for n in np.unique(space.effect_of) if n != GAIN and n not in ALWAYS]
        restless = restless_of(q, run, inflation, precisions(spread(0.0), groups))
    return Floor(x, how, spread(restless), inflation, q, run, fresh * q.cost / np.maximum(q.windows, 1),
                 _sizes(windows, rows), restless)


def restless_of(q: Quadratic, run: np.ndarray, inflation: float, weights: np.ndarray) -> float:
    """0 to 1 from what each run, as a new one, gains. weights: `precisions` of a car and road that stay the same."""
    apart = [gains(g, h, weights).mean() for g, h in runs_of(q, run, inflation)]
    return float(np.interp(np.mean(apart), (SAME, CHANGING), (0.0, 1.0)))


def runs_of(q: Quadratic, run: np.ndarray, inflation: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """(gradient, hessian) of each run, over the inflation."""
    return [(q.gradient[run == r].sum(axis=0) / inflation, q.hessian[run == r].sum(axis=0) / inflation)
            for r in np.unique(run)]


def of_a_new_run(windows: Windows, space: Space, x: np.ndarray, rows: np.ndarray, slopes: np.ndarray, own: Quadratic,
                 run: np.ndarray, inflation: float, start: np.ndarray, deviation: np.ndarray) -> Quadratic:
    """What the blocks of the reference would cost had the floor not been learnt from them.

    Values and sizes of errors are fitted to a run that is looked at, so it looks better than the next one will. Left
    out, it is seen by the floor of the others, worse than by that of all: of the way from the one to the other as much
    is gone as the others have of the windows. By the slopes about x, nothing is predicted anew.
    """
    plain = np.nan_to_num(slopes, nan=0.0, posinf=0.0, neginf=0.0)
    result = {name: getattr(own, name).astype(float) for name in ("cost", "gradient", "hessian")}
    for number in np.unique(run):
        others, rest = run != number, windows.run != number
        d = solve_map(own.hessian[others].sum(0) / inflation, own.gradient[others].sum(0) / inflation, deviation,
                      (x - start) / space.scale, (space.low - x) / space.scale, (space.high - x) / space.scale)
        moved = rows - np.einsum("p,pnm->nm", d, plain)
        how = whitening(moved[rest], windows.condition[rest], least(windows), windows.scored)
        left_out = quadratic(moved, slopes, windows, how)
        for name, values in result.items():
            values[~others] += rest.mean() * (getattr(left_out, name) - values)[~others]
    return Quadratic(**result, windows=own.windows)


def assumed(windows: Windows, space: Space, tick=None) -> Floor:
    """Without a reference: the vehicle file, and what healthy cars may differ from it.

    How large errors are and how they go together is taken from what is left of the suspect drives themselves once every
    effect may help a little.
    """
    start, how, inflation = space.start.copy(), default_whitening(windows), 4.0
    deviation = prior(space, UNKNOWN)
    x, rows = start.copy(), row_errors(windows, space, start)
    loose = prior(space, 1.0)
    loose[space.indices(*LIFTED)] = 1.0
    for _ in range(2):
        q = quadratic(rows, jacobian(windows, space, x, rows, tick=tick), windows, how)
        step = solve_map(q.hessian.sum(0) / inflation, q.gradient.sum(0) / inflation, loose,
                         (x - start) / space.scale, (space.low - x) / space.scale, (space.high - x) / space.scale)
        x, rows = _search(windows, space, x, step, rows, how, inflation, start, loose)
    how = whitening(rows, windows.condition, usual(windows) * 0.3, windows.scored)
    q = quadratic(rows, jacobian(windows, space, x, rows, tick=tick), windows, how)
    inflation = max(float(np.median(inflation_of(q))), 2.0)
    return Floor(start, how, np.diag(deviation**2), inflation, None, None, FRESH * q.cost / np.maximum(q.windows, 1),
                 _sizes(windows, rows), UNTOLD)


def noisier(runs: Sequence[DriveLog], reference: Sequence[DriveLog]) -> float:
    """How much more the INS of the runs trembles than that of the reference: middle of the ratios of variances of the
    third differences. What a car does is slow against the samples and falls out of these; so that it falls out alike,
    all are taken at the rate of the slowest.
    """
    spacings = {id(log): float(np.median(np.diff(log.ins_time_ns))) for log in (*runs, *reference)}
    slowest = max(spacings.values())
    names = ["yaw_rate", "velocity_x", "velocity_y"]
    if all(log.acceleration_y is not None for log in (*runs, *reference)):
        names.append("acceleration_y")

    def tremble(log: DriveLog, name: str) -> float:
        every = max(1, round(slowest / spacings[id(log)]))
        return float(np.nanmedian(np.abs(np.diff(getattr(log, name)[::every], 3))))
    ratios = [np.median([tremble(r, n) for r in runs]) / max(np.median([tremble(r, n) for r in reference]), 1e-9)
              for n in names if any(np.any(r.velocity_y) for r in reference) or n != "velocity_y"]
    more = float(np.median(ratios))**2
    return min(more, NOISIEST) if more > NOISIER else 1.0


def suspicions(floor: Floor, space: Space) -> list[str]:
    """What makes one doubt that the reference is that of a healthy car."""
    away = (floor.vector - space.healthy)[:-1] / space.scale[:-1]
    return [f"reference: {f.effect} {f.parameter} {v:.4g} {f.unit} is far from that of the vehicle file; is it healthy?"
            for f, v, d in zip(space.free, floor.vector[:-1], away, strict=True) if abs(d) > DOUBTFUL]


def _search(windows, space, x, step, rows, how, inflation, start, deviation):
    def total(vector, errors):
        return (costs(whitened(errors, windows.condition, how), windows)[0].sum() / inflation
                + np.square((vector - start) / space.scale / deviation).sum())
    best, best_rows, lowest = x, rows, total(x, rows)
    for share in (1.0, 0.5, 0.2):
        trial = space.inside(x + share * step * space.scale)
        errors = row_errors(windows, space, trial)
        cost = total(trial, errors)
        if cost < lowest:
            return trial, errors
    return best, best_rows


def _sizes(windows: Windows, rows: np.ndarray) -> dict[str, float]:
    values = rows.reshape(len(rows), len(windows.time), -1)[:, -1]
    values = values[np.isfinite(values).all(axis=1)]
    rms = np.sqrt(np.square(values).mean(axis=0)) if len(values) else np.full(len(windows.columns), np.nan)
    return {CHANNEL_OF.get(c, c): float(v) for c, v in zip(windows.columns, rms, strict=True)
            if c != "position_longitudinal"}
