"""The truth: a double-track car on the road. Own equations, no model of the suite is used here.

Axes ISO 8855 (x forward, y left, z up), state at the true CG, yaw counter-clockwise from east. Wheels: front left,
front right, rear left, rear right. A slip angle is positive when the wheel slides to its left, so the force is
negative.

    m (dv_x/dt - r v_y) = sum F_x - drag - m g sin(grade)
    m (dv_y/dt + r v_x) = sum F_y + wind - m g sin(bank)
    I_z dr/dt           = sum (x_i F_y,i - y_i F_x,i) + wind moment

with forces turned from each wheel into the body, tyre force from the delayed slip, loads from filtered accelerations,
and the steering chain hand wheel -> delay -> play -> ratio -> lag -> offset, roll steer, compliance.

Source: Pacejka, Tire and Vehicle Dynamics, ch. 1 and 7. Checked by: test_plant.py, test_effects.py.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, atan2, cos, hypot, sin

from .car import GRAVITY, TRACK_WIDTH, Car
from .environment import Environment, Surroundings
from .settings import Settings
from .tyres import MINIMUM_LOAD, Force, lateral_force, left_by_ellipse

STEP = 0.002
"""s, of the integrator (Heun). Halving it moves a 10 s drive by less than a millimetre (test_plant.py)."""

AIR_DENSITY = 1.2
SIDE_AREA = 2.5
"""m^2, side force coefficient times side area; about half of the Leaf's 4.7 m^2 of flank."""
WIND_ARM = 0.25
"""m, centre of side wind ahead of the CG."""
BRAKE_SHARE_FRONT = 0.65
ROLL_SHARE_FRONT = 0.55
"""Share of the lateral load transfer that the front axle takes."""

# Slip needs a speed to divide by. The paper's models use 3 m/s; a real tyre has no such limit, so it is as low as the
# step allows.
LOWEST_SLIP_SPEED = 0.5
CREEP_SPEED = 2.5
CREEP_DAMPING = 0.17
"""s/m. Below CREEP_SPEED a relaxing tyre is a spring with little damping; so much slip per sliding speed is added."""
STANDSTILL = 0.02
"""m/s. Slower than this with the brakes on is at rest."""

ROLL_FREQUENCY, ROLL_DAMPING = 12.6, 0.4
"""rad/s (2 Hz) and share of critical, of the body on its springs; both load transfer and roll follow it."""
PITCH_TIME = 0.08
COMPLIANCE_TIME = 0.01
"""s, first-order: pitch with its load transfer, and the give of the steering."""
ROLLING_ONSET = 0.2
"""m/s. Below it the rolling resistance fades out, so that it cannot push a standing car."""

# Positions in the state tuple.
X, Y, Z, YAW, VX, VY, YAW_RATE, RACK, GIVE, S_FL, S_FR, S_RL, S_RR, LEAN, LEAN_RATE, SQUAT = range(16)


@dataclass(slots=True)
class Forces:
    """What the last derivative saw.

    Per wheel (FL, FR, RL, RR) and of the body, for the truth record and the sensors.
    """

    acceleration_x: float = 0.0
    acceleration_y: float = 0.0
    yaw_acceleration: float = 0.0
    velocity_x_dot: float = 0.0
    velocity_y_dot: float = 0.0
    velocity_z: float = 0.0
    road_wheel_angle: float = 0.0
    lateral: tuple[float, ...] = (0.0,) * 4
    longitudinal: tuple[float, ...] = (0.0,) * 4
    load: tuple[float, ...] = (0.0,) * 4
    slip_angle: tuple[float, ...] = (0.0,) * 4
    wheel_speed: tuple[float, ...] = (0.0,) * 4


