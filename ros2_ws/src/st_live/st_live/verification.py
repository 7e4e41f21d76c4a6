"""Implements `st verify`: compares the recorded predictions and scores of the nodes with those of the library."""

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text
from st_core.errors import ConfigurationError
from st_core.evaluation import Mode
from st_core.log import LogSignals
from st_core.log_evaluation import MODES, PLANNED_MODES, EvaluationSettings, FutureInputs, evaluate_blocks
from st_core.models import Model, get_model
from st_core.palette import MODEL_COLOUR
from st_core.prediction import PredictionSettings, configuration_hash
from st_core.types import wrap_angle
from st_core.vehicle import VehicleParameters
from st_recordings import results
from st_recordings.paths import new_folder
from st_recordings.results import Predictions, Scores
from st_recordings.runs import ReadSettings
from st_recordings.runs.bag import is_bag, read_bag, was_interrupted

from .configuration import TRUNCATION_WARNING, find_bag
from .suite import SuiteError

# Each node starts its filter of the forward acceleration with the first sample it receives, and nodes may receive
# different first samples. The effect on the filter's output decays to 2e-9 after this number of time constants.
SETTLING_TIME_CONSTANTS = 20.0
# A longer pause between predictions [s] may be a restart of the predictor; a busy computer causes shorter ones.
RESTART_PAUSE = 1.0


@dataclass
class Comparison:
    """Comparison of one model: numbers of predictions and scores by mode, and largest |recorded - recomputed|."""

    model: str
    n_predictions: Counter[Mode] = field(default_factory=Counter)
    start_difference: float = 0.0  # of the start positions [m], which depend only on the state estimates
    path_difference: float = 0.0  # between positions at any point of a prediction [m]
    yaw_difference: float = 0.0  # between yaw angles at any point of a prediction [rad]
    worst_start_ns: int = 0  # start of the prediction with the largest path difference
    n_scores: Counter[Mode] = field(default_factory=Counter)  # complete live and offline
    score_difference: dict[Mode, float] = field(default_factory=lambda: defaultdict(float))  # [m]
    n_truncated: int = 0  # scores complete only live or only offline because the nodes or the recording ended
    n_one_sided: int = 0  # other scores complete only live or only offline, except those across a jump
    n_settling: int = 0  # forecasts not compared because the acceleration filter had not settled

    @property
    def largest_difference(self) -> float:
        """Largest difference of a position or an error [m]."""
        return max(self.path_difference, *self.score_difference.values())


@dataclass(frozen=True)
class Verification:
    """Comparisons of all models. same_configuration: whether all recorded forecasts used this car and settings."""

    comparisons: list[Comparison]
    vehicle: str
    same_configuration: bool
    warnings: tuple[str, ...]

    @property
    def largest_difference(self) -> float:
        return max((c.largest_difference for c in self.comparisons), default=0.0)


