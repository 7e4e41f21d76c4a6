"""Which switch of the virtual car stands for which effect of the library: the one table between the two worlds.

The plant's switches act in its own double-track equations; the library's names are those of st_core.effects. `full` is
the change of a large effect (scale 1), `signs` the directions it may take: the other is outside what the library, or a
car, allows.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from st_sim.settings import SETTINGS, Settings

BOTH, UP, DOWN = (1, -1), (1,), (-1,)


@dataclass(frozen=True)
class Hidden:
    """One switch of the plant. library: name in st_core.effects, None where no effect of it equals the switch.

    factor: the change multiplies the setting (1 + change), else it is added. with_: other settings of the healthy car
    that leave room for the effect. group: effects of one group are not paired in cases of two.
    """

    setting: str
    library: str | None
    full: float
    signs: tuple[int, ...] = BOTH
    factor: bool = False
    group: str = ""
    with_: Mapping[str, float] | None = None

    def applied(self, settings: Settings, scale: float, sign: int) -> dict[str, float]:
        change = sign * scale * self.full
        value = settings[self.setting] * (1.0 + change) if self.factor else settings[self.setting] + change
        limits = SETTINGS[self.setting]
        return {**settings, self.setting: min(max(value, limits.low), limits.high)}


KNOWN = (
    Hidden("steering_offset", "steering_offset", 0.006, group="side"),
    Hidden("steering_ratio_factor", "steering_ratio", 0.10, factor=True, group="gain"),
    Hidden("steering_lag", "steering_lag", 0.08, UP, group="time"),
    Hidden("steering_delay", "steering_delay", 0.05, UP, group="time"),
    Hidden("steering_backlash", "steering_backlash", 0.2, UP, group="play"),
    Hidden("steering_compliance", "steering_compliance", 3e-6, UP, group="gain"),
    Hidden("roll_steer", "roll_steer", 0.2, group="gain"),
    Hidden("front_stiffness_factor", "front_stiffness", 0.15, factor=True, group="gain"),
    Hidden("rear_stiffness_factor", "rear_stiffness", 0.2, factor=True, group="rear"),
    Hidden("friction_factor", "friction", 0.15, DOWN, factor=True, group="limit"),
    Hidden("relaxation_length", "tyre_relaxation", 0.6, UP, group="time"),
    Hidden("combined_slip", "combined_slip", 1.0, UP, group="limit", with_={"combined_slip": 0.0}),
    Hidden("lateral_load_transfer", "lateral_load_transfer", 1.0, UP, group="limit"),
    Hidden("longitudinal_load_transfer", "longitudinal_load_transfer", 1.0, UP, group="limit"),
    Hidden("mass_factor", "mass", 0.3, UP, factor=True, group="gain"),
    Hidden("yaw_inertia_factor", "yaw_inertia", 0.35, factor=True, group="time"),
    Hidden("cg_shift", "cg_position", 0.2, group="rear"),
    Hidden("bank_angle", "road_bank", 0.03, group="side"),
    Hidden("wind_speed", "crosswind", 18.0, group="side"),
    Hidden("ins_misalignment", "heading_misalignment", 0.006, group="mounting"),
    Hidden("ins_lever_error", "sensor_lever_arm", 0.2, group="mounting"),
    Hidden("yaw_rate_scale", "yaw_rate_scale", 0.05, factor=True, group="gain"),
    Hidden("velocity_scale", "speed_scale", 0.01, factor=True, group="speed"),
    Hidden("lateral_acceleration_bias", "lateral_acceleration_bias", 0.25, group="accelerometer"),
)
"""In the library. roll_steer counts the other way round there (understeer +); backlash is at the hand wheel here."""

FOREIGN = (
    Hidden("gust_speed", None, 10.0, UP),
    Hidden("friction_patch", None, 0.5, DOWN, factor=True),
    Hidden("terrain_wave", None, 0.06, UP),
    Hidden("hillside_slope", None, 0.06),
    Hidden("rear_roll_steer", None, 0.25),
    Hidden("camber_thrust", None, 1.0, UP),
)
"""No effect of the library equals these. Some of them an effect can nearly imitate (rear roll steer, camber thrust).
The Ackermann share is not here: on these drives nothing of it can be seen."""

UNSEEN = {
    "drag_area": ("drag", 0.6),
    "rolling_resistance": ("rolling_resistance", 0.02),
    "grade_angle": ("grade", 0.03),
}
"""setting -> (what a discovery calls it, change): invisible where the forward acceleration is an input."""

BY_NAME = {hidden.library: hidden for hidden in KNOWN}
