"""Implausible samples of every kind in every channel are reported, left out, and cause no other finding."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import exact_drive
from st_core.checks import AuxiliaryData, Severity, check
from st_core.checks.plausibility import CHANNEL_LIMITS, drop_implausible

NAMES = ("sample_spikes", "sentinel_values", "out_of_range", "channel_wraps")
MIDDLE = 2000


def _spikes(share, size):
    """size: multiple of the step that is plausible in the channel."""
    def edit(values, step):
        generator = np.random.default_rng(3)
        places = generator.choice(len(values), max(round(share * len(values)), 1), replace=False)
        values[places] += size * step * generator.choice((-1.0, 1.0), len(places))
        return places
    return edit


def _fixed(value, begin, count):
    def edit(values, step):
        places = np.arange(len(values))[begin:][:count]
        values[places] = value
        return places
    return edit


def _garbage(values, step):
    places = np.arange(MIDDLE, MIDDLE + 100)
    values[places] = np.random.default_rng(4).uniform(300.0, 900.0, len(places))
    return places


FAULTS = {
    "one small spike": _spikes(0.0, 3.0), "one large spike": _fixed(-500.0, MIDDLE, 1),
    "first sample": _fixed(777.0, 0, 1),
    "last sample": _fixed(-777.0, -1, 1), "+-487 in 0.2 %": _spikes(0.002, 487.0), "spikes in 10 %": _spikes(0.1, 6.0),
    "-9999": _fixed(-9999.0, MIDDLE, 120), "int16": _fixed(327.67, MIDDLE, 200), "all ones": _fixed(655.35, MIDDLE, 50),
    "float": _fixed(1e10, MIDDLE, 500), "at the start": _fixed(-9999.0, 0, 120),
    "at the end": _fixed(-9999.0, -120, 120),
    "garbage": _garbage,
}


@pytest.fixture(scope="module")
def log(leaf):
    return exact_drive(leaf, seconds=60.0)


def with_implausible_samples(log, car, channel, edit):
    """(log, indices of the edited samples)."""
    wheel = channel == "steering_wheel_angle"
    if not wheel:
        log = replace(log, steering_wheel_angle=None)
    values = getattr(log, channel).copy()
    places = edit(values, CHANNEL_LIMITS[channel].max_step)
    log = replace(log, **{channel: np.unwrap(values) if channel == "yaw" else values})
    return (log.with_steering(car) if wheel else log), places


@pytest.mark.slow
@pytest.mark.parametrize("channel", CHANNEL_LIMITS)
@pytest.mark.parametrize("kind", FAULTS)
def test_implausible_samples_are_reported_and_left_out_without_other_findings(log, leaf, kind, channel):
    broken, places = with_implausible_samples(log, leaf, channel, FAULTS[kind])
    findings = check(broken, leaf).findings
    named = [finding for finding in findings if finding.name in NAMES]
    assert named and {each for finding in named for each in finding.channels} == {channel}
    assert {finding.name for finding in findings} <= {*NAMES}
    usable, _ = drop_implausible(broken, broken.start_ns)
    values = getattr(usable, channel)
    truth = getattr(log, channel)
    time = log.steering_time_ns if "wheel" in channel else log.ins_time_ns
    remaining = usable.steering_time_ns if "wheel" in channel else usable.ins_time_ns
    if channel.startswith("acceleration"):
        assert np.isnan(values[places]).mean() > 0.99
    else:
        assert np.isin(time[places], remaining).mean() < 0.02
        kept = np.isin(time, remaining)
        error = values - truth[kept]
        error -= 2.0 * np.pi * np.round(error / (2.0 * np.pi)) if channel == "yaw" else 0.0
        assert np.abs(error).max() < CHANNEL_LIMITS[channel].max_step
        assert kept.sum() >= len(time) - 1.2 * len(places) - 10


@pytest.mark.slow
@pytest.mark.parametrize("channel", [name for name in CHANNEL_LIMITS if name not in ("x", "y", "yaw")])
def test_zeros_in_a_moving_car_are_reported_as_sentinel_values(log, leaf, channel):
    peak = int(np.argmax(np.abs(getattr(log, "road_wheel_angle" if "wheel" in channel else channel))[500:-500]))
    broken, _ = with_implausible_samples(log, leaf, channel, _fixed(0.0, 500 + peak - 40, 80))
    findings = check(broken, leaf).findings
    assert [finding.channels for finding in findings if finding.name == "sentinel_values"] == [(channel,)]
    assert {finding.name for finding in findings} == {"sentinel_values"}


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.7, 0.85])
@pytest.mark.parametrize("channel", ["yaw_rate", "acceleration_y", "road_wheel_angle", "steering_wheel_angle"])
def test_wrapped_channel_is_the_only_error(log, leaf, channel, share):
    def wrap(values, _):
        limit = share * np.abs(values).max()
        values[:] = (values + limit) % (2.0 * limit) - limit
        return np.zeros(0, int)
    broken, _ = with_implausible_samples(log, leaf, channel, wrap)
    found = check(broken, leaf)
    assert [(finding.name, finding.channels) for finding in found.findings].count(("channel_wraps", (channel,))) == 1
    _, implausible = drop_implausible(broken, broken.start_ns)
    rechecked = check(broken, leaf, AuxiliaryData(implausible=tuple(implausible))).findings
    assert [finding.name for finding in rechecked].count("channel_wraps") == 1
    assert not [finding for finding in found.with_severity(Severity.ERROR) if finding.name != "channel_wraps"]


def test_channel_with_a_sign_change_is_not_compared_with_others(log, leaf):
    broken = replace(log, velocity_x=log.velocity_x * np.where(np.arange(len(log.x)) < MIDDLE, 1.0, -1.0))
    found = check(broken, leaf)
    assert "channel_jumps" in {finding.name for finding in found.findings} and not found.comparisons


def test_channel_with_more_than_half_implausible_is_an_error_and_not_removed(log, leaf):
    broken, _ = with_implausible_samples(log, leaf, "yaw_rate", _fixed(-9999.0, 1000, 3500))
    usable, (finding,) = drop_implausible(broken, broken.start_ns)
    assert finding.severity is Severity.ERROR and len(usable.x) == len(log.x)


def test_two_kinds_that_together_exceed_half_are_errors_and_not_removed(log, leaf):
    yaw_rate = log.yaw_rate.copy()
    yaw_rate[600:2200], yaw_rate[2500:4100] = 0.0, 10.0 + np.sin(0.01 * np.arange(1600.0))
    usable, findings = drop_implausible(replace(log, yaw_rate=yaw_rate), log.start_ns)
    assert [finding.name for finding in findings] == ["sentinel_values", "out_of_range"]
    assert {finding.severity for finding in findings} == {Severity.ERROR} and len(usable.x) == len(log.x)
    assert not any("left out" in finding.text for finding in findings)


def test_sentinel_value_is_reported_in_degrees_too(log, leaf):
    broken, _ = with_implausible_samples(log, leaf, "steering_wheel_angle", _fixed(np.deg2rad(-9999.0), MIDDLE, 120))
    assert "(-9999 deg)" in drop_implausible(broken, broken.start_ns)[1][0].text
