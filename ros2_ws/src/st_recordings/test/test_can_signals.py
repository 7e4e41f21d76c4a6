"""Signals of a complete log: the same values, faults and rejected frames as in the live decoder, frame by frame."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import can
import numpy as np
import pytest
from canedge_bridge.decode import Decoder
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.can_signals import (
    CanSignals,
    Signal,
    SignalTable,
    decode_signals,
    find_steering,
    load_signal_table,
)
from st_recordings.runs.cdr import WHEEL_SPEEDS, load_typestore
from st_recordings.runs.errors import RunError
from st_recordings.runs.frames import REMOTE, Frames, merge_by_time
from st_recordings.runs.write import Serialiser
from support import GOLDEN_DATA, ROOT

DBC, TABLE = ROOT / "config/can/leaf_ze0.dbc", ROOT / "config/can/leaf_ze0.yaml"


@pytest.fixture(scope="module")
def frames() -> Frames:
    return read_can_logs([GOLDEN_DATA / "can/synthetic_leaf_rt.mf4"]).frames


@pytest.fixture(scope="module")
def table() -> SignalTable:
    return load_signal_table(DBC, TABLE)


@pytest.fixture(scope="module")
def steering_frames(frames: Frames) -> Frames:
    return frames.select(frames.id == 2)


def make_frames(period_ns: int, identifiers: Sequence[int], payloads: Sequence[bytes]) -> Frames:
    """Frames on one bus at a constant period."""
    n = len(payloads)
    data = [np.frombuffer(payload.ljust(8, b"\0"), np.uint8) for payload in payloads]
    return Frames(np.arange(n) * period_ns, np.array(identifiers, np.uint32), np.stack(data),
                  np.array([len(payload) for payload in payloads], np.uint8), np.zeros(n, np.uint8),
                  np.zeros(n, np.uint8))


def write_table(folder: Path, message: str, signal: str) -> SignalTable:
    """A table of one message (DBC lines) with the steering wheel angle in its signal Angle (further YAML keys)."""
    (folder / "car.dbc").write_text(f'VERSION ""\n\nBS_:\n\nBU_: X\n\n{message}')
    name = message.split()[2].rstrip(":")
    (folder / "car.yaml").write_text(
        f"messages: {{{name}: {{needed: true, period: {{value: 0.01, unit: s}}, timeout: {{value: 0.2, unit: s}}, "
        f"signals: {{Angle: {{name: steering_wheel_angle, sign: 1, {signal}}}}}}}}}\n")
    return load_signal_table(folder / "car.dbc", folder / "car.yaml")


def decode_live(frames: Frames) -> dict[tuple[str, str], list[tuple[int, float, bool]]]:
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


@pytest.mark.parametrize("damage", [0.02, 0.3])
def test_signals_equal_those_of_the_live_decoder(frames: Frames, table: SignalTable, damage: float) -> None:
    """One bit is flipped in a share of the frames, and half as many frames are lost."""
    random = np.random.default_rng(5)
    payload = frames.payload.copy()
    hit = random.random(len(frames)) < damage
    payload[hit, random.integers(0, 5, hit.sum())] ^= (1 << random.integers(0, 8, hit.sum())).astype(np.uint8)
    log = replace(frames, payload=payload).select(random.random(len(frames)) >= damage / 2)
    expected = decode_live(log)
    signals = decode_signals(log, table).signals
    assert signals.keys() == expected.keys()
    for key, signal in signals.items():
        times, values, valid = map(np.array, zip(*expected[key], strict=True))
        # The live decoder rejects the first good frames after many implausible ones; a complete log shows them as good.
        both = np.isin(signal.time_ns, times)
        assert both.sum() == len(times) and (~both).sum() <= (0.05 * len(both) if damage > 0.1 else 0), key
        assert signal.valid[both].tolist() == valid.tolist(), key
        np.testing.assert_allclose(signal.values[both], values, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("implausible", [[1000.0] * 100, [500.0], [-700.0, 700.0] * 20])
def test_only_implausible_frames_are_left_out(table: SignalTable, implausible: list[float]) -> None:
    encoder = Decoder(DBC, TABLE)
    angles = np.radians(np.concatenate([np.linspace(0, 50, 150), implausible, np.linspace(55, 60, 150)]))
    payloads = [bytes(encoder.encode("Leaf_Steering", {"steering_wheel_angle": angle}, k % 16).data)
                for k, angle in enumerate(angles)]
    steering = decode_signals(make_frames(10**7, [2] * len(angles), payloads), table).find_first("steering_wheel_angle")
    assert np.abs(steering.values).max() < np.radians(61) and len(steering.values) >= 299


def test_time_frames_give_utc(table: SignalTable) -> None:
    encoder = Decoder(DBC, TABLE)
    unix_time = 1_700_000_000.25
    sent = [encoder.encode(name, {"ins_unix_time": unix_time}) for name in ("RT_MilliTime", "RT_DateTime")]
    log = make_frames(10**9, [frame.arbitration_id for frame in sent], [bytes(frame.data) for frame in sent])
    signals = decode_signals(log, table).find_all("ins_unix_time")
    assert [s.message for s in signals] == ["RT_DateTime", "RT_MilliTime"]
    assert [s.values[0] for s in signals] == pytest.approx([unix_time, unix_time], abs=1e-6)


def test_log_without_steering_is_rejected_with_the_messages_it_contains(frames: Frames, table: SignalTable) -> None:
    without = decode_signals(frames.select(frames.id != 2), table)
    with pytest.raises(RunError, match=r"drive\.mf4: the steering message Leaf_Steering \(0x002\) is not in the log; "
                                       r"known messages in the log: Leaf_WheelSpeedFront, .*; name the"):
        find_steering(without, "drive.mf4", table)
    real = read_can_logs([GOLDEN_DATA / "can/canedge2_2F6913DB_00000004_00000001.MF4"]).frames
    with pytest.raises(RunError, match=r"2 of 2 frames \(100 %\) have \d bytes instead of 5 .* 2 frames are not used"):
        find_steering(decode_signals(real, table), "real.mf4", table)


def test_remote_frames_give_no_signal(frames: Frames, table: SignalTable) -> None:
    flags = np.where(frames.id == 2, REMOTE, 0).astype(np.uint8)
    assert decode_signals(replace(frames, flags=flags), table).find_first("steering_wheel_angle") is None


def test_multiplexed_steering_angle_is_read_from_its_own_frames(tmp_path: Path) -> None:
    table = write_table(tmp_path, 'BO_ 37 Steer: 8 X\n SG_ Page M : 0|8@1+ (1,0) [0|255] "" X\n'
                                ' SG_ Angle m3 : 15|16@0- (0.1,0) [-900|900] "deg" X\n'
                                ' SG_ Other m4 : 15|16@0- (1,0) [0|0] "" X\n',
                        "unit: deg, range: [-900, 900], max_rate: 2000")
    n = 400
    payloads = [bytes([3 + k % 2, k % 2 * 0x7F, k // 4, 0, 0, 0, 0, 0]) for k in range(n)]
    signals = decode_signals(make_frames(5_000_000, [37] * n, payloads), table)
    steering = signals.find_first("steering_wheel_angle")
    np.testing.assert_allclose(np.degrees(steering.values), 0.1 * (np.arange(0, n, 2) // 4))
    assert not signals.faults and not signals.rejected_times_ns


def test_value_that_the_dbc_names_init_is_no_steering_angle(tmp_path: Path) -> None:
    """A sensor sends it for a second after it is switched on; it is within the range."""
    table = write_table(tmp_path, 'BO_ 134 Steer: 2 X\n SG_ Angle : 0|14@1+ (0.1,-819.2) [-800|800] "deg" X\n\n'
                                  'VAL_ 134 Angle 16382 "Init" 16383 "Error" ;\n',
                        "unit: deg, range: [-900, 900], max_rate: 2000")
    payloads = [raw.to_bytes(2, "little") for raw in (*[16382] * 100, *range(8192, 8492))]
    signals = decode_signals(make_frames(10**7, [134] * len(payloads), payloads), table)
    np.testing.assert_allclose(np.degrees(signals.find_first("steering_wheel_angle").values), 0.1 * np.arange(300))
    assert "Angle implausible (not a number, or named in the DBC) in 100 of 400 frames" in signals.faults["Steer"]


def test_steering_message_with_nothing_but_named_values_is_not_missing(tmp_path: Path) -> None:
    table = write_table(tmp_path, 'BO_ 134 Steer: 2 X\n SG_ Angle : 0|14@1+ (0.1,-819.2) [-800|800] "deg" X\n\n'
                                  'VAL_ 134 Angle 16383 "SNA" ;\n', "unit: deg")
    signals = decode_signals(make_frames(10**7, [134] * 9, [b"\xff\x3f"] * 9), table)
    with pytest.raises(RunError, match=r"Steer \(0x086\) cannot be used: none of 9 frames contains an angle; values n"):
        find_steering(signals, "drive.mf4", table)


def test_simultaneous_copies_of_a_frame_count_once(steering_frames: Frames, table: SignalTable) -> None:
    repeated = steering_frames.select(np.repeat(np.arange(len(steering_frames)), 2))
    signal = decode_signals(repeated, table).find_first("steering_wheel_angle")
    assert np.array_equal(signal.time_ns, steering_frames.time_ns)


@pytest.mark.parametrize("other", ["gateway", "other content", "longer"])
def test_identifier_on_two_buses_is_read_from_the_bus_that_matches_the_dbc(
        steering_frames: Frames, table: SignalTable, other: str) -> None:
    steering = replace(steering_frames, bus=np.full(len(steering_frames), 1, np.uint8))
    payload = steering.payload.copy()
    if other != "gateway":
        payload[:, :5] = np.random.default_rng(1).integers(0, 256, (len(payload), 5))
    other_bus = replace(steering, time_ns=steering.time_ns + 150_000, bus=np.full(len(steering), 2, np.uint8),
                        payload=payload, length=np.full(len(payload), 8 if other == "longer" else 5, np.uint8))
    signals = decode_signals(merge_by_time([other_bus, steering]), table)
    signal = signals.find_first("steering_wheel_angle")
    expected = decode_signals(steering, table).find_first("steering_wheel_angle")
    assert signal.valid.all() and np.array_equal(signal.values, expected.values)
    assert set((signal.time_ns - expected.time_ns).tolist()) <= {0, 150_000}
    assert signals.faults["Leaf_Steering"] == f"{len(other_bus)} frames of this identifier on other buses are not used"


def test_halves_of_a_drive_on_two_buses_are_both_used(steering_frames: Frames, table: SignalTable) -> None:
    n = len(steering_frames)
    bus = np.where(np.arange(n) < n // 2, 1, 2).astype(np.uint8)
    payload = steering_frames.payload.copy()
    payload[100, 4] ^= 0x10
    signals = decode_signals(replace(steering_frames, bus=bus, payload=payload), table)
    assert len(signals.find_first("steering_wheel_angle").time_ns) == n


def test_steering_that_the_dbc_decodes_incorrectly_is_rejected(frames: Frames, table: SignalTable) -> None:
    payload = frames.payload.copy()
    payload[frames.id == 2, :2] = payload[frames.id == 2, 1::-1]  # high byte first
    with pytest.raises(RunError, match=r"cannot be used: .*implausible .* in \d+ of \d+ frames; correct the DBC"):
        find_steering(decode_signals(replace(frames, payload=payload), table), "a.mf4", table)


def test_j1939_message_with_another_source_address_is_reported(tmp_path: Path) -> None:
    table = write_table(tmp_path, f'BO_ {0x98F009FE} VDC2: 8 X\n'
                                ' SG_ Angle : 0|16@1+ (0.0009765625,-31.374) [0|0] "rad" X\n', "unit: rad")
    log = make_frames(10_000_000, [0x98F0090B] * 50, [b"\x7f" * 8] * 50)
    with pytest.raises(RunError, match=r"the log has 0x18F0090B \(50 frames\) instead, .* J1939 priority and source"):
        find_steering(decode_signals(log, table), "a.asc", table)


def test_unreadable_lines_are_reported_with_missing_steering(frames: Frames, table: SignalTable) -> None:
    with pytest.raises(RunError, match=r"RT_VelocityLevel; 7 of 9 lines cannot be read; name the car"):
        find_steering(decode_signals(frames.select(frames.id != 2), table), "a.asc", table,
                      ["a.asc: 7 of 9 lines cannot be read"])


def test_error_in_a_signal_table_names_the_file_once(tmp_path: Path) -> None:
    broken = tmp_path / "table.yaml"
    broken.write_text("messages: [")
    with pytest.raises(RunError) as error:
        load_signal_table(DBC, broken)
    assert str(error.value).count(str(broken)) == 1


def test_wheel_speeds_in_alternate_frames_keep_their_times() -> None:
    signals = {}
    for start, name in enumerate(("wheel_speed_rear_left", "wheel_speed_rear_right")):
        rows = np.arange(start, 4, 2)
        signals[name, "Wheels"] = Signal(name, "Wheels", rows * 10, rows * 1.0, np.ones(2, bool), rows)
    messages = Serialiser(load_typestore()).serialise_wheel_speeds("Wheels", CanSignals(signals, {}), np.asarray)
    read = [load_typestore().deserialize_cdr(data, WHEEL_SPEEDS) for _, _, data in messages]
    assert [time_ns for time_ns, _, _ in messages] == [0, 10, 20, 30]
    np.testing.assert_array_equal([message.rear_left for message in read], [0.0, np.nan, 2.0, np.nan])
    np.testing.assert_array_equal([message.rear_right for message in read], [np.nan, 1.0, np.nan, 3.0])
