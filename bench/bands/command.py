"""Bands on held-out runs: coverage, worst cell, and interval score compared with parametric alternatives.

ST_BANDS=genesis, virtual, manoeuvres, corrected, changes or adaptive runs one part only; ST_BANDS=cost measures tick
and live latency with and without bands, on an idle machine. Each part replaces its rows in
docs/measurements/bands_held_out.csv, or its table in bands.md.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from st_core.bands import Band, CalibrationDomain, ErrorSamples, calibrate, compute_error_samples
from st_core.bands.calibration import compute_highest_level, join_runs
from st_core.bands.error_budget import Intervals
from st_core.checks import check, pool_estimates
from st_core.discovery import DiscoverySettings, discover
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.model_file import ModelFile
from st_core.models import MODELS, Model, get_model
from st_core.vehicle import VehicleParameters
from st_offline.bands.bands_report import (
    collect_intervals,
    make_contribution_rows,
    pool_sums,
    sum_band_scores,
    sum_contributions,
    summarise_bands,
    summarise_contributions,
)
from st_offline.discovery.discover_command import build_model_file
from st_offline.discovery.drives import Drive as DiscoveryDrive
from st_offline.discovery.drives import Request
from st_offline.discovery.vehicle_update import update_vehicle
from st_recordings.runs import find_runs, read

from .._drives import OTHER_DRIVES, SOUND_DRIVES
from .._drives import genesis as genesis_vehicle
from .._pages import format_records, replace_part
from ..plants import programmes
from ..plants.record import LEAF, RunPlan, healthy_car, record_run, vehicle_of
from .adaptive import Drive, Score, evaluate_drive, join_drives
from .changes import DELAY, measure_changes
from .methods import LEVELS, METHODS, SEED, SETTINGS, TIME
from .page import COVERAGE_50, COVERAGE_90, PAGE, WORST_CELL, write_rows

MODES = ("hindsight", "forecast")
# Days of recording, from the web page of the data; for low_speed_f to _h only the campaign is known.
DAYS = {
    "2018-08-20": ("cpg_lap_slow", "cpg_lap_fast"), "2018-08-22": ("cpg_lap_medium", "cpg_lap_fast_controlled"),
    "June 2019": ("cpg_low_speed_a", "cpg_low_speed_b", "cpg_low_speed_f", "stale_position_low_speed_g",
                  "stale_position_low_speed_h"),
    "2019-10-18": ("rfs_turn_a", "rfs_turn_c"), "2019-11-27": ("rfs_turn_b",),
}
SITES = {"Richmond": DAYS["2019-10-18"] + DAYS["2019-11-27"],
         "proving ground": DAYS["2018-08-20"] + DAYS["2018-08-22"] + DAYS["June 2019"]}
REAR_AXLE_RUNS = ("rear_ref_rfs_1", "rear_ref_rfs_2", "rear_ref_rfs_3", "rear_ref_rfs_lanekeeping")
SEEDS, DRIVES_PER_MANOEUVRE, DRIVES_PER_SESSION, FOLDS, CORRECTION_DRIVES = 32, 4, 8, 4, 6
MANOEUVRES = ("SWEEP", "STEPS", "SLALOM", "WEAVE", "LIMIT", "BRAKING", "ORDINARY", "CIRCLE")
DEVIATIONS = {"friction_factor": 0.75, "steering_offset": 0.01, "mass_factor": 1.1}
"""Deviations of the second virtual car from the vehicle file: factors, and an offset [rad]."""

Runs = Mapping[str, ErrorSamples]
Row = dict[str, str]
COLUMNS = (COVERAGE_90, "worst run", COVERAGE_50, WORST_CELL, "interval score", "CRPS", "half-width at 5 s", "no band")


def run() -> dict:
    """Rows of all parts, or of the part chosen by ST_BANDS."""
    parts = {"genesis": score_genesis, "virtual": score_virtual, "manoeuvres": score_manoeuvres,
             "corrected": score_corrected, "changes": score_changes, "adaptive": score_adaptive, "cost": measure_cost}
    chosen = os.environ.get("ST_BANDS")
    all_rows: dict[str, Row] = {}
    for name, part in parts.items():
        if name == chosen or (chosen is None and name != "cost"):
            rows = part()
            if name not in ("changes", "adaptive", "cost") and rows:
                write_rows(rows)
            all_rows |= rows
    return all_rows


def score_changes() -> dict[str, Row]:
    """Delays of the coverage warning; the page contains all rows except those of forecasts without a warning."""
    rows = measure_changes()
    page_rows = [row for row in rows if row["mode"] == "hindsight" or row[DELAY] != "none"]
    replace_part(PAGE, "changes in mid-drive", format_records(merge_models(page_rows)))
    return {", ".join(list(row.values())[:4]): row for row in rows}


def merge_models(rows: Iterable[Row]) -> list[Row]:
    """One row for all models with equal results."""
    merged: dict[tuple[str, ...], Row] = {}
    for row in rows:
        key = tuple(value for name, value in row.items() if name != "model")
        if key in merged:
            merged[key]["model"] += f", {row['model']}"
        else:
            merged[key] = dict(row)
    return list(merged.values())


def score_adaptive() -> dict[str, Row]:
    """Adaptive bands of the linear model for sessions of the virtual car with one manoeuvre each, and for the Genesis:
    held out by day and by site, with the INS at the rear axle, and without calibrated bands."""
    virtual = make_virtual_leaf()
    groups = {name: tuple(f"{name} {k}" for k in range(DRIVES_PER_SESSION)) for name in MANOEUVRES}
    logs = {names[k]: virtual.drive(manoeuvre, k, virtual.healthy, manoeuvre) for manoeuvre, names in groups.items()
            for k in range(DRIVES_PER_SESSION)}
    runs = {name: collect_samples(log, virtual.file, ("linear",)) for name, log in logs.items()}
    drives = {name: evaluate_drive(log, virtual.file, "linear", SETTINGS) for name, log in logs.items()}
    sessions = {manoeuvre: [join_drives(manoeuvre, [drives[name] for name in names])]
                for manoeuvre, names in groups.items()}
    sets = [("virtual, by manoeuvre", runs, groups, sessions)]
    genesis = _genesis_logs()
    if genesis is not None:
        car, logs = genesis
        runs = {name: collect_samples(log, car, ("linear",)) for name, log in logs.items()}
        drives = {name: evaluate_drive(log, car, "linear", SETTINGS) for name, log in logs.items()}
        others = {name: run for name, run in runs.items() if name not in REAR_AXLE_RUNS}
        for title, groups, calibration_runs in (("Genesis, by day", DAYS, others), ("Genesis, by site", SITES, others),
                                                ("Genesis, INS at the rear axle", {"rear": REAR_AXLE_RUNS}, others)):
            tested = {key: [drives[name] for name in names] for key, names in groups.items()}
            sets.append((title, calibration_runs, groups, tested))
        sets.append(("Genesis, no file", {}, {"all": ()}, {"all": list(drives.values())}))
    rows = [row for arguments in sets for row in _adaptive_rows(*arguments)]
    replace_part(PAGE, "adaptive bands", format_records(rows))
    return {f"{row['held out']}, {row['mode']}": row for row in rows}


def _adaptive_rows(title: str, runs: Runs, groups: Mapping[str, Sequence[str]],
                   tested: Mapping[str, Sequence[Drive]]) -> list[Row]:
    """Rows of both modes. runs: calibration runs; those of the tested group are left out; empty: no calibration."""
    rows = []
    for mode in MODES:
        score = Score(TIME, ("linear", mode))
        for group, names in groups.items():
            others = [run for name, run in runs.items() if name not in names]
            levels = [level for level in LEVELS if others and level <= compute_highest_level(len(others))]
            band = calibrate(others, ("linear", mode), TIME, levels) if levels else None
            domain = CalibrationDomain.from_runs([run.conditions for run in others]) if levels else None
            for drive in tested[group]:
                score.add(drive, band, domain)
        rows.append({"held out": title, "mode": mode} | score.cells(bool(runs)))
        print(rows[-1], flush=True)
    return rows


def score_genesis() -> dict[str, Row]:
    """Bands of the Genesis, held out by run, by day and by site; empty without the shared drives."""
    runs = _genesis_runs()
    if runs is None:
        return {}
    rear_axle = {name: runs.pop(name) for name in REAR_AXLE_RUNS}
    rows = {}
    for model in MODELS:
        rows |= score_held_out(f"Genesis, {model}, by run", runs, {name: (name,) for name in runs}, model,
                               tuple(METHODS))
        rows |= score_held_out(f"Genesis, {model}, by day", runs, DAYS, model)
        rows |= score_held_out(f"Genesis, {model}, by site", runs, SITES, model)
    replace_part(PAGE, "days as runs", format_records(score_days(runs)))
    return rows | score_transfer("Genesis, linear, on runs with the INS point at the rear axle", runs, rear_axle,
                                 "linear")


def score_days(runs: Runs) -> list[Row]:
    """Coverage on each day of bands calibrated on the other days, with the runs of a day joined into one run."""
    rows = []
    days = {day: join_runs([runs[name] for name in names]) for day, names in DAYS.items()}
    levels = (0.5, compute_highest_level(len(days) - 1))
    for model_mode in product(MODELS, MODES):
        coverages = []
        for day, tested in days.items():
            others = [run for other, run in days.items() if other != day]
            band = calibrate(others, model_mode, TIME, levels)
            domain = CalibrationDomain.from_runs([run.conditions for run in others])
            inside = domain.contains(tested.conditions)
            if not inside.any():
                continue
            errors = np.abs(tested.errors[model_mode][inside].astype(float))
            scores = (errors / band.scale(tested.conditions[inside])).max(axis=(1, 2))
            coverages.append([float((scores <= band.factors[level]).mean()) for level in levels])
        rows.append(dict(zip(("model", "mode"), model_mode, strict=True)) | {
            f"{level:.0%} band: coverage (days)": f"{np.mean(rates):.0%} ({', '.join(f'{rate:.0%}' for rate in rates)})"
            for level, rates in zip(levels, zip(*coverages, strict=True), strict=True)})
    return rows


def score_virtual() -> dict[str, Row]:
    """Bands of the virtual car, held out by seed, and transferred to a car that deviates from its vehicle file."""
    virtual = make_virtual_leaf()
    healthy = virtual.samples("seed", SEEDS, virtual.healthy)
    deviating = virtual.samples("off", SEEDS, virtual.deviating)
    return score_held_out("virtual, nonlinear, by seed", healthy, _folds(healthy), "nonlinear", tuple(METHODS)) \
        | score_held_out("virtual, deviating car, by seed", deviating, _folds(deviating), "nonlinear", tuple(METHODS)) \
        | score_transfer("virtual, bands of the healthy car on the deviating one", healthy, deviating, "nonlinear")


def score_manoeuvres() -> dict[str, Row]:
    """Bands of the virtual car, held out by manoeuvre."""
    virtual = make_virtual_leaf()
    by_manoeuvre = {name: virtual.samples(name, DRIVES_PER_MANOEUVRE, virtual.healthy, name) for name in MANOEUVRES}
    all_runs = {name: run for runs in by_manoeuvre.values() for name, run in runs.items()}
    groups = {manoeuvre: tuple(runs) for manoeuvre, runs in by_manoeuvre.items()}
    return score_held_out("virtual, nonlinear, by manoeuvre", all_runs, groups, "nonlinear")


def score_corrected() -> dict[str, Row]:
    """Bands of the car that deviates from its file, after `st discover` has corrected the file with other drives: held
    out by seed, and transferred from the healthy and from the uncorrected car."""
    virtual = make_virtual_leaf()
    drives = [virtual.drive("to mend", k, virtual.deviating) for k in range(CORRECTION_DRIVES)]
    car, model, intervals = correct_files(drives, virtual.file)
    logs = [virtual.drive("off", k, virtual.deviating).with_steering(car) for k in range(SEEDS)]
    after = {log.name: collect_samples(log, car, (model,)) for log in logs}
    _write_contributions([sum_contributions([model], car, SETTINGS.signals(log), SETTINGS, {model.name: intervals})
                          for log in logs])
    before = virtual.samples("off", SEEDS, virtual.deviating)
    healthy = virtual.samples("seed", SEEDS, virtual.healthy)
    name = model.name
    rows = score_held_out("virtual, corrected by st discover, by seed", after, _folds(after), name, tuple(METHODS))
    renamed = {key: ErrorSamples(run.name, run.conditions, {("nonlinear", mode): run.errors[name, mode]
                                                            for mode in MODES}) for key, run in after.items()}
    return rows \
        | score_transfer("virtual, bands of the healthy car on the corrected one", healthy, renamed, "nonlinear") \
        | score_transfer("virtual, bands of the uncorrected car on the corrected one", before, renamed, "nonlinear")


def correct_files(logs: Sequence[DriveLog], vehicle: VehicleParameters) -> tuple[VehicleParameters, Model, Intervals]:
    """Vehicle, model and 95 % intervals of its parameters, from the files that `st discover` writes for these logs."""
    sensors = pool_estimates([check(log, vehicle).estimates for log in logs])
    settings = DiscoverySettings()
    discovery = discover(logs, vehicle, "nonlinear", (), settings, sensor_estimates=sensors)
    request = Request("nonlinear", vehicle, "the file", vehicle.to_yaml(), settings,
                      drives=[DiscoveryDrive(log.name, log, {"files": {}}) for log in logs])
    files = update_vehicle(discovery, request)
    if files is None:
        raise RuntimeError(f"st discover found no model: {discovery.outcome}")
    car = VehicleParameters.from_yaml(files.text) if files.text else vehicle
    model = build_model_file(discovery, request, files)
    if model is None:
        return car, get_model("nonlinear"), {}
    file = ModelFile.from_yaml(model.to_yaml())
    return car, file.model(), next(iter(collect_intervals([file]).values()))


def _write_contributions(runs: Sequence[dict]) -> None:
    """Writes the error budget of the corrected car to the page."""
    contributions = summarise_contributions(pool_sums(runs))
    (contribution,) = contributions.values()
    causes = {name: values["5"]["lateral"] for name, values in contribution["rms_of_cause"].items()}
    largest = sorted(causes, key=causes.get, reverse=True)[:5]
    text = "; ".join(f"{name} {causes[name]:.2f} m" for name in largest)
    replace_part(PAGE, "shares", f"{format_records(make_contribution_rows(contributions))}\n\n"
                 f"The largest lateral contributions at 5 s, rms: {text}.")


@dataclass(frozen=True)
class VirtualLeaf:
    """The virtual Leaf: vehicle file, settings of the car that it describes, and settings of a car that deviates."""

    file: VehicleParameters
    healthy: Mapping[str, float]
    deviating: Mapping[str, float]

    def drive(self, name: str, number: int, settings: Mapping[str, float], manoeuvre: str | None = None) -> DriveLog:
        """Log of a drive. name, number: seed; manoeuvre: of plants.programmes, repeated three times, or None
        for several random ones."""
        parts = None if manoeuvre is None else (getattr(programmes, manoeuvre),) * 3
        return record_run(LEAF, self.file,
                          RunPlan(f"{name} {number}", (SEED, *name.encode(), number), settings, parts))

    def samples(self, name: str, count: int, settings: Mapping[str, float], manoeuvre: str | None = None) -> Runs:
        return {f"{name} {k}": collect_samples(self.drive(name, k, settings, manoeuvre), self.file, ("nonlinear",))
                for k in range(count)}


def make_virtual_leaf() -> VirtualLeaf:
    car = healthy_car(LEAF, (SEED,)).settings
    deviating = {name: car[name] * value if name.endswith("factor") else car[name] + value
                 for name, value in DEVIATIONS.items()}
    return VirtualLeaf(vehicle_of(LEAF, car), car, car | deviating)


def collect_samples(log: DriveLog, vehicle: VehicleParameters, models: Sequence[str | Model]) -> ErrorSamples:
    return compute_error_samples([get_model(model) for model in models], vehicle, SETTINGS.signals(log), SETTINGS)


def score_held_out(title: str, runs: Runs, groups: Mapping, model: str,
                   methods: Sequence[str] = ("conformal",)) -> dict[str, Row]:
    """Tests each group of runs with bands of all other groups; one row for each mode and method."""
    rows = {}
    for mode in MODES:
        entries: dict[str, list] = {method: [] for method in methods}
        failures = []
        for group, names in groups.items():
            others = [run for key, run in runs.items() if key not in names]
            try:
                band = calibrate(others, (model, mode), TIME, LEVELS)
            except StCoreError as error:
                failures.append(f"{group}: {error}")
                continue
            for method in methods:
                entries[method] += sum_scores(METHODS[method](band, others, (model, mode)), others,
                                              [runs[key] for key in names], (model, mode))
        for method, sums in entries.items():
            rows[f"{title}, {mode}, {method}"] = format_cells(sums, failures)
            print(title, mode, method, rows[f"{title}, {mode}, {method}"], flush=True)
    return rows


def score_transfer(title: str, runs: Runs, others: Runs, model: str) -> dict[str, Row]:
    """Tests bands of `runs` on runs of another car or mounting, for which the coverage is not guaranteed."""
    tested = {f"tested {name}": run for name, run in others.items()}
    return score_held_out(title, {**runs, **tested}, {"tested": tuple(tested)}, model)


def sum_scores(band: Band, calibration_runs: Sequence[ErrorSamples], tested_runs: Sequence[ErrorSamples],
               model_mode: tuple[str, str]) -> list[dict]:
    """Sums over the starts of each tested run, which `summarise_bands` needs."""
    domain, entries = CalibrationDomain.from_runs([run.conditions for run in calibration_runs]), []
    for run in tested_runs:
        rows = domain.contains(run.conditions)
        sums = sum_band_scores(band, run.conditions[rows], run.errors[model_mode][rows].astype(float))
        entries.append(sums | {"without_band": int((~rows).sum())})
    return entries


def format_cells(runs: Sequence[dict], failures: Sequence[str]) -> Row:
    """Cells of a row. failures: groups without a band, each with the reason for the failed calibration."""
    pooled = summarise_bands({"models": {"m": {"q": pool_sums(runs)}}})["models"]["m"]["q"] if runs else None
    if pooled is None or not pooled["starts"]:
        return dict.fromkeys(COLUMNS, "-") | {"no band": "; ".join(failures) or "100%"}
    coverages = {level: [run["coverage"][level] / run["starts"] for run in runs if run["starts"]]
                 for level in ("0.9", "0.5")}
    worst, width = pooled["worst_cell"], pooled["half_width"]["0.9"]["5"]
    without = pooled["without_band"] / (pooled["without_band"] + pooled["starts"])
    cells = [f"{np.mean(coverages['0.9']):.1%}", f"{min(coverages['0.9']):.0%}", f"{np.mean(coverages['0.5']):.1%}",
             f"{worst['coverage']:.0%} ({worst['cell']}, {worst['starts']})" if worst else "none",
             _format_axes(pooled["interval_score"]["0.9"]), _format_axes(pooled["crps"]), _format_axes(width),
             "; ".join([f"{without:.1%}", *failures])]
    return dict(zip(COLUMNS, cells, strict=True))


def _format_axes(axes: Mapping[str, float]) -> str:
    return f"{axes['longitudinal']:.2f} | {axes['lateral']:.2f}"


def _folds(runs: Runs) -> dict[int, list[str]]:
    return dict(enumerate([list(part) for part in np.array_split(np.array(list(runs)), FOLDS)]))


def _genesis_runs() -> dict[str, ErrorSamples] | None:
    """Error samples of all drives except the one with a wrong map projection; None without the shared drives."""
    genesis = _genesis_logs()
    return genesis and {name: collect_samples(log, genesis[0], MODELS) for name, log in genesis[1].items()}


def _genesis_logs() -> tuple[VehicleParameters, dict[str, DriveLog]] | None:
    folders = [SOUND_DRIVES, OTHER_DRIVES]
    if not all(folder.exists() for folder in folders):
        return None
    car = genesis_vehicle()
    sources = [source for source in find_runs(folders) if not source.name.startswith("wrong_projection")]
    return car, {source.name: read(source, car).log for source in sources}


def measure_cost() -> dict[str, Row]:
    """Duration of a tick, and latency and load of live runs, without and with bands."""
    from .. import latency, tick

    turns = int(os.environ.get("ST_BENCH_TURNS", "2"))
    os.environ.setdefault("ST_BENCH_SECONDS", "25")
    ticks, latencies = tick.run(), {"0": [], "1": []}
    for _ in range(turns):
        for bands, results in latencies.items():
            os.environ["ST_BENCH_BANDS"] = bands
            results.append(latency.run())
    rows = [_cost_row(name, ticks[f"{key}ms_p50"], ticks[f"{key}ms_p99"], results)
            for name, key, results in (("no", "", latencies["0"]), ("yes", "with_bands_", latencies["1"]))]
    replace_part(PAGE, "cost of bands", format_records(rows))
    return {row["bands"]: row for row in rows}


def _cost_row(name: str, median: float, quantile_99: float, results: list[dict]) -> dict[str, str]:
    """A row of the table, with a latency and a load for each live run."""
    latencies = [result["samples_to_third_prediction_published_ms"] for result in results]
    return {"bands": name, "tick p50 | p99, ms": f"{median:.2f} | {quantile_99:.2f}",
            "latency p50, ms": ", ".join(f"{latency['p50']:.1f}" for latency in latencies),
            "latency p99, ms": ", ".join(f"{latency['p99']:.1f}" for latency in latencies),
            **{f"{node}, % of a core": ", ".join(f"{result['cpu_percent'][node]:.1f}" for result in results)
               for node in ("predictor", "evaluator", "recorder")}}
