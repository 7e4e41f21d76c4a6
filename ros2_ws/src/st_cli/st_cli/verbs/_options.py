"""Defines the options shared by the commands, resolves the car from them, and reports errors in one line."""

import inspect
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from st_offline.terminal import console  # noqa: F401 - used by the verbs
from st_recordings.paths import config

if TYPE_CHECKING:
    from st_core.vehicle import VehicleParameters
    from st_live.page import LiveView
    from st_recordings.runs import ReadSettings

FILE: dict[str, Any] = {"exists": True, "dir_okay": False}
FOLDER: dict[str, Any] = {"exists": True, "file_okay": False}
"""Arguments of typer.Option for an existing file or folder."""


def _check_sign(value: int | None) -> int | None:
    if value not in (None, 1, -1):
        raise typer.BadParameter(f"{value} is neither 1 nor -1")
    return value


def in_range(minimum: float, unit: str, maximum: float = math.inf) -> Callable[[float | None], float | None]:
    """Callback that rejects a number outside the range; unlike that of typer, its message contains the unit."""
    def check(value: float | None) -> float | None:
        if value is not None and not minimum <= value <= maximum:
            limit = f"above the maximum of {maximum:g}" if value > maximum else f"below the minimum of {minimum:g}"
            raise typer.BadParameter(f"{value:g} {unit} is {limit} {unit}")
        return value

    return check


Runs = Annotated[list[Path], typer.Argument(
    help="Recordings: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.", show_default=False)]
CarName = Annotated[str | None, typer.Option(
    help="The car: a name in config/car, or a folder with vehicle.yaml, can.dbc, signals.yaml and car.yaml. "
    "--vehicle, --dbc, --signals, --steering-sign and --steering-latency each replace a part of it.")]
VehicleFile = Annotated[Path | None, typer.Option(
    help="Vehicle file; default: from --car, else from a model file (evaluate, calibrate, export) or bag (check), else "
    "that of the Leaf.", **FILE)]
BagVehicle = Annotated[Path | None, typer.Option(
    help="Vehicle file; default: from --car, else from the recording, else that of the Leaf.", **FILE)]
ModelEffects = Annotated[Path | None, typer.Option(
    help="Folder of your own effects that a model file uses.", **FOLDER)]


@contextmanager
def report_errors(verb: str, *additional: type[Exception]) -> Iterator[None]:
    """Report errors in the inputs of a command in one line, with exit status 2. additional: further error types."""
    from st_core.errors import StCoreError
    from st_recordings.paths import OutputError, remove_empty_folders
    from st_recordings.runs.errors import RunError

    expected: tuple[type[Exception], ...] = (StCoreError, RunError, OutputError, UnicodeDecodeError, *additional)
    try:
        yield
    except expected as error:
        remove_empty_folders()
        text = f"{error.filename}: {error.strerror}" if isinstance(error, OSError) and error.filename else str(error)
        typer.echo(f"st {verb}: {text}", err=True)
        raise typer.Exit(2) from None


def split_names(text: str) -> tuple[str, ...]:
    """Names in a comma-separated list, without surrounding spaces; empty names are left out."""
    return tuple(part.strip() for part in text.split(",") if part.strip())


