"""The numbers findings depend on, with meaning and unit; `st bench checks --ablation` halves and doubles each."""

from dataclasses import dataclass

from .finding import Severity

HORIZON = 5.0  # s, over which effects are judged
WHEEL_SCALE = 0.03  # 1; tyres wear and are pumped up by that


@dataclass(frozen=True)
class Limits:
    """min_reported_effect [m]: what a fault must move the position after 5 s by; an RTK position is known to 2 cm.

    warning [m]: a quarter metre; the best models are wrong by 0.4 m over such horizons. error [m]: 5 m; a model that
    drove straight on in a bend of 250 m would be as wrong at 10 m/s, so nothing is left to compare.
    unit: factor beyond which a ratio is a unit, a sign or an axis and no calibration; channel_unit: the same of an
    accelerometer or a wheel, which a rolling body or a tyre may change more. settling [s]: for so long a model
    remembers a wrong start of its yaw rate. lag [s]: below it is filtering inside a sensor; from grave_lag on it would
    pass for a delay of the steering. correlation: two estimates
    of a quantity below it are not compared.
    bias_acceleration [m/s^2]: 0.1 is 0.6 degrees of mounting or road. tyre [m/s^2]: no road tyre gives more.
    steering_unit: factor by which steering and curvature of any healthy car may differ beyond the understeer of its
    file (ratio, wheelbase, guessed stiffnesses). steering_lag [s]: what a car itself may need. steering_offset [rad]:
    at the road wheels.
    mounting [m]: accuracy of a tape measure. heading [rad]: 0.1 degree, accuracy of a dual antenna.
    """

    min_reported_effect: float = 0.02
    warning: float = 0.25
    error: float = 5.0
    unit: float = 1.33
    channel_unit: float = 2.0
    settling: float = 0.2
    lag: float = 0.015
    grave_lag: float = 0.05
    correlation: float = 0.6
    bias_acceleration: float = 0.1
    tyre: float = 13.0
    steering_unit: float = 1.5
    steering_lag: float = 0.1
    steering_offset: float = 0.02
    mounting: float = 0.25
    heading: float = 0.002

    def severity(self, effect: float) -> Severity:
        """Of an effect on the position after 5 s [m]."""
        if effect >= self.error:
            return Severity.ERROR
        return Severity.WARNING if effect >= self.warning else Severity.NOTE


LIMITS = Limits()

SYSTEMATIC = {
    "lag": 0.005, "velocity_lag": 0.01, "acceleration_x_lag": 0.01, "acceleration_y_lag": 0.01, "steering_lag": 0.04,
    "wheel_speed_lag": 0.02, "scale": 0.001, "acceleration_x_scale": 0.01, "acceleration_y_scale": 0.01,
    "wheel_speed_scale": 0.005, "ins_speed_scale": 0.002, "steering_scale": 0.05, "steering_sign": 0.05,
    "yaw_rate_bias": 0.0002, "acceleration_x_bias": 0.01, "acceleration_y_bias": 0.01, "yaw_offset": 0.001,
    "heading_misaligned": 0.001, "steering_offset": 0.001, "position_reference": 0.02, "measuring_point": 0.05,
    "map_shear": 0.001, "velocity_x_bias": 0.02, "velocity_y_bias": 0.02,
}
"""Systematic uncertainty of an identity, half of a 95 % interval, in the finding's unit (scales: share of the value):
filters, interpolation between samples, roll, and for the steering the car's own response, which resampling does not
cover. By finding, else by the last part of its name. Added in quadrature (GUM: type B to type A). Set from the errors
of the estimates on the development drives of bench/checks; the sealed drives were not used."""
