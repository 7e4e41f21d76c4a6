"""Live equals offline: what the nodes predicted and scored against the library, start by start, on one recording."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.markup import escape
from st_core.errors import ConfigurationError
from st_core.evaluation import Mode
from st_core.log_evaluation import MODES, EvaluationSettings, evaluate_blocks
from st_core.log_signals import LogSignals
from st_core.models import Model, get_model
from st_core.prediction import PredictionSettings, configuration_hash
from st_core.vehicle import VehicleParameters
from st_recordings.recorded import (
    Predictions,
    Progress,
    RecordedConfiguration,
    Scores,
    configuration_of,
    read_predictions,
    read_scores,
)
from st_recordings.runs.bag import is_bag, read_bag, was_cut
from st_recordings.runs.errors import RunError
from st_recordings.runs.foreign import SteeringField
from st_recordings.runs.made_again import WHERE
from st_recordings.runs.messages import ODOMETRY, STEERING

SETTINGS = ("horizon", "step", "minimum_speed", "stale_after", "maximum_gap", "filter_cutoff")
# Nodes and recorder find each other one by one, and the filter of the forward acceleration begins with the first sample
# each of them hears. After so many of its time constants it knows nothing of that (2e-9 is left).
SETTLED = 20.0
# So long without a prediction, the predictor may have been started again [s]; a busy computer skips fewer ticks.
PAUSE = 1.0
CUT = "{} was cut: its recorder did not end it; what came after is not {}"


@dataclass
class Comparison:
    """Of one model. Differences are largest magnitudes: position of any point [m], yaw [rad], error of any point [m].

    n_starts: predictions compared. n_scores: complete scores compared, by mode. n_cut: scores the nodes were ended
    before; n_disagree: other scores complete on one side only, jumps of the position apart. start: position at the
    start alone, which tells a different state from a different prediction [m]. n_settling: predictions, with their
    scores, that are not compared, see `settled`.
    """

    model: str
    n_starts: int = 0
    start: float = 0.0
    position: float = 0.0
    yaw: float = 0.0
    at_ns: int = 0
    n_scores: dict[str, int] = field(default_factory=lambda: dict.fromkeys(MODES, 0))
    error: dict[str, float] = field(default_factory=lambda: dict.fromkeys(MODES, 0.0))
    n_cut: int = 0
    n_disagree: int = 0
    n_settling: int = 0

    @property
    def largest(self) -> float:
        """The largest difference of a position or an error [m]."""
        return max(self.position, *self.error.values())


@dataclass(frozen=True)
class Verification:
    """same_configuration: whether vehicle and settings taken here are those the predictions carry the hash of."""

    comparisons: list[Comparison]
    vehicle: str
    same_configuration: bool
    warnings: tuple[str, ...]

    @property
    def largest(self) -> float:
        return max((c.largest for c in self.comparisons), default=0.0)

    @property
    def n_starts(self) -> int:
        return sum(c.n_starts for c in self.comparisons)


def replay_bag(bag: Path, folder: Path, vehicle: Path | None, rate: float, console: Console, view=None,
               bands: Path | None = None, steering: SteeringField | None = None):
    """(Outcome, name of the vehicle) of playing a recording with its own configuration; see replaying.replay.

    steering: where the angle is in a recording of another make.
    """
    from .bands import with_bands
    from .replaying import node_parameters, replay

    drive = read_bag(bag, steering=steering)
    made = [name for name in (ODOMETRY, STEERING) if drive.topics[name].endswith(WHERE)]
    if made:
        raise RunError(bag, f"it holds no {' and no '.join(made)} to play",
                       "st evaluate and st verify make them again from raw packets and frames")
    for line in not_played(bag, drive.unknown):
        console.print(f"[yellow]{escape(line)}[/yellow]", highlight=False, soft_wrap=True)
    car, recorded, _ = configuration_of(drive.records, vehicle)
    file = folder / "vehicle.yaml"
    file.write_text(car.to_yaml())
    parameters = with_bands(node_parameters(folder, file, recorded), bands)
    if "map_frame" not in recorded.nodes.get("predictor", {}):
        for node in ("predictor", "evaluator"):  # of another make, its odometry may be in a frame of another name
            parameters[node]["map_frame"] = drive.frame
    return replay(bag, drive.topics, folder, parameters, rate, console, view, player_options(steering, car)), car.name


def not_played(bag: Path, unknown: Sequence[str]) -> list[str]:
    """What a replay does not show, in sentences: topics nobody here knows, and the rest of a recording that was cut."""
    topics = [f"not known and not played: {', '.join(unknown)}"] if unknown else []
    return topics + ([CUT.format(bag, "played")] if was_cut(bag) else [])


def player_options(steering: SteeringField | None, car: VehicleParameters) -> list[str]:
    """How the player makes st_msgs/Steering of another topic; nothing where it is that already."""
    if steering is None:
        return []
    wheel = ["--steering-wheel", repr(car.steering_ratio), repr(car.steering_wheel_offset)]
    return ["--steering-field", steering.field, *(wheel if steering.quantity == "wheel" else [])]


def recordings_of(path: Path) -> tuple[Path, list[Path]]:
    """(the bag with measurements, bags that may hold scores) for a bag, or the folder of a run of st."""
    bag = path / "bag" if path.is_dir() and not is_bag(path) and is_bag(path / "bag") else path
    errors = bag.parent / "errors"
    return bag, [errors] if is_bag(errors) and errors.is_dir() else [bag]


def verify(path: Path, vehicle: Path | None = None, progress: Progress | None = None) -> Verification | None:
    """Compare every prediction and score in a recording with the library; None where it holds no predictions.

    vehicle: file to take instead of the one in the recording. Raises RunError, ConfigurationError.
    """
    bag, score_bags = recordings_of(path)
    predictions = read_predictions(bag, progress)
    if not predictions:
        return None
    drive = read_bag(bag)
    car, recorded, source = configuration_of(drive.records, vehicle)
    settings = _settings(recorded)
    scores = read_scores(score_bags, progress)
    signals = LogSignals(drive.log, settings.maximum_gap, settings.filter_cutoff)
    cut = [CUT.format(one, "compared") for one in dict.fromkeys((bag, *score_bags)) if was_cut(one)]
    comparisons, warnings = [], [*drive.warnings, *cut]
    for name, live in predictions.items():
        try:
            model = get_model(name)
        except ConfigurationError:
            warnings.append(f"predictions of {name} are not compared: the library has no model of that name")
            continue
        of_model = {mode: scores[name, mode] for mode in MODES if (name, mode) in scores}
        comparisons.append(_compare(model, car, signals, live, of_model, settings.filter_cutoff, progress))
    expected = configuration_hash(car, settings)
    same = all(live.hashes == {expected} for live in predictions.values())
    return Verification(comparisons, f"{car.name}, from {source}", same, tuple(warnings))


def _settings(recorded: RecordedConfiguration) -> PredictionSettings:
    given = {**recorded.nodes.get("evaluator", {}), **recorded.nodes.get("predictor", {})}
    return PredictionSettings(**{key: float(given[key]) for key in SETTINGS if key in given})


def settled(starts_ns: np.ndarray, ins_time_ns: np.ndarray, cutoff: float) -> np.ndarray:
    """Whether the forward acceleration at a start no longer depends on which INS sample was the first to be heard.

    starts_ns: of predictions, rising. A predictor that was started again begins anew, so the time counts from the first
    start since the recording knows the INS, and from the first after every pause: of PAUSE, or of three intervals where
    the predictor is slower. cutoff: of the filter [Hz].
    """
    known = starts_ns >= ins_time_ns[0] if len(ins_time_ns) else np.zeros(len(starts_ns), bool)
    between = np.diff(starts_ns)
    pause = max(round(1e9 * PAUSE), 3 * np.median(between)) if len(between) else 0
    begins = np.concatenate([np.ones(min(len(starts_ns), 1), bool), between > pause])
    begins |= np.diff(known, prepend=False)
    since_ns = starts_ns - np.maximum.accumulate(np.where(begins, starts_ns, starts_ns[:1]))
    return known & (since_ns > SETTLED / (2.0 * np.pi * cutoff) * 1e9)


def _compare(model: Model, car: VehicleParameters, signals: LogSignals, live: Predictions,
             scores: Mapping[Mode, Scores], cutoff: float, progress: Progress | None) -> Comparison:
    horizon = live.step * (live.states.shape[1] - 1)
    settings = EvaluationSettings(PredictionSettings(horizon=horizon, step=live.step, minimum_speed=0.0))
    result = Comparison(model.name)
    kept = settled(live.starts_ns, signals.log.ins_time_ns, cutoff)
    result.n_settling = int((~kept).sum())
    starts_ns, live_states = live.starts_ns[kept], live.states[kept]
    for rows, block in evaluate_blocks([model], car, signals, starts_ns, settings):
        ours, theirs = block.trajectories[model.name, "forecast"], live_states[rows]
        known = np.isfinite(ours).all(axis=(1, 2)) & np.isfinite(theirs).all(axis=(1, 2))
        distance = np.hypot(ours[known][..., 0] - theirs[known][..., 0], ours[known][..., 1] - theirs[known][..., 1])
        result.n_starts += int(known.sum())
        if distance.size:
            if distance.max() > result.position:
                result.at_ns = int(starts_ns[rows][known][distance.max(axis=1).argmax()])
            result.position = max(result.position, float(distance.max()))
            result.start = max(result.start, float(distance[:, 0].max()))
            result.yaw = max(result.yaw, float(np.abs(ours[known][..., 4] - theirs[known][..., 4]).max()))
        for mode, scored in scores.items():
            _compare_scores(result, mode, scored, starts_ns[rows], block.errors[model.name, mode])
        if progress:
            progress(rows.stop, len(starts_ns))
    return result


def _compare_scores(result: Comparison, mode: str, scored: Scores, starts_ns: np.ndarray, ours: np.ndarray) -> None:
    _, mine, theirs = np.intersect1d(starts_ns, scored.starts_ns, assume_unique=True, return_indices=True)
    complete = np.isfinite(ours[mine]).all(axis=(1, 2))
    both = complete & scored.complete[theirs]
    cut = complete & scored.cut[theirs]
    result.n_cut += int(cut.sum())
    # Offline `st check` tells jumps of the position and leaves them out; live no score goes across one.
    excused = cut | scored.jumped[theirs]
    result.n_disagree += int(((complete != scored.complete[theirs]) & ~excused).sum())
    result.n_scores[mode] += int(both.sum())
    if both.any():
        difference = np.abs(ours[mine][both][..., :2] - scored.errors[theirs][both][..., :2])
        result.error[mode] = max(result.error[mode], float(difference.max()))
