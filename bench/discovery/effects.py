"""Settings of the plants, and the effects of the library (st_core.effects) to which they correspond.

The settings act in the equations of the plants. `size` is the change for a large effect (scale 1), `signs` are its
directions; a direction that does not occur in real cars is left out, here and in the library.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from st_core.effects import get_effect
from st_core.vehicle import VehicleParameters
from st_sim.settings import SETTINGS, Settings

BOTH, UP, DOWN = (1, -1), (1,), (-1,)
Values = dict[str, dict[str, float]]


@dataclass(frozen=True)
class InjectedChange:
    """A change of one setting of a plant, unknown to discovery."""

    setting: str
    library: str | None  # name of the effect, None if no effect of the library describes the setting
    size: float
    signs: tuple[int, ...] = BOTH
    factor: bool = False  # the setting is multiplied by 1 + change; otherwise the change is added
    # Other settings of the healthy car without which the change has no effect.
    requires: Mapping[str, float] | None = None

    def apply(self, settings: Settings, scale: float, sign: int) -> dict[str, float]:
        change = sign * scale * self.size
        value = settings[self.setting] * (1.0 + change) if self.factor else settings[self.setting] + change
        if self.setting in SETTINGS:
            value = min(max(value, SETTINGS[self.setting].low), SETTINGS[self.setting].high)
        return {**settings, self.setting: value}


KNOWN = (
    InjectedChange("steering_offset", "steering_offset", 0.006),
    InjectedChange("steering_ratio_factor", "steering_ratio", 0.10, factor=True),
    InjectedChange("steering_lag", "steering_lag", 0.08, UP),
    InjectedChange("steering_delay", "steering_delay", 0.05, UP),
    InjectedChange("steering_backlash", "steering_backlash", 0.2, UP),
    InjectedChange("steering_compliance", "steering_compliance", 3e-6, UP),
    InjectedChange("roll_steer", "roll_steer", 0.2),
    InjectedChange("front_stiffness_factor", "front_stiffness", 0.15, factor=True),
    InjectedChange("rear_stiffness_factor", "rear_stiffness", 0.2, factor=True),
    InjectedChange("friction_factor", "friction", 0.15, DOWN, factor=True),
    InjectedChange("relaxation_length", "tyre_relaxation", 0.6, UP),
    InjectedChange("combined_slip", "combined_slip", 1.0, UP, requires={"combined_slip": 0.0}),
    InjectedChange("lateral_load_transfer", "lateral_load_transfer", 1.0, UP),
    InjectedChange("longitudinal_load_transfer", "longitudinal_load_transfer", 1.0, UP),
    InjectedChange("mass_factor", "mass", 0.3, UP, factor=True),
    InjectedChange("yaw_inertia_factor", "yaw_inertia", 0.35, factor=True),
    InjectedChange("cg_shift", "cg_position", 0.2),
    InjectedChange("bank_angle", "road_bank", 0.03),
    InjectedChange("wind_speed", "crosswind", 18.0),
    InjectedChange("hillside_slope", "road_slope", 0.03),
    InjectedChange("ins_misalignment", "heading_misalignment", 0.006),
    InjectedChange("ins_lever_error", "sensor_lever_arm", 0.2),
    InjectedChange("yaw_rate_scale", "yaw_rate_scale", 0.05, factor=True),
    InjectedChange("yaw_rate_bias", "yaw_rate_bias", 0.008),
    InjectedChange("velocity_scale", "speed_scale", 0.01, factor=True),
    InjectedChange("lateral_acceleration_bias", "lateral_acceleration_bias", 0.25),
)
"""Settings that the library describes. Its roll_steer has the opposite sign (understeer +), and its backlash is that of
the road wheels. Only the multi-body cars have a bias of the yaw rate."""
BY_NAME = {hidden.library: hidden for hidden in KNOWN}

PLACE_DEPENDENT = (
    InjectedChange("friction_patch", None, 0.5, DOWN, factor=True),
    InjectedChange("terrain_wave", None, 0.06, UP),
    InjectedChange("hillside_slope", None, 0.05),
)
"""Changes that depend on the place. The slope exists at one of two sites; the library describes one at both."""
OUTSIDE_LIBRARY = (
    InjectedChange("gust_speed", None, 10.0, UP),
    InjectedChange("rear_roll_steer", None, 0.25),
    InjectedChange("camber_thrust", None, 1.0, UP),
)
"""Changes that no effect of the library describes, some of them almost (rear roll steer, camber thrust). The Ackermann
fraction is not included, because its effect on these drives is too small."""

SENSORS = ("yaw_rate_scale", "yaw_rate_bias", "speed_scale", "lateral_acceleration_bias", "sensor_lever_arm")
PHYSICS = ("steering_lag", "steering_delay", "steering_backlash", "steering_compliance", "roll_steer",
           "tyre_relaxation", "combined_slip", "lateral_load_transfer", "crosswind", "road_bank")
"""Up to two effects of each of these groups are present in block B, in addition to errors of the vehicle file."""

PLANT_DIFFERENCES: dict[str, dict[str, str]] = {
    "leaf": {
        "steering_lag": "the virtual car's steering has a lag of 40 ms, the model none",
        "steering_delay": "the steering angle is stamped 4 ms late; part of the lag acts like a delay",
        "steering_compliance": "compliance of the front wheels of 1.5e-6 rad/N",
        "roll_steer": "the front wheels steer by -3 % of the roll",
        "tyre_relaxation": "relaxation length of 0.4 m, in the model none",
        "lateral_load_transfer": "load moves to the outer wheels",
        "combined_slip": "friction ellipse at every wheel",
        "steered_drive_force": "front-wheel drive",
        "longitudinal_load_transfer": "the load transfer lags by 80 ms, as the pitch does",
        "steering_map": "the mean of both wheels' angles depends on the Ackermann split",
    },
    "multibody": {
        "lateral_load_transfer": "four wheels on springs",
        "longitudinal_load_transfer": "as above",
        "combined_slip": "its tyres weight longitudinal and lateral slip differently",
        "steered_drive_force": "drive and brakes also act at the steered wheels",
        "roll_steer": "camber and toe of its axles change with roll",
        "tyre_stiffness": "the tyres of the vehicle file only approximate its tyres",
        "front_stiffness": "as above",
        "rear_stiffness": "as above",
        "friction": "as above",
        "yaw_rate_scale": "the gyroscope rolls with the body, by up to 0.11 rad, and then reads 0.6 % low",
    },
}
"""Plant -> effect that the plant always has, but not the base model -> reason. Stating it is correct."""
SCATTER = ("heading_misalignment", "lateral_acceleration_bias", "yaw_rate_scale", "speed_scale")
"""Effects that every car has to some degree and that are not in a vehicle file. Stating one is correct if the interval
contains its true value; the same applies to residual errors of an identified file."""

# Effects whose value is the ratio of the settings of car and file ...
_QUOTIENTS = {"steering_ratio": "steering_ratio_factor", "front_stiffness": "front_stiffness_factor",
              "rear_stiffness": "rear_stiffness_factor", "friction": "friction_factor", "mass": "mass_factor",
              "yaw_inertia": "yaw_inertia_factor"}
# ... or their difference ...
_DIFFERENCES = {"cg_position": ("shift", "cg_shift"), "sensor_lever_arm": ("x", "ins_lever_error")}
# ... or the setting of the car, because a vehicle file does not contain it.
_TOTALS = {
    "steering_lag": ("time_constant", "steering_lag"), "steering_compliance": ("compliance", "steering_compliance"),
    "tyre_relaxation": ("length", "relaxation_length"), "combined_slip": ("share", "combined_slip"),
    "lateral_load_transfer": ("share", "lateral_load_transfer"), "road_bank": ("angle", "bank_angle"),
    "crosswind": ("wind_y", "wind_speed"), "road_slope": ("slope_y", "hillside_slope"),
    "heading_misalignment": ("angle", "ins_misalignment"), "yaw_rate_scale": ("factor", "yaw_rate_scale"),
    "yaw_rate_bias": ("bias", "yaw_rate_bias"), "speed_scale": ("factor", "velocity_scale"),
    "lateral_acceleration_bias": ("bias", "lateral_acceleration_bias"),
}


def true_values(car: Settings, file: Settings, vehicle: VehicleParameters) -> Values:
    """Effect -> {parameter: value} for a plant with the settings `car` and a vehicle file that assumes `file`.

    vehicle: the vehicle file. Effects of value zero are included, those without a setting are not.
    """
    ratio = car["steering_ratio_factor"] / file["steering_ratio_factor"]
    values = {name: {"factor": car[s] / file[s]} for name, s in _QUOTIENTS.items() if s in car}
    values |= {name: {p: car[s] - file[s]} for name, (p, s) in _DIFFERENCES.items() if s in car}
    values |= {name: {p: car[s]} for name, (p, s) in _TOTALS.items() if s in car}
    values["steering_offset"] = {"angle": car["steering_offset"] - file["steering_offset"] / ratio}
    values["steering_delay"] = {"time": car["steering_delay"] - car.get("steering_sensor_latency", 0.0)}
    values["steering_backlash"] = {"play": car["steering_backlash"] / (vehicle.steering_ratio * ratio)}
    if "roll_steer" in car:
        values["roll_steer"] = {"gradient": -car["roll_steer"] * car["roll_gradient"]}
    if "longitudinal_load_transfer" in car:
        excess = car["longitudinal_load_transfer"] - 1.0
        values["longitudinal_load_transfer"] = {"height": excess * vehicle.cg_height}
    return values


def null_value(effect: str, parameter: str) -> float:
    return next(p.null for p in get_effect(effect).parameters if p.name == parameter)


def members(name: str) -> tuple[str, ...]:
    """The effects of which a composite effect consists, or the effect itself."""
    return getattr(get_effect(name), "members", ()) or (name,)


def is_similar(first: str, second: str) -> bool:
    """Whether two effects are the same, one is a part of the other, or they are declared as confounded."""
    if first == second or first in members(second) or second in members(first):
        return True
    return second in get_effect(first).confounded_with or first in get_effect(second).confounded_with