@dataclass(frozen=True)
class ReadOptions:
    """Options for reading recordings, as given by the user; one field per option."""

    car: CarName = None
    vehicle: VehicleFile = None
    offset: Annotated[float | None, typer.Option(
        help="INS minus CAN clock, s; default: from run.yaml, else estimated from the signals.")] = None
    ins_can_latency: Annotated[tuple[float, float] | None, typer.Option(
        help="Latency of the INS's own CAN frames and its standard deviation, s; default: from run.yaml, else 0.002 "
        "0.002.")] = None
    dbc: Annotated[Path | None, typer.Option(
        help="DBC of the CAN logs; default: from --car, else from run.yaml, else that of the Leaf.", **FILE)] = None
    signals: Annotated[Path | None, typer.Option(
        help="Signal table of the DBC; default: from --car, else from run.yaml, else that of the Leaf.", **FILE)] = None
    steering_sign: Annotated[int | None, typer.Option(
        callback=_check_sign, help="1 if the decoded or recorded steering angle is positive to the left, -1 if it is "
        "positive to the right. Default: from --car (CAN only), else 1 (in st live: from nodes.yaml).")] = None
    steering_latency: Annotated[float | None, typer.Option(
        callback=in_range(0.0, "s", 1.0), help="Delay from the motion of the steering wheel to the stamp of the CAN "
        "frame, s. Default: from --car, else 0 (in st live: from nodes.yaml).")] = None
    steering_topic: Annotated[str | None, typer.Option(
        help="Bags of other recorders: topic with the steering angle, of any message type that the bag defines. "
        "Default: the topic of type st_msgs/Steering, else the only one of a known type of steering report.")] = None
    steering_field: Annotated[str | None, typer.Option(
        help="Message field with the steering angle: data (default), position.1, ... Without "
        "--steering-topic: column of a CSV or VBO file.")] = None
    steering_is: Annotated[Literal["road", "wheel"], typer.Option(
        help="Meaning of the steering angle in the bag or table: road-wheel angle (road), or steering-wheel angle "
        "(wheel), which is converted with the ratio and the offset of the vehicle file.")] = "road"
    steering_unit: Annotated[Literal["rad", "deg"] | None, typer.Option(
        help="Unit of the steering angle; default: the unit in the name of the field or column, else rad.")] = None
    odometry_topic: Annotated[str | None, typer.Option(
        help="Bags with several INS: the topic to use, of type nav_msgs/Odometry, or several topics of types such as "
        "NavSatFix and Imu, separated by commas.")] = None

    def resolve(self, **others: Any) -> "tuple[Path | None, ReadSettings]":
        """The vehicle file (None without --vehicle and --car) and the settings for reading. others: further fields of
        ReadSettings. Raises RunError for a car that cannot be read."""
        from st_recordings.runs import ReadSettings
        from st_recordings.runs.run_types import SteeringField

        options, steering = self.fill_in_car(), None
        if self.steering_topic is not None or self.steering_field is not None:
            steering = SteeringField(self.steering_topic or "", self.steering_field or "data", self.steering_is,
                                     self.steering_unit, self.steering_sign or 1)
        return options.vehicle, ReadSettings(dbc=options.dbc, signals=options.signals, offset=self.offset,
                                             ins_can_latency=self.ins_can_latency, steering=steering,
                                             odometry=self.odometry_topic, **options.sensor_settings, **others)

    def fill_in_car(self, requires_bus: bool = False) -> "ReadOptions":
        """The options; files and sensor settings that the user did not give are those of --car. Raises RunError for a
        car that cannot be read and, if `requires_bus`, for a --car without DBC or signal table."""
        from st_recordings.car import load_car
        from st_recordings.runs.errors import RunError

        if self.car is None:
            return self
        car, parts = load_car(self.car), ("vehicle", "dbc", "signals", "steering_sign", "steering_latency")
        options = replace(self, **{part: getattr(car, part) for part in parts if getattr(self, part) is None})
        for file, option in ((options.dbc, "--dbc"), (options.signals, "--signals")):
            if requires_bus and file and not file.is_file():
                raise RunError(file, "does not exist, but is needed to describe the CAN bus",
                               f"create it, or pass another file with {option}")
        return options

    @property
    def sensor_settings(self) -> dict[str, Any]:
        """Sign and latency of the steering sensor, if given."""
        values = {"steering_sign": self.steering_sign, "steering_latency": self.steering_latency}
        return {name: value for name, value in values.items() if value is not None}


