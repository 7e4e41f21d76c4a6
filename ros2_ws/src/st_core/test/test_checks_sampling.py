"""Sampling of a recording: resolution, repeated and frozen values, time stamps, gaps, missing values, jumps, delays."""

import re
from dataclasses import replace

import numpy as np
import pytest
from exact_drive import SPEED, Noise, Sines, exact_drive
from exact_faults import findings_by_name
from st_core.checks import AuxiliaryData, Severity, check
from st_core.checks.sampling import estimate_resolution
from st_core.corrections import apply_corrections
from st_core.log import INS_SIGNALS, OPTIONAL_INS_SIGNALS, STEERING
from st_core.timeseries import NANOSECOND


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, 40.0)


@pytest.mark.parametrize("step", [1e-4, 0.02, 3.0])
def test_resolution_of_rounded_values(step):
    time = np.arange(0.0, 20.0, 0.01)
    values = 30.0 * step * np.sin(time) + step * np.random.default_rng(0).standard_normal(len(time))
    assert estimate_resolution(time, np.round(values / step) * step) == pytest.approx(step, rel=1e-6)
    assert estimate_resolution(time, values) == 0.0


@pytest.mark.parametrize(("rate", "jitter", "expected"), [
    (1.0, 0.0, True), (5.0, 0.0, True), (10.0, 0.0, False), (10.0, 0.005, True), (20.0, 0.005, False)])
def test_sampling_rate_too_low_for_predictions_is_reported(leaf, rate, jitter, expected):
    """jitter: largest error of a time stamp [s]."""
    log = exact_drive(leaf, seconds=120.0, rate=rate)
    late = (jitter * np.random.default_rng(0).uniform(-1.0, 1.0, len(log.x)) / NANOSECOND).astype(np.int64)
    texts = [finding.text for finding in check(replace(log, ins_time_ns=log.ins_time_ns + late), leaf).findings
             if finding.name == "time_gaps"]
    assert bool(texts) == expected
    assert all("exceed 0.1 s; no prediction is made across these" in text for text in texts)
    assert ["not compared with each other" in text for text in texts[:1]] == [rate < 4.0] * expected


@pytest.mark.parametrize("rate", [2.0, 3.0])
def test_only_the_rate_is_reported_of_drives_too_slow_to_judge_a_wrong_scale(leaf, rate):
    log = exact_drive(leaf, seconds=120.0, rate=rate)
    findings = check(replace(log, yaw=1.3 * log.yaw), leaf).findings
    assert [finding.name for finding in findings] == ["time_gaps", "time_gaps"]  # of INS and steering


def test_unrounded_values_have_no_resolution():
    time = np.arange(0.0, 20.0, 0.01)
    assert estimate_resolution(time, 12.3 * time) == 0.0
    assert estimate_resolution(time, np.sin(time)) == 0.0
    assert estimate_resolution(time, np.zeros(len(time))) == 0.0
    noise = np.random.default_rng(0).normal(0.0, 1e-3, len(time))
    lost = np.delete(np.arange(len(time)), np.arange(5, len(time), 11))  # as lost UDP packets
    assert estimate_resolution(time[lost], (12.3 * time + noise)[lost]) == 0.0


def test_channel_statistics(leaf):
    drive = exact_drive(leaf, 40.0, rate=50.0, noise=Noise(yaw_rate=0.004))
    channels = check(drive, auxiliary=AuxiliaryData(missing={"yaw_rate": 7})).channels
    assert channels["yaw_rate"].rate == pytest.approx(50.0) and channels["yaw_rate"].samples == 2000
    assert channels["yaw_rate"].noise == pytest.approx(0.004, rel=0.1) and channels["yaw_rate"].missing == 7
    assert channels["x"].gaps == 0 and channels["x"].longest_gap == pytest.approx(0.02)
    assert channels["yaw_rate"].unit == "rad/s" and channels["road_wheel_angle"].repeated < 0.01


@pytest.mark.slow
@pytest.mark.parametrize(("channel", "coarse", "fine"), [
    ("x", 0.5, 0.01), ("yaw", np.deg2rad(1.0), np.deg2rad(0.01)), ("velocity_x", 0.2, 0.005)])
def test_coarse_resolution_is_reported(log, channel, coarse, fine):
    def rounded(step):
        return replace(log, **{channel: np.round(getattr(log, channel) / step) * step})
    finding = findings_by_name(rounded(coarse))["resolution_coarse"]
    assert finding.channels == (channel,) and finding.value == pytest.approx(coarse, rel=1e-6)
    assert "resolution_coarse" not in findings_by_name(rounded(fine))


