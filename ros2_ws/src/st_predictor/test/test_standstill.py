"""The predictor when the car stops: predictions that end at standstill are scored for the adaptive bands."""

from collections.abc import Iterator

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from rclpy.time import Time
from st_core.bands.live import WARM_UP
from st_core.types import InsSample
from st_predictor.nodes.predictor import PredictorNode
from support import LEAF

pytestmark = pytest.mark.ros
BEGIN_NS = 1_700_000_000 * 10**9


@pytest.fixture
def node() -> Iterator[PredictorNode]:
    rclpy.init(args=["--ros-args", "-p", f"vehicle_file:={LEAF}", "-p", "use_sim_time:=true",
                     "-p", "compiled:=false"])
    node = PredictorNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def drive(node: PredictorNode) -> tuple[int, list[str]]:
    """10 s at 10 m/s, 2 s of braking, 15 s of standstill: (predictions, final texts of the checks plan and course)."""
    before, x = node._counter.as_dict()["predicted"], 0.0
    for k in range(2700):
        speed = min(10.0, max(0.0, 10.0 - 0.05 * (k - 1000)))
        time_ns, x = BEGIN_NS + k * 10_000_000, x + 0.01 * speed
        node._core.add_ins(InsSample(time_ns, x, 0.0, 0.0, speed, 0.0, 0.0))
        node._core.add_steering(time_ns, 0.0)
        if k % 10 == 0:
            node.get_clock().set_ros_time_override(Time(nanoseconds=time_ns, clock_type=node.get_clock().clock_type))
            node._tick()
    texts = [c.message for c in node._make_checks() if c.name in ("plan", "course")]
    return node._counter.as_dict()["predicted"] - before, texts


@pytest.mark.slow
def test_predictions_that_end_at_standstill_are_scored(node: PredictorNode) -> None:
    predicted, texts = drive(node)
    assert predicted > 100
    assert node._bands._adaptive.remaining_warm_up == pytest.approx(WARM_UP - 0.1 * predicted, abs=1.5)
    assert texts == ["not used: no predictions are being made", "off (course_file is empty)"]
    repeated, _ = drive(node)  # time jumps back, as in a replay that restarts
    assert repeated == pytest.approx(predicted, abs=3)
    assert node._bands._adaptive.remaining_warm_up == pytest.approx(WARM_UP - 0.1 * (predicted + repeated), abs=3.0)
