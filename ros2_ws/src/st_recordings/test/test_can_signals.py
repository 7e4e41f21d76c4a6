"""Signals of a whole log: the same values, faults and omissions as the live decoder finds frame by frame."""

from dataclasses import replace

import can
import numpy as np
import pytest
from canedge_bridge.decode import Decoder
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.can_signals import decode_signals, find_steering, load_signal_table
from st_recordings.runs.errors import RunError
from st_recordings.runs.frames import REMOTE, Frames, merge_by_time
from support import KEPT, ROOT

DBC, TABLE = ROOT / "config/can/leaf_ze0.dbc", ROOT / "config/can/leaf_ze0.yaml"


@pytest.fixture(scope="module")
def frames() -> Frames:
    return read_can_logs([KEPT / "can/synthetic_leaf_rt.mf4"]).frames


def live(frames: Frames) -> dict[tuple[str, str], list[tuple[int, float, bool]]]:
    decoder = Decoder(DBC, TABLE)
    found: dict[tuple[str, str], list[tuple[int, float, bool]]] = {}
    for k in range(len(frames)):
        message = can.Message(arbitration_id=int(frames.id[k]), is_extended_id=False,
                              data=frames.payload[k, : frames.length[k]].tobytes())
        decoded = decoder.decode(message, int(frames.time_ns[k]))
        if decoded is not None:
            for name, value in decoded.values.items():
                if np.isfinite(value) and not name.startswith("gps_"):
                    found.setdefault((name, decoded.message), []).append((decoded.time_ns, value, decoded.valid))
    return found


@pytest.mark.parametrize("damage", [0.0, 0.02, 0.3])
def test_equal_to_the_live_decoder(frames: Frames, damage: float) -> None:
    """Bits flipped in a share of the frames and as many frames lost."""
    random = np.random.default_rng(5)
    payload = frames.payload.copy()
    hit = random.random(len(frames)) < damage
    payload[hit, random.integers(0, 5, hit.sum())] ^= (1 << random.integers(0, 8, hit.sum())).astype(np.uint8)
    log = replace(frames, payload=payload).select(random.random(len(frames)) >= damage / 2)
    expected = live(log)
    signals = decode_signals(log, load_signal_table(DBC, TABLE)).signals
    assert signals.keys() == expected.keys()
    for key, signal in signals.items():
        times, values, valid = map(np.array, zip(*expected[key], strict=True))
        # The first frames behind a stretch of implausible ones: only a whole log shows that they are good.
        both = np.isin(signal.time_ns, times)
        assert both.sum() == len(times) and (~both).sum() <= (0.05 * len(both) if damage > 0.1 else 0), key
        assert signal.valid[both].tolist() == valid.tolist(), key
        np.testing.assert_allclose(signal.values[both], values, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("bad", [[1000.0] * 100, [500.0], [-700.0, 700.0] * 20])
def test_only_implausible_frames_are_left_out(bad: list[float]) -> None:
    table, encoder = load_signal_table(DBC, TABLE), Decoder(DBC, TABLE)
    angles = np.radians(np.concatenate([np.linspace(0, 50, 150), bad, np.linspace(55, 60, 150)]))
    rows = [encoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, k % 16) for k, angle in enumerate(angles)]
    n = len(rows)
    log = Frames(np.arange(n) * 10**7, np.full(n, 2, np.uint32),
                 np.stack([np.frombuffer(bytes(r.data).ljust(8, b"\0"), np.uint8) for r in rows]),
                 np.full(n, 5, np.uint8), np.zeros(n, np.uint8), np.zeros(n, np.uint8))
    steering = decode_signals(log, table).first_of("steering_wheel_angle")
    assert np.abs(steering.values).max() < np.radians(61) and len(steering.values) >= 299


