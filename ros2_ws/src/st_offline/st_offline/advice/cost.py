"""What a prediction costs: processor time of each model and step, taken in turns, so that ratios hold on any machine.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from st_core.batch import LogBatch
from st_core.compiled import compile_models
from st_core.log_evaluation import EvaluationSettings, regular_starts, usable_starts
from st_core.log_signals import LogSignals
from st_core.models import Model
from st_core.prediction import predict
from st_core.types import ControlInput, VehicleState
from st_core.vehicle import VehicleParameters

ROUNDS, LEAST = 5, 0.02
"""Turns, and seconds of processor time of each."""
BATCHED = 960
"""Starts of a batch: 20 groups of the compiled lanes."""

Call = Callable[[], object]
Key = tuple[str, float, str]


@dataclass(frozen=True)
class Cost:
    """Processor time of one prediction over the horizon [s]. floats: as live without numba. compiled: as live with it,
    one at a time; None where the model cannot be compiled. batch: a start of many in one drive.
    """

    floats: float
    compiled: float | None
    batch: float


def costs(models: Sequence[Model], vehicle: VehicleParameters, signals: LogSignals,
          settings: Mapping[float, EvaluationSettings]) -> dict[tuple[str, float], Cost]:
    """By model and step [s], of this drive. settings: by step."""
    calls: dict[tuple[str, float, str], tuple[Call, int]] = {}
    for step, one in settings.items():
        starts, _ = usable_starts(signals, vehicle, regular_starts(signals.log, one.interval),
                                  one.prediction.minimum_speed)
        starts = starts[:BATCHED]
        batch = LogBatch(signals, starts, one.prediction.horizon, step, inputs="held")
        middle = starts[len(starts) // 2:][:1]
        state = VehicleState(*signals.states_at(middle, vehicle)[0])
        acceleration, = signals.ins_at(middle, "velocity_x_dot")
        held = ControlInput(float(signals.road_wheel_angle_at(middle)[0]), float(acceleration[0]))
        compiled, _ = compile_models(models, vehicle, one.prediction)
        for model in models:
            calls[model.name, step, "floats"] = partial(
                predict, model, vehicle, state, held, one.prediction.horizon, step), 1
            if model.name in compiled:
                calls[model.name, step, "compiled"] = partial(compiled[model.name], state, held), 1
            calls[model.name, step, "batch"] = partial(batch.predict, model, vehicle), len(starts)
    seconds = in_turns(calls)
    return {(model.name, step): Cost(seconds[model.name, step, "floats"], seconds.get((model.name, step, "compiled")),
                                     seconds[model.name, step, "batch"]) for model in models for step in settings}


def in_turns(calls: Mapping[Key, tuple[Call, int]]) -> dict[Key, float]:
    """Median processor time [s] of one of the predictions that a call makes, all calls in every round."""
    taken: dict[Key, list[float]] = {key: [] for key in calls}
    for call, _ in calls.values():
        call()
    for _ in range(ROUNDS):
        for key, (call, predictions) in calls.items():
            count, begin = 0, time.process_time()
            while not count or time.process_time() - begin < LEAST:
                call()
                count += 1
            taken[key].append((time.process_time() - begin) / (count * predictions))
    return {key: float(np.median(values)) for key, values in taken.items()}