@pytest.mark.parametrize(("every", "severity"), [(4, Severity.NOTE), (10, Severity.WARNING)])
def test_values_repeated_at_a_lower_rate_are_reported(log, every, severity):
    rows = np.arange(len(log.x)) // every * every
    finding = findings_by_name(replace(log, acceleration_y=log.acceleration_y[rows]))["samples_repeated"]
    assert finding.channels == ("acceleration_y",) and finding.severity is severity
    assert finding.value == pytest.approx(1.0 - 1.0 / every, abs=0.01)
    assert f"{100.0 / every:.3g} Hz" in finding.text


def freeze(log, channel, begin, end):
    """Holds the channel constant from begin to end [s]."""
    values = getattr(log, channel).copy()
    steering = channel == "road_wheel_angle"
    time_ns = log.steering_time_ns if steering else log.ins_time_ns
    since = (time_ns - log.ins_time_ns[0]) * 1e-9
    inside = (since >= begin) & (since <= end)
    values[inside] = values[inside][0]
    return replace(log, **{channel: values}, **({"steering_wheel_angle": None} if steering else {}))


@pytest.mark.slow
@pytest.mark.parametrize("channel", ["x", "yaw", "velocity_x", "yaw_rate", "acceleration_y", "road_wheel_angle"])
def test_frozen_channel_is_found_while_the_car_moves(log, leaf, channel):
    finding = findings_by_name(freeze(log, channel, 10.0, 16.0), leaf)["channel_frozen"]
    assert finding.channels == (channel,) and finding.value == pytest.approx(6.0, abs=0.05)
    assert finding.times == (pytest.approx((10.0, 16.0), abs=0.05),)
    if channel != "road_wheel_angle":
        assert finding.advice.entry == {"leave_out": [[pytest.approx(10.0, abs=0.05), pytest.approx(16.0, abs=0.05)]]}


def test_constant_channel_is_not_frozen_in_constant_motion(leaf):
    straight = exact_drive(leaf, 40.0, turning=Sines(0.0, ()))
    assert findings_by_name(freeze(straight, "yaw_rate", 10.0, 16.0)) == {}
    assert findings_by_name(freeze(straight, "yaw", 10.0, 16.0)) == {}
    constant_speed = exact_drive(leaf, 40.0, speed=Sines(SPEED.mean, ()))
    assert findings_by_name(freeze(constant_speed, "velocity_x", 10.0, 16.0)) == {}


def test_decreasing_and_duplicate_time_stamps_are_counted(log):
    stamps = log.ins_time_ns.copy()
    stamps[100:200:10] = stamps[99:199:10]
    stamps[1000] = stamps[990]
    findings = findings_by_name(log, auxiliary=AuxiliaryData(stamps={"INS": stamps}))
    assert findings["time_duplicates"].value == pytest.approx(10 / len(stamps))
    assert findings["time_order"].value == pytest.approx(1 / len(stamps))
    assert {finding.severity for finding in findings.values()} == {Severity.NOTE}
    assert findings["time_order"].times == (pytest.approx((9.99, 9.99)),)  # the newest earlier stamp
    steering = log.steering_time_ns[500:].copy()  # starts after the INS
    steering[100], time = steering[90], (steering[99] - log.ins_time_ns[0]) * 1e-9
    findings = findings_by_name(log, auxiliary=AuxiliaryData(stamps={"steering": steering}))
    assert findings["time_order"].times == (pytest.approx((time, time)),)
    healthy = AuxiliaryData(stamps={"INS": log.ins_time_ns, "steering": log.steering_time_ns})
    assert findings_by_name(log, auxiliary=healthy) == {}


def test_first_stamp_far_too_late_is_counted(log):
    stamps = log.ins_time_ns.copy()
    stamps[0] += 10**15
    finding = findings_by_name(log, auxiliary=AuxiliaryData(stamps={"INS": stamps}))["time_order"]
    assert finding.value == pytest.approx(1 / len(stamps)) and f"1 of {len(stamps)} rows" in finding.text
    assert abs(finding.times[0][0]) < 1.0


@pytest.mark.parametrize(("seconds", "severity"), [(1.0, Severity.NOTE), (4.0, Severity.WARNING)])
def test_gaps_are_reported_with_length_and_time(log, leaf, seconds, severity):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    findings = findings_by_name(log.select_ins((since < 15.0) | (since >= 15.0 + seconds)), leaf)
    assert list(findings) == ["time_gaps"]
    gaps = findings["time_gaps"]
    assert gaps.severity is severity and gaps.value == pytest.approx(seconds, abs=0.02)
    assert gaps.times == (pytest.approx((15.0, 15.0 + seconds), abs=0.02),)