def test_time_frames_become_utc() -> None:
    encoder = Decoder(DBC, TABLE)
    at = 1_700_000_000.25
    rows = [encoder.encode(name, {"ins_unix_time": at}) for name in ("RT_MilliTime", "RT_DateTime")]
    log = Frames(np.array([1, 2]) * 10**9, np.array([r.arbitration_id for r in rows], np.uint32),
                 np.stack([np.frombuffer(bytes(r.data).ljust(8, b"\0"), np.uint8) for r in rows]),
                 np.array([len(r.data) for r in rows], np.uint8), np.zeros(2, np.uint8), np.zeros(2, np.uint8))
    found = decode_signals(log, load_signal_table(DBC, TABLE)).all_of("ins_unix_time")
    assert [s.message for s in found] == ["RT_DateTime", "RT_MilliTime"]
    assert [s.values[0] for s in found] == pytest.approx([at, at], abs=1e-6)


def test_a_log_without_steering_says_what_is_there(frames: Frames) -> None:
    table = load_signal_table(DBC, TABLE)
    without = decode_signals(frames.select(frames.id != 2), table)
    with pytest.raises(RunError, match=r"drive\.mf4: the steering message Leaf_Steering \(0x002\) is not in the log; "
                                       r"known messages in the log: Leaf_WheelSpeedFront, .*; name the"):
        find_steering(without, "drive.mf4", table)
    real = read_can_logs([KEPT / "can/canedge2_2F6913DB_00000004_00000001.MF4"]).frames
    with pytest.raises(RunError, match=r"2 of 2 frames \(100 %\) have \d bytes instead of 5 .* 2 frames are not used"):
        find_steering(decode_signals(real, table), "real.mf4", table)


def test_remote_frames_decode_to_nothing(frames: Frames) -> None:
    flags = np.where(frames.id == 2, REMOTE, 0).astype(np.uint8)
    assert decode_signals(replace(frames, flags=flags), load_signal_table(DBC, TABLE)).first_of(
        "steering_wheel_angle") is None


