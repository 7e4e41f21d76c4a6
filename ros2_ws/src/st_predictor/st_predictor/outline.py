"""The car as a drawing."""

import numpy as np
from st_core.frames import body_to_map
from st_core.vehicle import VehicleParameters


def car_outline(pose: tuple[float, float, float], car: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """Map x, y [m] of the body's closed outline, with a nose that points ahead.

    pose: x, y [m] and yaw [rad] of the INS point. Front and rear overhang are taken as equal: the vehicle file gives
    the length only.
    """
    overhang = 0.5 * (car.length - car.wheelbase)
    front, rear, half = car.cg_to_front_axle + overhang, -car.cg_to_rear_axle - overhang, 0.5 * car.width
    forward = np.array([rear, 0.6 * front, front, 0.6 * front, rear, rear]) - car.cg_to_ins_x
    left = np.array([half, half, 0.0, -half, -half, half]) - car.cg_to_ins_y
    dx, dy = body_to_map(forward, left, pose[2])
    return pose[0] + dx, pose[1] + dy
