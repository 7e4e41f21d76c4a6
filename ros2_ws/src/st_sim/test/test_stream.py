"""NCOM packets and CAN frames of the virtual car, decoded by the bridges and compared with the truth."""

import math
from functools import cache

import can
import numpy as np
import pytest
from canedge_bridge.decode import Decoder
from canedge_bridge.ins_time import replace_gps_time
from oxts_bridge.channels import decode_channel
from oxts_bridge.geometry import LocalFrame
from oxts_bridge.stream import NcomParser
from st_sim.driver import SimulatedCar
from st_sim.encoders import (
    CYCLE_LENGTH,
    INS_BUS,
    UNDULATION,
    VEHICLE_BUS,
    CanEncoder,
    NcomEncoder,
    Origin,
    from_ecef,
    make_schedule,
    to_ecef,
)
from st_sim.plant import Truth
from st_sim.scenarios import load_plan
from st_sim.sensors import Ins, SteeringSensor
from st_sim.settings import read_vehicle, resolve_settings
from st_sim.stream import Stream
from support import LEAF, ROOT

CAR = read_vehicle(LEAF)
START_NS = 1_756_900_832_000_000_000  # 10 s before a full minute of GPS, so that a drive crosses it
ORIGIN = Origin(51.448, 5.49, 65.0)
FRAME = LocalFrame(math.radians(51.448), math.radians(5.49), 65.0)


def codec():
    return Decoder(ROOT / "config/can/leaf_ze0.dbc", ROOT / "config/can/leaf_ze0.yaml")


@cache
def outputs(seconds, effects=(), scenario="S6", plant="ideal", rate=100, seed=0, **options):
    settings = resolve_settings(plant, effects)
    car = SimulatedCar(CAR, settings, load_plan(scenario), seed)
    stream = Stream(car, settings, Ins(CAR, settings, 1 / rate, seed), SteeringSensor(CAR, settings, seed),
                    NcomEncoder(ORIGIN, START_NS, rate), CanEncoder(codec(), ORIGIN, START_NS), rate, seed, **options)
    return list(stream.generate_outputs(seconds))


def select(kind, emitted):
    return [o for o in emitted if isinstance(o.payload, kind)]


def parse(emitted):
    parser = NcomParser()
    received = [r for o in select(bytes, emitted) for r in parser.feed(o.payload)]
    return received, parser


def truths(seconds, scenario="S6", rate=100):
    car = SimulatedCar(CAR, resolve_settings("ideal"), load_plan(scenario))
    found = []
    for i in range(seconds * rate):
        car.advance(i / rate)
        found.append(car.make_truth())
    return found


@pytest.mark.slow
@pytest.mark.parametrize("rate", [100, 250])
def test_ncom_equals_the_truth_within_its_resolution(rate):
    """S7 without noise: a wide range of speed, and turns to both sides."""
    received, parser = parse(outputs(12, scenario="S7", rate=rate))
    expected = truths(12, "S7", rate)
    assert len(received) == len(expected) == 12 * rate
    assert parser.counters.skipped_bytes == parser.counters.inner_checksum_warnings == 0
    for i, (r, t) in enumerate(zip(received, expected, strict=True)):
        p = r.packet
        x, y, vx, vy = t.motion_at(-0.398, 0.0)
        assert FRAME.to_enu(p.latitude, p.longitude, p.altitude + UNDULATION) == pytest.approx((x, y, 0.0), abs=2e-5)
        yaw = math.pi / 2 - p.heading
        assert math.remainder(yaw - t.yaw, 2 * math.pi) == pytest.approx(0.0, abs=6e-7)
        north, east, down = p.velocity_ned
        forward, left = math.cos(yaw) * east + math.sin(yaw) * north, math.cos(yaw) * north - math.sin(yaw) * east
        assert (forward, left, down) == pytest.approx((vx, vy, 0.0), abs=2e-4)
        ax, ay = t.acceleration_at(-0.398, 0.0)
        assert p.acceleration == pytest.approx((ax, -ay, -9.81), abs=6e-5)
        assert p.angular_rate == pytest.approx((0.0, 0.0, -t.yaw_rate), abs=6e-6)
        assert (p.pitch, p.roll, p.navigation_status) == (0.0, 0.0, 4)
        assert r.utc_ns == START_NS + i * 1_000_000_000 // rate


