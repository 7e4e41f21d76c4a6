"""Bands between the file, the predictor's messages and the evaluator's counts (st_core.bands)."""

import math
from array import array
from collections.abc import Mapping
from types import SimpleNamespace

import numpy as np
from st_core.alignment import MeasurementHistory
from st_core.bands import Coverages, LiveBands, conditions_now
from st_core.bands.live import Stated
from st_core.log_evaluation import EvaluationSettings
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_msgs.msg import Band, ErrorStatistics, Prediction
from st_ros import diagnostics
from st_ros.diagnostics import Check

from .. import params

AXES = ("along", "across", "yaw")


class PredictionBands:
    """What the predictor states around its paths; nothing where no file is given.

    models: hash of the model file by model, "" for one of the paper's. Raises ConfigurationError for a file that holds
    for another car, model or configuration.
    """

    def __init__(self, values: SimpleNamespace, vehicle: VehicleParameters, models: Mapping[str, str],
                 settings: PredictionSettings):
        self._live: LiveBands | None = None
        self._messages = BandMessages()
        self._missing = ""
        file = params.load_bands(values)
        if file is not None:
            place = f"bands_file: {values.bands_file}: "
            params.checked(values, lambda: file.check(vehicle, models, EvaluationSettings(settings)), place)
            self._live = LiveBands(file, models)
            levels = " and ".join(f"{100 * level:g} %" for level in self._live.levels)
            self._text = f"{levels}, learnt from {file.runs} runs"

    def at(self, history: MeasurementHistory, time_ns: int) -> dict[str, list[Band]]:
        """By model, for predictions that start at an instant [ns]; empty without a band. Valid until the next call."""
        if self._live is None:
            return {}
        condition = conditions_now(history, time_ns)
        found = self._live(condition)
        self._missing = "" if found else self._live.why_not(condition)
        return self._messages.fill(found)

    def check(self) -> Check:
        """For the diagnostics."""
        if self._live is None:
            return Check("bands", diagnostics.OK, "off (bands_file is empty)")
        if self._missing:
            return Check("bands", diagnostics.WARN, f"no band: {self._missing}")
        return Check("bands", diagnostics.OK, self._text)


class BandMessages:
    """The bands of predictions as messages that are filled again and again: making them anew takes five times as long.
    """

    def __init__(self) -> None:
        self._made: dict[tuple[str, str, float], tuple[Band, list[np.ndarray]]] = {}

    def fill(self, found: Mapping[str, Stated]) -> dict[str, list[Band]]:
        """By model; valid until the next call."""
        return {model: [self._filled((model, mode, level), widths) for (mode, level), widths in stated.items()]
                for model, stated in found.items()}

    def _filled(self, key: tuple[str, str, float], widths: np.ndarray) -> Band:
        if key not in self._made:
            zeros = array("f", bytes(4 * len(widths)))
            message = Band(mode=key[1], level=key[2], **dict.fromkeys(AXES, zeros))
            self._made[key] = message, [np.frombuffer(getattr(message, axis), np.float32) for axis in AXES]
        message, columns = self._made[key]
        for column, values in zip(columns, widths.T, strict=True):
            column[:] = values
        return message


def read_bands(message: Prediction) -> Stated:
    """What a prediction states; what does not fit its points is left out."""
    wanted = len(message.x)
    columns = {(one.mode, one.level): [getattr(one, axis) for axis in AXES] for one in message.bands}
    return {key: np.array(three, float).T for key, three in columns.items() if {len(c) for c in three} == {wanted}}


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

