"""A step of the host's clock, as when it is set at the car, must not stop the timers of the nodes."""

from pathlib import Path

import pytest

pytest.importorskip("rclpy", reason="needs ROS 2")
pytest.importorskip("st_msgs", reason="needs the built workspace")

import rclpy
from canedge_bridge.node import CanedgeBridge
from oxts_bridge.node import OxtsBridge
from rclpy.clock import ClockType
from ros_processes import free_domain
from st_live.nodes.monitor import Monitor
from st_predictor.nodes.evaluator import EvaluatorNode
from st_predictor.nodes.predictor import PredictorNode
from st_predictor.nodes.recorder import RecorderNode
from support import LEAF, ROOT

pytestmark = pytest.mark.ros
CAN = ROOT / "config" / "can"
PARAMETERS = {
    "oxts_bridge.autostart": "false", "canedge_bridge.interface": "virtual", "canedge_bridge.channel": "clock",
    "canedge_bridge.dbc_file": CAN / "leaf_ze0.dbc", "canedge_bridge.signals_file": CAN / "leaf_ze0.yaml",
    "canedge_bridge.publish_frames": "true", "predictor.compiled": "false",
    **{f"{node}.vehicle_file": LEAF for node in ("canedge_bridge", "predictor", "evaluator")}}
NODES = (OxtsBridge, CanedgeBridge, PredictorNode, EvaluatorNode, RecorderNode)


def clock_types(make_node: type, folder: Path, *, simulated: bool = False) -> set[ClockType]:
    values = {**PARAMETERS, "recorder.output_directory": folder / "bag",
              **({"predictor.use_sim_time": "true"} if simulated else {})}
    words = [word for name, value in values.items() for word in ("-p", f"{name.replace('.', ':')}:={value}")]
    rclpy.init(args=["--ros-args", *words], domain_id=free_domain())
    try:
        node = make_node()
        types = {timer.clock.clock_type for timer in node.timers}
        if hasattr(node, "close"):
            node.close()
        node.destroy_node()
    finally:
        rclpy.shutdown()
    return types


@pytest.mark.parametrize("make_node", NODES, ids=lambda node: node.__name__)
def test_timers_of_a_live_run_do_not_follow_the_hosts_clock(make_node: type, tmp_path: Path) -> None:
    """Such a timer of period 1 s is not called for an hour after the clock is set back by an hour."""
    assert clock_types(make_node, tmp_path) == {ClockType.STEADY_TIME}


def test_timers_of_the_monitor_do_not_follow_the_hosts_clock() -> None:
    with Monitor(free_domain()) as monitor:
        assert {timer.clock.clock_type for timer in monitor._node.timers} == {ClockType.STEADY_TIME}


def test_ticks_of_a_replay_follow_its_clock(tmp_path: Path) -> None:
    assert clock_types(PredictorNode, tmp_path, simulated=True) == {ClockType.STEADY_TIME, ClockType.ROS_TIME}
