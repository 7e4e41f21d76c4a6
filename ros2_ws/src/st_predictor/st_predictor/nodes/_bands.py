"""Bands between the file, the predictor's messages and the evaluator's counts (st_core.bands)."""

import math
from array import array
from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import numpy as np
from st_core.alignment import MeasurementHistory
from st_core.bands import AdaptiveBands, Coverages, LiveBands, conditions_now
from st_core.bands.live import Stated
from st_core.evaluation import Evaluator, Mode
from st_core.log_evaluation import MODES, EvaluationSettings
from st_core.models import Model
from st_core.prediction import PredictionSettings, Runner, Start
from st_core.types import InsSample, Trajectory
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Band, ErrorStatistics, Prediction
from st_ros import diagnostics
from st_ros.diagnostics import Check

from .. import params
from ..convert import OTHER_MODES

AXES = ("along", "across", "yaw")


class PredictionBands:
    """What the predictor states around its paths: bands of a file, corrected by the scores of this run or not.

    models: hash of the model file by model, "" for one of the paper's. further, runners: as of `Evaluator`. Raises
    ConfigurationError for a file of another car, model or configuration.
    """

    def __init__(self, values: SimpleNamespace, vehicle: VehicleParameters, models: Mapping[str, str],
                 settings: PredictionSettings, further: Sequence[Model], runners: Mapping[str, Runner]):
        self._missing, self._text = "", ""
        self._fixed: LiveBands | None = None
        self._adaptive: AdaptiveBands | None = None
        file = params.load_bands(values)
        if file is not None:
            place = f"bands_file: {values.bands_file}: "
            params.checked(values, lambda: file.check(vehicle, models, EvaluationSettings(settings)), place)
            self._text = f"learnt from {file.runs} runs"
        if values.adaptive_bands:
            time = settings.step * np.arange(1, settings.steps + 1)
            self._adaptive = AdaptiveBands(time, list(models), (*MODES, *OTHER_MODES), file)
            self._messages = BandMessages(self._adaptive.stated)
            self._scorer = Evaluator(vehicle, settings, 0.0, further, runners)
        elif file is not None:
            self._fixed = LiveBands(file, models)
            self._messages = BandMessages(self._fixed.stated)

    def add_ins(self, sample: InsSample) -> None:
        """Measurements by which earlier predictions are scored."""
        if self._adaptive:
            self._scorer.add_ins(sample)

    def add_steering(self, time_ns: int, road_wheel_angle: float) -> None:
        if self._adaptive:
            self._scorer.add_steering(time_ns, road_wheel_angle)

    def at(self, history: MeasurementHistory, time_ns: int, modes: Sequence[Mode]) -> Mapping[str, list[Band]]:
        """By model, for predictions with these modes that start at an instant [ns]; empty without a band. Valid until
        the next call."""
        if self._adaptive:
            condition = conditions_now(history, time_ns) if self._text else ()  # only a calibrated scale needs it
            found, self._missing = self._adaptive.issue(time_ns, condition, modes)
            return {model: [band for band in bands if (model, band.mode) in found]
                    for model, bands in (self._messages.fill() if found else {}).items()}
        if self._fixed is None:
            return {}
        condition = conditions_now(history, time_ns)
        self._missing = "" if self._fixed(condition) else self._fixed.why_not(condition)
        return {} if self._missing else self._messages.fill()

    def score(self) -> None:
        """Score the predictions that have ended; also where none is made, or those that end in standstill are lost."""
        if self._adaptive:
            for score in self._scorer.poll():
                self._adaptive.observe(score)

    def keep(self, start: Start, issued: Mapping[str, Mapping[Mode, Trajectory]]) -> None:
        """Keep predictions issued now, by model and mode, until they have ended."""
        for model, by_mode in issued.items() if self._adaptive else ():
            for mode, trajectory in by_mode.items():
                self._scorer.add_prediction(model, start.time_ns, trajectory, mode)

    def check(self) -> Check:
        """For the diagnostics."""
        if self._missing:
            return Check("bands", diagnostics.WARN, f"no band: {self._missing}")
        if self._fixed:
            levels = " and ".join(f"{100 * level:g} %" for level in self._fixed.levels)
            return Check("bands", diagnostics.OK, f"{levels}, {self._text}")
        if self._adaptive is None:
            return Check("bands", diagnostics.OK, "off (bands_file is empty, adaptive_bands is false)")
        values = {f"{model} {mode} {100 * level:g} %": f"{inside / n:.3f} of {n}"
                  for (model, mode), (n, kept) in self._adaptive.counts.items() for level, inside in kept.items()}
        if (seconds := self._adaptive.learning) > 0.0:
            return Check("bands", diagnostics.OK, "adaptive, learning: no band yet", {"driving required [s]": seconds})
        text = f"adaptive, {self._text or 'learnt from the errors of this run'}"
        return Check("bands", diagnostics.OK, text, values)


class BandMessages:
    """Half-widths as reused messages: constructing them takes ten times as long.

    stated: by model; its arrays are read at every `fill`.
    """

    def __init__(self, stated: Mapping[str, Stated]):
        self._messages: dict[str, list[Band]] = {}
        self._copies: list[tuple[memoryview, memoryview]] = []
        for model, of_model in stated.items():
            self._messages[model] = [self._made(*key, widths) for key, widths in of_model.items()]

    def _made(self, mode: str, level: float, widths: np.ndarray) -> Band:
        zeros = array("f", bytes(4 * len(widths)))
        message = Band(mode=mode, level=level, **dict.fromkeys(AXES, zeros))
        # A message makes arrays of its own; with views of both sides, copying is all that is left to do.
        self._copies += [(memoryview(getattr(message, axis)), memoryview(column))
                         for axis, column in zip(AXES, widths.T, strict=True)]
        return message

    def fill(self) -> Mapping[str, list[Band]]:
        """By model; valid until the next call."""
        for target, column in self._copies:
            target[:] = column
        return self._messages


def read_bands(message: Prediction) -> Stated:
    """What a prediction states; what does not fit its points is left out."""
    points = len(message.x)
    columns = {(one.mode, one.level): [getattr(one, axis) for axis in AXES] for one in message.bands}
    return {key: np.array(three, float).T for key, three in columns.items() if {len(c) for c in three} == {points}}


def coverage_check(coverages: Coverages) -> Check:
    """For the evaluator's diagnostics."""
    values = {f"{model} {mode} {100 * level:g} %": f"{one.share(level):.3f} of {one.n}"
              for (model, mode), one in coverages.by_question.items() for level in sorted(one.kept)}
    if warning := coverages.warning():
        return Check("bands", diagnostics.WARN, warning, values)
    return Check("bands", diagnostics.OK, "cover as they state" if values else "no prediction with a band yet", values)


def add_coverage(message: ErrorStatistics, coverages: Coverages) -> ErrorStatistics:
    """The message with how often its model and mode's bands held."""
    one = coverages.by_question.get((message.model, message.mode))
    message.n_bands = one.n if one else 0
    message.coverage_50, message.coverage_90 = (one.share(level) if one else math.nan for level in (0.5, 0.9))
    return message

