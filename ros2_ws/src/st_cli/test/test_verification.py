"""The command st verify, without ROS: a bag of predictions by the live classes, compared with the offline library."""

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import st
from mcap.reader import make_reader
from rich.console import Console
from ros_messages import STORE, definition, header, odometry, serialise, stamp
from scipy.integrate import trapezoid
from st_core.evaluation import Evaluator
from st_core.prediction import PredictionSettings, Predictor, Start, configuration_hash
from st_core.types import InsSample
from st_core.vehicle import VehicleParameters
from st_live import replaying, session, verification
from st_live.replaying import describe_omissions, replay_bag
from st_live.verification import verify
from st_recordings.mcap import BagWriter
from st_recordings.runs.bag import ODOMETRY, STEERING, read_bag
from st_recordings.runs.errors import RunError
from st_recordings.runs.reconstruct import RECONSTRUCTED_SUFFIX
from support import LEAF, ROOT

PREDICTION, ERROR = "st_msgs/msg/Prediction", "st_msgs/msg/PredictionError"
MODELS = ("kinematic", "linear")
T0 = 1_756_900_800_000_000_000
SECONDS = 6.0
SETTINGS = PredictionSettings(horizon=1.0)
LEAF_TEXT = LEAF.read_text()
CAR = VehicleParameters.from_yaml(LEAF_TEXT, "leaf")
NODES = {"predictor": {"horizon": 1.0, "vehicle_file": "config/vehicle/leaf.yaml"}, "evaluator": {}}


def path(time: float) -> tuple[float, float]:
    """x and y [m] after driving for `time` [s] at 8 + sin t and -0.1 cos t m/s, yaw 0.3 sin t."""
    t = np.linspace(0.0, time, 200)
    yaw, forward, left = 0.3 * np.sin(t), 8.0 + np.sin(t), -0.1 * np.cos(t)
    return (float(trapezoid(forward * np.cos(yaw) - left * np.sin(yaw), t)),
            float(trapezoid(forward * np.sin(yaw) + left * np.cos(yaw), t)))


class LiveBag:
    """A weaving drive processed by Predictor and Evaluator tick by tick, and written as the nodes write it."""

    def __init__(self, folder: Path, car: VehicleParameters):
        self.folder, self.car = folder, car
        self.path_shift = 0.0  # m or rad, added to the end of one predicted path
        self.shifted_column = "x"
        self.score_shift = 0.0  # m, added to the lateral scores of one model and mode
        self.without_predictions = False
        self.contains_its_car = True
        self.model_text = ""  # of the recorded model file, if there is one
        self.has_model_of_a_file = False  # whether a model of a file also predicts
        self.velocity_factor = 1.0
        self.unreceived = range(0)  # numbers of the samples the predictor does not receive
        self.n_before_evaluator = 0  # number of the first samples that the evaluator does not receive
        self.n_recorded = 10_000  # number of samples until the recorder, but not the evaluator, is killed
        self._predictor, self._evaluator = Predictor(car, MODELS, SETTINGS), Evaluator(car, SETTINGS)
        self._count = 0

    def write(self) -> Path:
        import yaml

        parameters = yaml.safe_dump({node: {"ros__parameters": values} for node, values in NODES.items()})
        files = {"leaf.yaml": LEAF_TEXT} if self.contains_its_car else {}
        files |= {"model.yaml": self.model_text} if self.model_text else {}
        writer = BagWriter(self.folder, {"configuration": {**files, "parameters.yaml": parameters}})
        topics = {name: writer.add_topic(topic, name, definition=definition(name),
                                         type_hash=STORE.hash_rihs01(name))
                  for topic, name in (("/ins/odometry", ODOMETRY), ("/vehicle/steering", STEERING),
                                      ("/predictor/x/prediction", PREDICTION), ("/evaluator/errors", ERROR))}
        for k in range(round(SECONDS * 100)):
            time, time_ns = 0.01 * k, T0 + 10_000_000 * k
            velocity = self.velocity_factor * np.array([8.0 + np.sin(time), -0.1 * np.cos(time)])
            sample = InsSample(time_ns, *path(time), 0.3 * np.sin(time), *velocity.tolist(), 0.3 * np.cos(time))
            angle = 0.1 * np.cos(time - 0.003)
            steering_ns = time_ns + 3_000_000
            if k == self.unreceived.stop:
                self._predictor = Predictor(self.car, MODELS, SETTINGS)
            for core in [*([] if k in self.unreceived else [self._predictor]),
                         *([] if k < self.n_before_evaluator else [self._evaluator])]:
                core.add_ins(sample)
                core.add_steering(steering_ns, angle)
            if k < self.n_recorded:
                writer.write(topics[ODOMETRY], odometry(*sample), time_ns)
                writer.write(topics[STEERING], serialise(STEERING, header=header(steering_ns), road_wheel_angle=angle,
                                                       steering_wheel_angle=angle * 17.3, valid=True), steering_ns)
            if k % 10 == 9 and not self.without_predictions:
                for prediction in self._tick(steering_ns):
                    if k < self.n_recorded:
                        writer.write(topics[PREDICTION], prediction, steering_ns)
            for score in self._evaluator.poll():
                writer.write(topics[ERROR], self._score(score), steering_ns)
        for score in self._evaluator.flush():
            writer.write(topics[ERROR], self._score(score), T0 + 10**10)
        writer.close()
        return self.folder

    def _tick(self, now_ns: int) -> list[bytes]:
        start = self._predictor.find_start(now_ns)
        if not isinstance(start, Start):
            return []
        messages = []
        for model in MODELS:
            path = self._predictor.run(start, model)
            self._evaluator.add_prediction(model, start.time_ns, path)
            self._count += 1
            names = ("x", "y", "velocity_x", "velocity_y", "yaw", "yaw_rate")
            columns = {name: path.states[:, k].copy() for k, name in enumerate(names)}
            columns[self.shifted_column][-1] += self.path_shift if self._count == 41 else 0.0
            hashes = {model: configuration_hash(self.car, SETTINGS)}
            if self.has_model_of_a_file:
                hashes["augmented"] = configuration_hash(self.car, SETTINGS, "hash of the model file")
            messages += [serialise(
                PREDICTION, header=header(start.time_ns, "map"), issued_at=stamp(0), model=name, step=path.step,
                road_wheel_angle=start.inputs.road_wheel_angle, velocity_x_dot=start.inputs.velocity_x_dot, **columns,
                cg_to_ins_x=self.car.cg_to_ins_x, cg_to_ins_y=0.0, compute_time=0.0, configuration_hash=hashed,
                bands=[]) for name, hashed in hashes.items()]
        return messages

    def _score(self, score) -> bytes:
        shift = self.score_shift if (score.model, score.mode) == ("linear", "hindsight") else 0.0
        return serialise(
            ERROR, header=header(score.start_ns, "map"), model=score.model, mode=score.mode, complete=score.complete,
            incomplete_reason=score.incomplete_reason, horizon=score.horizon, longitudinal=score.longitudinal,
            lateral=score.lateral + shift, yaw=score.yaw, longitudinal_mean=score.longitudinal_mean,
            lateral_mean=score.lateral_mean, yaw_mean=score.yaw_mean, configuration_hash="")


