"""Closed forms of the linear single-track car: steady state and stability."""

import math

import numpy as np

from .vehicle import VehicleParameters


def understeer_coefficient(car: VehicleParameters) -> float:
    """K = m (l_r C_r - l_f C_f) / (l^2 C_f C_r) [s^2/m^2]; > 0: understeer.

    Source: Guiggiani, The Science of Vehicle Dynamics, ch. 6.
    """
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    return car.mass * (car.cg_to_rear_axle * rear - car.cg_to_front_axle * front) / (car.wheelbase**2 * front * rear)


def steady_state_yaw_rate(speed: float, road_wheel_angle: float, car: VehicleParameters) -> float:
    """Yaw rate the linear car settles to under a constant steer angle [rad/s], left +.

        r = v delta / (l (1 + K v^2))

    speed: v at the CG [m/s], >= 0. road_wheel_angle: delta [rad], left +. NaN where 1 + K v^2 <= 0: past its critical
    speed an oversteering car has no steady state. Holds for small angles, level road, no drive or brake force.
    Source: Guiggiani, ch. 6. Checked by: test_handling.py, against simulation and the root of the model's equations.
    """
    divisor = 1.0 + understeer_coefficient(car) * speed * speed
    return speed * road_wheel_angle / (car.wheelbase * divisor) if divisor > 0.0 else math.nan


def linear_system(speed: float, car: VehicleParameters) -> tuple[np.ndarray, np.ndarray]:
    """(A, B) of d/dt (v_y, r) = A (v_y, r) + B delta, linearised about straight driving at `speed` [m/s].

    Below minimum_slip_speed the tyre terms use that speed in place of v, as the models do.
    Source: Guiggiani, ch. 6. Checked by: test_handling.py, against the numerical Jacobian of the model.
    """
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    l_f, l_r, v = car.cg_to_front_axle, car.cg_to_rear_axle, max(speed, car.minimum_slip_speed)
    a = np.array([[-(front + rear) / (car.mass * v), (l_r * rear - l_f * front) / (car.mass * v) - speed],
                  [(l_r * rear - l_f * front) / (car.yaw_inertia * v),
                   -(l_f**2 * front + l_r**2 * rear) / (car.yaw_inertia * v)]])
    ratio = speed / v
    return a, ratio * np.array([front / car.mass, l_f * front / car.yaw_inertia])
