"""Effects of the models against those of the virtual car, which has its own equations: same sign and size.

Each drive has one effect in the plant or its sensors. With the same effect at the same value, the error of the model
decreases to that of the healthy car.
"""

from functools import cache

import numpy as np
import pytest
from st_core.augmented import augment
from st_core.batch import LogBatch
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_sim.driver import SimulatedCar
from st_sim.scenarios import load_plan
from st_sim.sensors import Ins, SteeringSensor
from st_sim.settings import IDEAL, read_vehicle
from support import LEAF as LEAF_FILE

LEAF = VehicleParameters.from_yaml(LEAF_FILE.read_text())
CAR = read_vehicle(LEAF_FILE)
# An effect that the virtual car always has and the models of the paper do not.
BASELINE_EFFECTS = {"steered_drive_force": {"share": 1.0}}
PERIOD_NS = 10_000_000

# scenario, settings of the plant, effect, its values, maximum share of the error that may remain
CASES = [
    ("sweep", {"steering_ratio_factor": 1.07}, "steering_ratio", {"factor": 1.07}, 0.1),
    ("sweep", {"steering_offset": 0.006}, "steering_offset", {"angle": 0.006}, 0.1),
    ("sweep", {"steering_delay": 0.08}, "steering_delay", {"time": 0.08}, 0.1),
    ("sweep", {"steering_lag": 0.1}, "steering_lag", {"time_constant": 0.1}, 0.1),
    ("sweep", {"steering_backlash": 0.1}, "steering_backlash", {"play": 0.1 / CAR.steering_ratio}, 0.1),
    ("sweep", {"steering_compliance": 2e-6}, "steering_compliance", {"compliance": 2e-6}, 0.1),
    ("sweep", {"roll_steer": -0.1, "roll_gradient": 0.0075}, "roll_steer", {"gradient": 0.1 * 0.0075}, 0.2),
    ("sweep", {"front_stiffness_factor": 0.85}, "front_stiffness", {"factor": 0.85}, 0.1),
    ("sweep", {"rear_stiffness_factor": 0.85}, "rear_stiffness", {"factor": 0.85}, 0.1),
    ("sweep", {"relaxation_length": 0.4}, "tyre_relaxation", {"length": 0.4}, 0.2),
    ("sweep", {"mass_factor": 1.18}, "mass", {"factor": 1.18}, 0.1),
    ("sweep", {"yaw_inertia_factor": 1.22}, "yaw_inertia", {"factor": 1.22}, 0.15),
    ("sweep", {"cg_shift": 0.1}, "cg_position", {"shift": 0.1}, 0.15),
    ("sweep", {"bank_angle": 0.03}, "road_bank", {"angle": 0.03}, 0.1),
    ("sweep", {"wind_speed": 15.0}, "crosswind", {"wind_x": 0.0, "wind_y": 15.0}, 0.1),
    ("sweep", {"ins_lever_error": 0.3}, "sensor_lever_arm", {"x": 0.3, "y": 0.0}, 0.2),
    ("sweep", {"ins_misalignment": 0.02}, "heading_misalignment", {"angle": 0.02}, 0.1),
    ("sweep", {"yaw_rate_scale": 1.08}, "yaw_rate_scale", {"factor": 1.08}, 0.3),
    ("sweep", {"velocity_scale": 1.03}, "speed_scale", {"factor": 1.03}, 0.2),
    ("brake_in_turn", {"friction_factor": 0.75}, "friction", {"factor": 0.75}, 0.5),
    ("brake_in_turn", {"combined_slip": 1.0}, "combined_slip", {"share": 1.0}, 0.4),
    ("brake_in_turn", {"lateral_load_transfer": 1.0}, "lateral_load_transfer", {"share": 1.0}, 0.2),
    ("brake_in_turn", {"longitudinal_load_transfer": 2.0}, "longitudinal_load_transfer",
     {"height": CAR.cg_height}, 0.6),
]
DURATION = {"sweep": 14.0, "brake_in_turn": 20.0}  # s


@cache
def drive(scenario: str, settings: tuple[tuple[str, float], ...]) -> DriveLog:
    """The recording of sensors without noise and rounding."""
    settings = {**IDEAL, **dict(settings)}
    car = SimulatedCar(CAR, settings, load_plan(scenario), seed=1)
    ins, steering = Ins(CAR, settings, 0.01, 1), SteeringSensor(CAR, settings, 1)
    rows, angles = [], []
    for k in range(round(DURATION[scenario] * 1e9 / PERIOD_NS)):
        car.advance(k * PERIOD_NS * 1e-9)
        truth = car.make_truth()
        r = ins.read(truth)
        rows.append((r.x, r.y, r.yaw, r.velocity_x, r.velocity_y, r.rates[2]))
        angles.append(LEAF.road_wheel_angle(steering.read(truth)))
    x, y, yaw, velocity_x, velocity_y, yaw_rate = np.array(rows).T
    time_ns = PERIOD_NS * np.arange(len(rows), dtype=np.int64)
    return DriveLog(scenario, time_ns, x, y, np.unwrap(yaw), velocity_x, velocity_y, yaw_rate, time_ns,
                    np.array(angles))


def lateral_error(log: DriveLog, effects: dict) -> float:
    """RMS lateral error over a horizon of 2 s [m]."""
    starts = np.arange(1_000_000_000, int(log.ins_time_ns[-1]) - 2_100_000_000, 100_000_000)
    batch = LogBatch(log, starts, 2.0, backend="numpy")
    errors = batch.errors(augment("nonlinear", {**BASELINE_EFFECTS, **effects}), LEAF)
    assert np.isfinite(errors).all()
    return float(np.sqrt(np.square(errors[..., 1]).mean()))


@pytest.mark.slow
@pytest.mark.parametrize(("scenario", "settings", "effect", "values", "max_ratio"), CASES, ids=[c[2] for c in CASES])
def test_effect_reduces_the_error_to_that_of_the_healthy_car(scenario, settings, effect, values, max_ratio):
    log = drive(scenario, tuple(settings.items()))
    before, after = lateral_error(log, {}), lateral_error(log, {effect: values})
    assert after < max_ratio * before
    assert after < lateral_error(drive(scenario, ()), {}) + 0.003


@pytest.mark.slow
def test_steered_drive_force_reduces_the_error_of_braking_in_a_turn():
    log = drive("brake_in_turn", ())
    batch = LogBatch(log, np.arange(1_000_000_000, 17_000_000_000, 100_000_000), 2.0, backend="numpy")
    errors = [batch.errors(model, LEAF)[..., 1] for model in ("nonlinear", augment("nonlinear", BASELINE_EFFECTS))]
    rms = [float(np.sqrt(np.square(e).mean())) for e in errors]
    assert rms[1] < 0.2 * rms[0]
