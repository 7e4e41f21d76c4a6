"""Publishes odometry, steering and plans of a drive on a winding road in real time, the plans correct or faulty."""

import argparse
import math
import time
from pathlib import Path

import numpy as np
import rclpy
from circle_feeder import odometry, steering
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile
from st_core.vehicle import VehicleParameters
from st_msgs.msg import InputPlan, Steering
from st_ros import spin
from st_ros.polling import from_nanoseconds
from winding_road import RATE, Truth, winding_road

REACH, SPACING = 5.5, 0.1  # s ahead, and between points of a plan
SETTLING = 0.5  # s
FAULTS = ("nan", "frame", "past", "short", "sign", "none")


def plan_message(drive: np.ndarray, angle: np.ndarray, k: int, stamp_ns: int, fault: str, path: bool,
                 car: VehicleParameters) -> InputPlan:
    """The drive's own inputs from row k on. path: as speed and curvature."""
    rows = k + np.arange(0, round(REACH * RATE), round(SPACING * RATE))
    seconds = (rows - k) / RATE
    v_x = drive[:, 4] + drive[:, 6] * car.cg_to_ins_y
    message = InputPlan(time=seconds.tolist())
    if path:
        message.speed, message.curvature = v_x[rows].tolist(), (drive[rows, 6] / v_x[rows]).tolist()
    else:
        planned = -angle if fault == "sign" else angle
        message.road_wheel_angle = planned[rows].tolist()
        message.velocity_x_dot = np.gradient(v_x, 1.0 / RATE)[rows].tolist()
        if fault == "nan":
            message.road_wheel_angle[7] = math.nan
    if fault == "short":
        for name in ("time", "road_wheel_angle", "velocity_x_dot"):
            setattr(message, name, getattr(message, name)[:20])
    message.header.frame_id = "map" if fault == "frame" else "base_link"
    message.header.stamp = from_nanoseconds(stamp_ns - (2_000_000_000 if fault == "past" else 0))
    return message


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--vehicle", type=Path, required=True)
    parser.add_argument("--good", type=float, default=14.0, help="s of correct plans")
    parser.add_argument("--faulty", type=float, default=2.0, help="s of each of FAULTS")
    parser.add_argument("--path", action="store_true", help="plans of speed and curvature, without faults")
    options = parser.parse_args()
    car = VehicleParameters.from_yaml(options.vehicle.read_text(), str(options.vehicle))
    faults = () if options.path else FAULTS
    seconds = options.good + options.faulty * len(faults)
    truth = Truth(car.steering_wheel_offset, car.steering_ratio, 1.0)
    drive = winding_road(car, truth, seconds + REACH + 1.0, 3, noise=0.0)
    angle = np.array([car.road_wheel_angle(steering_wheel) for steering_wheel in drive[:, 7]])
    rclpy.init()
    node = rclpy.create_node("feeder")
    qos = QoSProfile(depth=1000)
    ins, angles, plans = (node.create_publisher(kind, name, qos) for kind, name in (
        (Odometry, "ins/odometry"), (Steering, "vehicle/steering"), (InputPlan, "plan/inputs")))
    expected = {"ins/odometry": 3, "vehicle/steering": 3, "plan/inputs": 2}
    for model in ("kinematic", "linear", "nonlinear"):
        expected |= {f"predictor/{model}/prediction": 2, f"predictor/{model}/plan": 2}
    while any(node.count_subscribers(topic) < count for topic, count in expected.items()):
        time.sleep(0.02)
    time.sleep(SETTLING)
    zero_ns, began = time.time_ns(), time.monotonic()
    print("feeding", zero_ns, flush=True)
    for k in range(round(seconds * RATE)):
        t, x, y, yaw, v_x, v_y, rate, steering_wheel = drive[k].tolist()
        time.sleep(max(0.0, began + t - time.monotonic()))
        stamp_ns = zero_ns + round(t * 1e9)
        ins.publish(odometry(stamp_ns, x, y, yaw, v_x, v_y, rate))
        angles.publish(steering(stamp_ns, steering_wheel, float(angle[k])))
        fault = faults[int((t - options.good) / options.faulty)] if t >= options.good else ""
        if k % 10 == 0 and fault != "none":
            plans.publish(plan_message(drive, angle, k, stamp_ns, fault, options.path, car))
    spin.flush(node)
    node.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