def verify(path: Path, vehicle: Path | None = None,
           read_settings: ReadSettings = ReadSettings()) -> Verification | None:
    """Compare recorded predictions and scores with the library's; None for a recording without predictions. vehicle:
    file to use instead of the recorded vehicle. Raises RunError, ConfigurationError."""
    bag = find_bag(path)
    errors = bag.parent / "errors"
    score_bag = errors if errors.is_dir() and is_bag(errors) else bag
    predictions = results.read_predictions(bag)
    if not predictions:
        return None
    drive = read_bag(bag, steering=read_settings.steering, odometry=read_settings.odometry)
    car, recorded, source = results.find_configuration(drive.records, vehicle)
    parameters = {**recorded.nodes.get("evaluator", {}), **recorded.nodes.get("predictor", {})}
    names = PredictionSettings.__dataclass_fields__.keys() & parameters.keys()
    settings = PredictionSettings(**{name: float(parameters[name]) for name in names})
    scores = results.read_scores([score_bag])
    planned_by_mode = {mode: results.read_predictions(bag, mode) for mode in PLANNED_MODES}
    signals = LogSignals(drive.log, settings.maximum_gap, settings.filter_cutoff)
    truncations = [TRUNCATION_WARNING.format(file, "compared") for file in dict.fromkeys((bag, score_bag))
                   if was_interrupted(file)]
    comparisons, warnings = [], [*drive.warnings, *truncations]
    for name, forecasts in predictions.items():
        try:
            model = get_model(name)
        except ConfigurationError:
            warnings.append(f"predictions of {name} are not compared: the library has no model of this name")
            continue
        model_scores = {mode: scores[name, mode] for mode in (*MODES, *PLANNED_MODES) if (name, mode) in scores}
        planned = {mode: by_model[name] for mode, by_model in planned_by_mode.items() if name in by_model}
        comparisons.append(_compare(model, car, signals, forecasts, planned, model_scores, settings.filter_cutoff))
    is_same = all(predictions[c.model].hashes == {configuration_hash(car, settings)} for c in comparisons)
    return Verification(comparisons, f"{car.name}, from {source}", is_same, tuple(warnings))


def find_settled_starts(starts_ns: np.ndarray, ins_time_ns: np.ndarray, cutoff: float) -> np.ndarray:
    """(n,) whether the acceleration filter had settled at each start. cutoff: cut-off frequency of the filter [Hz].

    Settling begins at the first prediction after the first recorded INS sample, and again after every pause that may
    be a restart of the predictor: longer than RESTART_PAUSE and longer than three prediction intervals.
    """
    has_ins = starts_ns >= ins_time_ns[0] if len(ins_time_ns) else np.zeros(len(starts_ns), bool)
    intervals = np.diff(starts_ns)
    pause = max(round(1e9 * RESTART_PAUSE), 3 * np.median(intervals)) if len(intervals) else 0
    restarts = np.concatenate([np.ones(min(len(starts_ns), 1), bool), intervals > pause])
    restarts |= np.diff(has_ins, prepend=False)
    since_ns = starts_ns - np.maximum.accumulate(np.where(restarts, starts_ns, starts_ns[:1]))
    return has_ins & (since_ns > SETTLING_TIME_CONSTANTS / (2.0 * np.pi * cutoff) * 1e9)


def _compare(model: Model, car: VehicleParameters, signals: LogSignals, forecasts: Predictions,
             planned: Mapping[Mode, Predictions], scores: Mapping[Mode, Scores], cutoff: float) -> Comparison:
    horizon = forecasts.step * (forecasts.states.shape[1] - 1)
    settings = EvaluationSettings(PredictionSettings(horizon=horizon, step=forecasts.step, minimum_speed=0.0))
    result = Comparison(model.name)
    is_settled = find_settled_starts(forecasts.starts_ns, signals.log.ins_time_ns, cutoff)
    result.n_settling = int((~is_settled).sum())
    starts_ns = forecasts.starts_ns[is_settled]
    recorded: dict[Mode, Predictions] = {"forecast": forecasts, **planned}
    end_ns = min(int(times.max(initial=0)) for times in (signals.log.ins_time_ns, signals.log.steering_time_ns))
    last_ns = end_ns - round(horizon * 1e9)  # the last start with recorded measurements in its whole horizon
    future_inputs: dict[Mode, FutureInputs] = {mode: predictions.inputs_at for mode, predictions in planned.items()}
    # The inputs of a plan or course are known only from its recorded predictions; other scores cannot be recomputed.
    scores = {mode: mode_scores.at(planned[mode].starts_ns) if mode in planned else mode_scores
              for mode, mode_scores in scores.items() if mode in MODES or mode in planned}
    for mode, live in scores.items():  # an evaluator that is ready after the predictor misses the first samples
        if live.complete.any():
            has_settled = find_settled_starts(live.starts_ns, live.starts_ns[live.complete], cutoff)
            scores[mode] = live.at(live.starts_ns[has_settled])
    for indices, block in evaluate_blocks([model], car, signals, starts_ns, settings, future_inputs):
        for mode, predictions in recorded.items():
            _compare_paths(result, mode, predictions, starts_ns[indices], block.trajectories[model.name, mode])
        for mode, mode_scores in scores.items():
            _compare_scores(result, mode, mode_scores, starts_ns[indices], block.errors[model.name, mode], last_ns)
    return result


