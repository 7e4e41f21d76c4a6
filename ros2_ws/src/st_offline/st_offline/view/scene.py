"""Draws one instant of a running suite into a Rerun recording: plain values in, nothing of ROS."""

import math

import numpy as np
import rerun as rr
from st_core.vehicle import VehicleParameters
from st_predictor.history import History
from st_predictor.outline import car_outline
from st_predictor.palette import MEASURED_COLOUR, colour_of, label_index, rgb

from . import geometry
from .layout import TIMELINE

RINGS = (10, 20, 30, 40, 50, 60)  # m around the car
GHOST_STRENGTH = 0.4  # 1: full colour, 0: paper
PATH_WIDTH, GHOST_WIDTH, TRACK_WIDTH = 0.22, 0.09, 0.5  # m, radii


class Scene:
    """recording: where to draw. car: for its outline."""

    def __init__(self, recording: rr.RecordingStream, car: VehicleParameters):
        self._rr, self._car = recording, car
        self._named: set[str] = set()
        angle = np.linspace(0.0, 2.0 * math.pi, 73)
        rings = [np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1) for r in RINGS]
        recording.log("ahead/rings", rr.LineStrips2D(rings, colors=[(228, 228, 228)], radii=0.04, draw_order=-1.0),
                      static=True)
        recording.log("ahead/ring_names", rr.Points2D(
            [(0.0, -float(r)) for r in RINGS[1::2]], radii=0.01, colors=[(120, 120, 120)],
            labels=[f"{r} m" for r in RINGS[1::2]], show_labels=True), static=True)
        for name, unit in (("steering", "road wheel angle"), ("speed", "speed"),
                           ("lateral_acceleration", "v_x r")):
            self._series(f"plots/{name}/measured", unit, MEASURED_COLOUR)

    def _series(self, entity: str, name: str, colour: str) -> None:
        self._rr.log(entity, rr.SeriesLines(colors=[rgb(colour)], names=[name], widths=[2.0]), static=True)

    def motion(self, time_ns: int, velocity_x: float, yaw_rate: float, road_wheel_angle: float | None) -> None:
        """Points of the plots; road_wheel_angle in rad, None while unknown."""
        self._at(time_ns)
        self._rr.log("plots/speed/measured", rr.Scalars([velocity_x]))
        self._rr.log("plots/lateral_acceleration/measured", rr.Scalars([velocity_x * yaw_rate]))
        if road_wheel_angle is not None:
            self._rr.log("plots/steering/measured", rr.Scalars([math.degrees(road_wheel_angle)]))

    def error(self, end_ns: int, model: str, longitudinal: float, lateral: float) -> None:
        """The horizon means [m] of one forecast, drawn at the end of its horizon, when they became known."""
        if model not in self._named:
            self._named.add(model)
            for quantity in ("lateral", "longitudinal"):
                self._series(f"plots/{quantity}/{model}", model, colour_of(model))
        self._at(end_ns)
        self._rr.log(f"plots/lateral/{model}", rr.Scalars([lateral]))
        self._rr.log(f"plots/longitudinal/{model}", rr.Scalars([longitudinal]))

    def words(self, time_ns: int, markdown: str) -> None:
        self._at(time_ns)
        self._rr.log("words", rr.TextDocument(markdown, media_type="text/markdown"))

    def paths(self, time_ns: int, pose: tuple[float, float, float], history: History) -> None:
        """Car, track, predictions and ghosts, on the map and from the driver's seat; pose (x, y [m], yaw [rad])."""
        self._at(time_ns)
        self._picture("map", geometry.north_up, pose, history, time_ns, width=2.5)
        self._picture("ahead", lambda x, y: geometry.heading_up(x, y, pose), pose, history, time_ns)

    def _picture(self, root: str, place, pose, history: History, now_ns: int, width: float = 1.0) -> None:
        strips, colours, radii = [], [], []
        for model in history.models:
            for age, ghost in history.ghosts(model, now_ns):
                strips.append(place(ghost.x, ghost.y))
                colours.append(rgb(colour_of(model), GHOST_STRENGTH * (1.2 - 0.15 * age)))
                radii.append(GHOST_WIDTH * width)
        self._rr.log(f"{root}/ghosts", rr.LineStrips2D(strips, colors=colours, radii=radii, draw_order=1.0))
        track = np.array([(x, y) for _, x, y in history.track])
        self._rr.log(f"{root}/track", rr.LineStrips2D(
            [place(track[:, 0], track[:, 1])], colors=[rgb(MEASURED_COLOUR, 0.6)], radii=TRACK_WIDTH * width ** 0.5,
            draw_order=0.0))
        for model in history.models:
            self._prediction(root, place, model, history, width)
        self._misses(root, place, pose, history, now_ns, width)
        self._rr.log(f"{root}/car", rr.LineStrips2D(
            [place(*car_outline(pose, self._car))], colors=[(20, 20, 20)], radii=0.08 * width,
            draw_order=5.0))

    def _prediction(self, root: str, place, model: str, history: History, width: float) -> None:
        path, colour = history.newest(model), rgb(colour_of(model))
        points = place(path.x, path.y)
        self._rr.log(f"{root}/paths/{model}", rr.LineStrips2D(
            [points], colors=[colour], radii=PATH_WIDTH * width, draw_order=3.0))
        label_at = label_index(model, path.step, len(points))
        self._rr.log(f"{root}/names/{model}", rr.Points2D(
            [points[label_at]], colors=[colour], radii=0.4 * width, labels=[model], show_labels=root == "ahead",
            draw_order=4.0))

    def _misses(self, root: str, place, pose, history: History, now_ns: int, width: float) -> None:
        """From where the car is to where the oldest ghost of each model had it."""
        strips, colours = [], []
        for model in history.models:
            if (ghosts := history.ghosts(model, now_ns)) and (point := ghosts[-1][1].at(now_ns)):
                strips.append(place(np.array([pose[0], point[0]]), np.array([pose[1], point[1]])))
                colours.append(rgb(colour_of(model)))
        self._rr.log(f"{root}/misses", rr.LineStrips2D(
            strips, colors=colours, radii=0.12 * width, draw_order=4.5))

    def _at(self, time_ns: int) -> None:
        self._rr.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))
