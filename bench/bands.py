"""Bands on runs they were not learnt from: coverage, worst cell, interval score against parametric alternatives."""

import os
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from _band_changes import changes
from scipy import stats
from st_core.bands import Band, RunSamples, Seen, calibrate, run_samples
from st_core.bands.scale import Scale, features, fit_scale, spread
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.log_evaluation import EvaluationSettings
from st_core.models import get_model
from st_core.vehicle import VehicleParameters
from st_offline.bands.scoring import question_sums
from st_offline.bands.sums import finished, pooled_sums
from st_recordings.paths import config, project_root
from st_recordings.runs import find_runs, read

SETTINGS = EvaluationSettings()
TIME = SETTINGS.prediction.step * np.arange(1, SETTINGS.prediction.steps + 1)
MODES = ("hindsight", "forecast")
LEVELS = (0.5, 0.9)
SEED = 21
# Days as the data's own page has them; of low_speed_f to _h only the campaign is known.
DAYS = {
    "2018-08-20": ("cpg_lap_slow", "cpg_lap_fast"), "2018-08-22": ("cpg_lap_medium", "cpg_lap_fast_controlled"),
    "June 2019": ("cpg_low_speed_a", "cpg_low_speed_b", "cpg_low_speed_f", "stale_position_low_speed_g",
                  "stale_position_low_speed_h"),
    "2019-10-18": ("rfs_turn_a", "rfs_turn_c"), "2019-11-27": ("rfs_turn_b",),
}
SITES = {"Richmond": DAYS["2019-10-18"] + DAYS["2019-11-27"],
         "proving ground": DAYS["2018-08-20"] + DAYS["2018-08-22"] + DAYS["June 2019"]}
OTHER_POINT = ("rear_ref_rfs_1", "rear_ref_rfs_2", "rear_ref_rfs_3", "rear_ref_rfs_lanekeeping")
SEEDS, OF_A_MANOEUVRE, FOLDS = 32, 4, 4
OFF = {"friction_factor": 0.75, "steering_offset": 0.01, "mass_factor": 1.1}
"""What is off on the car whose vehicle file is not."""

Runs = Mapping[str, RunSamples]
Learn = Callable[[Sequence[RunSamples], tuple[str, str]], Band]


def run() -> dict:
    """ST_BANDS=genesis, virtual or changes: that part only. Figures are of one model and question a row."""
    parts = {"genesis": genesis, "virtual": virtual, "changes": changes}
    chosen = os.environ.get("ST_BANDS")
    found: dict[str, str] = {}
    for name, part in parts.items():
        if chosen in (None, name):
            found |= part()
    return found


def genesis() -> dict[str, str]:
    runs = _genesis_runs()
    if runs is None:
        return {"Genesis": "the shared drives are not here"}
    apart = {name: runs.pop(name) for name in OTHER_POINT}
    found = {}
    for model in ("kinematic", "linear"):
        found |= held_out(f"Genesis, {model}, by run", runs, {name: (name,) for name in runs}, model)
    for model in ("linear",):
        found |= held_out(f"Genesis, {model}, by day", runs, DAYS, model)
        found |= held_out(f"Genesis, {model}, by site", runs, SITES, model)
        found |= transferred(f"Genesis, {model}, INS point at the rear axle", runs, apart, model)
    return found


