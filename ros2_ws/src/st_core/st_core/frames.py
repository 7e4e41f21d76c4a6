"""Frames and lever arms: ENU and NED, body axes, INS point and centre of gravity, angle wrapping.

Functions of angles and positions take floats or arrays and return the same.
"""

import math

import numpy as np

from .types import InsSample, Number, VehicleState

TWO_PI = 2.0 * math.pi


def wrap_angle(angle: Number) -> Number:
    """The same angle in [-pi, pi) [rad]; NaN stays NaN."""
    return (angle + math.pi) % TWO_PI - math.pi


def body_to_map(x: Number, y: Number, yaw: Number) -> tuple[Number, Number]:
    """Map components of a body vector: rotation by yaw counter-clockwise."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return x * cosine - y * sine, x * sine + y * cosine


def map_to_body(x: Number, y: Number, yaw: Number) -> tuple[Number, Number]:
    """Forward and left components of a map vector: rotation by -yaw."""
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return x * cosine + y * sine, y * cosine - x * sine


def pose_errors(predicted_x: Number, predicted_y: Number, predicted_yaw: Number, x: Number, y: Number,
                yaw: Number) -> tuple[Number, Number, Number]:
    """Errors (longitudinal [m], lateral [m], yaw [rad]) of each point, what the INS would show against what it showed.

        (e_lon, e_lat) = R(-yaw_measured) (p_predicted - p_measured),  p at the INS point

    Source: paper, section on the comparison. NaN where the measurement is NaN.
    """
    longitudinal, lateral = map_to_body(predicted_x - x, predicted_y - y, yaw)
    return longitudinal, lateral, wrap_angle(predicted_yaw - yaw)


def ins_to_cg(sample: InsSample, cg_to_ins_x: float, cg_to_ins_y: float = 0.0) -> VehicleState:
    """State at the CG of a rigid car from a measurement at the INS point.

        p_cg = p_ins - R(yaw) d,    v_x,cg = v_x,ins + r d_y,    v_y,cg = v_y,ins - r d_x

    d = (cg_to_ins_x, cg_to_ins_y) [m] is the INS point seen from the CG, forward and left; behind the CG d_x < 0.
    Source: paper, eq. of the sensor offset (its d points the other way). Checked by: test_frames.py.
    """
    cosine, sine = math.cos(sample.yaw), math.sin(sample.yaw)
    return VehicleState(
        x=sample.x - cosine * cg_to_ins_x + sine * cg_to_ins_y,
        y=sample.y - sine * cg_to_ins_x - cosine * cg_to_ins_y,
        velocity_x=sample.velocity_x + sample.yaw_rate * cg_to_ins_y,
        velocity_y=sample.velocity_y - sample.yaw_rate * cg_to_ins_x,
        yaw=sample.yaw,
        yaw_rate=sample.yaw_rate,
    )


def cg_to_ins_position(x: Number, y: Number, yaw: Number, cg_to_ins_x: Number,
                       cg_to_ins_y: Number = 0.0) -> tuple[Number, Number]:
    """Map position [m] of the INS point, (x, y) each like the input, for CG positions x, y [m] and yaw [rad]."""
    forward, left = body_to_map(cg_to_ins_x, cg_to_ins_y, yaw)
    return x + forward, y + left


def ins_to_cg_acceleration(acceleration_x: Number, acceleration_y: Number, yaw_rate: Number, yaw_acceleration: Number,
                           cg_to_ins_x: float, cg_to_ins_y: float = 0.0) -> tuple[Number, Number]:
    """Acceleration at the CG [m/s^2], body axes, from that at the INS point.

        a_x,cg = a_x,ins + r^2 d_x + r_dot d_y,    a_y,cg = a_y,ins - r_dot d_x + r^2 d_y

    d as in `ins_to_cg`; yaw_rate r [rad/s], yaw_acceleration r_dot [rad/s^2].
    """
    return (acceleration_x + yaw_rate * yaw_rate * cg_to_ins_x + yaw_acceleration * cg_to_ins_y,
            acceleration_y - yaw_acceleration * cg_to_ins_x + yaw_rate * yaw_rate * cg_to_ins_y)
