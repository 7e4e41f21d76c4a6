"""A recorded drive as the source of the simulated sensors."""

import math

import numpy as np
import pytest
from oxts_bridge.geometry import LocalFrame
from oxts_bridge.stream import NcomParser
from st_core.errors import ConfigurationError
from st_sim import run
from st_sim.encoders import UNDULATION
from st_sim.recorded_drive import COLUMNS, RecordedDrive
from st_sim.settings import read_vehicle
from support import EXAMPLES, ROOT

GENESIS = ROOT / "config/vehicle/hyundai_genesis.yaml"
CAR = read_vehicle(GENESIS)
HEADER = ",".join(COLUMNS)


def write_rows(tmp_path, rows):
    file = tmp_path / "drive.csv"
    file.write_text(HEADER + "\n" + "\n".join(",".join(map(str, row)) for row in rows) + "\n")
    return file


def test_values_are_interpolated_linearly(tmp_path):
    # Yaw passes from just below pi to just above -pi between the rows.
    a = [5.0, 0.0, 0.0, 3.1, 8.0, 0.1, 0.4, 0.2, 3.0, 0.05]
    b = [5.1, -0.8, 0.1, -3.1, 9.0, 0.3, 0.6, 0.4, 5.0, 0.07]
    drive = RecordedDrive(write_rows(tmp_path, [a, b]), CAR)
    assert drive.duration == pytest.approx(0.1)
    drive.advance(0.025)
    t = drive.make_truth()
    assert (t.x, t.y, t.velocity_x, t.velocity_y) == pytest.approx((-0.2, 0.025, 8.25, 0.15))
    assert (t.yaw_rate, t.acceleration_x, t.acceleration_y) == pytest.approx((0.45, 0.25, 3.5))
    assert t.yaw == pytest.approx(3.1 + 0.25 * (2 * math.pi - 6.2))
    assert t.road_wheel_angle == pytest.approx(0.055)
    assert t.steering_wheel_angle == pytest.approx(0.055 * CAR.steering_ratio)
    assert t.wheel_speed == pytest.approx((8.25,) * 4)
    drive.advance(7.0)
    assert drive.make_truth().velocity_x == pytest.approx(9.0)


@pytest.mark.slow
def test_real_drive_is_encoded_as_recorded(tmp_path):
    file = EXAMPLES / "rfs_turn_a.csv"
    arguments = ["--drive", str(file), "--vehicle", str(GENESIS), "--to-files", str(tmp_path), "--ncom-rate", "250"]
    assert run.main(arguments) == 0
    table = np.genfromtxt(file, delimiter=",", names=True)
    received = NcomParser().feed((tmp_path / "run.ncom").read_bytes())
    time = np.array([(r.utc_ns - received[0].utc_ns) / 1e9 for r in received])
    assert time[-1] == pytest.approx(table["t"][-1], abs=0.005) and np.diff(time) == pytest.approx(0.004)
    frame = LocalFrame(math.radians(51.448), math.radians(5.49), 65.0)
    position = np.array(
        [frame.to_enu(r.packet.latitude, r.packet.longitude, r.packet.altitude + UNDULATION) for r in received]
    )
    for i, name in enumerate(("x", "y")):
        assert position[:, i] == pytest.approx(np.interp(time, table["t"], table[name]), abs=2e-5)
    yaw = np.unwrap([math.pi / 2 - r.packet.heading for r in received])
    yaw += 2 * math.pi * round((table["yaw"][0] - yaw[0]) / 2 / math.pi)
    assert yaw == pytest.approx(np.interp(time, table["t"], table["yaw"]), abs=1e-6)
    north, east, _ = np.array([r.packet.velocity_ned for r in received]).T
    assert np.cos(yaw) * east + np.sin(yaw) * north == pytest.approx(np.interp(time, table["t"], table["vx"]), abs=2e-4)
    assert np.cos(yaw) * north - np.sin(yaw) * east == pytest.approx(np.interp(time, table["t"], table["vy"]), abs=2e-4)
    rates = np.array([-r.packet.angular_rate[2] for r in received])
    assert rates == pytest.approx(np.interp(time, table["t"], table["yaw_rate"]), abs=1e-5)


VALID_ROWS = "0,0,0,0,5,0,0,0,0,0\n0.02,0.1,0,0,5,0,0,0,0,0\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t,x,y\n0,0,0\n", "column yaw is missing"),
        (f"{HEADER}\n{VALID_ROWS}0.04,a,0,0,5,0,0,0,0,0\n", "line 4"),
        (f"{HEADER}\n{VALID_ROWS}0.04,0,0\n", "line 4"),
        (f"{HEADER}\n{VALID_ROWS}0.04,nan,0,0,5,0,0,0,0,0\n", "line 4: not all of t, x, y"),
        (f"{HEADER}\n{VALID_ROWS}0.01,0,0,0,5,0,0,0,0,0\n", "line 4: t does not increase"),
        (f"{HEADER}\n{VALID_ROWS}\n\n0.01,0,0,0,5,0,0,0,0,0\n", "line 6: t does not increase"),
        (f"{HEADER}\n0,0,0,0,5,0,0,0,0,0\n", "at least 2 rows are required, not 1"),
        ("", "column t is missing"),
        ("\udcff\udcfe", "not a CSV file"),
    ],
)
def test_invalid_drive_is_rejected_with_its_name(tmp_path, text, message):
    file = tmp_path / "drive.csv"
    file.write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(ConfigurationError, match=r"^[^\n]*drive\.csv[^\n]*$") as caught:
        RecordedDrive(file, CAR)
    assert message in str(caught.value)