def test_a_multiplexed_steering_angle_is_not_missing_in_the_other_frames(tmp_path) -> None:
    (tmp_path / "car.dbc").write_text(
        'VERSION ""\n\nBS_:\n\nBU_: X\n\nBO_ 37 Steer: 8 X\n SG_ Page M : 0|8@1+ (1,0) [0|255] "" X\n'
        ' SG_ Angle m3 : 15|16@0- (0.1,0) [-900|900] "deg" X\n SG_ Other m4 : 15|16@0- (1,0) [0|0] "" X\n')
    (tmp_path / "car.yaml").write_text(
        "messages: {Steer: {needed: true, period: {value: 0.01, unit: s}, timeout: {value: 0.2, unit: s}, signals: "
        "{Angle: {name: steering_wheel_angle, unit: deg, sign: 1, range: [-900, 900], max_rate: 2000}}}}\n")
    n = 400
    payload = np.zeros((n, 8), np.uint8)
    payload[:, 0], payload[:, 1], payload[:, 2] = 3 + np.arange(n) % 2, np.arange(n) % 2 * 0x7F, np.arange(n) // 4
    pages = Frames(np.arange(n) * 5_000_000, np.full(n, 37, np.uint32), payload, np.full(n, 8, np.uint8),
                   np.zeros(n, np.uint8), np.zeros(n, np.uint8))
    signals = decode_signals(pages, load_signal_table(tmp_path / "car.dbc", tmp_path / "car.yaml"))
    steering = signals.first_of("steering_wheel_angle")
    np.testing.assert_allclose(np.degrees(steering.values), 0.1 * (np.arange(0, n, 2) // 4))
    assert not signals.faults and not signals.rejected


def test_the_same_message_on_two_buses_counts_once(frames: Frames) -> None:
    steering = frames.select(frames.id == 2)
    twice = Frames(*(np.repeat(getattr(steering, c), 2, axis=0) for c in ("time_ns", "id", "payload", "length", "bus",
                                                                         "flags")))
    signal = decode_signals(twice, load_signal_table(DBC, TABLE)).first_of("steering_wheel_angle")
    assert np.array_equal(signal.time_ns, steering.time_ns)


@pytest.mark.parametrize("other", ["gateway", "other content", "longer"])
def test_an_identifier_on_two_buses_is_read_from_the_bus_that_fits(frames: Frames, other: str) -> None:
    steering = replace(own := frames.select(frames.id == 2), bus=np.full(len(own), 1, np.uint8))
    payload = steering.payload.copy()
    if other != "gateway":
        payload[:, :5] = np.random.default_rng(1).integers(0, 256, (len(payload), 5))
    foreign = replace(steering, time_ns=steering.time_ns + 150_000, bus=np.full(len(steering), 2, np.uint8),
                      payload=payload, length=np.full(len(payload), 8 if other == "longer" else 5, np.uint8))
    signals = decode_signals(merge_by_time([foreign, steering]), load_signal_table(DBC, TABLE))
    signal = signals.first_of("steering_wheel_angle")
    alone = decode_signals(steering, load_signal_table(DBC, TABLE)).first_of("steering_wheel_angle")
    offset = signal.time_ns - alone.time_ns
    assert signal.valid.all() and np.array_equal(signal.values, alone.values) and set(offset.tolist()) <= {0, 150_000}
    assert signals.faults["Leaf_Steering"] == f"{len(foreign)} frames of this identifier on other buses are not used"


def test_halves_of_a_drive_on_two_buses_are_both_used(frames: Frames) -> None:
    steering = frames.select(frames.id == 2)
    bus = np.where(np.arange(len(steering)) < len(steering) // 2, 1, 2).astype(np.uint8)
    payload = steering.payload.copy()
    payload[100, 4] ^= 0x10
    found = decode_signals(replace(steering, bus=bus, payload=payload), load_signal_table(DBC, TABLE))
    assert len(found.first_of("steering_wheel_angle").time_ns) == len(steering)


def test_steering_that_the_dbc_decodes_incorrectly_is_refused(frames: Frames) -> None:
    payload = frames.payload.copy()
    payload[frames.id == 2, :2] = payload[frames.id == 2, 1::-1]  # high byte first
    table = load_signal_table(DBC, TABLE)
    with pytest.raises(RunError, match=r"cannot be used: .*implausible .* in \d+ of \d+ frames; correct the DBC"):
        find_steering(decode_signals(replace(frames, payload=payload), table), "a.mf4", table)


def test_an_identifier_that_differs_only_in_the_source_address_of_j1939_is_named(tmp_path) -> None:
    (tmp_path / "car.dbc").write_text(
        f'VERSION ""\n\nBS_:\n\nBU_: X\n\nBO_ {0x98F009FE} VDC2: 8 X\n'
        ' SG_ Angle : 0|16@1+ (0.0009765625,-31.374) [0|0] "rad" X\n')
    (tmp_path / "car.yaml").write_text(
        "messages: {VDC2: {needed: true, period: {value: 0.01, unit: s}, timeout: {value: 0.2, unit: s}, signals: "
        "{Angle: {name: steering_wheel_angle, unit: rad, sign: 1}}}}\n")
    n, table = 50, load_signal_table(tmp_path / "car.dbc", tmp_path / "car.yaml")
    log = Frames(np.arange(n) * 10_000_000, np.full(n, 0x98F0090B, np.uint32), np.full((n, 8), 127, np.uint8),
                 np.full(n, 8, np.uint8), np.zeros(n, np.uint8), np.zeros(n, np.uint8))
    with pytest.raises(RunError, match=r"the log has 0x18F0090B \(50 frames\) instead, .* J1939 priority and source"):
        find_steering(decode_signals(log, table), "a.asc", table)


def test_unreadable_lines_are_named_where_the_steering_is_missing(frames: Frames) -> None:
    table = load_signal_table(DBC, TABLE)
    with pytest.raises(RunError, match=r"RT_VelocityLevel; 7 of 9 lines cannot be read; name the car"):
        find_steering(decode_signals(frames.select(frames.id != 2), table), "a.asc", table,
                      ["a.asc: 7 of 9 lines cannot be read"])


def test_a_table_that_does_not_hold_together(tmp_path) -> None:
    broken = tmp_path / "table.yaml"
    broken.write_text("messages: [")
    with pytest.raises(RunError) as refused:
        load_signal_table(DBC, broken)
    assert str(refused.value).count(str(broken)) == 1