@pytest.mark.parametrize(("rows", "severity"), [(3, Severity.NOTE), (400, Severity.WARNING)])
def test_missing_values_are_reported_with_their_percentage(log, rows, severity):
    kept = np.ones(len(log.x), bool)
    kept[np.random.default_rng(1).choice(len(kept), rows, replace=False)] = False
    finding = findings_by_name(log.select_ins(kept),
                               auxiliary=AuxiliaryData(missing={"yaw_rate": rows}))["values_missing"]
    assert finding.channels == ("yaw_rate",) and finding.severity is severity
    assert finding.value == pytest.approx(rows / len(log.x))


def missing_steering_finding(log, kept):
    """The finding for a recording in which only the rows `kept` contain a steering angle."""
    reduced = replace(log, steering_time_ns=log.steering_time_ns[kept], road_wheel_angle=log.road_wheel_angle[kept],
                   steering_wheel_angle=log.steering_wheel_angle[kept])
    missing = len(log.steering_time_ns) - len(reduced.steering_time_ns)
    auxiliary = AuxiliaryData({"INS": log.steering_time_ns}, missing={"road_wheel_angle": missing})
    return findings_by_name(reduced, auxiliary=auxiliary)["values_missing"]


def test_slower_sensor_in_common_rows_is_a_note_with_its_rate(log):
    finding = missing_steering_finding(log, np.arange(len(log.steering_time_ns)) % 4 == 0)
    assert finding.severity is Severity.NOTE and "25 Hz" in finding.text
    assert finding.value == pytest.approx(0.75, abs=0.01)


@pytest.mark.parametrize("gap", [(0.0, 0.4), (0.0, 0.5), (0.3, 0.7)])
def test_gap_is_not_mistaken_for_a_slower_sensor(log, gap):
    position = np.linspace(0.0, 1.0, len(log.steering_time_ns))
    finding = missing_steering_finding(log, (position < gap[0]) | (position > gap[1]))
    assert finding.severity is Severity.WARNING and "have no usable value" in finding.text


@pytest.mark.parametrize(("channel", "share"), [("road_wheel_angle", 0.5), ("yaw_rate", 0.5), ("acceleration_x", 1.0)])
def test_percentage_of_missing_values_refers_to_all_recorded_rows(log, channel, share):
    count = len(log.steering_time_ns if channel == "road_wheel_angle" else log.x)
    finding = findings_by_name(log, auxiliary=AuxiliaryData(missing={channel: count}))["values_missing"]
    assert finding.value == pytest.approx(share)
    assert ("they were kept without it" in finding.text) is (channel == "acceleration_x")


@pytest.mark.parametrize(("channels", "count"), [
    (("x", "y"), 10), (("x", "y"), 100), (("velocity_x", "velocity_y"), 10), (("yaw",), 10), (("yaw_rate",), 20),
    (("acceleration_x", "acceleration_y"), 50)])
def test_values_repeated_at_a_lower_rate_are_not_jumps_and_have_no_lag(log, channels, count):
    rows = np.maximum((np.arange(len(log.x)) - count // 2) // count * count + count // 2, 0)
    repeated = replace(log, **{name: getattr(log, name)[rows] for name in channels})
    assert list(findings_by_name(repeated)) == ["samples_repeated"]


@pytest.mark.parametrize(("size", "end", "stretches"), [
    (0.3, 20.0, [12.205, 12.485, 19.855, 20.135]), (2.0, 20.0, [12.205, 12.485, 19.855, 20.135]),
    (5.0, 12.40, [12.205, 12.535])])  # a short excursion: the samples in it are left out too
def test_position_jumps_are_found_and_left_out(log, size, end, stretches):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    away = size * ((since >= 12.345) & (since < end - 0.001))
    wrong = replace(log, x=log.x + 0.6 * away, y=log.y - 0.8 * away)
    finding = findings_by_name(wrong)["position_jumps"]
    assert finding.value == 2.0
    assert float(re.search(r"largest ([\d.]+) m", finding.text)[1]) == pytest.approx(size, abs=0.02)
    assert finding.times == (pytest.approx((12.34, 12.35)), pytest.approx((end - 0.01, end)))
    left_out = finding.advice.entry["leave_out"]
    assert np.ravel(left_out) == pytest.approx(stretches, abs=0.011)
    assert "position_jumps" not in findings_by_name(apply_corrections(wrong, {}, None, left_out))


def test_frequent_position_jumps_have_no_automatic_correction(log):
    since = (log.ins_time_ns - log.ins_time_ns[0]) * 1e-9
    finding = findings_by_name(replace(log, x=log.x + 0.5 * (np.floor(2.0 * since) % 2)))["position_jumps"]
    assert finding.value > 50 and finding.advice.kind == "text"


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.7])
def test_positions_delayed_by_one_sample_at_random_are_found(log, share):
    delayed = np.random.default_rng(3).random(len(log.x)) < share
    delayed[0] = False
    rows = np.arange(len(delayed)) - delayed
    finding = findings_by_name(replace(log, x=log.x[rows], y=log.y[rows]))["position_stale"]
    share_of_steps = np.mean(delayed[1:] & ~delayed[:-1])
    assert finding.interval[0] <= share_of_steps <= finding.interval[1] and finding.severity is Severity.WARNING
    # The distance travelled in one sampling interval of 10 ms.
    assert finding.effect == pytest.approx(0.01 * np.median(log.velocity_x), rel=0.3)