def test_ncom_of_a_tilted_car():
    """Roll includes body and road; levelled by roll, the specific force equals the lateral acceleration."""
    emitted = outputs(3, ("bank_angle=0.05", "roll_gradient=0.0075"), scenario="S3")
    received, _ = parse(emitted)
    truth = select(Truth, emitted)[200].payload
    packet = received[200].packet
    assert packet.roll == pytest.approx(truth.roll, abs=1e-6) and truth.roll > 0.06
    across, lift = -packet.acceleration[1], -packet.acceleration[2]
    level = across * math.cos(packet.roll) - lift * math.sin(packet.roll)
    assert level == pytest.approx(truth.acceleration_at(-0.398, 0.0)[1], abs=0.01)


def test_status_channels_have_the_schedule_of_a_real_unit():
    slots = make_schedule()
    places = {channel: [i for i in range(CYCLE_LENGTH) if slots[i] == channel] for channel in set(slots)}
    assert all(np.diff(places[1]) == 10) and np.diff(places[0]).max() <= 10
    for channel in (3, 4, 5, 20, 24, 43, 65, 66, 67):
        assert all(np.diff(places[channel]) == 50)
    for channel in range(57):
        assert channel == 25 or channel in places, channel
    for channel in (16, 23, 40, 48):
        assert all(np.diff(places[channel]) == 100)


def test_status_matches_the_drive():
    received, _ = parse(outputs(12))
    fields = {}
    for r in received:
        fields.update(decode_channel(r.packet.channel, r.packet.batch_s))
    assert fields["TimeUtcOffset"] == -18
    assert fields["NorthAcc"] == pytest.approx(0.01) and fields["HeadingAcc"] == pytest.approx(math.degrees(0.001))
    assert (fields["RefLat"], fields["RefLon"]) == pytest.approx((51.448, 5.49), abs=1e-9)
    assert fields["RefAlt"] == pytest.approx(65.0 - UNDULATION) and fields["RefHeading"] == pytest.approx(90.0)
    assert fields["Undulation"] == pytest.approx(UNDULATION)
    assert fields["GpsPosMode"] == 6 and 1000 <= fields["UpTimeCode"] < 10800
    assert fields["SerialNumber"] == fields["SerialNumber24"]
    assert all(abs(fields[f"InnPos{a}"]) <= 0.5 for a in "XYZ")


def test_antenna_lever_arm_is_constant_once_known():
    received, _ = parse(outputs(12))
    fields, known = {}, False
    for r in received:
        fields.update(decode_channel(r.packet.channel, r.packet.batch_s))
        known = known or "GAPx" in fields
        assert not known or fields["GAPx"] == pytest.approx(0.35)
    assert known and fields["ImuTemperature"] == pytest.approx(38.5) and fields["NtripStatus"] == 6


@pytest.mark.slow
def test_starting_unit_passes_through_its_states():
    emitted = outputs(30, start_up=True)
    received, parser = parse(emitted)
    due = [o.due for o in select(bytes, emitted)]
    status = np.array([r.packet.navigation_status for r in received])
    assert [s for i, s in enumerate(status) if i == 0 or s != status[i - 1]] == [0, 1, 2, 3, 4]
    assert (status <= 1).sum() == 20 and all(r.utc_ns is None for r in received[:20])
    timed = [(r, d) for r, d in zip(received, due, strict=True) if r.utc_ns]
    behind = {
        s: [d - (r.utc_ns - START_NS) / 1e9 for r, d in timed if r.packet.navigation_status == s] for s in (2, 3, 4)
    }
    assert behind[2] == pytest.approx([1.0] * len(behind[2]))
    # The delay decreases by 0.1 s per second: 11 s of the drive in 10 s.
    assert behind[3][0] == pytest.approx(1.0) and behind[3][-1] == pytest.approx(0.0, abs=0.01)
    assert due[int(np.argmax(status == 4))] - due[int(np.argmax(status == 3))] == pytest.approx(10.0, abs=0.05)
    assert max(map(abs, behind[4])) < 1e-9
    assert parser.counters.skipped_bytes == 0


