"""A drive in closed form: speed and yaw rate are sums of sines, positions their integrals, exact except for rounding.

    v(t) = v0 + sum A sin(w t),    r(t) = r0 + sum B sin(w t),    yaw = integral of r
    v_y = (d - s v^2) r            d: INS point ahead of the rear axle, s: slip of the rear axle
    (x, y) = integral of R(yaw) (v, v_y)          by Gauss-Legendre quadrature, six nodes per sample
    steering(t) = atan(L r / v) at t + tau        tau: lag of the car behind its steering
"""

from dataclasses import dataclass, replace

import numpy as np
from st_core.checks.vehicle_relations import compute_response_time
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters

T0 = 1_700_000_000_000_000_000
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


@dataclass(frozen=True)
class Sines:
    """mean + sum of amplitude * sin(2 pi time / period + phase); parts: (amplitude, period [s], phase [rad])."""

    mean: float
    parts: tuple[tuple[float, float, float], ...]

    def at(self, time: np.ndarray) -> np.ndarray:
        return self.mean + sum(a * np.sin(2.0 * np.pi * time / p + b) for a, p, b in self.parts)

    def slope(self, time: np.ndarray) -> np.ndarray:
        return sum(a * 2.0 * np.pi / p * np.cos(2.0 * np.pi * time / p + b) for a, p, b in self.parts)

    def integral(self, time: np.ndarray) -> np.ndarray:
        return self.mean * time - sum(
            a * p / (2.0 * np.pi) * np.cos(2.0 * np.pi * time / p + b) for a, p, b in self.parts)


SPEED = Sines(12.0, ((3.0, 41.0, 0.4), (1.5, 13.0, 1.1)))
TURNING = Sines(0.02, ((0.16, 23.0, 0.0), (0.07, 6.1, 0.7), (0.03, 2.3, 2.0)))


@dataclass(frozen=True)
class Noise:
    """Standard deviations of the white noise of a good INS [SI]."""

    position: float = 0.003
    yaw: float = 0.0005
    velocity: float = 0.01
    yaw_rate: float = 0.002
    acceleration: float = 0.05
    steering: float = 0.0005


SILENT = Noise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def exact_drive(car: VehicleParameters, seconds: float = 60.0, *, rate: float = 100.0, speed: Sines = SPEED,
                turning: Sines = TURNING, noise: Noise = Noise(), seed: int = 0) -> DriveLog:
    """INS and steering at `rate` [Hz], steering half a sample later."""
    time = np.arange(0.0, seconds, 1.0 / rate)
    ahead = car.cg_to_rear_axle + car.cg_to_ins_x
    slip = car.mass * car.cg_to_front_axle / (car.wheelbase * car.cornering_stiffness_rear)

    def lateral_velocity(t: np.ndarray) -> np.ndarray:
        return (ahead - slip * speed.at(t) ** 2) * turning.at(t)

    def map_velocity(t: np.ndarray) -> np.ndarray:
        return (speed.at(t) + 1j * lateral_velocity(t)) * np.exp(1j * turning.integral(t))

    half = 0.5 / rate
    inner = map_velocity(time[:-1, None] + half * (1.0 + NODES))
    place = np.concatenate(([0.0], np.cumsum(half * inner @ WEIGHTS)))
    v, r = speed.at(time), turning.at(time)
    lateral_slope = (ahead - slip * v**2) * turning.slope(time) - 2.0 * slip * v * speed.slope(time) * r
    draw = np.random.default_rng(seed).standard_normal((9, len(time)))
    later = time + half
    response = later + compute_response_time(car, float(np.median(np.abs(v))))
    road = np.arctan(car.wheelbase * turning.at(response) / speed.at(response)) + noise.steering * draw[8]
    wheel = car.steering_wheel_angle(road)
    ns, later_ns = (T0 + np.round(t * 1e9).astype(np.int64) for t in (time, later))
    return DriveLog(
        "exact", ns, place.real + noise.position * draw[0], place.imag + noise.position * draw[1],
        turning.integral(time) + noise.yaw * draw[2], v + noise.velocity * draw[3],
        lateral_velocity(time) + noise.velocity * draw[4], r + noise.yaw_rate * draw[5], later_ns,
        car.road_wheel_angle(wheel), wheel,
        speed.slope(time) - lateral_velocity(time) * r + noise.acceleration * draw[6],
        lateral_slope + v * r + noise.acceleration * draw[7])


def delay(log: DriveLog, seconds: float, *channels: str) -> DriveLog:
    """Delays INS channels by a whole number of samples, or the stamps of the steering [s]."""
    if channels == ("road_wheel_angle",):
        return replace(log, steering_time_ns=log.steering_time_ns + round(seconds * 1e9))
    rows = round(seconds / (float(np.median(np.diff(log.ins_time_ns))) * 1e-9))
    first, last = max(rows, 0), len(log.x) + min(rows, 0)
    kept = log.select_ins(np.arange(first, last))
    return replace(kept, **{name: getattr(log, name)[first - rows:last - rows] for name in channels})