def virtual() -> dict[str, str]:
    sys.path.insert(0, str(project_root()))
    from bench.discovery import cars, programmes
    from bench.discovery.plants import Order, driven, vehicle_of

    car = cars.healthy_car(cars.LEAF, (SEED,))
    file = vehicle_of(cars.LEAF, car.settings)
    off = car.settings | {name: car.settings[name] * v if name.endswith("factor") else car.settings[name] + v
                          for name, v in OFF.items()}

    def drives(name: str, count: int, settings: Mapping[str, float], parts: tuple | None = None) -> dict:
        return {f"{name} {k}": samples(driven(cars.LEAF, file, Order(f"{name} {k}", (SEED, *name.encode(), k), settings,
                                                                     parts)), file, ("nonlinear",))
                for k in range(count)}

    mixed, other = drives("seed", SEEDS, car.settings), drives("off", SEEDS, off)
    kinds = ("SWEEP", "STEPS", "SLALOM", "WEAVE", "LIMIT", "BRAKING", "ORDINARY", "CIRCLE")
    single = {kind: drives(kind, OF_A_MANOEUVRE, car.settings, (getattr(programmes, kind),) * 3) for kind in kinds}
    groups = [list(part) for part in np.array_split(np.array(list(mixed)), FOLDS)]
    found = held_out("virtual, nonlinear, by seed", mixed, dict(enumerate(groups)), "nonlinear")
    found |= held_out("virtual, parameters off, by seed", other, dict(enumerate(
        [list(part) for part in np.array_split(np.array(list(other)), FOLDS)])), "nonlinear")
    found |= transferred("virtual, bands of the healthy car on the one that is off", mixed, other, "nonlinear")
    found |= held_out("virtual, nonlinear, by manoeuvre", {k: v for one in single.values() for k, v in one.items()},
                      {kind: tuple(one) for kind, one in single.items()}, "nonlinear")
    return found


def samples(log: DriveLog, vehicle: VehicleParameters, models: Sequence[str]) -> RunSamples:
    return run_samples([get_model(model) for model in models], vehicle, SETTINGS.signals(log), SETTINGS)


def held_out(title: str, runs: Runs, groups: Mapping, model: str) -> dict[str, str]:
    """Each group of runs tested with bands learnt from all the others; one row for each question and way."""
    found = {}
    for mode in MODES:
        for name, learn in WAYS.items():
            entries, refused = [], []
            for group, names in groups.items():
                try:
                    entries.append(tested([one for key, one in runs.items() if key not in names],
                                          [runs[key] for key in names], (model, mode), learn))
                except StCoreError as error:
                    refused.append(f"{group}: {error}")
            found[f"{title}, {mode}, {name}"] = row(entries, refused)
            print(f"{title}, {mode}, {name}: {found[f'{title}, {mode}, {name}']}", flush=True)
    return found


def transferred(title: str, runs: Runs, others: Runs, model: str) -> dict[str, str]:
    """Bands of these runs on runs that are not like them: the promise does not hold there, and it shows."""
    found = {}
    for mode in MODES:
        entry = tested(list(runs.values()), list(others.values()), (model, mode), WAYS["conformal"])
        found[f"{title}, {mode}, conformal"] = row([entry], [])
        print(f"{title}, {mode}: {found[f'{title}, {mode}, conformal']}", flush=True)
    return found


def tested(known: Sequence[RunSamples], new: Sequence[RunSamples], question: tuple[str, str],
           learn: Learn) -> list[dict]:
    """Sums (bands.scoring) of every new run."""
    band, seen = learn(known, question), Seen.of([one.conditions for one in known])
    entries = []
    for one in new:
        rows = seen(one.conditions)
        sums = question_sums(band, one.conditions[rows], one.errors[question][rows].astype(float))
        entries.append(sums | {"without_band": int((~rows).sum())})
    return entries


def row(entries: Sequence[Sequence[dict]], refused: Sequence[str]) -> str:
    runs = [one for group in entries for one in group]
    if not runs:
        return "refused: " + "; ".join(refused)
    of_all = finished({"models": {"m": {"q": pooled_sums(runs)}}})["models"]["m"]["q"]
    every = [[one["coverage"][key] / one["starts"] for one in runs if one["starts"]] for key in ("0.9", "0.5")]
    score, crps, worst = of_all["interval_score"]["0.9"], of_all["crps"], of_all["worst_cell"]
    width = of_all["half_width"]["0.9"]["5"]
    words = [f"90 % covers {np.mean(every[0]):.1%} (mean of {len(every[0])} runs, least {min(every[0]):.0%}; of starts "
             f"{of_all['coverage']['0.9']:.1%})", f"50 % covers {np.mean(every[1]):.1%}",
             f"worst cell {worst['coverage']:.0%} ({worst['cell']}, {worst['starts']})" if worst else "no cell of 200",
             f"interval score {score['longitudinal']:.2f} | {score['lateral']:.2f} m",
             f"CRPS {crps['longitudinal']:.2f} | {crps['lateral']:.2f} m",
             f"half-width at 5 s {width['longitudinal']:.2f} | {width['lateral']:.2f} m",
             f"no band {of_all['without_band'] / (of_all['without_band'] + of_all['starts']):.1%}"]
    return "; ".join([*words, *(f"refused {one}" for one in refused)])