def test_can_equals_the_truth_within_its_resolution():
    decoder = codec()
    expected = {round(t.time * 500): t for t in truths(12, "S6", 500)}
    seen = {}
    for o in select(can.Message, outputs(12)):
        decoded = decoder.decode(o.payload, START_NS + round(o.due * 1e9))
        if decoded is None:
            # 0x421 and 0x601: in the DBC, but not used by the suite.
            assert o.payload.arbitration_id in (0x421, 0x601)
            continue
        assert decoded.valid
        seen.setdefault(decoded.message, []).append(o.due)
        t = expected[int(o.due * 500 + 1e-6)]
        v = decoded.values
        if decoded.message == "Leaf_Steering":
            assert o.payload.channel == VEHICLE_BUS
            degrees = math.degrees(t.steering_wheel_angle) - 2.7
            assert math.degrees(v["steering_wheel_angle"]) == pytest.approx(degrees, abs=0.0501)
            back = (v["steering_wheel_angle"] - CAR.steering_wheel_offset) / CAR.steering_ratio
            assert back == pytest.approx(t.road_wheel_angle, abs=1e-4)
        elif decoded.message == "Leaf_WheelSpeedFront":
            found = v["wheel_speed_front_left"], v["wheel_speed_front_right"], v["vehicle_speed"]
            assert found == pytest.approx((*t.wheel_speed[:2], t.velocity_x), abs=0.0015)
        elif decoded.message == "RT_IsoVsVelocity":
            # Measured at the epoch, sent 1.5 ms and eight frames later.
            t = expected[int(o.due * 100) * 5]
            assert o.payload.channel == INS_BUS
            x = t.motion_at(-0.398, 0.0)
            assert (v["ins_velocity_x"], v["ins_velocity_y"]) == pytest.approx((x[2], x[3]), abs=0.0051)
        elif decoded.message == "RT_HeadingPitchRoll":
            t = expected[int(o.due * 100) * 5]
            assert math.remainder(v["ins_yaw"] - t.yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-4)
        elif decoded.message == "RT_RateVehicle":
            t = expected[int(o.due * 100) * 5]
            assert v["ins_yaw_rate"] == pytest.approx(t.yaw_rate, abs=1e-4)
        elif decoded.message == "RT_MilliTime":
            due = START_NS / 1e9 + int(o.due * 100) / 100
            assert replace_gps_time(v)["ins_unix_time"] == pytest.approx(due, abs=1e-6)
    rates = {name: len(times) / 12 for name, times in seen.items()}
    assert rates["Leaf_Steering"] == 100 and rates["Leaf_WheelSpeedFront"] == rates["Leaf_WheelSpeedRear"] == 50
    assert {rates[m] for m in rates if m.startswith("RT_")} == {100.0}
    assert len([m for m in rates if m.startswith("RT_")]) == 7


def test_bus_traffic_has_the_rates_of_the_car_and_the_ins():
    ids = [o.payload.arbitration_id for o in select(can.Message, outputs(2, background=True))]
    car = [i for i in ids if not 0x600 <= i <= 0x608 and not 0x630 <= i <= 0x634]
    # 0x60D is traffic of the car, although it is in the identifier range of the INS.
    assert len(car) / 2 == pytest.approx(1750, rel=0.02)  # as in a recorded Leaf
    assert len(ids) - len(car) == 2 * 100 * 8
    decoded = {key[0] for key in codec().keys} | {0x421, 0x601}
    assert {0x002, 0x284, 0x285, 0x421} <= set(car) and len(set(ids) - decoded) >= 20


