"""Alignment of the public synthetic pair: CAN log and INS log of one drive on two clocks; the truth is in its README.

    t_ins = (t_can + 3.2170 s) (1 + 40e-6),    t_can: instant of the measurement since the start of the log

Frames of the INS have latencies of 1.5 to 2.3 ms, those of the car none. The set "excerpt" in tests/golden/data has the
whole CAN log and every fourth row of the INS log (25 Hz); the set "complete" is reference data.
"""

import io
import json
import math
from dataclasses import replace
from functools import cache, cached_property

import numpy as np
import pytest
from rich.console import Console
from st_cli.cli import app
from st_cli.verbs.raw_logs import _make_signal_table, describe_alignment
from st_core.clock_alignment import align, manual_alignment
from st_core.clock_types import Alignment, SignalAgreement, Verdict
from st_recordings.runs.can_logs import read_can_logs
from st_recordings.runs.can_signals import CanSignals, decode_signals, load_signal_table
from st_recordings.runs.clocks import INS_ON_CAN_DELAY, align_clocks, pair_shared_signals
from st_recordings.runs.columns import Layout
from st_recordings.runs.csv import MOTION_SIGNALS, build_ins_log
from st_recordings.runs.csv_table import read_table
from support import ROOT, SETS, vectors
from typer.testing import CliRunner

OFFSET, DRIFT = 3.2170, 40e-6  # s, 1
LATENCY = {"RT_VelocityLevel": 0.0015, "RT_HeadingPitchRoll": 0.0017, "RT_RateVehicle": 0.0019,  # s
           "RT_IsoOrientation": 0.0021, "RT_IsoVsVelocity": 0.0023}


class Pair:
    def __init__(self, which: str):
        self.files = [vectors(which, f"can/{n}") for n in ("synthetic_rt_own_log.csv", "synthetic_leaf_rt.mf4")]
        self.ins = build_ins_log(read_table(self.files[0], Layout()), MOTION_SIGNALS)
        self.log = read_can_logs(self.files[1:])
        table = load_signal_table(ROOT / "config/can/leaf_ze0.dbc", ROOT / "config/can/leaf_ze0.yaml")
        self.signals = decode_signals(self.log.frames, table)

    def error(self, result: Alignment, at_ns: int) -> float:
        """Estimated minus true INS time [s] of an instant of the CAN clock."""
        elapsed = (at_ns - self.log.start_ns) * 1e-9
        return result.to_reference_ns(at_ns) * 1e-9 - (elapsed + OFFSET) * (1 + DRIFT)

    def without(self, *prefixes: str) -> CanSignals:
        return CanSignals({k: s for k, s in self.signals.signals.items() if not k[0].startswith(prefixes)}, {})

    def only(self, *prefixes: str) -> CanSignals:
        return CanSignals({k: s for k, s in self.signals.signals.items() if k[0].startswith(prefixes)}, {})

    @cached_property
    def alignment(self) -> Alignment:
        """As `st align` computes it, without knowledge of the latencies."""
        return align_clocks(self.ins, self.signals)[0]

    @cache  # noqa: B019
    def alignment_of(self, *prefixes: str) -> Alignment:
        return align_clocks(self.ins, self.only(*prefixes))[0]


@pytest.fixture(scope="module", params=SETS)
def pair(request: pytest.FixtureRequest) -> Pair:
    return Pair(request.param)