@pytest.mark.parametrize("deviation", [0.003, 0.01])
def test_time_stamp_jitter_is_estimated_from_the_motion(leaf, deviation):
    drive = exact_drive(leaf, 40.0, rate=20.0)
    jitter_ns = np.round(1e9 * np.clip(deviation * np.random.default_rng(5).standard_normal(len(drive.x)), -0.02, 0.02))
    finding = findings_by_name(replace(drive,
                                       ins_time_ns=drive.ins_time_ns + jitter_ns.astype(np.int64)))["time_jitter"]
    assert finding.value == pytest.approx(float(np.std(np.diff(jitter_ns))) * 1e-9, rel=0.1)
    assert "time_jitter" not in findings_by_name(drive)


@pytest.mark.parametrize("signal", ["ins_time_ns", "steering_time_ns"])
def test_samples_in_bursts_are_named_and_cause_no_other_finding(leaf, signal):
    """Bursts of 5 to 40 samples at 100 Hz, each with the time of its last sample: pauses of 0.05 to 0.4 s."""
    drive = exact_drive(leaf, 90.0)
    stamps, count = getattr(drive, signal), len(getattr(drive, signal))
    ends = np.append(np.cumsum(np.random.default_rng(1).integers(5, 41, count // 5)), count - 1)
    last = ends[np.searchsorted(ends, np.arange(count))].clip(max=count - 1)
    speed = drive.velocity_x + np.where(np.arange(len(drive.velocity_x)) == 1000, 30.0, 0.0)
    drive = replace(drive, velocity_x=speed, **{signal: stamps[last] + 2000 * (np.arange(count) - last)})
    findings = findings_by_name(drive, leaf)
    assert findings.keys() - {"steering_lag"} == {"time_jitter", "sample_spikes"}  # steering or motion is late
    burst = findings["time_jitter"]
    assert "bursts of 2" in burst.text and burst.severity is Severity.WARNING and 0.05 < burst.value < 0.12


@pytest.mark.parametrize(("rate", "seconds", "length", "period"), [(100.0, 90.0, 0.4, 2.0), (10.0, 300.0, 5.0, 25.0)])
def test_recording_in_short_parts_has_gaps_but_no_bursts(leaf, rate, seconds, length, period):
    drive = exact_drive(leaf, seconds, rate=rate)
    kept = {}
    for signal, names in (("ins", (*INS_SIGNALS, *OPTIONAL_INS_SIGNALS)), ("steering", STEERING)):
        stamps = getattr(drive, f"{signal}_time_ns")
        rows = (stamps - drive.start_ns) * NANOSECOND % period < length
        kept |= {name: getattr(drive, name)[rows] for name in (f"{signal}_time_ns", *names)
                 if getattr(drive, name) is not None}
    findings = check(replace(drive, **kept), leaf).findings
    assert [finding.name for finding in findings] == ["time_gaps", "time_gaps"]  # of INS and steering


@pytest.mark.parametrize("rate", [10.0, 25.0, 50.0, 100.0])
def test_samples_in_pairs_are_reported_and_cause_no_other_finding(leaf, rate):
    drive = exact_drive(leaf, 90.0, rate=rate)
    stamps, k = drive.ins_time_ns, np.arange(len(drive.x))
    (finding,) = check(replace(drive, ins_time_ns=stamps[k // 2 * 2] + 2000 * (k % 2)), leaf).findings
    assert "bursts of 2" in finding.text
    assert finding.severity is (Severity.NOTE if rate >= 50.0 else Severity.WARNING)


@pytest.mark.parametrize("step", [0.005, 0.01, 0.02])
def test_steering_sent_on_change_does_not_come_in_bursts(leaf, step):
    drive = exact_drive(leaf, 90.0)
    angle = step * np.round(drive.road_wheel_angle / step)
    rows = np.append(True, np.diff(angle) != 0.0)
    drive = replace(drive, road_wheel_angle=angle[rows], steering_time_ns=drive.steering_time_ns[rows],
                    steering_wheel_angle=None)
    assert "time_jitter" not in findings_by_name(drive, leaf)


def test_randomly_missing_samples_give_no_jitter_finding(leaf):
    """The motion between samples agrees with the uneven time stamps."""
    drive = exact_drive(leaf, 40.0)
    kept = np.random.default_rng(7).random(len(drive.x)) < 0.7
    assert findings_by_name(drive.select_ins(kept), leaf) == {}