def test_outputs_are_sorted_and_delayed():
    emitted = outputs(2, ("ins_latency=0.02", "steering_sensor_latency=0.03"))
    assert [o.due for o in emitted] == sorted(o.due for o in emitted)
    received, _ = parse(emitted)
    delays = [o.due - (r.utc_ns - START_NS) / 1e9 for o, r in zip(select(bytes, emitted), received, strict=True)]
    assert delays == pytest.approx([0.02] * len(delays))
    first = next(o for o in select(can.Message, emitted) if o.payload.arbitration_id == 2)
    assert first.due == pytest.approx(0.002 + 0.03)


@pytest.mark.slow
def test_losses_leave_countable_gaps():
    emitted = outputs(8, ("ins_packet_loss=0.1", "can_frame_loss=0.1", "ins_outage_every=5"))
    times = [(r.utc_ns - START_NS) / 1e9 for r in parse(emitted)[0] if r.utc_ns]
    assert not [t for t in times if 5.0 <= t < 6.0] and times[-1] > 7.9
    assert len(times) == pytest.approx(0.9 * 700, rel=0.05)
    decoder = codec()
    for o in select(can.Message, emitted):
        decoder.decode(o.payload, START_NS + round(o.due * 1e9))
    statistics = decoder.statistics("Leaf_Steering")
    assert statistics.lost == pytest.approx(80, abs=25) and statistics.wrong_checksum == 0


def test_time_error_changes_the_stamps_only():
    plain, _ = parse(outputs(1))
    wrong, _ = parse(outputs(1, ("ins_time_error=0.04",)))
    assert {w.utc_ns - p.utc_ns for p, w in zip(plain, wrong, strict=True)} == {40_000_000}
    assert [w.packet.velocity_ned for w in wrong] == [p.packet.velocity_ned for p in plain]


def test_minute_of_every_packet_is_current():
    """Channel 0 directly after a full minute contains the new minute."""
    received, _ = parse(outputs(12))
    after = [r for r in received if r.packet.milliseconds < 200 and r.packet.channel == 0]
    assert after
    for r in after:
        minutes = decode_channel(0, r.packet.batch_s)["GpsMinutes"]
        assert minutes * 60_000 + r.packet.milliseconds == r.gps_ns // 1_000_000


# Geodesy: against the independent conversion of the bridge and radii of curvature.

@pytest.mark.parametrize("point", [(0.0, 0.0, 0.0), (100.0, -50.0, 2.0), (-3000.0, 8000.0, 30.0), (20000.0, 1.0, -5.0)])
def test_geodetic_conversion_is_inverse_to_that_of_the_bridge(point):
    assert FRAME.to_enu(*ORIGIN.to_geodetic(*point)) == pytest.approx(point, abs=1e-6)


def test_short_distances_agree_with_the_radii_of_curvature():
    sine = math.sin(math.radians(51.448))
    e2 = 0.00669437999014
    normal = 6378137.0 / math.sqrt(1 - e2 * sine**2)
    meridian = normal * (1 - e2) / (1 - e2 * sine**2)
    latitude, longitude, height = ORIGIN.to_geodetic(1.0, 1.0, 0.0)
    assert latitude - math.radians(51.448) == pytest.approx(1.0 / (meridian + 65.0), rel=1e-6)
    assert longitude - math.radians(5.49) == pytest.approx(
        1.0 / (normal + 65.0) / math.cos(math.radians(51.448)), rel=1e-6
    )
    assert height == pytest.approx(65.0, abs=1e-6)


@pytest.mark.parametrize("latitude", [-89.0, -37.5, 0.0, 12.0, 51.4, 88.9])
@pytest.mark.parametrize("height", [-50.0, 0.0, 3000.0])
def test_earth_fixed_round_trip(latitude, height):
    back = from_ecef(*to_ecef(math.radians(latitude), 2.1, height))
    assert back[0] == pytest.approx(math.radians(latitude), abs=1e-12)
    assert back[1] == pytest.approx(2.1, abs=1e-12) and back[2] == pytest.approx(height, abs=1e-6)
