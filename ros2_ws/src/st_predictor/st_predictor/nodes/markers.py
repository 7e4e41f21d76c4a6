"""Node markers: publishes track, car, earlier paths, bands and errors for RViz and Foxglove, and errors to plot.

The node subscribes with best-effort reliability, so that no publisher waits for it.
"""

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point, Vector3Stamped
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from st_core.palette import MEASURED_COLOUR, get_label_index, get_model_colour, rgb
from st_core.types import InsSample
from st_msgs.msg import Prediction, PredictionError
from st_ros import parameters, spin
from st_ros.polling import PolledSubscription, create_steady_timer, from_nanoseconds
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from .. import convert, params
from ..map_drawing import History, Pose, make_car_outline

NEWEST_QOS = QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT)
SCORE_QOS = QoSProfile(depth=200, reliability=ReliabilityPolicy.BEST_EFFORT)  # scores of one start arrive together
LIFETIME = Duration(sec=1)  # markers disappear this long after the suite has ended
TEXT_HEIGHT, OUTLINE_WIDTH, ERROR_WIDTH, GHOST_WIDTH, MEASURED_WIDTH = 1.2, 0.15, 0.25, 0.1, 0.6  # m
GHOST_ALPHA = 0.4
RIBBON_ALPHA = {0.9: 0.15, 0.5: 0.3}  # by probability
RIBBON_STRIDE = 4  # every n-th point of a band is drawn


class MarkersNode(Node):
    def __init__(self) -> None:
        super().__init__("markers")
        values = parameters.declare(self, params.MARKERS)
        self._car, self._map_frame = params.load_vehicle(values), values.map_frame
        self._history = History()
        self._odometry = PolledSubscription(self, Odometry, "ins/odometry", NEWEST_QOS)
        self._predictions = {
            model: PolledSubscription(self, Prediction, f"predictor/{model}/prediction", NEWEST_QOS)
            for model in values.models}
        self._errors = PolledSubscription(self, PredictionError, "evaluator/errors", SCORE_QOS)
        self._markers = self.create_publisher(MarkerArray, "view/markers", 10)
        self._bands = self.create_publisher(MarkerArray, "view/bands", 10)
        self._plots = {model: self.create_publisher(Vector3Stamped, f"view/{model}/error", 10)
                       for model in values.models}
        create_steady_timer(self, 1.0 / values.rate, self._draw)
        self.get_logger().info(f"drawing {', '.join(values.models)} of {self._car.name}")

    def _draw(self) -> None:
        for model, subscription in self._predictions.items():
            for message, _, _ in subscription.take():
                self._history.add_path(model, convert.read_ins_path(message))
        for message, _, _ in self._errors.take():
            if message.complete and message.mode == "forecast" and message.model in self._plots:
                plot = Vector3Stamped(header=message.header)  # mean errors: longitudinal, lateral [m], yaw [rad]
                plot.vector.x, plot.vector.y, plot.vector.z = (
                    message.longitudinal_mean, message.lateral_mean, message.yaw_mean)
                self._plots[message.model].publish(plot)
        sample = None
        for message, _, _ in self._odometry.take():
            newest = convert.read_ins_sample(message, self._map_frame)
            sample = sample if isinstance(newest, str) else newest
        if sample is not None:
            self._history.add_pose(sample.time_ns, sample.x, sample.y)
            self._markers.publish(MarkerArray(markers=self._make_markers(sample)))
            if ribbons := self._make_ribbons(sample.time_ns):
                self._bands.publish(MarkerArray(markers=ribbons))

    def _make_markers(self, sample: InsSample) -> list[Marker]:
        now_ns = sample.time_ns
        track = np.array([(x, y) for _, x, y in self._history.track])
        markers = [
            self._make_line("track", 0, now_ns, track[:, 0], track[:, 1], MEASURED_COLOUR, MEASURED_WIDTH, 0.5, z=-0.2),
            self._make_line("car", 0, now_ns, *make_car_outline(Pose(sample.x, sample.y, sample.yaw), self._car),
                            "#141414", OUTLINE_WIDTH),
        ]
        for number, model in enumerate(self._history.models):
            colour = get_model_colour(model)
            markers += [self._make_line("ghosts", 10 * number + round(age), now_ns, ghost.x, ghost.y,
                                        colour, GHOST_WIDTH, GHOST_ALPHA, z=-0.1)
                        for age, ghost in self._history.find_ghosts(model, now_ns)]
            if point := self._history.find_predicted_position(model, now_ns):
                markers.append(self._make_line("errors", number, now_ns, [sample.x, point[0]], [sample.y, point[1]],
                                               colour, ERROR_WIDTH, z=0.1))
            if path := self._history.find_newest(model, now_ns):
                label = self._make_marker(Marker.TEXT_VIEW_FACING, "names", number, now_ns, colour, 1.0)
                index, position = get_label_index(model, path.step, len(path.x)), label.pose.position
                position.x, position.y, position.z = float(path.x[index]), float(path.y[index]), 1.0
                label.scale.z, label.text = TEXT_HEIGHT, model
                markers.append(label)
        return markers

    def _make_ribbons(self, now_ns: int) -> list[Marker]:
        """Markers of the bands of the newest predictions, the 50 % band above the 90 % band; namespace: the model."""
        markers = []
        for number, model in enumerate(self._history.models):
            path = self._history.find_newest(model, now_ns)
            for ribbon in path.ribbons if path else ():
                marker = self._make_marker(Marker.TRIANGLE_LIST, model, round(100 * ribbon.level), now_ns,
                                           get_model_colour(model), RIBBON_ALPHA.get(ribbon.level, RIBBON_ALPHA[0.9]))
                marker.scale.x = marker.scale.y = marker.scale.z = 1.0
                # Below the paths, at different heights, which set the drawing order.
                z = -0.3 - 0.02 * number - 0.2 * ribbon.level
                marker.points = [Point(x=px, y=py, z=z)
                                 for px, py in ribbon.make_triangles(RIBBON_STRIDE).reshape(-1, 2).tolist()]
                markers.append(marker)
        return markers

    def _make_marker(self, kind: int, namespace: str, number: int, time_ns: int, colour: str, alpha: float) -> Marker:
        marker = Marker(type=kind, ns=namespace, id=number, action=Marker.ADD, lifetime=LIFETIME)
        marker.header.stamp, marker.header.frame_id = from_nanoseconds(time_ns), self._map_frame
        marker.pose.orientation.w = 1.0
        red, green, blue = (c / 255.0 for c in rgb(colour))
        marker.color = ColorRGBA(r=red, g=green, b=blue, a=alpha)
        return marker

    def _make_line(self, namespace: str, number: int, time_ns: int, x, y, colour: str, width: float,
                   alpha: float = 1.0, z: float = 0.0) -> Marker:
        """A line through map points [m]. z: height above the map [m], which sets the drawing order."""
        marker = self._make_marker(Marker.LINE_STRIP, namespace, number, time_ns, colour, alpha)
        marker.scale.x = width
        marker.points = [Point(x=float(px), y=float(py), z=z) for px, py in zip(x, y, strict=True)]
        return marker


def main() -> int:
    return spin.run(MarkersNode)
