"""Draws a recorded run as a Rerun recording (.rrd) with a frame every 0.1 s."""

import math
from collections.abc import Sequence
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rich.console import Console
from rosbags.highlevel import AnyReader
from st_core.palette import MEASURED_COLOUR, MODEL_COLOUR, get_model_colour, rgb
from st_core.types import InsSample, map_to_body
from st_core.vehicle import VehicleParameters
from st_predictor import convert
from st_predictor.map_drawing import History, Pose, Ribbon, make_car_outline
from st_recordings.results import find_configuration
from st_recordings.runs.bag import read_metadata_records
from st_recordings.runs.bag_storage import open_bag
from st_recordings.runs.cdr import load_typestore
from st_recordings.runs.errors import RunError
from st_ros.polling import to_nanoseconds

from .configuration import find_bag
from .nodes.monitor import Status, SuiteState, render_results

TIMELINE = "measured"
PLOT_SPAN = 40.0  # s
RANGE_AHEAD, RANGE_BEHIND, RANGE_SIDEWAYS = 44.0, 16.0, 34.0  # m shown, heading up; 5 s at 30 km/h are 42 m
MAP_RANGE, GRID_SPACING = 50.0, 20.0  # m shown around the car on the map, and between the lines of its grid
PLOTS = {
    "lateral": "mean lateral error over the last horizon, m (positive: predicted left)",
    "longitudinal": "mean longitudinal error, m (positive: predicted ahead)",
    "steering": "road-wheel angle, deg (left positive)",
    "speed": "speed, m/s",
    "lateral_acceleration": "lateral acceleration v_x r, m/s² (left positive)",
}
WHITE = (255, 255, 255)
RINGS = (10, 20, 30, 40, 50, 60)  # m, radii around the car
LIGHT_GREY = (228, 228, 228)
GHOST_STRENGTH = 0.4  # colour strength of earlier predictions, decreasing with age; 1: full colour, 0: white
GHOST_STRIDE, TRACK_STRIDE, RIBBON_STRIDE = 5, 2, 2  # every n-th point is drawn
RIBBON_STRENGTH = {0.9: 0.13, 0.5: 0.28}  # colour strength by level of the band
# Half the line width in screen points, the same at every zoom.
THIN_LINE, THICK_LINE, TRACK_LINE = (rr.Radius.ui_points(points) for points in (0.6, 1.8, 4.0))
# Each model's path is narrower than the previous one and drawn above it, so all are visible where they coincide.
MODEL_RADII = tuple(rr.Radius.ui_points(points) for points in (3.2, 2.0, 1.0, 0.6))
FRAME_PERIOD_NS = 100_000_000
FLUSH_PERIOD = 5.0  # s between writes; few large chunks load quickly
TEXT_PERIOD_NS = 1_000_000_000
TEXT_WIDTH = 72  # characters, of the table of errors
TOPICS = {  # kind of message by topic
    "predictor/status": "predictor_status", "ins/odometry": "odometry", "vehicle/steering": "steering",
    **{f"predictor/{model}/prediction": "prediction" for model in MODEL_COLOUR},
    "evaluator/errors": "error", "evaluator/summary": "summary", "/diagnostics": "diagnostics",
}


def make_blueprint() -> rrb.Blueprint:
    """Layout of the panels."""
    from_cursor = rrb.TimeRangeBoundary.cursor_relative
    window = rrb.VisibleTimeRange(TIMELINE, start=from_cursor(seconds=-PLOT_SPAN), end=from_cursor())

    def plot(name: str) -> rrb.TimeSeriesView:
        return rrb.TimeSeriesView(origin=f"plots/{name}", name=PLOTS[name], time_ranges=[window],
                                  plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop))

    heading_up_view = rrb.Spatial2DView(
        origin="ahead", name="Heading up (10 m rings)", background=WHITE,
        visual_bounds=rrb.VisualBounds2D(x_range=[-RANGE_SIDEWAYS, RANGE_SIDEWAYS],
                                         y_range=[-RANGE_AHEAD, RANGE_BEHIND]))
    map_view = rrb.Spatial2DView(
        origin="map", name=f"Map (north up, {GRID_SPACING:.0f} m grid)", background=WHITE,
        visual_bounds=rrb.VisualBounds2D(x_range=[-MAP_RANGE, MAP_RANGE], y_range=[-MAP_RANGE, MAP_RANGE]))
    text = rrb.TextDocumentView(origin="text", name="Errors so far, and health")
    motion = rrb.Tabs(plot("steering"), plot("speed"), plot("lateral_acceleration"))
    errors = rrb.Tabs(plot("lateral"), plot("longitudinal"))
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(heading_up_view, motion, row_shares=[3, 1]),
                       rrb.Vertical(rrb.Horizontal(map_view, text), errors, row_shares=[2, 1]),
                       column_shares=[1, 1.35]),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE, play_state="following"),
        rrb.BlueprintPanel(state="hidden"), rrb.SelectionPanel(state="hidden"), auto_views=False)


