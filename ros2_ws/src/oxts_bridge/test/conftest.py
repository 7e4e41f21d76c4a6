"""Packets of a drive as a unit sends them."""

from collections.abc import Callable
from dataclasses import replace
from math import radians

import hypothesis
import pytest
from oxts_bridge import ncom
from oxts_bridge.channels import encode_channel

# A loaded machine must not cause failures.
hypothesis.settings.register_profile("no deadline", deadline=None)
hypothesis.settings.load_profile("no deadline")

# 2025-09-03T12:00:34.560 GPS time is in this minute.
MINUTE = 24_015_600
LOCKED = ncom.Packet(
    navigation_status=4, acceleration=(0.1, -0.2, -9.81), angular_rate=(0.001, 0.002, 0.1), latitude=radians(52.0),
    longitude=radians(-1.25), altitude=100.5, velocity_ned=(10.0, 5.0, -0.5), heading=radians(30.0),
    pitch=radians(5.0), roll=radians(-10.0))
MODES = {"GpsNumObs": 14, "GpsPosMode": 6, "GpsVelMode": 6, "GpsAttMode": 6}
ACCURACY = {
    3: {"NorthAcc": 0.02, "EastAcc": 0.03, "AltAcc": 0.05},
    4: {"VnAcc": 0.01, "VeAcc": 0.02, "VdAcc": 0.03},
    5: {"HeadingAcc": 0.1, "PitchAcc": 0.05, "RollAcc": 0.04},
}


def make_packet(gps_ms: int, channel: int = 255, fields: dict | None = None, **changes) -> bytes:
    """A locked packet at a GPS time [ms since 1980]; channel 0 carries the minute."""
    minute, ms = divmod(gps_ms, 60_000)
    if channel == 0:
        fields = {"GpsMinutes": minute, **MODES, **(fields or {})}
    status = b"\xff" * 8 if fields is None else encode_channel(channel, fields)
    changes.setdefault("batch_s", status)
    return ncom.encode(replace(LOCKED, milliseconds=ms, channel=channel, **changes))


@pytest.fixture(scope="session")
def packet() -> Callable[..., bytes]:
    return make_packet


@pytest.fixture(scope="session")
def drive() -> Callable[..., list[bytes]]:
    """drive(count, start_ms, step_ms, every): packets of a steady drive, channel 0 in every `every`-th (0: none)."""

    def make(count: int, start_ms: int = MINUTE * 60_000 + 1_000, step_ms: int = 4, every: int = 10) -> list[bytes]:
        others = [3, 4, 5]
        result = []
        for i in range(count):
            channel = 0 if every and i % every == 0 else others[i % 3]
            result.append(make_packet(start_ms + i * step_ms, channel, ACCURACY.get(channel)))
        return result

    return make
