"""A short animation of a run: the predicted paths from the driver's seat, and the error as it becomes known."""

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image
from st_core.frames import cg_to_ins_position, map_to_body
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR, RC
from st_core.vehicle import VehicleParameters
from st_predictor.outline import car_outline
from st_recordings.recorded import Predictions, read_predictions
from st_recordings.results import Results, read_results

FRAMES_PER_SECOND = 5
SIZE, DPI = (8.0, 4.2), 80
GHOST_AGES = (1.0, 2.0, 3.0, 4.0, 5.0)  # s
AHEAD, BEHIND, ASIDE = 34.0, 16.0, 30.0  # m


def animate(run: Path, car: VehicleParameters, file: Path, first: float, last: float) -> int:
    """Write seconds `first` to `last` of a run folder as WebP or GIF; returns the number of frames."""
    results, predictions = read_results(run), read_predictions(run / "bag")
    begin_ns = int(results.track.time_ns[0])
    frames = []
    with plt.rc_context(RC):
        for seconds in np.arange(first, last, 1.0 / FRAMES_PER_SECOND):
            frames.append(_frame(results, predictions, car, begin_ns, seconds, first, last))
    duration = round(1000 / FRAMES_PER_SECOND)
    frames[0].save(file, save_all=True, append_images=frames[1:], duration=duration, loop=0, quality=60, method=2)
    return len(frames)


def _frame(results: Results, predictions: dict[str, Predictions], car: VehicleParameters, begin_ns: int,
           seconds: float, first: float, last: float) -> Image.Image:
    figure, (scene, errors) = plt.subplots(1, 2, figsize=SIZE, dpi=DPI, width_ratios=(1.0, 1.0))
    now_ns = begin_ns + round(seconds * 1e9)
    track = results.track
    here_x, here_y, yaw = (float(np.interp(now_ns, track.time_ns, v)) for v in (track.x, track.y, track.yaw))

    def draw(x: np.ndarray, y: np.ndarray, **how: object) -> None:
        forward, left = map_to_body(np.asarray(x) - here_x, np.asarray(y) - here_y, yaw)
        scene.plot(-left, forward, **how)

    past = (track.time_ns <= now_ns) & (track.time_ns > now_ns - 20e9)
    draw(track.x[past][::10], track.y[past][::10], color=MEASURED_COLOUR, lw=5, alpha=0.5, solid_capstyle="round")
    for model, found in predictions.items():
        for age in (*reversed(GHOST_AGES), 0.0):
            path = _path(found, car, now_ns - round(age * 1e9))
            if path is not None:
                draw(*path, color=MODEL_COLOUR[model], lw=2.2 if age == 0 else 0.8, alpha=1.0 if age == 0 else 0.35,
                     label=model if age == 0 else None)
    draw(*car_outline((here_x, here_y, yaw), car), color="k", lw=1.6)
    scene.set(xlim=(-ASIDE, ASIDE), ylim=(-BEHIND, AHEAD), aspect="equal", xlabel="to the right, m", ylabel="ahead, m")
    scene.set_title("predicted 5 s ahead; thin: 1 to 5 s ago; grey: driven")
    if scene.get_legend_handles_labels()[0]:
        scene.legend(loc="upper left", fontsize=8)
    for (model, mode), scores in results.scores.items():
        end = (scores.start_ns - begin_ns) * 1e-9 + 5.0
        known = scores.complete & (end <= seconds)
        if mode == "hindsight":
            errors.plot(end[known], scores.lateral[known], color=MODEL_COLOUR[model])
    errors.axhline(0.0, color="k", lw=0.6)
    errors.set(xlim=(first, last), ylim=(-0.7, 0.7), xlabel="time, s", ylabel="m (+ = predicted left)")
    errors.set_title("mean lateral error of the 5 s just over\n(hindsight: measured inputs)")
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    plt.close(figure)
    return image


def _path(found: Predictions, car: VehicleParameters, start_ns: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The INS point's path of the prediction nearest to an instant; None where there is none within 150 ms."""
    nearest = int(np.argmin(np.abs(found.starts_ns - start_ns)))
    if abs(int(found.starts_ns[nearest]) - start_ns) > 150_000_000:
        return None
    x, y, yaw = found.states[nearest][:, [0, 1, 4]].T
    return cg_to_ins_position(x, y, yaw, car.cg_to_ins_x, car.cg_to_ins_y)
