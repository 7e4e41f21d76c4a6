"""Do the signals of a drive belong together? Degrees for radians, km/h, exchanged columns and signs show at once."""

from itertools import pairwise

import numpy as np

from ..filtering import NANOSECOND
from ..log import DriveLog
from ..vehicle import VehicleParameters
from .result import IdentificationError

SHORTEST = 5.0
"""s of common measurement below which a drive says nothing."""
BELIEVABLE_ACCELERATION = 15.0
"""m/s^2 across: more than any road tyre gives."""
WINDOW = 1.0
"""s over which changes of yaw and position are compared."""
LEAST_TURN, LEAST_WAY = 0.02, 1.0
"""rad and m in a window, root mean square, from which on such a comparison means something."""


def check_plausible(log: DriveLog, vehicle: VehicleParameters) -> None:
    """Raises IdentificationError, one line with the numbers, when a drive cannot be what it says it is.

    Compared over windows of a second: change of yaw with integrated yaw rate; way in the map with integrated speed;
    yaw rate with v_x delta / wheelbase at a lateral acceleration below 4 m/s^2. Each ratio should be near 1.
    """
    if log.overlap < SHORTEST or len(log.ins_time_ns) < 50:
        raise IdentificationError(f"{log.name}: too few samples: {len(log.ins_time_ns)} of the INS, {log.overlap:.1f} "
                                  f"s together with the steering; at least {SHORTEST:g} s and 50 are needed")
    _check_velocity(log)
    turn, rate = _windows(log, log.yaw, log.yaw_rate)
    _judge(log, "change of yaw over integrated yaw rate", _ratio(turn, rate, LEAST_TURN), {
        57.3: "yaw looks like degrees", 1 / 57.3: "yaw_rate looks like degrees per second",
        -1.0: "one of the two has the wrong sign (left is positive)"})
    across = np.abs(log.velocity_x * log.yaw_rate)
    if np.percentile(across, 99) > BELIEVABLE_ACCELERATION:
        raise IdentificationError(
            f"{log.name}: v_x yaw_rate reaches {np.percentile(across, 99):.0f} m/s^2, tyres give about 10; yaw and yaw "
            "rate look like degrees, or the speed like km/h: convert to rad and m/s")
    way, speed = _windows(log, _distance(log), np.hypot(log.velocity_x, log.velocity_y))
    _judge(log, "way in the map over integrated speed", _ratio(way, speed, LEAST_WAY), {
        1 / 3.6: "velocity looks like km/h", 57.3: "x, y are not in metres"})
    _check_steering(log, vehicle)


def _check_velocity(log: DriveLog) -> None:
    forward, across = (float(np.sqrt(np.square(v).mean())) for v in (log.velocity_x, log.velocity_y))
    if across > max(0.7 * forward, 0.5):
        raise IdentificationError(f"{log.name}: velocity_y has {across:.2g} m/s root mean square, velocity_x "
                                  f"{forward:.2g}: the columns look exchanged (x is forward, y is left)")


def _check_steering(log: DriveLog, vehicle: VehicleParameters) -> None:
    angle = np.interp(log.ins_time_ns, log.steering_time_ns, log.road_wheel_angle)
    moving = (np.abs(log.velocity_x) > 2.0) & (np.abs(log.velocity_x * log.yaw_rate) < 4.0)
    moving &= (log.ins_time_ns >= log.steering_time_ns[0]) & (log.ins_time_ns <= log.steering_time_ns[-1])
    if not moving.any() or np.std(log.yaw_rate[moving]) < 0.01:
        largest = float(np.abs(log.road_wheel_angle).max())
        if largest > np.pi / 2:
            raise IdentificationError(f"{log.name}: the road wheels reach {largest:.3g} rad; the steering looks like "
                                      "degrees: convert to rad")
        return
    # Deviations from the mean, so that an offset of the steering does not count.
    asked = (log.velocity_x * angle / vehicle.wheelbase)[moving]
    asked, given = asked - asked.mean(), log.yaw_rate[moving] - log.yaw_rate[moving].mean()
    slope = float(asked @ given / (given @ given))
    _judge(log, "yaw rate of the steering angle over measured yaw rate", slope, {
        57.3: "the steering looks like degrees", 1 / 57.3: "the steering was converted to rad twice",
        vehicle.steering_ratio: "the steering wheel was taken for the road wheels",
        -1.0: "the steering has the wrong sign (left is positive)"}, (0.33, 3.0))


def _judge(log: DriveLog, what: str, ratio: float, explanations: dict[float, str],
           allowed: tuple[float, float] = (0.7, 1.4)) -> None:
    if not np.isfinite(ratio) or allowed[0] <= ratio <= allowed[1]:
        return
    near = [words for factor, words in explanations.items() if ratio * factor > 0 and 0.6 < ratio / factor < 1.67]
    reason = near[0] if near else "the signals do not belong to one drive"
    raise IdentificationError(f"{log.name}: {what} is {ratio:.3g}, it should be near 1: {reason}")


def _windows(log: DriveLog, position: np.ndarray, rate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Changes of `position` and integrals of `rate` over windows without a gap."""
    seconds = (log.ins_time_ns - log.ins_time_ns[0]) * NANOSECOND
    spacing = np.diff(seconds)
    integral = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * spacing)))
    marks = np.arange(0.0, seconds[-1], WINDOW)
    places = np.minimum(np.searchsorted(seconds, marks), len(seconds) - 1)
    whole = np.array([spacing[a:b].max(initial=0.0) < 0.5 for a, b in pairwise(places)], bool)
    return np.diff(position[places])[whole], np.diff(integral[places])[whole]


def _ratio(change: np.ndarray, integral: np.ndarray, least: float) -> float:
    # The larger of the two decides whether there is anything to compare: a unit too small must not hide itself.
    if not len(change) or max(np.sqrt(np.square(change).mean()), np.sqrt(np.square(integral).mean())) < least:
        return np.nan
    return float(change @ integral / max(integral @ integral, 1e-12))


def _distance(log: DriveLog) -> np.ndarray:
    return np.concatenate(([0.0], np.cumsum(np.hypot(np.diff(log.x), np.diff(log.y)))))