def conformal(runs: Sequence[RunSamples], question: tuple[str, str]) -> Band:
    return calibrate(runs, question, TIME, LEVELS)


def normal(runs: Sequence[RunSamples], question: tuple[str, str], by_condition: bool = True,
           heavy: bool = False) -> Band:
    """A normal (or Student t) process: the quantile of the largest of its points and axes, by drawing from it.

    Its covariance is that of the errors divided by their scale, all windows of all runs together; nothing is held out
    and nothing calibrated. Degrees of freedom: maximum likelihood at single points.
    """
    scale = fit_scale([one.conditions for one in runs], [one.errors[question] for one in runs], TIME)
    if not by_condition:
        scale = _same_everywhere(scale, runs, question)
    picked = [spread(len(one.conditions), 100) for one in runs]
    z = np.concatenate([one.errors[question][rows] / scale(one.conditions[rows])
                        for one, rows in zip(runs, picked, strict=True)])
    points = z[:, 4::5].reshape(len(z), -1)
    generator = np.random.default_rng(SEED)
    drawn = generator.multivariate_normal(np.zeros(points.shape[1]), np.cov(points.T) + 1e-9 * np.eye(points.shape[1]),
                                          4000, method="eigh")
    marginal = stats.norm(scale=points.std())
    if heavy:
        sample = generator.choice(points.ravel(), 5000)
        freedom = max(2.5, stats.t.fit(sample, floc=0.0)[0])
        # The same covariance, heavier tails.
        drawn *= np.sqrt((freedom - 2.0) / generator.chisquare(freedom, (len(drawn), 1)))
        marginal = stats.t(freedom, scale=points.std() * np.sqrt((freedom - 2.0) / freedom))
    highest = np.abs(drawn).max(axis=1)
    ratios = np.tile(marginal.ppf(0.5 + 0.5 * 0.05 * np.arange(1, 20)), (3, 1))
    return Band(scale, {level: float(np.quantile(highest, level)) for level in LEVELS}, ratios)


def _same_everywhere(scale: Scale, runs: Sequence[RunSamples], question: tuple[str, str]) -> Scale:
    """Root mean square at each knot, whatever the conditions."""
    squares = np.mean([np.square(one.errors[question].astype(float)).mean(axis=0) for one in runs], axis=0)
    near = [int(np.abs(TIME - knot).argmin()) for knot in scale.knots]
    coefficients = np.zeros((3, len(near), features(np.zeros((1, 4))).shape[1]))
    coefficients[:, :, 0] = 0.5 * np.log(squares[near].T)
    return Scale(coefficients, scale.floor, TIME, scale.knots)


WAYS: dict[str, Learn] = {
    "conformal": conformal,
    "normal by condition": normal,
    "Student t by condition": lambda runs, question: normal(runs, question, heavy=True),
    "normal, same everywhere": lambda runs, question: normal(runs, question, by_condition=False),
}


def _genesis_runs() -> dict[str, RunSamples] | None:
    """All drives but the one that was projected wrongly."""
    data = Path(os.environ.get("ST_SHARED", project_root().parent / "shared")) / "data"
    folders = [data / name for name in ("hyundai_genesis_oxts", "hyundai_genesis_more")]
    if not all(folder.exists() for folder in folders):
        return None
    file = config("vehicle/hyundai_genesis.yaml")
    car = VehicleParameters.from_yaml(file.read_text(), str(file))
    sources = [source for source in find_runs(folders) if not source.name.startswith("wrong_projection")]
    return {source.name: samples(read(source, car).log, car, ("kinematic", "linear")) for source in sources}
