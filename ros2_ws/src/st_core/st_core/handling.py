"""Closed forms of the linear single-track car: understeer and stability."""

import numpy as np

from .vehicle import VehicleParameters


def understeer_coefficient(car: VehicleParameters) -> float:
    """K = m (l_r C_r - l_f C_f) / (l^2 C_f C_r) [s^2/m^2]; > 0: understeer.

    Source: Guiggiani, The Science of Vehicle Dynamics, ch. 6.
    """
    front, rear = car.cornering_stiffness_front, car.cornering_stiffness_rear
    return car.mass * (car.cg_to_rear_axle * rear - car.cg_to_front_axle * front) / (car.wheelbase**2 * front * rear)


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
