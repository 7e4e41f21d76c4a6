"""Status from its channels; trigger events; motion; the origin of the map."""

import math

import pytest
from oxts_bridge.channels import encode_channel
from oxts_bridge.motion import (
    FIRST_FIX,
    GIVEN,
    LOCAL_FRAME_TIMEOUT_NS,
    UNIT,
    Accuracy,
    Origin,
    compute_variances,
    extract_motion,
)
from oxts_bridge.ncom import describe_mode, get_fix_status, rank_mode
from oxts_bridge.status import StatusTracker
from oxts_bridge.stream import NcomParser
from trigger_bytes import encode_trigger

START = 24_015_600 * 60_000 + 1_000  # GPS time [ms]


def test_counters_are_unwrapped():
    status = StatusTracker()
    for sent in (65_000, 100, 100, 65_535, 0):
        status.update(2, encode_channel(2, {"GpsPrimary.Chars": sent, "GpsPrimary.Pkts": sent}))
    assert status.get("GpsPrimary.Chars") == 65_536 * 2


def test_counters_of_a_repeated_replay_begin_with_the_count_sent_first():
    status = StatusTracker()
    for sent in (100, 200, 300):
        status.update(2, encode_channel(2, {"GpsPrimary.Chars": sent}))
    status.restart()
    assert status.get("GpsPrimary.Chars") == 300
    for sent in (100, 200):
        assert status.update(2, encode_channel(2, {"GpsPrimary.Chars": sent}))["GpsPrimary.Chars"] == sent


def test_invalid_or_missing_accuracy_is_unknown_not_zero():
    status = StatusTracker()
    status.update(3, encode_channel(3, {"NorthAcc": 0.1, "EastAcc": 0.2, "AltAcc": 0.3}))
    accuracy = Accuracy.from_status(status)
    assert accuracy.position == pytest.approx((0.2, 0.1, 0.3))
    assert compute_variances(accuracy.position) == pytest.approx((0.04, 0.01, 0.09))
    assert compute_variances(accuracy.velocity) is compute_variances(accuracy.attitude) is None
    status.update(3, encode_channel(3, {}))
    assert compute_variances(Accuracy.from_status(status).position) is None


def test_repeated_bytes_update_only_the_filtered_lag():
    status = StatusTracker()
    data = encode_channel(5, {"HeadingAcc": 0.1, "PitchAcc": 0.1, "RollAcc": 0.1})
    assert status.update(5, data) and not status.update(5, data)
    for lag in (100, 200):
        status.update(23, encode_channel(23, {"BnsLag": lag, "UpTimeCode": 10_860}))
    assert status.get("BnsLagFilt") == pytest.approx(101.0)
    assert status.get("UpTime") == 240 * 60


def test_wheel_speed_count_is_dated_in_the_nearest_minute_and_unwrapped():
    status = StatusTracker()
    minute = START / 1000 - START / 1000 % 60
    status.update(45, encode_channel(45, {"WSpeedCount": 2**32 - 10, "WSpeedMilliseconds": 59_900}), minute + 60.05)
    assert status.get("WSpeedTime") == pytest.approx(minute + 59.9)
    status.update(45, encode_channel(45, {"WSpeedCount": 10, "WSpeedMilliseconds": 100}), minute + 60.15)
    assert status.get("WSpeedFreq") == pytest.approx(100.0, rel=1e-5)


def test_local_frame_requires_all_four_values_and_keeps_the_last_complete_ones():
    status = StatusTracker()
    status.update(66, encode_channel(66, {"RefLat": 52.0, "RefLon": -1.25}))
    assert status.local_origin is None
    status.update(67, encode_channel(67, {"RefAlt": 100.0, "RefHeading": 270.0 - 360.0}))
    assert status.local_origin == pytest.approx((52.0, -1.25, 100.0))
    assert status.get("RefHeading") == pytest.approx(-90.0)
    status.update(66, encode_channel(66, {"RefLat": 53.0}))
    assert status.local_origin == pytest.approx((52.0, -1.25, 100.0))


def test_channel_25_is_used_only_without_66_and_67():
    old = encode_channel(25, {"OldRefX": 120.0, "OldRefY": 0.0, "OldRefHeading": 0.0})
    position = (math.radians(52), math.radians(-1.25), 100.0)
    status = StatusTracker()
    status.update(25, old, None, position)
    assert status.local_origin[0] == pytest.approx(52.0 - 120.0 / 111_260, abs=1e-5)
    status.update(66, encode_channel(66, {"RefLat": 50.0, "RefLon": 1.0}))
    status.update(67, encode_channel(67, {"RefAlt": 1.0, "RefHeading": 90.0}))
    status.update(25, encode_channel(25, {"OldRefX": 1.2, "OldRefY": 0.0, "OldRefHeading": 0.0}), None, position)
    assert status.local_origin == pytest.approx((50.0, 1.0, 1.0))


@pytest.mark.parametrize("data", ["8000000080000000", "000080000000ffff", "0000000000000080", "ffff7f0000000000"])
def test_invalid_channel_25_gives_no_local_frame(data):
    status = StatusTracker()
    status.update(25, bytes.fromhex(data), None, (0.9, 0.0, 0.0))
    assert status.local_origin is None


def receive(parser, data):
    return parser.feed(data)[0]