def _compare_paths(result: Comparison, mode: Mode, recorded: Predictions, starts_ns: np.ndarray,
                   states: np.ndarray) -> None:
    """Compare recorded predictions with recomputed ones; states: (n, points, 6), for the starts (n,)."""
    starts_ns, rows, recorded_rows = np.intersect1d(starts_ns, recorded.starts_ns, assume_unique=True,
                                                    return_indices=True)
    difference = states[rows] - recorded.states[recorded_rows]
    is_finite = np.isfinite(difference).all(axis=(1, 2))
    difference, starts_ns = difference[is_finite], starts_ns[is_finite]
    result.n_predictions[mode] += len(difference)
    if not len(difference):
        return
    distance = np.hypot(difference[..., 0], difference[..., 1])
    if distance.max() > result.path_difference:
        result.path_difference = float(distance.max())
        result.worst_start_ns = int(starts_ns[distance.max(axis=1).argmax()])
    result.start_difference = max(result.start_difference, float(distance[:, 0].max()))
    result.yaw_difference = max(result.yaw_difference, float(np.abs(wrap_angle(difference[..., 4])).max()))


def _compare_scores(result: Comparison, mode: Mode, scores: Scores, starts_ns: np.ndarray, errors: np.ndarray,
                    last_ns: int) -> None:
    """Compare recorded scores with errors (n, points, 3) for the starts (n,). last_ns: last start for which the whole
    horizon is recorded; if the recorder was killed before the evaluator, later starts also have complete scores."""
    starts_ns, rows, score_rows = np.intersect1d(starts_ns, scores.starts_ns, return_indices=True)
    complete, complete_live = np.isfinite(errors[rows]).all(axis=(1, 2)), scores.complete[score_rows]
    one_sided = complete != complete_live
    truncated = one_sided & np.where(complete, scores.signal_ends[score_rows], starts_ns > last_ns)
    result.n_truncated += int(truncated.sum())
    # The evaluator does not score across a position jump; the library does, unless the jump is excluded from the run.
    result.n_one_sided += int((one_sided & ~truncated & ~scores.has_jump[score_rows]).sum())
    both = complete & complete_live
    result.n_scores[mode] += int(both.sum())
    difference = np.abs(errors[rows][both][..., :2] - scores.errors[score_rows][both][..., :2])
    result.score_difference[mode] = max(result.score_difference[mode], float(difference.max(initial=0.0)))


def verify_command(bag: Path, vehicle: Path | None, tolerance: float, replay: bool, output: Path | None,
                   console: Console, read_settings: ReadSettings) -> int:
    """Run `st verify`; returns the exit status: 0 if no difference exceeds `tolerance` [m; rad for yaw angles] and each
    score that is complete only live or only offline has a known reason, 2 if there is nothing to compare, else 1.
    replay: whether to play the recording through the nodes first, even if it contains predictions."""
    from .replaying import replay_bag  # needs ROS; comparing does not

    with console.status(description := "reading and comparing"):
        result = None if replay else verify(bag, vehicle, read_settings)
    if result is None:
        reason = "--replay" if replay else "it contains no predictions"
        folder = new_folder(output, f"verify-{bag.stem}")
        console.out(f"playing {bag.name} through the nodes ({reason}); recordings in {folder}", highlight=False)
        outcome, _ = replay_bag(find_bag(bag), folder, vehicle, 0.0, console, settings=read_settings)
        if not (outcome.ok and outcome.statuses):
            raise SuiteError(outcome.problem or f"the replay failed or was stopped before it began; see {folder}/logs")
        with console.status(description):
            result = verify(folder, vehicle)
    if result is None:
        console.print("nothing to compare: the nodes made no prediction from this recording")
        return 2
    for warning in result.warnings:
        console.out(warning, style="yellow", highlight=False)
    if not any(c.n_predictions["forecast"] for c in result.comparisons):
        n_settling = sum(c.n_settling for c in result.comparisons)
        reason = (f"the acceleration filter had not settled for {n_settling} predictions; no other can be recomputed"
                  if n_settling else "no recorded prediction can be recomputed")
        console.print(f"nothing to compare: {reason}")
        return 2
    console.print(_make_table(result))
    if not result.same_configuration:
        console.print("[yellow]the predictions were made with a different vehicle or settings[/yellow]")
    return _print_conclusion(result, tolerance, console)


