"""Adds prediction bands (st_core.bands) to the predictor's messages, and reports their coverage for the evaluator."""

from array import array
from collections.abc import Mapping, Sequence
from types import SimpleNamespace

import numpy as np
from st_core.bands import AdaptiveBands, Bands, CalibratedBands, CoverageMonitor, conditions_now
from st_core.bands.live import HalfWidths
from st_core.evaluation import Evaluator, Mode
from st_core.log_evaluation import MODES, PLANNED_MODES, EvaluationSettings
from st_core.measurement_history import MeasurementHistory
from st_core.prediction import PredictionSettings, Start
from st_core.types import Trajectory
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Band, Prediction
from st_ros import diagnostics
from st_ros.diagnostics import Check

from .. import params

AXES = ("along", "across", "yaw")


class PredictionBands:
    """Bands around the predicted paths: from a bands file, adapted to the errors of this run, both, or none.

    file_hashes: hash of the model file by model, "" for a built-in model. scorer: computes the errors to which
    the bands adapt, from measurements that the caller adds; None: not adaptive. Raises ConfigurationError for bands of
    a different car, model or configuration.
    """

    def __init__(self, values: SimpleNamespace, vehicle: VehicleParameters, file_hashes: Mapping[str, str],
                 settings: PredictionSettings, scorer: Evaluator | None):
        self._reason, self._calibration_note = "", ""  # why bands are missing; runs of the calibration
        self._calibrated: CalibratedBands | None = None
        self._adaptive: AdaptiveBands | None = None
        file = params.read_file(values, "bands_file", Bands.from_yaml)
        if file is not None:
            prefix = f"bands_file: {values.bands_file}: "
            evaluation = EvaluationSettings(settings)
            params.translate_errors(values, lambda: file.check(vehicle, file_hashes, evaluation), prefix)
            self._calibration_note = f"calibrated on {file.runs} runs"
        if scorer:
            time = settings.step * np.arange(1, settings.steps + 1)
            self._adaptive = AdaptiveBands(time, list(file_hashes), (*MODES, *PLANNED_MODES), file)
            self._messages = BandMessages(self._adaptive.half_widths)
            self._scorer = scorer
        elif file is not None:
            self._calibrated = CalibratedBands(file, file_hashes)
            self._messages = BandMessages(self._calibrated.half_widths)

    def make_messages(self, history: MeasurementHistory, time_ns: int,
                      modes: Sequence[Mode]) -> Mapping[str, list[Band]]:
        """Bands by model for predictions of these modes that start at `time_ns`; empty without bands. A bands file has
        no planned modes; only adaptive bands have them. The next call overwrites the messages."""
        if self._adaptive:
            condition = conditions_now(history, time_ns) if self._calibration_note else ()  # only a bands file needs it
            issued, self._reason = self._adaptive.issue(time_ns, condition, modes)
            messages = self._messages.fill() if issued else {}
            return {model: [band for band in bands if (model, band.mode) in issued]
                    for model, bands in messages.items()}
        if self._calibrated is None:
            return {}
        condition = conditions_now(history, time_ns)
        self._reason = "" if self._calibrated.update(condition) else self._calibrated.domain.describe_outside(condition)
        return {} if self._reason else self._messages.fill()

    def observe_scores(self) -> None:
        """Adapt to the errors of predictions whose horizon has passed; call it at every tick, even at standstill."""
        if self._adaptive:
            for score in self._scorer.poll():
                self._adaptive.observe(score)

    def add_predictions(self, start: Start, predictions: Mapping[Mode, Mapping[str, Trajectory]]) -> None:
        """If adaptive, store the predictions just issued, by mode and model, until their horizon has passed."""
        for mode, trajectories in predictions.items() if self._adaptive else ():
            for model, trajectory in trajectories.items():
                self._scorer.add_prediction(model, start.time_ns, trajectory, mode)

    def make_check(self) -> Check:
        if self._reason:
            return Check("bands", diagnostics.WARN, f"no calibrated band: {self._reason}")
        if self._calibrated:
            levels = " and ".join(f"{100 * level:g} %" for level in self._calibrated.levels)
            return Check("bands", diagnostics.OK, f"{levels}, {self._calibration_note}")
        if self._adaptive is None:
            return Check("bands", diagnostics.OK, "off (bands_file is empty, adaptive_bands is false)")
        if (seconds := self._adaptive.remaining_warm_up) > 0.0:
            return Check("bands", diagnostics.OK, "adaptive, learning: no band yet", {"driving required [s]": seconds})
        return Check("bands", diagnostics.OK,
                     f"adaptive, {self._calibration_note or 'estimated from the errors of this run'}")


class BandMessages:
    """Band messages, which are reused because constructing them takes ten times as long as filling them. half_widths:
    by model; `fill` copies the current values of the arrays."""

    def __init__(self, half_widths: Mapping[str, HalfWidths]):
        self._messages: dict[str, list[Band]] = {}
        self._copies: list[tuple[memoryview, memoryview]] = []
        for model, model_widths in half_widths.items():
            self._messages[model] = []
            for (mode, level), widths in model_widths.items():
                message = Band(mode=mode, level=level, **dict.fromkeys(AXES, array("f", bytes(4 * len(widths)))))
                self._messages[model].append(message)
                # The message contains copies of the arrays. With views of both, `fill` only has to copy memory.
                self._copies += [(memoryview(getattr(message, axis)), memoryview(column))
                                 for axis, column in zip(AXES, widths.T, strict=True)]

    def fill(self) -> Mapping[str, list[Band]]:
        """Messages by model, with the current half-widths; valid until the next call."""
        for target, column in self._copies:
            target[:] = column
        return self._messages


def read_bands(message: Prediction) -> HalfWidths:
    """(mode, level) -> half-widths (n, 3): along, across [m], yaw [rad]; bands of a different length are left out."""
    points = len(message.x)
    columns = {(band.mode, band.level): [getattr(band, axis) for axis in AXES] for band in message.bands}
    return {key: np.array(widths, float).T for key, widths in columns.items()
            if all(len(column) == points for column in widths)}


def make_coverage_check(coverages: CoverageMonitor) -> Check:
    """Diagnostic check of the evaluator: observed coverage of the bands."""
    values = {f"{model} {mode} {100 * level:g} %": f"{coverage.coverage_at(level):.3f} of {coverage.n}"
              for (model, mode), coverage in coverages.by_pair.items() for level in sorted(coverage.inside_counts)}
    if warning := coverages.describe_warnings():
        return Check("bands", diagnostics.WARN, warning, values)
    return Check("bands", diagnostics.OK, "coverage as expected" if values else "no prediction with a band yet", values)