def to_screen(view: Pose, x, y) -> np.ndarray:
    """Screen coordinates (..., 2) [m: right, down] of map points x, y [m]. view: screen origin and upward direction."""
    forward, left = map_to_body(np.asarray(x) - view.x, np.asarray(y) - view.y, view.yaw)
    return np.stack(np.broadcast_arrays(-left, -forward), axis=-1)


def make_grid_lines(pose: Pose, spacing: float, reach: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Grid lines (x, y) of the map [m] within `reach` of the car [m]."""
    def find_positions(centre: float) -> np.ndarray:
        return np.arange(np.ceil((centre - reach) / spacing) * spacing, centre + reach, spacing)

    ends = reach * np.array([-1.0, 1.0])
    return ([(np.full(2, x), pose.y + ends) for x in find_positions(pose.x)]
            + [(pose.x + ends, np.full(2, y)) for y in find_positions(pose.y)])


class Scene:
    """Collects the messages of a run, and draws the newest state when `draw` is called: plots, text, and two views, one
    with north up and one with the heading up. Axes of the views, as in Rerun: x right, y down."""

    def __init__(self, recording: rr.RecordingStream, car: VehicleParameters, map_frame: str):
        self._stream, self._car, self._map_frame = recording, car, map_frame
        self._history = History()
        self._sample: InsSample | None = None
        self._angle: float | None = None  # road-wheel angle, positive to the left [rad]
        self._state = SuiteState()
        self._text_due_ns = 0
        self._labelled_models: list[str] = []
        self._plotted_models: set[str] = set()  # models with error plots
        angle = np.linspace(0.0, 2.0 * math.pi, 73)
        rings = [np.stack([r * np.cos(angle), r * np.sin(angle)], axis=-1) for r in RINGS]
        recording.log("ahead/rings", rr.LineStrips2D(rings, colors=[LIGHT_GREY], radii=THIN_LINE, draw_order=-1.0),
                      static=True)
        # Ring labels are at the front right, where paths rarely cover them.
        recording.log("ahead/ring_names", rr.Points2D(
            [(0.7 * r, -0.7 * r) for r in RINGS[1::2]], radii=THIN_LINE, colors=[(120, 120, 120)],
            labels=[f"{r} m" for r in RINGS[1::2]], show_labels=True), static=True)
        for name, series in (("steering", "road-wheel angle"), ("speed", "speed"), ("lateral_acceleration", "v_x r")):
            self._add_series(f"plots/{name}/measured", series, MEASURED_COLOUR)

    def _add_series(self, entity: str, name: str, colour: str) -> None:
        self._stream.log(entity, rr.SeriesLines(colors=[rgb(colour)], names=[name], widths=[2.0]), static=True)

    def take(self, kind: str, message: Any) -> None:
        """Store a message of a kind in TOPICS; an error is plotted at once."""
        if kind == "odometry":
            sample = convert.read_ins_sample(message, self._map_frame)
            self._sample = self._sample if isinstance(sample, str) else sample
        elif kind == "steering":
            self._angle = message.road_wheel_angle
        elif kind == "prediction":
            self._history.add_path(message.model, convert.read_ins_path(message))
        elif kind == "error" and message.complete and message.mode == "forecast":
            self._draw_error(message)
        elif kind in ("summary", "predictor_status"):
            setattr(self._state, kind, message)
        elif kind == "diagnostics":
            self._state.health |= {s.name: Status(s.name, s.level, s.message, math.inf) for s in message.status}

    def _draw_error(self, message: Any) -> None:
        """Add the horizon means [m] of one forecast to the plots, at the end of its horizon."""
        model, means = message.model, {"lateral": message.lateral_mean, "longitudinal": message.longitudinal_mean}
        self._set_time(to_nanoseconds(message.header.stamp) + round(message.horizon[-1] * 1e9))
        for quantity, mean in means.items():
            if model not in self._plotted_models:
                self._add_series(f"plots/{quantity}/{model}", model, get_model_colour(model))
            self._stream.log(f"plots/{quantity}/{model}", rr.Scalars([mean]))
        self._plotted_models.add(model)

    def draw(self) -> bool:
        """Draw the state at the newest INS sample; False without a sample since the previous call."""
        sample, self._sample = self._sample, None
        if sample is None:
            return False
        now_ns, log, pose = sample.time_ns, self._stream.log, Pose(sample.x, sample.y, sample.yaw)
        self._history.add_pose(now_ns, sample.x, sample.y)
        self._set_time(now_ns)
        log("plots/speed/measured", rr.Scalars([sample.velocity_x]))
        log("plots/lateral_acceleration/measured", rr.Scalars([sample.velocity_x * sample.yaw_rate]))
        if self._angle is not None:
            log("plots/steering/measured", rr.Scalars([math.degrees(self._angle)]))
        north_up = pose._replace(yaw=0.5 * math.pi)
        lines = [to_screen(north_up, x, y) for x, y in make_grid_lines(pose, GRID_SPACING, 2.0 * MAP_RANGE)]
        self._log_lines("map/grid", lines, [LIGHT_GREY], THIN_LINE, order=-1.0)
        self._draw_view("map", north_up, pose, now_ns)
        self._draw_view("ahead", pose, pose, now_ns)
        if not 0 <= self._text_due_ns - now_ns <= TEXT_PERIOD_NS:  # the difference is larger if the clock was set back
            self._text_due_ns = now_ns + TEXT_PERIOD_NS
            log("text", rr.TextDocument(format_results(self._state), media_type="text/markdown"))
        return True

    def _draw_view(self, root: str, view: Pose, pose: Pose, now_ns: int) -> None:
        """Draw car, track, predictions with bands, and earlier predictions. view: as for `to_screen`."""
        history = self._history
        track = np.array([(x, y) for _, x, y in history.track])[::-TRACK_STRIDE]
        colour = rgb(MEASURED_COLOUR, 0.6)
        self._log_lines(f"{root}/track", [to_screen(view, track[:, 0], track[:, 1])], [colour], TRACK_LINE, order=0.0)
        outline = to_screen(view, *make_car_outline(pose, self._car))
        self._log_lines(f"{root}/car", [outline], [(20, 20, 20)], THICK_LINE, order=5.0)
        ghosts, ghost_colours, errors, error_colours = [], [], [], []
        for index, model in enumerate(history.models):
            self._log_name(model)
            path = history.find_newest(model, now_ns)
            self._log_lines(f"{root}/paths/{model}", [to_screen(view, path.x, path.y)] if path else [],
                            [rgb(get_model_colour(model))], MODEL_RADII[min(index, len(MODEL_RADII) - 1)],
                            order=3.0 + 0.1 * index)
            self._draw_ribbons(f"{root}/bands/{model}", view, path.ribbons if path else (), model, index)
            for age, ghost in history.find_ghosts(model, now_ns):
                ghosts.append(to_screen(view, ghost.x[::GHOST_STRIDE], ghost.y[::GHOST_STRIDE]))
                ghost_colours.append(rgb(get_model_colour(model), GHOST_STRENGTH * (1.2 - 0.15 * age)))
            # A line from the car to the position that the oldest stored prediction predicted for the present time.
            if point := history.find_predicted_position(model, now_ns):
                errors.append(to_screen(view, *np.transpose([(pose.x, pose.y), point])))
                error_colours.append(rgb(get_model_colour(model)))
        self._log_lines(f"{root}/ghosts", ghosts, ghost_colours, THIN_LINE, order=1.0)
        self._log_lines(f"{root}/errors", errors, error_colours, THICK_LINE, order=4.5)

    def _draw_ribbons(self, entity: str, view: Pose, ribbons: Sequence[Ribbon], model: str, index: int) -> None:
        """Fill the bands with lines from edge to edge, because Rerun cannot fill areas in 2D. The lines are 1.2 times
        as wide as their spacing, which leaves no gaps. The edges of the widest band are drawn above all areas."""
        edges = [to_screen(view, *side.T) for band in ribbons[:1] for side in (band.left, band.right)]
        self._log_lines(f"{entity}/edges", edges, [rgb(get_model_colour(model), 0.6)], THIN_LINE, order=0.8)
        for level, strength in RIBBON_STRENGTH.items():
            strips, radii = np.empty((0, 2, 2)), np.empty(0)
            for band in (r for r in ribbons if r.level == level):
                left, right = (to_screen(view, *side[::RIBBON_STRIDE].T) for side in (band.left, band.right))
                middle = 0.5 * (left + right)
                strips = np.stack([left, right], axis=1)
                radii = 0.6 * np.hypot(*np.gradient(middle, axis=0).T)
            order = 0.2 + 0.1 * index - 0.05 * level
            self._log_lines(f"{entity}/{level:.0%}", strips, [rgb(get_model_colour(model), strength)], radii, order)

    def _log_name(self, model: str) -> None:
        """Show colour and name of a model in the lower left corner; next to the paths, names would overlap."""
        if model not in self._labelled_models:
            corner = (-RANGE_SIDEWAYS + 6.0, RANGE_BEHIND - 7.0 - 5.0 * len(self._labelled_models))
            self._labelled_models.append(model)
            self._stream.log(f"ahead/names/{model}", rr.Points2D(
                [corner], colors=[rgb(get_model_colour(model))], radii=rr.Radius.ui_points(5.0), labels=[model],
                show_labels=True), static=True)

    def _log_lines(self, entity: str, strips: Any, colours: list, radii: Any, order: float) -> None:
        self._stream.log(entity, rr.LineStrips2D(strips, colors=colours, radii=radii, draw_order=order))

    def _set_time(self, time_ns: int) -> None:
        self._stream.set_time(TIMELINE, timestamp=np.datetime64(time_ns, "ns"))


def draw_recording(path: Path, file: Path, vehicle: Path | None = None) -> int:
    """Draw a bag, or the bag in the folder of a run, into `file` (.rrd); returns the number of frames. vehicle: vehicle
    file for the outline, instead of the recorded vehicle. Raises RunError, ConfigurationError."""
    bag = find_bag(path)
    if not any(f"/{topic.name}".endswith("/ins/odometry") for topic in open_bag(bag).topics):
        raise RunError(bag, "it has no topic ins/odometry, which the view requires",
                       "play it with `st replay`, and view the folder of that run")
    car, recorded, _ = find_configuration(read_metadata_records(bag), vehicle)
    batches = rr.ChunkBatcherConfig(flush_tick=FLUSH_PERIOD, flush_num_bytes=2_000_000)
    stream = rr.RecordingStream("single_track_predictor", batcher_config=batches)
    stream.send_recording_name(path.name)
    stream.set_sinks(rr.FileSink(str(file)), default_blueprint=make_blueprint())
    scene = Scene(stream, car, recorded.nodes.get("predictor", {}).get("map_frame", "map"))
    n_frames, due_ns = 0, 0
    with AnyReader([bag], default_typestore=load_typestore()) as reader:
        # The topics of the suite may be recorded in any namespace.
        kinds = {c.topic: kind for c in reader.connections for topic, kind in TOPICS.items()
                 if f"/{c.topic}".endswith(f"/{topic.lstrip('/')}")}
        connections = [c for c in reader.connections if c.topic in kinds]
        for connection, log_ns, data in reader.messages(connections=connections):
            if log_ns >= due_ns:
                n_frames += scene.draw()
                due_ns = log_ns + FRAME_PERIOD_NS
            scene.take(kinds[connection.topic], reader.deserialize(data, connection.msgtype))
    n_frames += scene.draw()
    stream.flush()
    stream.disconnect()
    return n_frames


def format_results(state: SuiteState) -> str:
    """Markdown text of the errors so far, and of all checks that are not OK, as the terminal shows them."""
    text = StringIO()
    # No colours, even if FORCE_COLOR is set.
    Console(file=text, width=TEXT_WIDTH, force_terminal=False).print(render_results(state))
    return f"```\n{text.getvalue()}```"
