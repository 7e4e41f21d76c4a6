"""Processor time of each model over the length of the log and over the horizon, with a plot."""

from pathlib import Path

import numpy as np
from st_core.batch import LogBatch
from st_core.models import MODELS
from st_recordings.paths import project_root

from ._drives import leaf
from ._processor_time import POINTS, measure_alternately, pin_to_core, start_times, weaving_drive

MINUTES = (1.0, 3.0, 10.0, 30.0)
HORIZONS = (1.0, 2.0, 3.0, 5.0, 7.0, 10.0)


def run() -> dict:
    """Processor time [ms] by length of the log [min] and by horizon [s]; draws docs/images/performance_growth.png."""
    car = leaf()
    logs = {minutes: weaving_drive(60.0 * minutes) for minutes in MINUTES}
    by_length, by_horizon = {}, {}
    with pin_to_core():
        for model in MODELS:
            batches = {str(m): LogBatch(log, start_times(log), points=POINTS) for m, log in logs.items()}
            by_length[model] = _measure(batches, model, car)
            log = logs[10.0]
            batches = {str(h): LogBatch(log, start_times(log, 10.0), h, points=(h,)) for h in HORIZONS}
            by_horizon[model] = _measure(batches, model, car)
    _plot(by_length, by_horizon, project_root() / "docs" / "images" / "performance_growth.png")
    return {"ms_by_minutes": by_length, "ms_by_horizon": by_horizon}


def _measure(batches, model, car) -> dict:
    seconds = measure_alternately({name: lambda b=b: b.predict(model, car) for name, b in batches.items()},
                                  repetitions=3)
    return {name: value * 1e3 for name, value in seconds.items()}


def _plot(by_length: dict, by_horizon: dict, path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from st_core.palette import FIGURE_STYLE, MODEL_COLOUR

    with plt.rc_context(FIGURE_STYLE):
        figure, axes = plt.subplots(1, 2, figsize=(7.5, 3.0))
        for axis, results, label in zip(axes, (by_length, by_horizon), ("log [min]", "horizon [s]"), strict=True):
            for model, values in results.items():
                x = np.array([float(name) for name in values])
                axis.plot(x, list(values.values()), "o-", color=MODEL_COLOUR[model], label=model, markersize=3)
            axis.set(xlabel=label, ylabel="CPU time [ms]", xlim=(0, None), ylim=(0, None))
        axes[0].set_title("5 s horizons, a start every 100 ms")
        axes[1].set_title("ten-minute log")
        axes[0].legend()
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path)
        plt.close(figure)
