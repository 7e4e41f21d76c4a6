"""Draws one instant of a running suite into a Rerun recording: plain values in, nothing of ROS."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import rerun as rr
from st_core.palette import MEASURED_COLOUR, colour_of, rgb
from st_core.vehicle import VehicleParameters
from st_predictor.map_drawing import History, Ribbon, car_outline

from .geometry import Pose, grid, heading_up, north_up
from .layout import AHEAD, AROUND, ASIDE, BEHIND, GRID, TIMELINE, blueprint

RINGS = (10, 20, 30, 40, 50, 60)  # m around the car
FAINT = (228, 228, 228)
LIGHT_COLOUR = {"all well": (0, 150, 60), "warning": (235, 150, 0), "error": (200, 0, 0),
                "nothing heard": (150, 150, 150)}
GHOST_STRENGTH = 0.4  # 1: full colour, 0: paper
OLD = 1.0  # s; a prediction older than this is not the current one
GHOST_STRIDE, TRACK_STRIDE = 5, 2  # of their points, one in so many is drawn
# Half the width of a line, in points of the screen: the same at every zoom.
RIBBON_STRIDE = 2  # of its points, one in so many is drawn
RIBBON_STRENGTH = {0.9: 0.13, 0.5: 0.28}
THIN, THICK, TRACK = (rr.Radius.ui_points(points) for points in (0.6, 1.8, 4.0))
# One after the other on top and narrower: where models agree, all of them are seen.
MODEL_WIDTHS = tuple(rr.Radius.ui_points(points) for points in (3.2, 2.0, 1.0, 0.6))
Place = Callable[[np.ndarray, np.ndarray], np.ndarray]  # map x, y to the screen


def recording(name: str, flush: float, *sinks: Any) -> rr.RecordingStream:
    """A recording into sinks, with the layout of the page. flush [s]: what is drawn goes out this often."""
    batches = rr.ChunkBatcherConfig(flush_tick=flush, flush_num_bytes=2_000_000)
    stream = rr.RecordingStream("single_track_predictor", batcher_config=batches)
    stream.send_recording_name(name)
    stream.set_sinks(*sinks, default_blueprint=blueprint())
    return stream


class Scene:
    """recording: where to draw. car: for its outline."""

    def __init__(self, recording: rr.RecordingStream, car: VehicleParameters):
        self._rr, self._car = recording, car
        self._named: list[str] = []
        self._scored: set[str] = set()
        angle = np.linspace(0.0, 2.0 * math.pi, 73)
        rings = [np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1) for r in RINGS]
        recording.log("ahead/rings", rr.LineStrips2D(rings, colors=[FAINT], radii=THIN, draw_order=-1.0),
                      static=True)
        # Towards the right and ahead, where a path rarely is.
        recording.log("ahead/ring_names", rr.Points2D(
            [(0.7 * r, -0.7 * r) for r in RINGS[1::2]], radii=THIN, colors=[(120, 120, 120)],
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
        if model not in self._scored:
            self._scored.add(model)
            for quantity in ("lateral", "longitudinal"):
                self._series(f"plots/{quantity}/{model}", model, colour_of(model))
        self._at(end_ns)
        self._rr.log(f"plots/lateral/{model}", rr.Scalars([lateral]))
        self._rr.log(f"plots/longitudinal/{model}", rr.Scalars([longitudinal]))

    def passenger(self, time_ns: int, markdown: str, light: str) -> None:
        """Large words, and the light in the corner of the picture ahead. light: a key of LIGHT_COLOUR."""
        self._at(time_ns)
        self._rr.log("passenger", rr.TextDocument(markdown, media_type="text/markdown"))
        self._rr.log("ahead/light", rr.Points2D([(ASIDE - 6.0, -AHEAD + 6.0)], colors=[LIGHT_COLOUR[light]],
                                                radii=rr.Radius.ui_points(14.0), labels=[light], show_labels=True))

    def words(self, time_ns: int, markdown: str) -> None:
        self._at(time_ns)
        self._rr.log("words", rr.TextDocument(markdown, media_type="text/markdown"))

    def paths(self, time_ns: int, pose: Pose, history: History) -> None:
        """Car, track, predictions with bands, and ghosts, on the map and from the driver's seat.

        pose: x, y [m], yaw [rad].
        """
        self._at(time_ns)
        lines = [north_up(x, y, pose) for x, y in grid(pose, GRID, 2.0 * AROUND)]
        self._lines("map/grid", lines, [FAINT], THIN, order=-1.0)
        self._picture("map", lambda x, y: north_up(x, y, pose), pose, history, time_ns)
        self._picture("ahead", lambda x, y: heading_up(x, y, pose), pose, history, time_ns)

    def _picture(self, root: str, place: Place, pose: Pose, history: History, now_ns: int) -> None:
        track = np.array([(x, y) for _, x, y in history.track])[::-TRACK_STRIDE]
        self._lines(f"{root}/track", [place(track[:, 0], track[:, 1])], [rgb(MEASURED_COLOUR, 0.6)], TRACK, order=0.0)
        self._lines(f"{root}/car", [place(*car_outline(pose, self._car))], [(20, 20, 20)], THICK, order=5.0)
        ghosts, ghost_colours, misses, miss_colours = [], [], [], []
        for number, model in enumerate(history.models):
            self._name(model)
            path = history.newest(model)
            fresh = now_ns - path.start_ns < OLD * 1e9
            self._lines(f"{root}/paths/{model}", [place(path.x, path.y)] if fresh else [], [rgb(colour_of(model))],
                        MODEL_WIDTHS[min(number, len(MODEL_WIDTHS) - 1)], order=3.0 + 0.1 * number)
            self._ribbons(f"{root}/bands/{model}", place, path.ribbons if fresh else (), model, number)
            for age, ghost in history.ghosts(model, now_ns):
                ghosts.append(place(ghost.x[::GHOST_STRIDE], ghost.y[::GHOST_STRIDE]))
                ghost_colours.append(rgb(colour_of(model), GHOST_STRENGTH * (1.2 - 0.15 * age)))
            # From where the car is to where a horizon ago it was expected to be.
            if point := history.expected(model, now_ns):
                misses.append(place(np.array([pose[0], point[0]]), np.array([pose[1], point[1]])))
                miss_colours.append(rgb(colour_of(model)))
        self._lines(f"{root}/ghosts", ghosts, ghost_colours, THIN, order=1.0)
        self._lines(f"{root}/misses", misses, miss_colours, THICK, order=4.5)

    def _ribbons(self, entity: str, place: Place, ribbons: Sequence[Ribbon], model: str, number: int) -> None:
        """Filled with lines from edge to edge, each as wide as it is far to the next: Rerun fills no areas in 2D. The
        edges of the widest are drawn over all areas: where models cover each other, every one is seen."""
        edges = [place(*side.T) for one in ribbons[:1] for side in (one.left, one.right)]
        self._lines(f"{entity}/edges", edges, [rgb(colour_of(model), 0.6)], THIN, order=0.8)
        for level, strength in RIBBON_STRENGTH.items():
            strips, radii = np.empty((0, 2, 2)), np.empty(0)
            for one in (r for r in ribbons if r.level == level):
                left, right = (place(*side[::RIBBON_STRIDE].T) for side in (one.left, one.right))
                middle = 0.5 * (left + right)
                strips = np.stack([left, right], axis=1)
                radii = 0.6 * np.hypot(*np.gradient(middle, axis=0).T)
            order = 0.2 + 0.1 * number - 0.05 * level
            self._lines(f"{entity}/{level:.0%}", strips, [rgb(colour_of(model), strength)], radii, order=order)

    def _name(self, model: str) -> None:
        """Its colour and name in the lower left corner: models that agree would cover each other's names."""
        if model not in self._named:
            corner = (-ASIDE + 6.0, BEHIND - 7.0 - 5.0 * len(self._named))
            self._named.append(model)
            self._rr.log(f"ahead/names/{model}", rr.Points2D(
                [corner], colors=[rgb(colour_of(model))], radii=rr.Radius.ui_points(5.0), labels=[model],
                show_labels=True), static=True)

    def _lines(self, entity: str, strips: Any, colours: list, width: Any, order: float) -> None:
        self._rr.log(entity, rr.LineStrips2D(strips, colors=colours, radii=width, draw_order=order))

    def _at(self, time_ns: int) -> None:
        self._rr.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))
