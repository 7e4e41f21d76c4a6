"""Implausible samples: every kind in every channel is named, left out, and blamed on nothing else."""

from dataclasses import replace

import numpy as np
import pytest
from exact_drive import exact_drive
from st_core.checks import AuxiliaryData, Severity, check
from st_core.checks.plausibility import CHANNELS, drop_implausible

NAMES = ("sample_spikes", "sentinel_values", "out_of_range", "channel_wraps")
MIDDLE = 2000


def _spikes(share, size):
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


KINDS = {
    "one small spike": _spikes(0.0, 3.0), "one large": _fixed(-500.0, MIDDLE, 1), "the first": _fixed(777.0, 0, 1),
    "the last": _fixed(-777.0, -1, 1), "+-487 in 0.2 %": _spikes(0.002, 487.0), "a tenth": _spikes(0.1, 6.0),
    "-9999": _fixed(-9999.0, MIDDLE, 120), "int16": _fixed(327.67, MIDDLE, 200), "all ones": _fixed(655.35, MIDDLE, 50),
    "float": _fixed(1e10, MIDDLE, 500), "at the begin": _fixed(-9999.0, 0, 120),
    "at the end": _fixed(-9999.0, -120, 120),
    "garbage": _garbage,
}


@pytest.fixture(scope="module")
def clean(leaf):
    log = exact_drive(leaf, seconds=60.0)
    return log, {one.name for one in check(log, leaf).findings}


def spoiled(log, car, channel, edit):
    """(log, INS or steering places edited)"""
    wheel = channel == "steering_wheel_angle"
    if not wheel:
        log = replace(log, steering_wheel_angle=None)
    values = getattr(log, channel).copy()
    places = edit(values, CHANNELS[channel].step)
    log = replace(log, **{channel: np.unwrap(values) if channel == "yaw" else values})
    return (log.with_steering(car) if wheel else log), places


@pytest.mark.parametrize("channel", CHANNELS)
@pytest.mark.parametrize("kind", KINDS)
def test_named_left_out_and_nothing_else_is_blamed(clean, leaf, kind, channel):
    log, before = clean
    broken, places = spoiled(log, leaf, channel, KINDS[kind])
    findings = check(broken, leaf).findings
    named = [one for one in findings if one.name in NAMES]
    assert named and {one for f in named for one in f.channels} == {channel}
    assert {one.name for one in findings} - before <= {*NAMES}
    usable, _ = drop_implausible(broken)
    values = getattr(usable, channel)
    truth = getattr(log, channel)
    time = log.steering_time_ns if "wheel" in channel else log.ins_time_ns
    left = usable.steering_time_ns if "wheel" in channel else usable.ins_time_ns
    if channel.startswith("acceleration"):
        assert np.isnan(values[places]).mean() > 0.99
    else:
        assert np.isin(time[places], left).mean() < 0.02
        at = np.isin(time, left)
        error = values - truth[at]
        error -= 2.0 * np.pi * np.round(error / (2.0 * np.pi)) if channel == "yaw" else 0.0
        assert np.abs(error).max() < CHANNELS[channel].step
        assert at.sum() >= len(time) - 1.2 * len(places) - 10


@pytest.mark.parametrize("channel", [name for name in CHANNELS if name not in ("x", "y", "yaw")])
def test_zero_while_the_car_moves(clean, leaf, channel):
    log, before = clean
    most = int(np.argmax(np.abs(getattr(log, "road_wheel_angle" if "wheel" in channel else channel))[500:-500]))
    broken, _ = spoiled(log, leaf, channel, _fixed(0.0, 500 + most - 40, 80))
    findings = check(broken, leaf).findings
    assert [one.channels for one in findings if one.name == "sentinel_values"] == [(channel,)]
    assert {one.name for one in findings} - before == {"sentinel_values"}


@pytest.mark.parametrize("share", [0.7, 0.85])
@pytest.mark.parametrize("channel", ["yaw_rate", "acceleration_y", "road_wheel_angle", "steering_wheel_angle"])
def test_wraps_are_named_first(clean, leaf, channel, share):
    log, _ = clean

    def wrap(values, _):
        half = share * np.abs(values).max()
        values[:] = (values + half) % (2.0 * half) - half
        return np.zeros(0, int)
    broken, _ = spoiled(log, leaf, channel, wrap)
    found = check(broken, leaf)
    assert [(one.name, one.channels) for one in found.findings].count(("channel_wraps", (channel,))) == 1
    _, implausible = drop_implausible(broken)
    again = check(broken, leaf, AuxiliaryData(implausible=tuple(implausible))).findings
    assert [one.name for one in again].count("channel_wraps") == 1
    assert not [one for one in found.with_severity(Severity.ERROR) if one.name != "channel_wraps"]


def test_a_channel_that_jumps_is_compared_with_nothing(clean, leaf):
    log, _ = clean
    broken = replace(log, velocity_x=log.velocity_x * np.where(np.arange(len(log.x)) < MIDDLE, 1.0, -1.0))
    found = check(broken, leaf)
    assert "channel_jumps" in {one.name for one in found.findings} and not found.comparisons


def test_more_than_half_is_an_error_and_stays(clean, leaf):
    log, _ = clean
    broken, _ = spoiled(log, leaf, "yaw_rate", _fixed(-9999.0, 1000, 3500))
    usable, (finding,) = drop_implausible(broken)
    assert finding.severity is Severity.ERROR and len(usable.x) == len(log.x)


def test_a_code_is_reported_in_degrees_too(clean, leaf):
    log, _ = clean
    broken, _ = spoiled(log, leaf, "steering_wheel_angle", _fixed(np.deg2rad(-9999.0), MIDDLE, 120))
    assert "(-9999 deg)" in drop_implausible(broken)[1][0].text