def test_repeated_event_is_detected_once(packet):
    parser = NcomParser()
    first, second = encode_trigger(24, (START + 5) * 1_000_000, 7), encode_trigger(24, (START + 900) * 1_000_000, 8)
    no_event = (-10080).to_bytes(4, "little", signed=True) + bytes(4)

    def event(status, data, channel=24):
        return receive(parser, packet(START, channel, batch_s=data, navigation_status=status)).event_ns

    assert event(4, no_event) is None
    assert event(22, first) == (START + 5) * 1_000_000
    assert event(4, first) is None and event(22, first) is None
    # The trigger packet of the second event was lost; its repetition has the time.
    assert event(4, second) == (START + 900) * 1_000_000
    assert event(4, second) is None
    assert event(4, encode_channel(5, {}), channel=5) is None


def test_event_before_the_start_is_not_detected(packet):
    parser = NcomParser()
    old = encode_trigger(43, START * 1_000_000, 200)
    assert receive(parser, packet(START, 43, batch_s=old)).event_ns is None
    new = encode_trigger(43, (START + 1) * 1_000_000, 201)
    trigger = receive(parser, packet(START, 43, batch_s=new, navigation_status=22))
    assert trigger.event_ns == (START + 1) * 1_000_000


def test_event_counter_wraps(packet):
    parser = NcomParser()
    for i, count in enumerate((254, 255, 1)):
        data = encode_trigger(65, (START + i) * 1_000_000, count)
        trigger = receive(parser, packet(START, 65, batch_s=data, navigation_status=22))
        assert trigger.event_ns == (START + i) * 1_000_000


@pytest.fixture
def motion(packet):
    return extract_motion(receive(NcomParser(), packet(START, 0)))


def test_motion_is_in_ros_axes(motion):
    assert motion.velocity == pytest.approx((5.0, 10.0, 0.5))
    assert motion.body_velocity == pytest.approx((11.16136377, 0.74210656, -0.35105068), abs=1e-5)
    assert motion.angular_velocity == pytest.approx((0.001, -0.002, -0.1))
    assert motion.acceleration == pytest.approx((0.1, 0.2, 9.81))


@pytest.mark.parametrize("status", [0, 1, 2, 5, 10])
def test_no_motion_without_a_fix(packet, status):
    received = NcomParser().feed(packet(START, 0, navigation_status=status))[0]
    assert extract_motion(received) is None


@pytest.mark.parametrize("changes", [
    {"velocity_ned": (math.nan, 0.0, 0.0)}, {"heading": math.nan}, {"latitude": math.nan},
    {"angular_rate": (0.0, 0.0, math.nan)},
])
def test_no_motion_from_an_incomplete_solution(packet, changes):
    assert extract_motion(NcomParser().feed(packet(START, 0, **changes))[0]) is None


def test_origin_at_the_first_fix_is_constant(motion):
    origin = Origin(FIRST_FIX)
    frame = origin.update(motion, StatusTracker(), 0)
    assert motion.locate(frame) == pytest.approx((0, 0, 0), abs=1e-9)
    motion.latitude += 1e-5
    assert origin.update(motion, StatusTracker(), 1) is frame
    assert motion.locate(frame)[1] == pytest.approx(63.6, abs=0.5)


def test_origin_given_by_the_user(motion):
    origin = Origin(GIVEN, (52.0, -1.25, 99.5))
    assert motion.locate(origin.update(motion, StatusTracker(), 0)) == pytest.approx((0, 0, 1), abs=1e-6)


def test_origin_of_the_unit_is_replaced_by_the_first_fix_after_a_timeout(motion):
    status = StatusTracker()
    origin = Origin(UNIT)
    assert origin.update(motion, status, 0) is None
    status.update(66, encode_channel(66, {"RefLat": 52.001, "RefLon": -1.25}))
    status.update(67, encode_channel(67, {"RefAlt": 100.5, "RefHeading": 90.0}))
    frame = origin.update(motion, status, 1)
    assert motion.locate(frame)[1] == pytest.approx(-111.26, abs=0.02)
    assert origin.chosen_source == UNIT
    waiting = Origin(UNIT)
    assert waiting.update(motion, StatusTracker(), 0) is None
    assert waiting.update(motion, StatusTracker(), LOCAL_FRAME_TIMEOUT_NS) is not None
    assert waiting.chosen_source == FIRST_FIX


@pytest.mark.parametrize(("mode", "text", "fix"), [
    (None, "", -1), (0, "none", -1), (3, "SPS", 0), (6, "RTK integer", 2), (7, "SBAS", 1), (31, "PPP", 1),
    (32, "unknown", -1), (77, "unknown (77)", -1),
])
def test_text_and_fix_status_of_gnss_modes(mode, text, fix):
    assert (describe_mode(mode), get_fix_status(mode)) == (text, fix)


def test_accuracy_of_a_mode_does_not_depend_on_the_kind_of_solution():
    for first in (12, 20, 25):  # post-processed, gx, ix: Doppler, SPS, differential, float, integer
        assert [rank_mode(mode) for mode in range(first, first + 5)] == [rank_mode(mode) for mode in range(2, 7)]
    assert rank_mode(28) < rank_mode(6) and rank_mode(19) == rank_mode(30) == rank_mode(None) == -1
