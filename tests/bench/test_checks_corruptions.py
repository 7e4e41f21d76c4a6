"""Faults put into drives for the matrix of checks: each does what its name says, and nothing else."""

import numpy as np
import pytest
from st_core.checks import Finding, Severity
from support import EXAMPLES

from bench.checks import faults, score, tables
from bench.checks.corruptions import KINDS, Kind, Size
from bench.checks.drives import real_drive
from bench.checks.recording import half, late, with_stamps
from bench.checks.run import sizes
from bench.checks.virtual import virtual_drive


@pytest.fixture(scope="module")
def car():
    return virtual_drive("S6", 3, 40.0)


@pytest.fixture(scope="module")
def genesis():
    return real_drive(EXAMPLES / "rfs_turn_a.csv")


def differs(a, b) -> bool:
    """Whether anything that was recorded does."""
    pairs = [(getattr(a.log, name), getattr(b.log, name)) for name in a.log.__dataclass_fields__ if name != "name"]
    for name in ("wheel_speed", "ins_speed", "quality"):
        one, other = getattr(a.extras, name), getattr(b.extras, name)
        pairs += [] if one is None else [(getattr(one, f), getattr(other, f)) for f in one.__dataclass_fields__]
    pairs += [(a.extras.stamps[name], b.extras.stamps[name]) for name in a.extras.stamps if name in b.extras.stamps]
    return any(one is not None and not np.array_equal(one, other) for one, other in pairs)


def test_there_are_enough_kinds_and_each_has_two_sizes():
    assert len(KINDS) >= 28
    for kind in KINDS.values():
        first, second = kind.sizes
        assert (first.value, first.part) != (second.value, second.part), kind.name


@pytest.mark.parametrize("kind", KINDS.values(), ids=lambda kind: kind.name)
def test_a_corruption_changes_the_recording_and_knows_the_truth(kind: Kind, car):
    clean = kind.before(car) if kind.before else car
    shown = [size for size in kind.sizes if kind.shows(clean, size.value)]
    for size in shown:
        corrupted, truth = kind.edit(clean, size.value)
        assert differs(clean, corrupted) and np.isfinite(truth)


def test_late_channels_say_what_was_true_before(car):
    moved = late(car, 0.3, "yaw_rate").log
    before = np.searchsorted(car.log.ins_time_ns, moved.ins_time_ns[500] - 300_000_000)
    assert moved.yaw_rate[500] == pytest.approx(car.log.yaw_rate[before])
    same = np.searchsorted(car.log.ins_time_ns, moved.ins_time_ns[500])
    assert moved.velocity_x[500] == car.log.velocity_x[same]
    assert moved.duration == pytest.approx(car.log.duration - 0.6, abs=0.02)


def test_gaps_are_as_long_as_they_say(genesis):
    corrupted, truth = faults.three_gaps(genesis, 1.0)
    steps = np.diff(corrupted.time)
    assert np.count_nonzero(steps > 0.25) == 3
    assert truth == pytest.approx(3.0, abs=0.15)
    assert np.diff(corrupted.log.steering_time_ns).max() > 0.9e9


def test_stamps_out_of_order_go_back_that_often_and_the_reader_leaves_them_out(genesis):
    corrupted, share = faults.stamps_swapped(with_stamps(genesis), 0.1)
    stamps = corrupted.extras.stamps["INS"]
    assert np.mean(np.diff(stamps) < 0) == pytest.approx(share, abs=0.001)
    rising = np.diff(np.maximum.accumulate(stamps), prepend=stamps[0] - 1) > 0
    np.testing.assert_array_equal(stamps[rising], corrupted.log.ins_time_ns)


def test_stamps_twice_are_that_share_of_the_rows(genesis):
    corrupted, share = faults.stamps_twice(with_stamps(genesis), 0.2)
    assert np.mean(np.diff(corrupted.extras.stamps["INS"]) == 0) == pytest.approx(share, abs=0.001)


def test_jitter_is_what_intervals_have_more(car):
    corrupted, truth = faults.jitter(car, 0.002)
    assert truth == pytest.approx(0.002 * np.sqrt(2), rel=0.05)
    np.testing.assert_allclose(corrupted.log.ins_time_ns, car.log.ins_time_ns, rtol=0, atol=12e6)


def test_stale_positions_are_those_of_the_row_before(car):
    corrupted, share = faults.stale_positions(car, 0.3)
    old = corrupted.log.x != car.log.x
    assert old.mean() == pytest.approx(0.3, abs=0.02)
    assert share == pytest.approx(0.3 * 0.7, abs=0.02)  # rows at which an old position follows a fresh one
    np.testing.assert_array_equal(corrupted.log.x[old], car.log.x[np.flatnonzero(old) - 1])