def test_offset_and_drift_are_within_1_ms_and_5_ppm(pair: Pair) -> None:
    result = pair.alignment
    assert result.verdict is Verdict.GOOD, result.reasons
    frames = pair.log.frames.time_ns
    errors = [pair.error(result, int(t)) for t in (frames[0], frames[len(frames) // 2], frames[-1])]
    assert max(map(abs, errors)) < 1e-3
    assert max(map(abs, errors)) < 2 * result.offset_deviation
    assert abs(result.drift_ppm - 1e6 * DRIFT) < min(5.0, 3 * result.drift_deviation)


def test_known_latencies_reduce_the_error_to_a_tenth_of_a_millisecond(pair: Pair) -> None:
    signals = [replace(s, latency=LATENCY[s.name.split("(")[1].rstrip(")")], latency_uncertainty=0.0)
               for s in pair_shared_signals(pair.ins, pair.signals)]
    assert len(signals) == len(LATENCY)
    result = align(signals)
    assert abs(pair.error(result, result.at_ns)) < min(1e-4, 3 * result.offset_deviation)
    assert abs(result.drift_ppm - 1e6 * DRIFT) < 1.0
    for row in result.signals:
        assert abs(row.difference) < max(3 * row.deviation, 5e-5)


def test_specified_latency_shifts_the_offset_and_reduces_its_uncertainty(pair: Pair) -> None:
    """A latency 3 ms longer than assumed gives an offset 3 ms larger."""
    assumed = pair.alignment
    given, _ = align_clocks(pair.ins, pair.signals, latency=(0.005, 0.0005))
    assert given.offset_at_ns(assumed.at_ns) - assumed.offset_at_ns(assumed.at_ns) == pytest.approx(3e6, abs=5e3)
    noise = assumed.offset_deviation**2 - INS_ON_CAN_DELAY[1] ** 2  # of the INS log: larger at 25 Hz than at 100 Hz
    assert given.offset_deviation == pytest.approx((0.0005**2 + noise) ** 0.5, rel=0.02)


def test_differences_between_signals_are_their_latencies_to_a_tenth_of_a_millisecond(pair: Pair) -> None:
    lag = {row.name.split("(")[1].rstrip(")"): row.difference for row in pair.alignment.signals}
    for name, latency in LATENCY.items():
        assert lag["RT_RateVehicle"] - lag[name] == pytest.approx(latency - LATENCY["RT_RateVehicle"], abs=1e-4)


def test_alignment_by_wheel_speed_alone_is_doubtful(pair: Pair) -> None:
    result, _ = align_clocks(pair.ins, pair.without("ins_"))
    assert result.verdict is Verdict.DOUBTFUL
    assert "no INS frames" in result.reasons[-1]
    assert abs(pair.error(result, result.at_ns)) < 2 * result.offset_deviation


def test_two_wheel_speeds_align_better_than_one(pair: Pair) -> None:
    deviations = []
    for removed in (("wheel_speed_rear_right",), ()):
        result, _ = align_clocks(pair.ins, pair.without("ins_", "vehicle", *removed))
        assert abs(pair.error(result, result.at_ns)) < 2 * result.offset_deviation
        deviations.append(result.signals[0].deviation)
    assert deviations[1] < deviations[0]


def test_alignment_by_steering_alone_is_doubtful(pair: Pair) -> None:
    result, _ = align_clocks(pair.ins, pair.without("ins_", "wheel", "vehicle"))
    assert result.verdict is Verdict.DOUBTFUL
    assert "steering and curvature" in result.reasons[-1]
    assert abs(pair.error(result, result.at_ns)) < 2 * result.offset_deviation


def test_right_positive_steering_aligns_with_steering_sign_and_is_rejected_without(pair: Pair) -> None:
    steering = pair.without("ins_", "wheel", "vehicle").signals
    turned = CanSignals({k: replace(s, values=-s.values) for k, s in steering.items()}, {})
    result, _ = align_clocks(pair.ins, turned, steering_sign=-1)
    assert result.verdict is Verdict.DOUBTFUL
    assert abs(pair.error(result, result.at_ns)) < 2 * result.offset_deviation
    wrong, _ = align_clocks(pair.ins, turned)
    assert wrong.verdict is Verdict.REFUSED
    assert "with the opposite steering_sign, curvature and steering have" in wrong.reasons[-1]


@pytest.mark.parametrize(("used", "signal", "value"), [
    *((("steering_wheel_angle",), "steering_wheel_angle", np.deg2rad(deg)) for deg in (-999.9, 327.67, 819.1, 500.0)),
    *((("vehicle_speed", "steering_wheel_angle"), "vehicle_speed", value) for value in (655.35 / 3.6, 91.0, 0.0)),
    *((("ins_velocity", "ins_yaw_rate"), "ins_yaw_rate", np.deg2rad(deg)) for deg in (327.67, 81.9)),
    *((("ins_velocity", "ins_yaw_rate"), "ins_velocity_x", value) for value in (327.67, 99.99)),
    *((used, channel, value) for used in (("steering_wheel_angle",), ("ins_velocity", "ins_yaw_rate"))
      for channel, value in (("yaw_rate", 5.72), ("yaw_rate", -1.43), ("velocity_x", 99.9), ("velocity_x", 327.67))),
])
def test_sentinel_values_in_a_signal_do_not_change_the_alignment(pair: Pair, used, signal, value) -> None:
    """1.2 s of a constant value in the log or in the INS recording, as large as the whole range of the motion."""
    clean = pair.alignment_of(*used)

    def with_sentinel(time_ns: np.ndarray, values: np.ndarray) -> np.ndarray:
        return np.where(np.abs((time_ns - time_ns[0]) * 1e-9 - 20.6) < 0.6, value, values)
    ins = pair.ins
    if signal in ("velocity_x", "yaw_rate"):
        ins = replace(ins, values={**ins.values, signal: with_sentinel(ins.time_ns, ins.values[signal])})
    signals = {k: replace(s, values=with_sentinel(s.time_ns, s.values)) if k[0] == signal else s
               for k, s in pair.only(*used).signals.items()}
    result, _ = align_clocks(ins, CanSignals(signals, {}))
    assert result.verdict is clean.verdict
    assert f"samples of {signal}" in result.reasons[0] and "the alignment does not use them" in result.reasons[0]
    assert abs(pair.error(result, result.at_ns) - pair.error(clean, clean.at_ns)) < 2e-3


def test_log_without_shared_signals_is_rejected_and_accepts_a_specified_offset(pair: Pair) -> None:
    nothing = pair.without("ins_", "wheel", "vehicle", "steering")
    result, _ = align_clocks(pair.ins, nothing)
    assert result.verdict is Verdict.REFUSED
    assert "give the offset (--offset)" in result.reasons[0]
    given, _ = align_clocks(pair.ins, nothing, offset=OFFSET - pair.log.start_ns * 1e-9)
    assert given.method == manual_alignment(0, 0).method
    assert given.offset_ns == pytest.approx(OFFSET * 1e9 - pair.log.start_ns, abs=1000)


def test_infinite_deviations_are_unknown(pair: Pair) -> None:
    refused = replace(pair.alignment, offset_deviation=math.inf, drift_deviation=math.inf)
    text = describe_alignment(refused, pair.log.start_ns, is_utc=True)
    assert text.count("unknown") == 2 and "inf" not in text


def test_name_of_a_signal_is_complete_in_a_narrow_terminal() -> None:
    name = "yaw_(RT_HeadingPitchRoll)"
    table = _make_signal_table(Alignment(signals=(SignalAgreement(name, 0.0, 0.0007, 0.11, 0.99),)))
    narrow = Console(width=80, file=io.StringIO())
    narrow.print(table)
    assert name in "".join(line[:26].strip() for line in narrow.file.getvalue().splitlines())


def test_align_command_writes_result_and_figure(pair: Pair, tmp_path) -> None:
    run = CliRunner().invoke(app, ["align", *map(str, pair.files), "--output", str(tmp_path / "out[1]")])
    assert run.exit_code == 0, run.output
    assert "good" in run.output and "out[1]/alignment.json" in run.output.replace("\n", "")
    result = json.loads((tmp_path / "out[1]/alignment.json").read_text())
    assert result["drift_ppm"] == pytest.approx(40, abs=5)
    elapsed = (result["at_ns"] - pair.log.start_ns) * 1e-9
    # The resolution of a float at 1.6e9 s is 0.2 us.
    assert result["offset_s"] + result["at_ns"] * 1e-9 == pytest.approx((elapsed + OFFSET) * (1 + DRIFT), abs=1e-3)
    assert (tmp_path / "out[1]/alignment.png").stat().st_size > 20_000
    assert np.isclose(result["common_time_s"], 60, atol=1)


def test_brake_slip_is_within_the_uncertainty_of_wheel_speeds(pair: Pair) -> None:
    """0.3 % slip per m/s^2, as of a rear axle with a third of the brake force."""
    signals = pair.without("ins_", "vehicle").signals

    def with_slip(signal):
        acceleration = np.gradient(signal.values, signal.time_ns * 1e-9)
        return replace(signal, values=signal.values * (1.0 + 0.003 * np.minimum(acceleration, 0.0)))

    slipping = {k: with_slip(s) if s.name.startswith("wheel_speed") else s for k, s in signals.items()}
    result, _ = align_clocks(pair.ins, CanSignals(slipping, {}))
    assert result.verdict is Verdict.DOUBTFUL and "delay and slip are unknown" in result.reasons[-1]
    assert abs(pair.error(result, result.at_ns)) < 2 * result.offset_deviation
