"""Assembles and checks the node parameters of a run, finds the bag of a run, and starts the virtual Leaf."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from st_core.bands import Bands
from st_core.course import Course
from st_core.effects import load_folder
from st_core.errors import StCoreError
from st_core.log_evaluation import EvaluationSettings
from st_core.models import MODELS, Model
from st_core.prediction import PredictionSettings
from st_core.vehicle import VehicleParameters
from st_recordings.car import read_model_file, read_text, read_vehicle
from st_recordings.paths import config, project_root
from st_recordings.results import RecordedConfiguration
from st_recordings.runs.bag import is_bag
from st_sim.run import check_arguments

from .suite import Parameters, Suite, SuiteError, find_executable, find_free_udp_port, merge_parameters

T = TypeVar("T")
REPLAY_NODES = ("recorder", "evaluator", "predictor")  # in the order of their start: subscribers first
TRUNCATION_WARNING = "{} was not closed by its recorder: its end may be missing and cannot be {}"
LEAF_TIMEOUT = 60.0  # s within which the virtual Leaf must start to transmit


def resolve_vehicle_file(file: Path | None) -> Path:
    """Absolute path of a vehicle file, by default the Leaf's. Raises StCoreError for an unreadable or invalid file."""
    path = (file or config("vehicle/leaf.yaml")).absolute()
    read_vehicle(path)
    return path


def find_vehicle_name(vehicle: Path) -> str:
    """Name of the car in results: the file name without suffix, or the name of the folder of a file vehicle.yaml."""
    return vehicle.parent.name if vehicle.name == "vehicle.yaml" else vehicle.stem


def make_bridge_parameters(vehicle: Path, ins: dict[str, Any], can: dict[str, Any], dbc: Path | None = None,
                           signals: Path | None = None) -> dict[str, dict[str, Any]]:
    """Parameters of both bridges, including the additional ones in `ins` and `can`. The transform from base_link to
    ins_link is the lever arm of the vehicle file, without a height: base_link is the CG, at the height of the INS."""
    car = read_vehicle(vehicle)
    lever_arm = [float(car.cg_to_ins_x), float(car.cg_to_ins_y), 0.0]
    files = {"vehicle_file": str(vehicle), "dbc_file": str((dbc or config("can/leaf_ze0.dbc")).absolute()),
             "signals_file": str((signals or config("can/leaf_ze0.yaml")).absolute())}
    # Raw frames are recorded, so that the bag can be decoded with a different DBC.
    return {"oxts_bridge": {"base_to_ins": lever_arm, **ins},
            "canedge_bridge": {**can, **files, "publish_frames": True}}


def make_live_parameters(folder: Path, vehicle: Path, bridges: Parameters, model: Mapping[str, str] | None = None,
                         record_all: bool = False) -> Parameters:
    """Parameters of config/nodes.yaml, updated for a live run in `folder`. model: result of `make_model_parameters`.
    record_all: whether to record topics that can be derived from others."""
    from st_predictor.params import ALL_TOPICS  # needs ROS, which `load_model` does not

    common = {"vehicle_file": str(vehicle), **(model or {})}
    # With the DBC and the signal table, the raw frames can be decoded on any computer.
    files = [str(vehicle), str(folder / "parameters.yaml"), bridges["canedge_bridge"]["dbc_file"],
             bridges["canedge_bridge"]["signals_file"], *([model["model_file"]] if model else [])]
    return merge_parameters(config("nodes.yaml"), {
        **bridges,
        "predictor": common,
        "evaluator": {**common, "output_directory": str(folder / "errors"), "number_if_exists": True},
        "recorder": {"output_directory": str(folder / "bag"), "number_if_exists": True, "configuration_files": files,
                     **({"topics": ALL_TOPICS} if record_all else {})},
    })


def make_replay_parameters(folder: Path, vehicle: Path, recorded: RecordedConfiguration,
                           model: Path | None = None) -> dict[str, dict[str, Any]]:
    """Parameters of REPLAY_NODES from config/nodes.yaml, updated with those recorded for predictor and evaluator.
    model: model file to use instead of the one named in the recording, which may have moved or changed."""
    model_file = {"model_file": str(model)} if model else {}
    common = {"vehicle_file": str(vehicle), "use_sim_time": True, **model_file}
    nodes = {node: {**{name: value for name, value in recorded.nodes.get(node, {}).items()
                       if name != "number_when_taken"},  # older name of number_if_exists
                    **common} for node in ("predictor", "evaluator")}
    merged = merge_parameters(config("nodes.yaml"), {
        # The files named in the recording may have moved or changed; `set_bands_and_course` sets those of this run.
        "predictor": {**nodes["predictor"], "bands_file": "", "course_file": ""},
        "evaluator": {**nodes["evaluator"], "output_directory": str(folder / "errors")},
        "recorder": {"use_sim_time": True, "output_directory": str(folder / "bag"),
                     "configuration_files": [str(vehicle), str(folder / "parameters.yaml"), *model_file.values()]},
    })
    return {node: merged[node] for node in REPLAY_NODES}


