"""Common equations of the two dynamic models: axle slip angles and motion of the single-track car."""

from ..ops import cos, sin
from ..tyres import slip_angle


def axle_slip_angles(velocity_x, velocity_y, yaw_rate, sine, cosine, p):
    """Slip angles (front, rear) [rad], + when the wheel slides to its left. sine, cosine: of the road wheel angle.

        v_x0 = v_x cos d + (v_y + l_f r) sin d,   v_sy0 = (v_y + l_f r) cos d - v_x sin d
        v_x1 = v_x,                               v_sy1 = v_y - l_r r

    Needs of p: cg_to_front_axle, cg_to_rear_axle [m], minimum_slip_speed [m/s]. Source: paper, wheel velocities.
    """
    lateral = velocity_y + p.cg_to_front_axle * yaw_rate
    front = slip_angle(lateral * cosine - velocity_x * sine, velocity_x * cosine + lateral * sine, p.minimum_slip_speed)
    rear = slip_angle(velocity_y - p.cg_to_rear_axle * yaw_rate, velocity_x, p.minimum_slip_speed)
    return front, rear


def motion(state, force_front, force_rear, cosine, velocity_x_dot, p):
    """Time derivative of the state under the axle forces [N], each in its wheel's lateral axis, left +.

        x_dot = v_x cos psi - v_y sin psi,  y_dot = v_x sin psi + v_y cos psi,  v_x_dot: input
        v_y_dot = (F_f cos d + F_r) / m - v_x r,  psi_dot = r,  r_dot = (l_f F_f cos d - l_r F_r) / I_z

    cosine: of the road wheel angle. Needs of p: mass, yaw_inertia and the two lengths. Source: paper, dynamic model.
    """
    _, _, velocity_x, velocity_y, yaw, yaw_rate = state
    cosine_yaw, sine_yaw = cos(yaw), sin(yaw)
    front = force_front * cosine
    return (velocity_x * cosine_yaw - velocity_y * sine_yaw,
            velocity_x * sine_yaw + velocity_y * cosine_yaw,
            velocity_x_dot,
            (front + force_rear) / p.mass - velocity_x * yaw_rate,
            yaw_rate,
            (p.cg_to_front_axle * front - p.cg_to_rear_axle * force_rear) / p.yaw_inertia)
