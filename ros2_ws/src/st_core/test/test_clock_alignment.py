"""Clock alignment on simulated drives and clocks: known offsets are recovered within the stated uncertainty."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.signal import butter, lfilter
from st_core import clock_alignment, clock_fit
from st_core.clock_alignment import align, align_by_time_frame, manual_alignment, mask_standstill
from st_core.clock_types import Alignment, SharedSignal, Verdict

EPOCH_NS = 1_700_000_000_000_000_000


class Drive:
    """A synthetic drive: speed [m/s] and yaw rate [rad/s] as smooth functions of time [s]."""

    def __init__(self, seed: int, duration: float):
        self.random = np.random.default_rng(seed)
        time = np.arange(0, duration + 60, 0.05)
        self.speed = CubicSpline(time, np.abs(10 + 50 * lfilter(*butter(2, 0.015), self._noise(len(time)))))
        self.yaw_rate = CubicSpline(time, 0.6 * lfilter(*butter(2, 0.06), self._noise(len(time))))

    def _noise(self, n: int) -> np.ndarray:
        return self.random.standard_normal(n)

    def correlated_noise(self, n: int, deviation: float) -> np.ndarray:
        """Correlated over 100 samples, as the difference between two sensors of one quantity is."""
        return lfilter([1], [1, -0.99], self._noise(n)) * np.sqrt(1 - 0.99**2) * deviation


def nanoseconds(time: np.ndarray) -> np.ndarray:
    return EPOCH_NS + np.round(time * 1e9).astype(np.int64)


def recorded(drive: Drive, duration: float, offset: float, drift: float, disagreement: float = 0.0, step: float = 0.0,
             jitter: float = 3e-4) -> list[SharedSignal]:
    """INS at 100 Hz; CAN at 100 Hz with 2 % of the frames missing, rounding, 3 % gain error, on a clock of its own."""
    ins = np.arange(5, duration + 5, 0.01)
    can = np.arange(10, duration, 0.01)
    can = can[drive.random.random(len(can)) > 0.02]
    stamp = (can - offset) / (1 + drift) + np.where(can > duration / 2, step, 0)
    stamp += drive.random.normal(0, jitter, len(can))
    order = np.argsort(stamp)
    can, stamp = can[order], stamp[order]
    speed = 1.03 * np.round((drive.speed(can) + drive.correlated_noise(len(can), disagreement)) / 0.01) * 0.01
    rate = drive.yaw_rate(can) + drive.correlated_noise(len(can), 0.1 * disagreement) + 0.01
    return [
        SharedSignal("speed", nanoseconds(ins), drive.speed(ins), nanoseconds(stamp), speed),
        SharedSignal("yaw rate", nanoseconds(ins), drive.yaw_rate(ins), nanoseconds(stamp), rate),
    ]


def true_offset(at_ns: int, offset: float, drift: float) -> float:
    """Reference minus other clock [s] at a time of the other clock: t_ref = t_other (1 + drift) + offset."""
    return offset + drift * (at_ns - EPOCH_NS) * 1e-9


@pytest.mark.parametrize(("offset", "drift"), [(3.217, 40e-6), (-72.4, -30e-6), (0.0, 0.0)])
def test_known_offset_and_drift_are_recovered(offset: float, drift: float) -> None:
    result = align(recorded(Drive(1, 300), 300, offset, drift))
    assert result.verdict is Verdict.GOOD, result.reasons
    assert result.offset_ns * 1e-9 == pytest.approx(true_offset(result.at_ns, offset, drift), abs=1e-4)
    assert result.drift_ppm == pytest.approx(drift * 1e6, abs=1.0)


def test_mapping_is_exact_to_the_nanosecond() -> None:
    result = replace(manual_alignment(3_217_000_001, EPOCH_NS), drift_ppm=40.0)
    times = EPOCH_NS + np.array([0, 1_000_000_000, -25_000_000_000])
    assert (result.to_reference_ns(times) - times).tolist() == [3_217_000_001, 3_217_040_001, 3_216_000_001]
    assert result.to_reference_ns(EPOCH_NS) == EPOCH_NS + 3_217_000_001
    assert Alignment().to_reference_ns(times).tolist() == times.tolist()
    assert (Alignment().method, Alignment().verdict) == ("none", "not needed")


@pytest.mark.slow
def test_errors_agree_with_the_stated_standard_deviations() -> None:
    """Over many drives the RMS of error / standard deviation is near 1, also for sensors with correlated errors."""
    for disagreement in (0.02, 0.1):
        z = []
        for seed in range(16):
            result = align(recorded(Drive(seed, 150), 150, 1.5, 20e-6, disagreement))
            error = result.offset_ns * 1e-9 - true_offset(result.at_ns, 1.5, 20e-6)
            z.append((error / result.offset_deviation, (result.drift_ppm - 20) / result.drift_deviation))
        rms = np.sqrt(np.mean(np.square(z), axis=0))
        assert (rms > 0.5).all() and (rms < 1.6).all(), (disagreement, rms)


def test_latency_is_subtracted_and_its_uncertainty_added() -> None:
    signals = recorded(Drive(2, 120), 120, 0.5, 0.0)
    late = [SharedSignal(s.name, s.reference_time_ns, s.reference, s.other_time_ns + 4_000_000, s.other, 0.004, 0.002)
            for s in signals]
    result = align(late)
    assert result.offset_ns * 1e-9 == pytest.approx(0.5, abs=2e-4)
    assert result.offset_deviation == pytest.approx(0.002, rel=0.05)


def test_signals_of_different_drives_are_rejected() -> None:
    one, two = recorded(Drive(3, 200), 200, 0, 0), recorded(Drive(4, 200), 200, 0, 0)
    result = align([SharedSignal(a.name, a.reference_time_ns, a.reference, b.other_time_ns, b.other)
                    for a, b in zip(one, two, strict=True)])
    assert result.verdict is Verdict.REFUSED
    assert "do not overlap in time" in result.reasons[-1]


def test_short_overlap_is_aligned_but_doubtful() -> None:
    signals = recorded(Drive(5, 400), 400, 2.0, 0.0)
    cut = []
    for s in signals:
        early, late = s.reference_time_ns < EPOCH_NS + 230 * 10**9, s.other_time_ns > EPOCH_NS + 190 * 10**9
        cut.append(SharedSignal(s.name, s.reference_time_ns[early], s.reference[early],
                                s.other_time_ns[late], s.other[late]))
    result = align(cut)
    assert result.offset_ns * 1e-9 == pytest.approx(2.0, abs=1e-3)
    assert result.verdict is Verdict.DOUBTFUL
    assert "share only" in result.reasons[-1]


def test_equal_laps_are_ambiguous_unless_the_search_is_bounded() -> None:
    drive = Drive(6, 200)
    time = np.arange(0, 600, 0.01)
    speed, rate = drive.speed(5 + time % 100), drive.yaw_rate(5 + time % 100)
    part = slice(5000, 45000)
    noise = drive.random.normal(0, 0.02, 40000)
    signals = [
        SharedSignal("speed", nanoseconds(time), speed, nanoseconds(time[part]), speed[part] + noise),
        SharedSignal("yaw rate", nanoseconds(time), rate, nanoseconds(time[part]), rate[part] + 0.1 * noise),
    ]
    result = align(signals)
    assert result.verdict is Verdict.DOUBTFUL
    assert "fits nearly as well" in result.reasons[0]
    bounded = align(signals, search=(-20, 20))
    assert (bounded.verdict, round(bounded.offset_ns * 1e-9, 3)) == (Verdict.GOOD, 0.0)


def test_alignment_with_an_unknown_deviation_is_rejected_despite_a_small_clock_step(monkeypatch) -> None:
    def fit_without_deviation(*arguments, **options):
        found = clock_fit.fit(*arguments, **options)
        return found if "free_drift" in options else replace(found, offset_deviation=np.inf)

    monkeypatch.setattr(clock_alignment, "fit", fit_without_deviation)
    monkeypatch.setattr(clock_alignment, "measure_window_lags", lambda *_: [
        clock_alignment.WindowLag(30.0 * k, 0.03 * (k > 5), 1e-3) for k in range(12)])
    result = align(recorded(Drive(7, 200), 200, 1.0, 20e-6))
    assert result.verdict is Verdict.REFUSED and "a clock steps by +30 ms" in result.reasons[0]


def test_long_step_of_the_fit_is_shortened_in_its_direction(monkeypatch) -> None:
    """Clipping the offset alone would change the direction of the step, since offset and drift are correlated here."""
    signals = recorded(Drive(3, 200), 200, 0.0, 0.0)
    pairs = [clock_fit.Pair(s.name, *(clock_fit.resample((time_ns - EPOCH_NS) * 1e-9, values, 0.1) for time_ns, values
                                      in ((s.reference_time_ns, s.reference), (s.other_time_ns, s.other))))
             for s in signals]
    solved, parameters = [], []

    def record(pairs, values, middle, free_drift):
        result = normal_equations(pairs, values, middle, free_drift)
        parameters.append(values.copy())
        solved.append(np.linalg.solve(result[1], -result[2]))
        return result

    normal_equations = clock_fit._normal_equations
    monkeypatch.setattr(clock_fit, "_normal_equations", record)
    found = clock_fit.fit(pairs, 0.6, 0.0)
    steps = np.diff(parameters, axis=0)
    assert abs(solved[0][0]) > abs(steps[0][0]) == pytest.approx(0.3)
    assert steps[0][1] / steps[0][0] == pytest.approx(solved[0][1] / solved[0][0])
    assert found.offset == pytest.approx(0.0, abs=0.01)


@pytest.mark.parametrize(("step", "verdict"), [(0.03, "doubtful"), (2.0, "refused"), (-10.0, "refused")])
def test_clock_step_during_the_drive_is_found(step: float, verdict: str) -> None:
    result = align(recorded(Drive(7, 600), 600, 1.0, 20e-6, disagreement=0.02, step=step))
    assert result.verdict == verdict
    found = re.match(r"a clock steps by ([+-]\d+) ms about ([+-]\d+) s", result.reasons[0])
    assert float(found[1]) == pytest.approx(-step * 1e3, abs=3)
    assert abs(float(found[2])) < 30


def test_constant_signals_are_rejected() -> None:
    time = nanoseconds(np.arange(0, 100, 0.01))
    steady = np.full(len(time), 20.0) + np.random.default_rng(8).normal(0, 0.005, len(time))
    result = align([SharedSignal("speed", time, steady, time, steady, min_deviation=0.3)])
    assert result.verdict is Verdict.REFUSED
    assert "hardly varies" in result.reasons[0]
    assert align([]).reasons == ("the recordings share no signal",)


def test_speed_that_rises_steadily_does_not_determine_an_offset() -> None:
    time = np.arange(0, 300, 0.01)
    result = align([SharedSignal("speed", nanoseconds(time), 0.05 * time, nanoseconds(time), 0.05 * time)])
    assert result.reasons == ("little motion: the uncertainty of the offset is infinite",)


def test_signal_with_long_gaps_throughout_is_named() -> None:
    speed, yaw_rate = recorded(Drive(10, 300), 300, 1.0, 0)
    slow = replace(speed, reference_time_ns=speed.reference_time_ns[::20], reference=speed.reference[::20])  # 5 Hz
    reason = "speed has no 2 s stretch without a gap above 0.15 s in one recording"
    assert align([slow]).reasons == (reason,)
    result = align([slow, yaw_rate])
    assert result.reasons == (reason,) and [s.name for s in result.signals] == ["yaw rate"]


def test_clock_step_of_years_is_rejected() -> None:
    signals = recorded(Drive(9, 100), 100, 0, 0)
    long_ago = np.where(np.arange(len(signals[0].other)) < 50, 10**18, 0)
    broken = [SharedSignal(s.name, s.reference_time_ns, s.reference, s.other_time_ns - long_ago, s.other)
              for s in signals]
    result = align(broken)
    assert result.verdict is Verdict.REFUSED
    assert "a clock was probably set" in result.reasons[0]


def test_gaps_do_not_disturb_and_standstill_is_masked() -> None:
    signals = recorded(Drive(10, 300), 300, 0.7, 10e-6)
    with_gaps = []
    for s in signals:
        other, reference = s.other.copy(), s.reference.copy()
        other[8000:9500] = np.nan
        reference[15000:15400] = np.nan
        with_gaps.append(SharedSignal(s.name, s.reference_time_ns, reference, s.other_time_ns, other))
    result = align(with_gaps)
    assert result.offset_ns * 1e-9 == pytest.approx(true_offset(result.at_ns, 0.7, 10e-6), abs=2e-4)
    time = nanoseconds(np.arange(0, 30, 0.1))
    speed = np.where(np.arange(300) < 100, 0.0, 5.0)
    masked = mask_standstill(time, speed, time, speed)
    assert np.isnan(masked[:80]).all() and np.isfinite(masked[80:]).all()


def test_coarse_wrapped_angle_with_a_different_zero_is_sufficient() -> None:
    """Yaw at 250 Hz, rounded to 0.01 deg in one recording: differences of successive samples are only rounding."""
    drive = Drive(12, 300)
    yaw = drive.yaw_rate.antiderivative()
    ins, can = np.arange(5, 290, 0.004), np.arange(20, 280, 0.004)
    wrapped = (yaw(can) + 1.0 + np.pi) % (2 * np.pi) - np.pi
    rounded = np.radians(np.round(np.degrees(wrapped), 2))
    gap = slice(20_000, 22_000)
    result = align([SharedSignal("yaw", nanoseconds(ins), yaw(ins), np.delete(nanoseconds(can - 0.7), gap),
                                 np.delete(rounded, gap), is_angle=True)])
    assert result.verdict is Verdict.GOOD, result.reasons
    assert result.offset_ns * 1e-9 == pytest.approx(0.7, abs=2e-4)


def test_manual_offset_is_used_and_compared_with_the_signals() -> None:
    signals = recorded(Drive(13, 120), 120, 2.0, 0.0)
    right, wrong = (manual_alignment(offset, EPOCH_NS, signals) for offset in (2_001_000_000, 1_600_000_000))
    assert (right.verdict, right.offset_ns) == (Verdict.GOOD, 2_001_000_000)
    assert (wrong.verdict, wrong.offset_ns) == (Verdict.DOUBTFUL, 1_600_000_000)
    assert "differs by +400 ms" in wrong.reasons[0]
    assert "could not be checked" in manual_alignment(0, EPOCH_NS).reasons[0]


def test_time_frames_give_offset_and_drift() -> None:
    random = np.random.default_rng(11)
    logged = np.arange(0, 600, 0.01)
    unit = np.floor((logged * (1 + 25e-6) + 1.25) * 1000) / 1000  # milliseconds, cut off
    late = logged + 0.002 + random.exponential(0.0003, len(logged))
    late[random.integers(0, len(late), 200)] += 0.02  # queueing
    order = np.argsort(late)
    result = align_by_time_frame(nanoseconds(late[order]), nanoseconds(unit[order]), latency=0.002,
                                 latency_uncertainty=0.001)
    assert result.verdict is Verdict.GOOD, result.reasons
    assert result.offset_ns * 1e-9 == pytest.approx(true_offset(result.at_ns, 1.25, 25e-6), abs=1e-3)
    assert result.drift_ppm == pytest.approx(25, abs=0.5)
    assert result.offset_deviation >= 0.001


def test_time_frames_show_a_clock_step() -> None:
    logged = np.arange(0, 600, 0.01)
    jumped = align_by_time_frame(nanoseconds(logged + np.where(logged > 400, 0.5, 0)), nanoseconds(logged))
    assert jumped.verdict is Verdict.REFUSED
    assert re.match(r"a clock steps by -500 ms about \+(9|10)\d s", jumped.reasons[0])
    small_step = align_by_time_frame(nanoseconds(logged + np.where(logged > 400, 0.04, 0)), nanoseconds(logged))
    assert small_step.verdict is Verdict.DOUBTFUL
    assert "do not lie on one line" in small_step.reasons[0]
    empty = np.zeros(0, dtype=np.int64)
    assert align_by_time_frame(empty, empty).verdict is Verdict.REFUSED
