"""Settings of the virtual car with their null values, which describe an ideal car, and the reader of vehicle files.

Presets: `ideal`, the null values; `realistic`, a typical car. A file or `--effect name=value` changes single values.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from canedge_bridge.yaml_reader import read_document, read_text
from st_core.errors import ConfigurationError
from st_core.vehicle import VehicleParameters

Settings = Mapping[str, float]


def read_vehicle(path: Path) -> VehicleParameters:
    """The car of a vehicle file. Raises ConfigurationError naming file and key."""
    return VehicleParameters.from_yaml(read_text(path), str(path))


@dataclass(frozen=True)
class Setting:
    """One setting and its range. group: steering, tyre, body, environment (the plant), driver, ins or can (sensors)."""

    name: str
    group: str
    null: float
    low: float
    high: float
    unit: str
    meaning: str


_TABLE = (
    # From steering-wheel angle to mean road-wheel angle, both positive to the left.
    ("steering_ratio_factor", "steering", 1.0, 0.5, 2.0, "1", "true steering ratio relative to the vehicle file"),
    ("steering_offset", "steering", 0.0, -0.1, 0.1, "rad", "road-wheel angle with a straight steering wheel"),
    ("steering_delay", "steering", 0.0, 0.0, 0.5, "s", "dead time from steering wheel to rack"),
    ("steering_lag", "steering", 0.0, 0.0, 0.5, "s", "first-order lag from steering wheel to rack"),
    ("steering_backlash", "steering", 0.0, 0.0, 0.3, "rad", "total play, at the steering wheel"),
    ("steering_compliance", "steering", 0.0, 0.0, 1e-5, "rad/N", "loss of road-wheel angle per front lateral force"),
    ("roll_steer", "steering", 0.0, -0.5, 0.5, "1", "front steer (left) over roll angle (right); < 0: understeer"),
    ("rear_roll_steer", "steering", 0.0, -0.5, 0.5, "1", "rear steer (left) over roll angle (right); > 0: understeer"),
    ("ackermann", "steering", 1.0, -0.5, 1.5, "1", "fraction of the full Ackermann angle; 0: parallel wheels"),
    ("front_stiffness_factor", "tyre", 1.0, 0.2, 4.0, "1", "factor on the cornering stiffness of the front tyres"),
    ("rear_stiffness_factor", "tyre", 1.0, 0.2, 4.0, "1", "factor on the cornering stiffness of the rear tyres"),
    ("friction_factor", "tyre", 1.0, 0.05, 2.0, "1", "factor on the peak force of all tyres"),
    ("relaxation_length", "tyre", 0.0, 0.0, 2.0, "m", "distance rolled until the force reaches 63 % of a step"),
    ("combined_slip", "tyre", 0.0, 0.0, 1.0, "1", "reduction of F_y by F_x; 1: friction ellipse, 0: none"),
    ("wheel_slip_compliance", "tyre", 0.0, 0.0, 0.2, "1", "longitudinal slip per F_x / F_z, in wheel speeds only"),
    ("camber_thrust", "tyre", 0.0, -2.0, 2.0, "1/rad", "outward lateral force per load and body roll"),
    ("lateral_load_transfer", "body", 0.0, 0.0, 2.0, "1", "fraction of m a_y h / track"),
    ("longitudinal_load_transfer", "body", 1.0, 0.0, 2.0, "1", "fraction of m a_x h / wheelbase"),
    ("roll_gradient", "body", 0.0, 0.0, 0.03, "rad s^2/m", "body roll per lateral acceleration"),
    ("pitch_gradient", "body", 0.0, 0.0, 0.03, "rad s^2/m", "body pitch per longitudinal acceleration"),
    ("mass_factor", "body", 1.0, 0.5, 2.0, "1", "factor on the mass"),
    ("yaw_inertia_factor", "body", 1.0, 0.5, 2.0, "1", "factor on the yaw inertia"),
    ("cg_shift", "body", 0.0, -0.5, 0.5, "m", "distance of the CG ahead of that in the file; the INS does not move"),
    ("drive_offset", "body", 0.0, -0.5, 0.5, "m", "distance of drive and brake force to the right of the CG"),
    ("drag_area", "body", 0.0, 0.0, 2.0, "m^2", "drag coefficient times frontal area"),
    ("rolling_resistance", "body", 0.0, 0.0, 0.1, "1", "rolling resistance per wheel load"),
    # Road and air.
    ("bank_angle", "environment", 0.0, -0.3, 0.3, "rad", "constant bank of the road, rising to the left of the car"),
    ("grade_angle", "environment", 0.0, -0.3, 0.3, "rad", "constant grade of the road, rising ahead of the car"),
    ("hillside_slope", "environment", 0.0, -0.3, 0.3, "rad", "slope of the ground, a plane that rises to the north"),
    ("terrain_wave", "environment", 0.0, 0.0, 0.2, "rad", "maximum slope of waves of 80 m along x (east)"),
    ("friction_patch", "environment", 1.0, 0.1, 2.0, "1", "friction factor on the first 10 m of every 40 m of x"),
    ("wind_speed", "environment", 0.0, -40.0, 40.0, "m/s", "steady wind, towards north"),
    ("gust_speed", "environment", 0.0, 0.0, 20.0, "m/s", "standard deviation of gusts, correlated over 1.5 s"),
    ("driver_tremor", "driver", 0.0, 0.0, 0.2, "rad", "standard deviation of random steering, at the steering wheel"),
    # INS. ins_noise 1: RT3000 with RTK on a normal road.
    ("ins_noise", "ins", 0.0, 0.0, 10.0, "1", "factor on the noise of the unit"),
    ("ins_latency", "ins", 0.0, 0.0, 0.5, "s", "delay from measurement to datagram; the stamp is not affected"),
    ("ins_time_error", "ins", 0.0, -0.5, 0.5, "s", "error added to the time stamp"),
    ("ins_misalignment", "ins", 0.0, -0.1, 0.1, "rad", "heading error of the unit, positive to the left"),
    ("ins_lever_error", "ins", 0.0, -1.0, 1.0, "m", "distance of the unit ahead of its position in the file"),
    ("yaw_rate_scale", "ins", 1.0, 0.8, 1.2, "1", "factor on the measured angular rates"),
    ("velocity_scale", "ins", 1.0, 0.8, 1.2, "1", "factor on the measured horizontal velocity"),
    ("lateral_acceleration_bias", "ins", 0.0, -2.0, 2.0, "m/s^2", "error added to the measured lateral acceleration"),
    ("ins_packet_loss", "ins", 0.0, 0.0, 0.9, "1", "fraction of datagrams lost"),
    ("ins_outage_every", "ins", 0.0, 0.0, 3600.0, "s", "period of outages of 1 s; 0: none"),
    ("steering_sensor_noise", "can", 0.0, 0.0, 0.1, "rad", "standard deviation at the steering wheel, before rounding"),
    ("steering_sensor_latency", "can", 0.0, 0.0, 0.5, "s", "delay from sample to frame"),
    ("wheel_speed_scale", "can", 1.0, 0.8, 1.2, "1", "factor on the four wheel speeds"),
    ("can_frame_loss", "can", 0.0, 0.0, 0.9, "1", "fraction of frames lost; counters continue"),
    ("can_outage_every", "can", 0.0, 0.0, 3600.0, "s", "period of outages of 1 s; 0: none"),
    ("logger_clock_offset", "can", 0.0, -10.0, 10.0, "s", "lead of the logger clock over UTC, in files only"),
    ("logger_clock_drift", "can", 0.0, -1e-3, 1e-3, "1", "rate error of the logger clock, in files only"),
)

SETTINGS: Mapping[str, Setting] = MappingProxyType({row[0]: Setting(*row) for row in _TABLE})

IDEAL: Settings = MappingProxyType({s.name: s.null for s in SETTINGS.values()})

# The models of the paper have errors like those with the real car in S3, S4 and S7 (test_pattern.py) with these values.
# The front axle stiffness of the file includes compliance, roll steer and load transfer; tyres alone are stiffer.
REALISTIC: Settings = MappingProxyType({
    **IDEAL, "steering_lag": 0.04, "steering_compliance": 1.5e-6, "roll_steer": -0.03, "ackermann": 0.6,
    "front_stiffness_factor": 1.35, "friction_factor": 1.12, "relaxation_length": 0.4, "combined_slip": 1.0,
    "wheel_slip_compliance": 0.04, "lateral_load_transfer": 1.0, "roll_gradient": 0.0075, "pitch_gradient": 0.004,
    "drag_area": 0.65, "rolling_resistance": 0.011, "driver_tremor": 0.01, "ins_noise": 1.0, "ins_latency": 0.004,
    "steering_sensor_latency": 0.004, "steering_sensor_noise": 0.0005})

PRESETS: Mapping[str, Settings] = MappingProxyType({"ideal": IDEAL, "realistic": REALISTIC})


def resolve_settings(plant: str, effects: Iterable[str] = ()) -> dict[str, float]:
    """All settings. plant: a preset, or a YAML file {preset: realistic, name: value, ...} (default preset: ideal).
    effects: "name=value" of settings to change. Raises ConfigurationError."""
    settings = dict(PRESETS[plant]) if plant in PRESETS else _read_file(Path(plant))
    for effect in effects:
        name, equals, text = effect.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not equals or math.isnan(value):
            raise ConfigurationError(f"--effect {effect}: must be name=value with a number")
        settings[name] = _check_value(name, value, "--effect")
    return settings


def find_overrides(settings: Settings) -> dict[str, float]:
    """Settings that differ from their null values."""
    return {name: value for name, value in settings.items() if value != SETTINGS[name].null}


def _read_file(path: Path) -> dict[str, float]:
    if not path.is_file():
        raise ConfigurationError(f"--plant {path}: not a file, and not a preset ({', '.join(PRESETS)})")
    document = read_document(path)
    if not isinstance(document, dict):
        raise ConfigurationError(f"{path}: not a mapping of settings to values")
    preset = document.pop("preset", "ideal")
    if not isinstance(preset, str) or preset not in PRESETS:
        raise ConfigurationError(f"{path}: preset: {preset!r} is not one of {', '.join(PRESETS)}")
    return {**PRESETS[preset], **{name: _check_value(name, value, str(path)) for name, value in document.items()}}


def _check_value(name: str, value: object, origin: str) -> float:
    setting = SETTINGS.get(name)
    if setting is None:
        raise ConfigurationError(f"{origin}: {name}: unknown setting; choose one of {', '.join(SETTINGS)}")
    if isinstance(value, bool) or not isinstance(value, int | float) or not setting.low <= value <= setting.high:
        unit = "" if setting.unit == "1" else f" {setting.unit}"
        raise ConfigurationError(f"{origin}: {name}: {value!r} is not within {setting.low:g} to {setting.high:g}{unit}")
    return float(value)
