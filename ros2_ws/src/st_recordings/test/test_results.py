"""Results of a recorded run: means against the arrays they are computed from, and the segments that are drawn."""

import resource
import signal
from pathlib import Path

import numpy as np
import pytest
from ros_messages import STORE, definition, header, odometry, serialise
from st_recordings.mcap import BagWriter
from st_recordings.paths import replace_file
from st_recordings.results import MAX_DRAWN_STARTS, read_results, summarise
from st_recordings.runs.errors import RunError

ERROR, STATUS, ODOMETRY = "st_msgs/msg/PredictionError", "st_msgs/msg/PredictorStatus", "nav_msgs/msg/Odometry"
T0 = 1_756_900_800_000_000_000
HORIZON = np.linspace(0.0, 5.0, 101)
STARTS = 40
INCOMPLETE = 7  # start that one model did not complete


def make_errors(model: str, mode: str, k: int) -> np.ndarray:
    """(points, 3): longitudinal and lateral error [m] and yaw error [rad] of the k-th start."""
    scale = {"kinematic": 1.0, "linear": 0.25}[model] * {"forecast": -1.0, "hindsight": 1.0}[mode]
    values = scale * (1 + k) * HORIZON[:, None] * [0.1, -0.03, 0.002]
    if (model, k) == ("linear", INCOMPLETE):
        values[90:] = np.nan
    return values


def error_message(model: str, mode: str, k: int) -> bytes:
    errors = make_errors(model, mode, k)
    complete = bool(np.isfinite(errors).all())
    means = errors.mean(axis=0) if complete else np.full(3, np.nan)
    names = ("longitudinal", "lateral", "yaw")
    return serialise(ERROR, header=header(T0 + k * 10**8), model=model, mode=mode, complete=complete,
                     incomplete_reason="" if complete else f"INS: no sample at {k * 0.1:.3f} s", horizon=HORIZON,
                     **dict(zip(names, errors.T.copy(), strict=True)),
                     **{f"{n}_mean": m for n, m in zip(names, means.tolist(), strict=True)}, configuration_hash="cafe")


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    """The INS moves east at 3 m/s while the car yaws about it at 0.1 rad/s."""
    def writer(name: str, topics: dict[str, str]) -> tuple[BagWriter, list[int]]:
        bag = BagWriter(tmp_path / name)
        return bag, [bag.add_topic(topic, t, definition=definition(t),
                                   type_hash=STORE.hash_rihs01(t)) for topic, t in topics.items()]

    bag, (ins, status) = writer("bag", {"/ins/odometry": ODOMETRY, "/predictor/status": STATUS})
    for k in range(1000):
        bag.write(ins, odometry(T0 + k * 10**7, 0.03 * k, 2.0, 0.001 * k), T0 + k * 10**7)
    for k in (1, 2):
        bag.write(status, serialise(STATUS, header=header(T0), due=50 * k, predicted=45 * k, skipped_stale=2 * k,
                                    skipped_overrun=k, skipped_slow=2 * k, reason="below 0.5 m/s", state_age=0.01,
                                    state_age_max=0.02), T0 + k)
    bag.close()
    errors, (topic,) = writer("errors", {"/evaluator/errors": ERROR})
    for k in reversed(range(STARTS)):
        for model in ("kinematic", "linear"):
            for mode in ("forecast", "hindsight"):
                errors.write(topic, error_message(model, mode, k), T0 + k * 10**8)
    errors.close()
    return tmp_path


def test_summary_equals_the_statistics_of_the_arrays(run_folder: Path) -> None:
    summary = summarise(read_results(run_folder), {"title": "test"})
    assert list(summary["models"]) == ["kinematic", "linear"]
    assert summary["configuration_hash"] == "cafe"
    assert summary["units"] == {"longitudinal": "m", "lateral": "m", "yaw": "rad"}
    assert summary["ticks"] == {"due": 100, "predicted": 90, "skipped": 10,
                                "skipped_by_reason": {"stale": 4, "overrun": 2, "slow": 4}}
    for model, modes in summary["models"].items():
        complete = [k for k in range(STARTS) if (model, k) != ("linear", INCOMPLETE)]
        for mode, row in modes.items():
            means = np.array([make_errors(model, mode, k).mean(axis=0) for k in complete])
            assert (row["n_starts"], row["n_incomplete"]) == (len(complete), STARTS - len(complete))
            for column, axis in enumerate(("longitudinal", "lateral", "yaw")):
                assert row[axis]["mean"] == pytest.approx(means[:, column].mean(), rel=1e-12)
                assert row[axis]["max"] == pytest.approx(np.abs(means[:, column]).max(), rel=1e-12)
                assert row[axis]["rmse"] == pytest.approx(np.sqrt((means[:, column] ** 2).mean()), rel=1e-12)


def test_segments_start_where_every_model_completed(run_folder: Path) -> None:
    results = read_results(run_folder)
    starts = sorted({start_ns for _, start_ns in results.segments})
    assert len(starts) == MAX_DRAWN_STARTS
    assert starts[0] == T0
    assert starts[-1] == T0 + (STARTS - 1) * 10**8
    assert T0 + INCOMPLETE * 10**8 not in starts
    assert set(results.segments) == {(model, s) for model in ("kinematic", "linear") for s in starts}
    for (model, start_ns), segment in results.segments.items():
        expected = make_errors(model, "hindsight", (start_ns - T0) // 10**8)
        np.testing.assert_array_equal(segment.longitudinal, expected[:, 0])
        np.testing.assert_array_equal(segment.lateral, expected[:, 1])
        np.testing.assert_allclose(segment.time_ns - start_ns, HORIZON * 1e9, atol=300.0)  # float64 of a UTC time


def test_track_is_that_of_the_ins(run_folder: Path) -> None:
    track = read_results(run_folder).track
    np.testing.assert_array_equal(track.time_ns, T0 + np.arange(1000) * 10**7)
    np.testing.assert_allclose(track.x, 0.03 * np.arange(1000))
    np.testing.assert_allclose(track.yaw, 0.001 * np.arange(1000), atol=1e-12)


def test_truncated_recording_is_rejected(run_folder: Path) -> None:
    file = run_folder / "errors" / "errors_0.mcap"
    file.write_bytes(file.read_bytes()[:-400])
    with pytest.raises(RunError, match=r"errors_0\.mcap: .*st recover"):
        read_results(run_folder)


def test_failed_write_leaves_the_previous_file(tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    replace_file(file, "{}")
    before = file.read_text()
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, limits[1]))
    try:
        with pytest.raises(OSError):
            replace_file(file, "x" * 1000)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert file.read_text() == before and list(tmp_path.iterdir()) == [file]