class Plant:
    """One car. `step` advances by STEP with the hand wheel and the drive force held."""

    def __init__(self, car: Car, settings: Settings, seed: int = 0, step: float = STEP):
        self.car, self.settings, self.time_step = car, settings, step
        self.environment = Environment(settings, step, seed)
        self.state: tuple[float, ...] = (0.0,) * 16
        self.forces = Forces()
        self.parked = False
        self.here = self.environment.at(0.0, 0.0, 0.0)
        s = settings
        self.mass = car.mass * s["mass_factor"]
        self.yaw_inertia = car.yaw_inertia * s["yaw_inertia_factor"]
        self.to_front = car.cg_to_front_axle - s["cg_shift"]
        self.to_rear = car.wheelbase - self.to_front
        self._ratio = car.steering_ratio * s["steering_ratio_factor"]
        self._play = s["steering_backlash"] / 2
        # A lag shorter than a step is a step: the integrator could not follow it.
        self._lag = max(s["steering_lag"], step) if s["steering_lag"] else 0.0
        self._delay: deque[float] = deque([0.0] * round(s["steering_delay"] / step))
        self._loose = 0.0
        self._steering_offset, self._compliance = s["steering_offset"], s["steering_compliance"]
        self._roll_steer, self._rear_roll_steer = s["roll_steer"], s["rear_roll_steer"]
        self._roll_gradient, self._camber = s["roll_gradient"], s["camber_thrust"]
        self._fastest = 1.0 / step
        self._relaxation, self._combined = s["relaxation_length"], s["combined_slip"]
        self._wheel_slip, self._rolling, self._drag_area = (
            s[name] for name in ("wheel_slip_compliance", "rolling_resistance", "drag_area")
        )
        self._front = lateral_force(car.tyre_front, s["front_stiffness_factor"])
        self._rear = lateral_force(car.tyre_rear, s["rear_stiffness_factor"])
        self._ackermann = s["ackermann"] * TRACK_WIDTH / (2 * car.wheelbase)
        self._transfer_x = s["longitudinal_load_transfer"] * self.mass * car.cg_height / car.wheelbase / 2
        self._transfer_y = s["lateral_load_transfer"] * self.mass * car.cg_height / TRACK_WIDTH
        self._static_front = self.mass * GRAVITY * self.to_rear / car.wheelbase / 2
        self._static_rear = self.mass * GRAVITY * self.to_front / car.wheelbase / 2

    def place(self, x: float, y: float, yaw: float, speed: float, curvature: float = 0.0) -> None:
        """Start there, on a circle of that curvature, without slip; what settles then is part of the drive."""
        values = [0.0] * 16
        values[X], values[Y], values[YAW], values[VX], values[YAW_RATE] = x, y, yaw, speed, speed * curvature
        values[VY] = speed * curvature * self.to_rear
        rack = atan(self.car.wheelbase * curvature)
        values[RACK] = rack
        self.state = tuple(values)
        self.here = self.environment.at(x, y, yaw)
        self._loose = rack * self._ratio
        self._delay = deque([self._loose] * len(self._delay))

    @property
    def steering_wheel_for(self) -> float:
        """Hand-wheel angle that belongs to the present rack position [rad]."""
        return self.state[RACK] * self._ratio

    @property
    def body_roll(self) -> float:
        """rad, relative to the road, right side down positive (the outside in a left turn)."""
        return self.settings["roll_gradient"] * self.state[LEAN]

    @property
    def body_pitch(self) -> float:
        """rad, relative to the road, nose up positive."""
        return self.settings["pitch_gradient"] * self.state[SQUAT]

    def step(self, steering_wheel_angle: float, drive_force: float) -> None:
        """Advance by one time step.

        steering_wheel_angle: true, left + [rad]; drive_force: sum over the wheels, braking < 0 [N].
        """
        s, dt = self.state, self.time_step
        self.here = here = self.environment.at(s[X], s[Y], s[YAW])
        target = self._rack_target(steering_wheel_angle)
        if self._lag == 0.0:
            s = (*s[:RACK], target, *s[RACK + 1 :])
        if self.parked and drive_force <= 0.0:
            self.state = self._at_rest(s)
            return
        self.parked = False
        k1 = self._derivative(s, target, drive_force, here)
        k2 = self._derivative([a + dt * b for a, b in zip(s, k1, strict=True)], target, drive_force, here)
        half = dt / 2
        s = tuple([a + half * (b + c) for a, b, c in zip(s, k1, k2, strict=True)])
        self.parked = s[VX] < STANDSTILL and drive_force <= 0.0
        self.state = self._at_rest(s) if self.parked else s

    def observe(self, drive_force: float) -> Forces:
        """Forces and accelerations at the present state, also kept in `forces`. At rest nothing accelerates."""
        self._derivative(self.state, self.state[RACK], drive_force, self.here, record=True)
        if self.parked:
            f = self.forces
            f.acceleration_x = f.acceleration_y = f.yaw_acceleration = 0.0
            f.velocity_x_dot = f.velocity_y_dot = f.velocity_z = 0.0
        return self.forces

    def _at_rest(self, s: Sequence[float]) -> tuple[float, ...]:
        """Held by the brakes: no velocity, no slip; the body settles."""
        values = list(s)
        for i in (VX, VY, YAW_RATE, GIVE, S_FL, S_FR, S_RL, S_RR):
            values[i] = 0.0
        for i in (LEAN, LEAN_RATE, SQUAT):
            values[i] *= 1.0 - self.time_step / PITCH_TIME
        return tuple(values)

    def _rack_target(self, hand: float) -> float:
        if self._delay:
            self._delay.append(hand)
            hand = self._delay.popleft()
        if self._play:
            self._loose = min(max(self._loose, hand - self._play), hand + self._play)
            hand = self._loose
        return hand / self._ratio

    def _wheel(
        self,
        force: Force,
        friction: float,
        load: float,
        slip: float,
        slid: float,
        rolled: float,
        pull: float,
    ) -> tuple[float, float, float]:
        """Lateral and longitudinal force of one wheel [N] and the rate of its delayed slip.

        slip: delayed (state); slid, rolled: velocity of the contact patch across and along the wheel [m/s]; pull:
        wanted F_x [N].
        """
        speed = abs(rolled)
        steady = slid / (speed if speed > LOWEST_SLIP_SPEED else LOWEST_SLIP_SPEED)
        if self._relaxation:
            pace = (speed if speed > LOWEST_SLIP_SPEED else LOWEST_SLIP_SPEED) / self._relaxation
            rate = (pace if pace < self._fastest else self._fastest) * (steady - slip)
            if speed < CREEP_SPEED:
                slip += CREEP_DAMPING * slid * (1.0 - speed / CREEP_SPEED)
        else:
            rate, slip = 0.0, steady
        lateral, peak = force(atan(slip), load, friction)
        if abs(pull) > 0.98 * peak:
            pull = 0.98 * peak if pull > 0 else -0.98 * peak
        if self._combined:
            lateral *= 1.0 - self._combined + self._combined * left_by_ellipse(pull, peak)
        return lateral, pull, rate

    def _derivative(
        self, s: Sequence[float], rack_target: float, drive_force: float, here: Surroundings, record: bool = False
    ) -> tuple[float, ...]:
        (_, _, _, yaw, vx, vy, r, rack, give, s_fl, s_fr, s_rl, s_rr, lean, lean_rate, squat) = s
        friction, bank, grade, wind_x, wind_y = here
        half_track, front, rear = TRACK_WIDTH / 2, self.to_front, self.to_rear
        roll = self._roll_gradient * lean

        steer = rack + self._steering_offset + self._roll_steer * roll - give
        sine = sin(steer)
        split = self._ackermann * sine * sine
        steer_l, steer_r = steer + split, steer - split
        cos_l, sin_l, cos_r, sin_r = cos(steer_l), sin(steer_l), cos(steer_r), sin(steer_r)
        steer_rear = self._rear_roll_steer * roll

        # Loads: static, then what the filtered accelerations move.
        normal = cos(bank) * cos(grade)
        pitch_load = self._transfer_x * squat
        sway = self._transfer_y * lean
        sway_front, sway_rear = ROLL_SHARE_FRONT * sway, (1.0 - ROLL_SHARE_FRONT) * sway
        load_front, load_rear = self._static_front * normal - pitch_load, self._static_rear * normal + pitch_load
        load_fl, load_fr = max(load_front - sway_front, MINIMUM_LOAD), max(load_front + sway_front, MINIMUM_LOAD)
        load_rl, load_rr = max(load_rear - sway_rear, MINIMUM_LOAD), max(load_rear + sway_rear, MINIMUM_LOAD)

        # Velocity of each contact patch, turned into its wheel.
        left_x, right_x, front_y, rear_y = vx - r * half_track, vx + r * half_track, vy + r * front, vy - r * rear
        rolled_fl, slid_fl = left_x * cos_l + front_y * sin_l, front_y * cos_l - left_x * sin_l
        rolled_fr, slid_fr = right_x * cos_r + front_y * sin_r, front_y * cos_r - right_x * sin_r
        slid_rl, slid_rr = rear_y - left_x * steer_rear, rear_y - right_x * steer_rear

        if drive_force >= 0.0:
            pull_front, pull_rear = drive_force / 2, 0.0
        else:
            pull_front, pull_rear = drive_force * BRAKE_SHARE_FRONT / 2, drive_force * (1.0 - BRAKE_SHARE_FRONT) / 2
        wheel = self._wheel
        y_fl, x_fl, rate_fl = wheel(self._front, friction, load_fl, s_fl, slid_fl, rolled_fl, pull_front)
        y_fr, x_fr, rate_fr = wheel(self._front, friction, load_fr, s_fr, slid_fr, rolled_fr, pull_front)
        y_rl, x_rl, rate_rl = wheel(self._rear, friction, load_rl, s_rl, slid_rl, left_x, pull_rear)
        y_rr, x_rr, rate_rr = wheel(self._rear, friction, load_rr, s_rr, slid_rr, right_x, pull_rear)
        axle_front = y_fl + y_fr
        if self._camber:
            lean_out = self._camber * roll
            y_fl, y_fr = y_fl - lean_out * load_fl, y_fr - lean_out * load_fr
            y_rl, y_rr = y_rl - lean_out * load_rl, y_rr - lean_out * load_rr

        # Into the body. The rear steers by a fraction of a degree at most: first order is exact to 1e-5.
        bx_fl, by_fl = x_fl * cos_l - y_fl * sin_l, x_fl * sin_l + y_fl * cos_l
        bx_fr, by_fr = x_fr * cos_r - y_fr * sin_r, x_fr * sin_r + y_fr * cos_r
        bx_rl, by_rl = x_rl - y_rl * steer_rear, y_rl + x_rl * steer_rear
        bx_rr, by_rr = x_rr - y_rr * steer_rear, y_rr + x_rr * steer_rear

        air_x, air_y = self._air(yaw, vx, vy, wind_x, wind_y)
        rolling = self._rolling * self.mass * GRAVITY * normal * min(max(vx / ROLLING_ONSET, -1.0), 1.0)
        force_x = bx_fl + bx_fr + bx_rl + bx_rr + air_x - rolling
        force_y = by_fl + by_fr + by_rl + by_rr + air_y
        moment = (
            front * (by_fl + by_fr)
            - rear * (by_rl + by_rr)
            + half_track * (bx_fr - bx_fl + bx_rr - bx_rl)
            + WIND_ARM * air_y
        )

        felt_x, felt_y = force_x / self.mass, force_y / self.mass
        vx_dot = felt_x - GRAVITY * sin(grade) + r * vy
        vy_dot = felt_y - GRAVITY * sin(bank) - r * vx
        r_dot = moment / self.yaw_inertia
        cos_yaw, sin_yaw = cos(yaw), sin(yaw)
        climb = vx * sin(grade) + vy * sin(bank)
        if record:
            f = self.forces
            f.acceleration_x, f.acceleration_y = vx_dot - r * vy, vy_dot + r * vx
            f.yaw_acceleration, f.velocity_x_dot, f.velocity_y_dot, f.velocity_z = r_dot, vx_dot, vy_dot, climb
            f.road_wheel_angle = steer
            f.lateral, f.longitudinal = (y_fl, y_fr, y_rl, y_rr), (x_fl, x_fr, x_rl, x_rr)
            f.load = (load_fl, load_fr, load_rl, load_rr)
            f.slip_angle = tuple(
                atan2(slid, max(abs(along), LOWEST_SLIP_SPEED))
                for slid, along in ((slid_fl, rolled_fl), (slid_fr, rolled_fr), (slid_rl, left_x), (slid_rr, right_x))
            )
            c = self._wheel_slip
            f.wheel_speed = (
                rolled_fl * (1 + c * x_fl / load_fl),
                rolled_fr * (1 + c * x_fr / load_fr),
                left_x * (1 + c * x_rl / load_rl),
                right_x * (1 + c * x_rr / load_rr),
            )
        flat = cos(grade)
        return (
            vx * flat * cos_yaw - vy * sin_yaw,
            vx * flat * sin_yaw + vy * cos_yaw,
            climb,
            r,
            vx_dot,
            vy_dot,
            r_dot,
            (rack_target - rack) / self._lag if self._lag else 0.0,
            (self._compliance * axle_front - give) / COMPLIANCE_TIME if self._compliance else 0.0,
            rate_fl,
            rate_fr,
            rate_rl,
            rate_rr,
            lean_rate,
            ROLL_FREQUENCY * (ROLL_FREQUENCY * (felt_y - lean) - 2 * ROLL_DAMPING * lean_rate),
            (felt_x - squat) / PITCH_TIME,
        )

    def _air(self, yaw: float, vx: float, vy: float, wind_x: float, wind_y: float) -> tuple[float, float]:
        """Drag and side force [N] in body axes.

        Still air acts lengthways only: the side force is what the wind adds.
        """
        along, across, own = -vx, -vy, hypot(vx, vy)
        if self.environment.calm:
            return 0.5 * AIR_DENSITY * own * self._drag_area * along, 0.0
        c, s = cos(yaw), sin(yaw)
        along, across = along + wind_x * c + wind_y * s, across + wind_y * c - wind_x * s
        felt = hypot(along, across)
        side = 0.5 * AIR_DENSITY * SIDE_AREA * (felt * across + own * vy)
        return 0.5 * AIR_DENSITY * felt * self._drag_area * along, side