def test_jumps_have_their_size_and_number(car):
    offset = np.hypot(*(getattr(faults.jumps_every_second(car, 0.3)[0].log, c) - getattr(car.log, c) for c in "xy"))
    assert np.unique(np.round(offset, 6)).tolist() == [0.0, 0.3]
    assert np.count_nonzero(np.abs(np.diff(offset)) > 0.1) == faults.jumps_every_second(car, 0.3)[1] == 39


def test_held_and_frozen_channels_repeat(car):
    corrupted, share = faults.held("yaw_rate")(car, 5.0)
    assert share == pytest.approx(0.95, abs=0.002)
    assert np.mean(np.diff(corrupted.log.yaw_rate) == 0) == pytest.approx(share, abs=0.002)
    stood, seconds = faults.frozen("yaw_rate")(car, 10.0)
    same = np.diff(np.flatnonzero(np.diff(stood.log.yaw_rate, prepend=np.nan) != 0)).max() * 0.01
    assert same == pytest.approx(seconds, abs=0.03)


def test_degrees_wrapped_and_unwrapped_as_rad_jump(car):
    yaw = faults.wrapped_degrees(car, 57.29577951)[0].log.yaw
    # 360 deg taken for rad: 360 - 57 * 2 pi.
    assert np.abs(np.diff(yaw)).max() == pytest.approx(1.858, abs=0.3)


def test_an_ins_askew_or_elsewhere_still_travels_the_same_way(car):
    turned, moved = (KINDS[name].edit(car, 0.5)[0].log for name in ("INS askew", "measuring point moved back"))
    for log, lever in ((turned, 0.0), (moved, -0.5)):
        east = np.cos(log.yaw) * log.velocity_x - np.sin(log.yaw) * log.velocity_y
        assert np.hypot(log.x - car.log.x, log.y - car.log.y).max() == pytest.approx(-lever)
        # Position differences are still the velocity, so positions and velocities were moved together.
        assert np.abs(np.diff(log.x) - 0.005 * (east[1:] + east[:-1])).mean() < 0.002


def test_the_sealed_sizes_differ_and_repeat():
    kind = KINDS["yaw rate late"]
    first, again = (sizes(kind, "rfs_turn_a", "sealed") for _ in range(2))
    assert first == again != sizes(kind, "cpg_lap_fast", "sealed")
    for size, usual in zip(first, kind.sizes, strict=True):
        assert 0.7 <= size.value / usual.value <= 1.5 and size.value != usual.value
    assert sizes(KINDS["yaw in other units"], "rfs_turn_a", "sealed") == list(KINDS["yaw in other units"].sizes)
    smaller = score.drawn(Size("1.1", 1.1), "times", 0.7)
    assert smaller.value == pytest.approx(1.07)


def test_half_a_drive_is_its_middle(car):
    part = half(car)
    assert part.log.duration == pytest.approx(car.log.duration / 2, abs=0.02)
    assert len(part.extras.quality.time_ns) == len(part.extras.quality.position_mode) == len(part.log.x)


def finding(value, interval, severity=Severity.WARNING) -> Finding:
    return Finding("yaw_rate_bias", severity, ("yaw_rate",), "", value, "rad/s", interval)


def test_a_value_is_inside_its_interval_or_within_what_the_kind_allows():
    strict, share = KINDS["yaw rate bias"], KINDS["yaw rate held"]
    assert score.is_inside(strict, finding(0.012, (0.008, 0.016)), 0.01)
    assert not score.is_inside(strict, finding(0.012, (0.011, 0.013)), 0.01)
    assert not score.is_inside(strict, finding(0.0101, None), 0.01)
    assert score.is_inside(share, finding(0.93, None), 0.95)
    assert not score.is_inside(share, finding(0.8, (0.79, 0.81)), 0.95)
    assert not score.is_inside(share, finding(None, None), 0.95)


def test_truth_of_a_virtual_car_knows_its_leaning_body(car):
    kind = KINDS["a_y in other units"]
    truth, source = score.true_value(kind, kind.sizes[0], car, 1 / 9.80665)
    assert source == "edit" and truth * 9.80665 == pytest.approx(1 + 9.80665 * 0.0075, rel=1e-3)
    # The same from what it recorded: a_y against dv_y/dt + r v_x, over half a second.
    smooth = np.ones(50) / 50
    derived = np.gradient(car.log.velocity_y, car.time) + car.log.yaw_rate * car.log.velocity_x
    slope = np.polyfit(*(np.convolve(c, smooth, "valid") for c in (derived, car.log.acceleration_y)), 1)[0]
    assert slope == pytest.approx(truth * 9.80665, abs=0.01)


def test_the_table_goes_between_its_marks(tmp_path):
    page = tmp_path / "checks.md"
    page.write_text(f"before\n<!-- here -->\nold\n{tables.END}\nafter\n")
    tables.put_into(page, "here", "new")
    assert page.read_text() == f"before\n<!-- here -->\n\nnew\n\n{tables.END}\nafter\n"
    page.write_text("no marks")
    with pytest.raises(ValueError, match="marks"):
        tables.put_into(page, "there", "new")