def _make_table(result: Verification) -> Table:
    """Table of the comparisons, at most 80 columns wide for a drive of one hour."""
    table = Table(title=f"Live versus offline ({result.vehicle}): largest differences", title_justify="left",
                  title_style="bold", box=None, collapse_padding=True, pad_edge=False)
    table.add_column("model")
    for heading in ("predictions", "start\npoint\nmm", "path\nmm", "hindsight\nscores\nnumber, mm",
                    "forecast\nscores\nnumber, mm", "scores\nonly live\nor offline"):
        table.add_column(heading, justify="right", no_wrap=True)
    for c in result.comparisons:
        scores = [f"{c.n_scores[mode]}, {c.score_difference[mode] * 1000:.2g}" for mode in MODES]
        table.add_row(Text(c.model, style=MODEL_COLOUR.get(c.model, "")), str(c.n_predictions["forecast"]),
                      f"{c.start_difference * 1000:.2g}", f"{c.path_difference * 1000:.2g}", *scores,
                      str(c.n_one_sided))
    return table


def _print_conclusion(result: Verification, tolerance: float, console: Console) -> int:
    n_one_sided, n_truncated, n_settling, n_scores, n_forecasts, n_planned = np.sum(
        [(c.n_one_sided, c.n_truncated, c.n_settling, c.n_scores.total(), c.n_predictions["forecast"],
          sum(c.n_predictions[mode] for mode in PLANNED_MODES)) for c in result.comparisons], axis=0)
    yaw_difference = max(c.yaw_difference for c in result.comparisons)
    passed = max(result.largest_difference, yaw_difference) <= tolerance and not n_one_sided
    verdict = "[green]live equals offline[/green]" if passed else "[red]live differs from offline[/red]"
    worst = max(result.comparisons, key=lambda c: c.path_difference)
    location = ""
    if worst.worst_start_ns and not passed:
        time = f"{datetime.fromtimestamp(worst.worst_start_ns * 1e-9, UTC):%H:%M:%S.%f}"[:-3]
        location = f"; the path that differs most: {worst.model} at {time} UTC"
    planned = f", {n_planned} more with inputs of a plan or course," if n_planned else ""
    console.print(f"{verdict}: {n_forecasts} predictions{planned} and {n_scores} scores compared, largest "
                  f"difference {result.largest_difference * 1000:.3g} mm (limit {tolerance * 1000:g} mm), in yaw "
                  f"{yaw_difference * 1000:.3g} mrad (limit {tolerance * 1000:g} mrad); {n_one_sided} scores complete "
                  f"only live or only offline, {n_truncated} incomplete because nodes or recording ended{location}",
                  highlight=False, soft_wrap=True)
    console.print(f"[dim]{n_settling} predictions not compared: the filter of the forward acceleration had not settled "
                  "after the first sample that each node received[/dim]", highlight=False, soft_wrap=True)
    return 0 if passed else 1
