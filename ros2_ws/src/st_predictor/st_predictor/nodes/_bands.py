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

    models: hash of the model file by model, "" for one of the paper's. Raises ConfigurationError for a file of
    another car, model or configuration.
    """

    def __init__(self, values: SimpleNamespace, vehicle: VehicleParameters, models: Mapping[str, str],
                 settings: PredictionSettings):
        self._live: LiveBands | None = None
        self._missing = ""
        file = params.load_bands(values)
        if file is not None:
            place = f"bands_file: {values.bands_file}: "
            params.checked(values, lambda: file.check(vehicle, models, EvaluationSettings(settings)), place)
            self._live = LiveBands(file, models)
            self._messages = BandMessages(self._live.stated)
            levels = " and ".join(f"{100 * level:g} %" for level in self._live.levels)
            self._text = f"{levels}, learnt from {file.runs} runs"

    def at(self, history: MeasurementHistory, time_ns: int) -> Mapping[str, list[Band]]:
        """By model, for predictions that start at an instant [ns]; empty without a band. Valid until the next call."""
        if self._live is None:
            return {}
        condition = conditions_now(history, time_ns)
        if self._live(condition):
            self._missing = ""
            return self._messages.fill()
        self._missing = self._live.why_not(condition)
        return {}

    def check(self) -> Check:
        """For the diagnostics."""
        if self._live is None:
            return Check("bands", diagnostics.OK, "off (bands_file is empty)")
        if self._missing:
            return Check("bands", diagnostics.WARN, f"no band: {self._missing}")
        return Check("bands", diagnostics.OK, self._text)


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