@dataclass(frozen=True)
class RunOptions:
    """Options for running the nodes, as given by the user; one field per option."""

    model: Annotated[Path | None, typer.Option(
        help="Model file (model.yaml of `st discover`), run alongside kinematic, linear and nonlinear.", **FILE)] = None
    effects: ModelEffects = None
    bands: Annotated[Path | None, typer.Option(
        help="Bands around the predictions (bands.yaml of `st calibrate`).", **FILE)] = None
    adaptive: Annotated[bool | None, typer.Option(
        "--adaptive/--no-adaptive", help="Adapt the bands to the errors of the run; without --bands they appear "
        "after two minutes of driving. Default: as in config/nodes.yaml (yes).")] = None
    course: Annotated[Path | None, typer.Option(
        help="Course of `st course build` for this site: adds forecasts with its steering and speed. "
        "Default in a replay: the recorded course.", **FILE)] = None
    record: Annotated[Literal["needed", "all"], typer.Option(
        help="needed: raw packets and frames, odometry, status, steering, predictions, errors, "
        "diagnostics. all: also the other topics of the bridges, which can be computed from these.")] = "needed"
    view: Annotated[bool, typer.Option(
        "--view", help="Show the path ahead and its error live in the browser.")] = False
    view_address: Annotated[str | None, typer.Option(
        help="HOST or HOST:PORT of this computer for --view; default 127.0.0.1, this computer only. "
        "0.0.0.0:8080: open to every device in the same network, such as a phone.")] = None
    view_save: Annotated[Path | None, typer.Option(
        help="After the run, save its view to this file (.rrd), for `st view`.")] = None

    def make_view(self) -> "LiveView":
        """The view of the run. Raises SuiteError for an address or a file that cannot be used."""
        from st_live.page import LiveView

        return LiveView(self.view, self.view_address, self.view_save)


BAG_INPUTS = ("car", "vehicle", "steering_sign", "steering_topic", "steering_field", "steering_is", "steering_unit",
              "odometry_topic")
"""Options that apply to a bag with odometry and steering."""


def expand_options(group: type, *names: str, **annotations: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
    """Decorator that replaces a command's parameter of type `group`, a dataclass, with one option per field.

    names: fields to use; default: all. annotations: replacements, by field, for those in `group`. The decorated command
    also groups similar warnings, reports errors in its inputs (`report_errors`), and exits with the status that the
    function returns.
    """
    used_fields = [f for f in fields(group) if not names or f.name in names]

    def decorate(verb: Callable[..., Any]) -> Callable[..., Any]:
        declared = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in inspect.signature(verb).parameters.values()]
        position = next(k for k, p in enumerate(declared) if p.annotation is group)

        @wraps(verb)
        def call(**arguments: Any) -> Any:
            from st_recordings.runs.errors import group_similar_warnings

            options = {f.name: arguments.pop(f.name) for f in used_fields}
            with report_errors(verb.__name__.rstrip("_")), group_similar_warnings():
                raise typer.Exit(verb(**arguments, **{declared[position].name: group(**options)}) or 0)

        options = [inspect.Parameter(f.name, inspect.Parameter.KEYWORD_ONLY, default=f.default,
                                     annotation=annotations.get(f.name, f.type)) for f in used_fields]
        parameters = [*declared[:position], *options, *declared[position + 1 :]]
        call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        call.__annotations__ = {p.name: p.annotation for p in parameters}
        return call

    return decorate


LEAF = config("car/leaf/vehicle.yaml")


def load_vehicle_or_default(vehicle: Path | None) -> "tuple[VehicleParameters, Path]":
    """(vehicle parameters, their file), by default those of the Leaf. Raises ConfigurationError."""
    from st_recordings.car import read_vehicle

    file = vehicle or LEAF
    return read_vehicle(file), file


def report_default_car(verb: str, given_file: Path | None, file: Path | str) -> None:
    """Print a line if `file` (vehicle or DBC) is the Leaf's because the user gave none."""
    from st_recordings.car import list_cars

    if given_file is None and Path(file).resolve().parent == LEAF.resolve().parent:
        typer.echo(f"st {verb}: no car was given: the Leaf's file {file} is used; specify your car with --car "
                   f"({', '.join(list_cars())}, or a folder)", err=True)


def report_bag(verb: str, path: Path, vehicle: Path | None) -> None:
    """Report the use of the Leaf's vehicle file, and unused bags of the run. Raises RunError for an unreadable bag."""
    from st_live.configuration import find_bag
    from st_recordings.results import parse_configuration
    from st_recordings.runs.bag import is_bag, read_metadata_records

    bag = find_bag(path)
    if vehicle is None and parse_configuration(read_metadata_records(bag)).vehicle is None:
        report_default_car(verb, None, LEAF)
    further_bags = [folder.name for folder in sorted(path.glob("bag_*")) if is_bag(folder)] if bag != path else []
    if further_bags:
        typer.echo(f"st {verb}: only {bag} is used; the recorder was restarted and continued in "
                   f"{', '.join(further_bags)}, which can be used separately", err=True)