@pytest.fixture
def live(tmp_path):
    return LiveBag(tmp_path / "bag", CAR)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A recording of the nodes without deviations."""
    return LiveBag(tmp_path_factory.mktemp("live") / "bag", CAR).write()


def st_verify(*arguments):
    return st("verify", *arguments, columns=80)


def test_live_and_offline_agree_for_every_start(bag):
    found = verify(bag)
    assert [c.model for c in found.comparisons] == list(MODELS) and found.same_configuration
    for comparison in found.comparisons:
        assert comparison.n_predictions == {"forecast": 53} and comparison.n_one_sided == comparison.n_truncated == 0
        assert comparison.n_settling == 7
        # One second of horizon at the end is incomplete on both sides.
        assert comparison.n_scores == {"hindsight": 43, "forecast": 43}
        assert comparison.largest_difference < 1e-9 and comparison.yaw_difference < 1e-9
    result = st_verify(bag)
    assert "no car was given" not in result.stderr
    assert result.exit_code == 0 and "106 predictions and 172 scores compared" in result.output.replace("\n", " ")


def test_deviation_of_two_millimetres_is_found_and_located(live):
    live.path_shift = 0.002
    found = verify(live.write())
    kinematic, linear = found.comparisons
    assert kinematic.path_difference == pytest.approx(0.002, abs=1e-9) and kinematic.start_difference < 1e-9
    assert kinematic.worst_start_ns == T0 + 10_000_000 * (20 * 10 + 9) and linear.path_difference < 1e-9
    result = st_verify(live.folder)
    assert result.exit_code == 1 and "live differs from offline" in result.output
    assert st_verify(live.folder, "--tolerance", "0.003").exit_code == 0


def test_deviation_of_yaw_alone_is_found(live):
    live.shifted_column, live.path_shift = "yaw", 0.002
    assert verify(live.write()).largest_difference < 1e-9
    result = st_verify(live.folder)
    assert result.exit_code == 1 and "in yaw 2 mrad (limit 1 mrad)" in " ".join(result.output.split())


@pytest.mark.slow
@pytest.mark.parametrize("unreceived", [range(17), range(250, 400)], ids=["discovered late", "restarted"])
def test_predictions_before_the_filter_settles_are_excluded_and_counted(live, unreceived, monkeypatch):
    live.unreceived = unreceived
    found = verify(live.write())
    assert found.largest_difference < 1e-6 and all(c.n_settling >= 7 for c in found.comparisons)
    result = st_verify(live.folder)
    assert result.exit_code == 0 and "predictions not compared: the filter" in result.output.replace("\n", " ")
    monkeypatch.setattr(verification, "SETTLING_TIME_CONSTANTS", 0.0)
    assert verify(live.folder).largest_difference > 0.001  # the settling filter is the only cause


def test_too_short_recording_is_reported(bag, monkeypatch):
    monkeypatch.setattr(verification, "SETTLING_TIME_CONSTANTS", 1e6)
    result = st_verify(bag)
    assert result.exit_code == 2 and "filter had not settled for 120 predictions" in result.output.replace("\n", " ")


@pytest.mark.parametrize("period", [0.1, 0.5, 1.0, 2.0])
def test_slow_predictions_are_compared_and_a_restart_settles_again(period):
    rng = np.random.default_rng(1)
    starts = np.arange(60) * period + rng.normal(0.0, 2e-3, 60)
    starts[30:] += 10 * period + 2.0
    starts_ns = np.round(1e9 * starts).astype(np.int64)
    settled = verification.find_settled_starts(starts_ns, starts_ns[:1], cutoff=5.0)
    assert not settled[0] and not settled[30]
    assert settled.sum() >= 60 - 2 * (1 + int(0.7 / period))


def test_deviating_score_is_found(live):
    live.score_shift = -0.005
    found = verify(live.write())
    assert found.comparisons[1].score_difference["hindsight"] == pytest.approx(0.005, abs=1e-9)
    assert found.comparisons[1].score_difference["forecast"] < 1e-9
    assert found.largest_difference == pytest.approx(0.005, abs=1e-9)


def test_evaluator_that_is_ready_after_the_predictor_is_no_difference(live):
    live.n_before_evaluator = 150
    found = verify(live.write())
    assert found.largest_difference < 1e-9 and not sum(c.n_one_sided for c in found.comparisons)
    assert found.comparisons[0].n_scores["hindsight"] > 20


def test_scores_beyond_the_end_of_a_killed_recorder_are_no_difference(live):
    live.n_recorded = 400
    found = verify(live.write())
    for comparison in found.comparisons:
        assert comparison.n_predictions["forecast"] == 33 and comparison.n_one_sided == 0
        assert comparison.n_truncated == 20 and comparison.n_scores == {"hindsight": 23, "forecast": 23}
    result = st_verify(live.folder)
    assert result.exit_code == 0 and "40 incomplete because nodes or recording ended" in " ".join(result.output.split())


def test_bags_after_a_restart_of_the_recorder_are_reported(live):
    run = live.write().parent
    assert "restarted" not in st_verify(run).output
    shutil.copytree(live.folder, run / "bag_2")
    output = st_verify(run).output
    assert f"only {live.folder} is used" in output and "continued in bag_2" in output


def test_truncated_recording_is_reported(live):
    assert "was not closed" not in st_verify(live.write()).output and describe_omissions(live.folder, ()) == []
    file = live.folder / f"{live.folder.name}_0.mcap"
    with file.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    os.truncate(file, chunks[-1].chunk_start_offset + chunks[-1].chunk_length)
    unread = st_verify(live.folder)
    assert unread.exit_code == 2 and "was not closed" in unread.output and "st recover" in unread.output
    recovered = st("recover", live.folder)
    assert recovered.exit_code == 0, recovered.output
    done = st_verify(live.folder)
    assert f"{live.folder} was not closed" in done.output.replace("\n", "")
    (text,) = describe_omissions(live.folder, ())
    assert text.startswith(f"{live.folder} was not closed") and text.endswith("cannot be played")
    assert describe_omissions(live.folder, ["/a (b)"])[0] == "topics of unknown type, not played: /a (b)"


def test_recording_with_an_error_is_compared_when_forced(live):
    """The nodes received km/h as well, so live equals offline; neither reports the wrong unit."""
    live.velocity_factor = 3.6
    folder = live.write()
    result = st_verify(folder)
    assert result.exit_code == 2 and "velocity_scale" in result.output and "--force" in result.output
    forced = st_verify(folder, "--force")
    assert forced.exit_code == 0 and "live equals offline" in forced.output
    assert "error: " in forced.output and "km/h" in forced.output


def test_check_uses_the_vehicle_of_the_recording(bag, tmp_path):

    def check_vehicle(output, *more):
        result = st("check", bag, "--output", tmp_path / output, *more, columns=80)
        assert result.exit_code == 0, result.output
        content = json.loads((tmp_path / output / "check.json").read_text())
        (run,), (source,) = content["runs"].values(), content["vehicle"]
        assert run["vehicle"] == source and source in result.output and "no car was given" not in result.stderr
        return source

    assert check_vehicle("a") == "the recording"
    given = tmp_path / "given.yaml"
    given.write_text(LEAF_TEXT)
    assert check_vehicle("b", "--vehicle", given) == str(given)


def test_different_vehicle_gives_different_predictions(bag, tmp_path):
    other = tmp_path / "other.yaml"
    stiffness = "cornering_stiffness_front: {value: "
    other.write_text(LEAF_TEXT.replace(f"{stiffness}70000.0", f"{stiffness}60000.0"))
    found = verify(bag, other)
    kinematic, linear = found.comparisons
    assert not found.same_configuration and kinematic.path_difference < 1e-9 and linear.path_difference > 0.01
    assert linear.start_difference < 1e-9
    assert "a different vehicle" in st_verify(bag, "--vehicle", other).output


def test_model_of_a_file_is_not_compared_and_does_not_make_the_configuration_different(live):
    live.has_model_of_a_file = True
    found = verify(live.write())
    assert [c.model for c in found.comparisons] == list(MODELS) and found.same_configuration
    assert any("augmented are not compared" in warning for warning in found.warnings)


def test_recording_without_predictions_has_nothing_to_compare(live):
    live.without_predictions = True
    assert verify(live.write()) is None


def test_replay_uses_the_recorded_model_file(live, tmp_path, monkeypatch):
    """The file itself may have moved or changed."""
    live.model_text = "recorded model"
    monkeypatch.setitem(NODES["predictor"], "model_file", "/elsewhere/model.yaml")
    runs = []
    monkeypatch.setattr(session, "run", lambda *arguments: runs.append(arguments))
    replay_bag(live.write(), tmp_path, None, 0.0, Console())
    parameters, model = runs[0][1], tmp_path / "model.yaml"
    assert model.read_text() == "recorded model" and str(model) in parameters["recorder"]["configuration_files"]
    assert {parameters[node]["model_file"] for node in ("predictor", "evaluator")} == {str(model)}


@pytest.mark.parametrize(("changes", "message"), [
    ({"conversions": ("all stamps were moved to the clock of /odom",)},
     r"played as recorded: all stamps were moved .*; st check, st evaluate and"),
    ({"topics": {ODOMETRY: f"/ins/ncom{RECONSTRUCTED_SUFFIX}", STEERING: "/vehicle/steering"}},
     r"cannot be played: no nav_msgs/msg/Odometry; use st evaluate, which reconstructs")])
def test_recording_that_is_converted_or_reconstructed_is_not_replayed(live, tmp_path, monkeypatch, changes, message):
    drive = replace(read_bag(live.write()), **changes)
    monkeypatch.setattr(replaying, "read_bag", lambda *arguments, **settings: drive)
    with pytest.raises(RunError, match=message):
        replay_bag(tmp_path, tmp_path, None, 0.0, Console())


def test_replay_that_was_stopped_before_it_began_is_reported(bag, tmp_path, monkeypatch):
    monkeypatch.setattr(session, "run", lambda *arguments, **options: session.Outcome({}, interrupted=True))
    result = st("verify", bag, "--replay", "--output", tmp_path / "replay")
    assert result.exit_code == 2 and "stopped before it began" in result.output


def test_invalid_recording_is_rejected(tmp_path):
    file = tmp_path / "x.mcap"
    file.write_bytes(b"nothing of the kind")
    for verb in ("verify", "view"):
        result = st(verb, file)
        assert result.exit_code == 2 and "x.mcap" in result.output and "no car was given" not in result.stderr


@pytest.mark.slow
def test_use_of_the_default_leaf_is_reported_for_a_recording_without_a_car(live, tmp_path):
    live.contains_its_car = False
    bag = live.write()
    drive = ROOT / "examples" / "data" / "rfs_turn_a.csv"
    for arguments in (["verify", bag], ["check", bag, "--output", tmp_path / "a"],
                      ["check", drive, "--output", tmp_path / "b"]):
        text = st(*arguments).stderr
        assert text.count("no car was given") == 1 and "car/leaf/vehicle.yaml" in text and "--car" in text
    for arguments in (["verify", bag], ["check", drive, "--output", tmp_path / "c"]):
        named = st(*arguments, "--car", "leaf")
        assert "no car was given" not in named.stderr and named.exit_code in (0, 1), named.output