def make_model_parameters(model: Path | None, effects: Path | None, vehicle: Path) -> dict[str, str]:
    """Parameters that add a model file to predictor and evaluator; empty without one. Raises StCoreError."""
    load_model(model, effects, read_vehicle(vehicle), str(vehicle))
    if model is None:
        return {}
    return {"model_file": str(model.absolute()), "effects_directory": str(effects.absolute()) if effects else ""}


def load_model(model: Path | None, effects: Path | None, car: VehicleParameters, origin: str) -> Model:
    """The model in a model file, without a file the nonlinear model. effects: folder of user-defined effects. origin:
    file of `car`. Raises StCoreError for a file that is invalid or of a different car, and for `effects` alone."""
    if model is None:
        if effects is not None:
            raise SuiteError(f"--effects {effects}: requires a model file; add --model")
        return MODELS["nonlinear"]
    if effects is not None:
        load_folder(str(effects.absolute()))
    file = read_model_file(str(model))
    file.check_vehicle(car, origin, f"{model}: ")
    return file.model()


def set_bands_and_course(parameters: Parameters, bands: Path | None, course: Path | None,
                         adaptive: bool | None = None) -> dict[str, dict[str, Any]]:
    """Copy of the parameters with these values of bands_file, course_file and adaptive_bands; None: unchanged. Raises
    StCoreError for an invalid file, and for bands of a different car, model or configuration."""
    updated = {node: {**values} for node, values in parameters.items()}
    predictor, recorder = updated["predictor"], updated["recorder"]
    if adaptive is not None:
        predictor["adaptive_bands"] = adaptive
    if bands:
        loaded_bands = _read_option("--bands", bands, Bands.from_yaml)
        car = read_vehicle(Path(predictor["vehicle_file"]))
        hashes = dict.fromkeys(predictor["models"], "")  # hash of the model file by model; "" for a built-in model
        if name := predictor.get("model_file"):
            model_file = read_model_file(name)
            hashes[model_file.model().name] = model_file.hash
        settings = {name: predictor[name] for name in PredictionSettings.__dataclass_fields__ if name in predictor}
        try:
            loaded_bands.check(car, hashes, EvaluationSettings(PredictionSettings(**settings)))
        except StCoreError as error:
            raise SuiteError(f"--bands {bands}: {error}") from None
    if course:
        _read_option("--course", course, Course.from_yaml)
    for name, path in (("bands_file", bands), ("course_file", course)):
        if path:
            predictor[name] = str(path.absolute())
            recorder["configuration_files"] = [*recorder["configuration_files"], str(path.absolute())]
    return updated


def _read_option(option: str, file: Path, parse: Callable[[str, str], T]) -> T:
    """The parsed content of a file given as an option. Raises SuiteError naming option and file."""
    try:
        return parse(read_text(file), str(file))
    except StCoreError as error:
        raise SuiteError(f"{option} {error}") from None


def find_bag(path: Path) -> Path:
    """The folder `bag`, with measurements and predictions, for the folder of a run; any other path unchanged."""
    return path / "bag" if path.is_dir() and not is_bag(path) and is_bag(path / "bag") else path


class VirtualCar:
    """The virtual Leaf on a free UDP port and a CAN multicast group of the loopback interface. options: arguments of
    virtual_leaf. simulated_vehicle: vehicle file of the simulated car, by default that of the nodes, `vehicle`. Raises
    ConfigurationError for invalid options."""

    def __init__(self, vehicle: Path, options: Sequence[str], simulated_vehicle: Path | None = None):
        self.vehicle = vehicle
        self.port = find_free_udp_port()
        self.channel = f"239.74.163.2:{self.port}"
        own_options = {
            "--vehicle": simulated_vehicle or vehicle, "--config": project_root() / "config", "--ncom-port": self.port,
            "--can-interface": "udp_multicast", "--can-channel": self.channel}
        self._arguments = [*options, *(str(part) for option in own_options.items() for part in option)]
        check_arguments(self._arguments)

    def make_bridge_parameters(self) -> dict[str, dict[str, Any]]:
        # config/nodes.yaml may contain the sign and latency of a real sensor; the virtual one follows the signal table.
        can = {"interface": "udp_multicast", "channel": self.channel, "steering_sign": 1, "steering_latency": 0.0}
        return make_bridge_parameters(self.vehicle, {"udp_port": self.port, "bind_address": "127.0.0.1"}, can)

    def start(self, suite: Suite) -> float:
        """Start the car and wait until it transmits; returns the duration of the drive [s]. Raises SuiteError."""
        arguments = [*self._arguments, "--output", str(suite.folder / "truth")]
        leaf = suite.start("virtual_leaf", [find_executable("st_sim", "virtual_leaf"), *arguments])
        if line := leaf.wait_for('"sending"', LEAF_TIMEOUT):
            return json.loads(line)["duration"]
        raise SuiteError(leaf.read_reason() or f"virtual Leaf: no data in {LEAF_TIMEOUT:g} s; is the computer busy?")
