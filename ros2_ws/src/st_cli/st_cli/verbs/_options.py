"""What several verbs share: options, whose recordings these are, how raw logs become runs, and how a verb refuses."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from st_recordings.paths import config

if TYPE_CHECKING:
    from st_core.vehicle import VehicleParameters
    from st_recordings.runs import ReadSettings
    from st_recordings.runs.external_topics import SteeringField


def _sign(value: int | None) -> int | None:
    if value not in (None, 1, -1):
        raise typer.BadParameter(f"{value} is neither 1 nor -1")
    return value


def _record(value: str) -> str:
    if value not in ("needed", "all"):
        raise typer.BadParameter(f"{value} is neither needed nor all")
    return value


Runs = Annotated[list[Path], typer.Argument(
    help="Recordings: bags, .ncom with CAN logs, CSV, run.yaml, or folders of them.", show_default=False)]
CarName = Annotated[str | None, typer.Option(
    "--car", help="The car: a name in config/car, or a folder with vehicle.yaml, can.dbc, signals.yaml and car.yaml. "
    "--vehicle, --dbc, --signals and --steering-... each replace a part of it.")]
VehicleFile = Annotated[Path | None, typer.Option(
    "--vehicle", help="Vehicle file; default that of --car, else the Leaf's.", exists=True, dir_okay=False)]
VehicleOfBag = Annotated[Path | None, typer.Option(
    "--vehicle", help="Vehicle file; default that of --car, else the one in the recording, else the Leaf's.",
    exists=True, dir_okay=False)]
Models = Annotated[list[str], typer.Option(
    "--model", help="kinematic, linear, nonlinear, or a model file (augmented); repeatable.")]
EffectsOfFile = Annotated[Path | None, typer.Option(
    "--effects", help="Folder of your own effects that a model file uses.", exists=True, file_okay=False)]
FourthModel = Annotated[Path | None, typer.Option(
    "--model", help="Model file (model.yaml of `st discover`): a fourth model in addition to the three.", exists=True,
    dir_okay=False)]
EffectsOfModel = Annotated[Path | None, typer.Option(
    "--effects", help="Folder of your own effects that --model uses.", exists=True, file_okay=False)]
Filtering = Annotated[Literal["causal", "zero-phase"], typer.Option(
    "--acceleration", help="Filter of the forward speed before its derivative; live, only causal is possible.")]
Inputs = Annotated[Literal["interpolate", "hold"], typer.Option(
    "--inputs", help="Measured inputs within an integration step: interpolated, or held over it.")]
Horizon = Annotated[float, typer.Option(help="Length of a prediction, s; a whole number of steps.")]
Step = Annotated[float, typer.Option(help="Integration step, s.")]
MinimumSpeed = Annotated[float, typer.Option(help="No prediction starts below this speed, m/s.")]
BandsFile = Annotated[Path | None, typer.Option(
    "--bands", help="Bands around every prediction (bands.yaml of `st calibrate`).", exists=True, dir_okay=False)]
View = Annotated[bool, typer.Option("--view", help="Show the path ahead and its error live in the browser.")]
ViewAddress = Annotated[str | None, typer.Option(
    "--view-address", help="HOST or HOST:PORT of this computer for --view; default 127.0.0.1, this computer only. "
    "0.0.0.0:8080: also a phone in the same network, which anybody there can open.")]
ViewSave = Annotated[Path | None, typer.Option(help="After the run, draw it into this file (.rrd), for `st view`.")]
Offset = Annotated[float | None, typer.Option(
    help="INS minus CAN clock, s, set by hand; default: found from the signals.")]
InsCanLatency = Annotated[tuple[float, float] | None, typer.Option(
    help="Latency of the INS's own CAN frames and its standard deviation, s; default 0.002 0.002.")]
Dbc = Annotated[Path | None, typer.Option(
    help="DBC of the CAN logs; default that of --car, else the Leaf's.", exists=True, dir_okay=False)]
Signals = Annotated[Path | None, typer.Option(
    help="Signal table for the DBC; default that of --car, else the Leaf's.", exists=True, dir_okay=False)]
SteeringSign = Annotated[int | None, typer.Option(
    callback=_sign, help="1 if the sensor, as decoded by DBC and table, is positive to the left; -1: to the right. "
    "Default that of --car, else 1; live: else that of config/nodes.yaml.")]
SteeringTopic = Annotated[str | None, typer.Option(
    "--steering-topic", help="For bags of other recorders: the topic with the steering angle, rad, left +, of any type "
    "of ROS 2 Jazzy. Default: the one of type st_msgs/Steering.")]
SteeringPath = Annotated[str, typer.Option(
    "--steering-field", help="The number in its messages: data, drive.steering_angle, ...")]
SteeringIs = Annotated[str, typer.Option(
    "--steering-is", help="road: angle of the front wheels; wheel: of the hand wheel, converted with ratio and offset "
    "of the vehicle file.")]
Record = Annotated[str, typer.Option(
    "--record", callback=_record, help="needed: raw packets and frames, odometry, status, steering, predictions, "
    "errors, diagnostics. all: also the other topics of the bridges, which can be computed from these.")]
SteeringLatency = Annotated[float | None, typer.Option(
    help="s, from the motion of the wheel to the frame; default that of --car, else 0; live: else that of "
    "config/nodes.yaml.", min=0.0, max=1.0)]


@contextmanager
def refusals(verb: str, *more: type[Exception]) -> Iterator[None]:
    """What a verb cannot work with: one line, and exit status 2. more: errors that only this verb has."""
    # Imported when it runs, see demo.py.
    from st_core.errors import StCoreError
    from st_recordings.output import OutputError
    from st_recordings.runs.errors import RunError

    refused: tuple[type[Exception], ...] = (StCoreError, RunError, OutputError, UnicodeDecodeError, *more)
    try:
        yield
    except refused as error:
        typer.echo(f"st {verb}: {error}", err=True)
        raise typer.Exit(2) from None


def foreign_steering(topic: str | None, path: str, quantity: str) -> "SteeringField | None":
    """Where the angle is in a bag of another make; None where no topic was named."""
    from st_recordings.runs.external_topics import SteeringField

    if quantity not in ("road", "wheel"):
        raise typer.BadParameter(f"--steering-is {quantity}: road or wheel is wanted")
    return None if topic is None else SteeringField(topic, path, quantity)  # type: ignore[arg-type]


def whose(car: str | None, vehicle: Path | None, dbc: Path | None = None, signals: Path | None = None,
          steering_sign: int | None = None, steering_latency: float | None = None,
          **others) -> "tuple[Path | None, ReadSettings]":
    """(vehicle file, None where none was named; how raw logs are read). others: of ReadSettings.

    Raises RunError for a car that cannot be read.
    """
    from st_recordings.car import STEERING, car_named
    from st_recordings.runs import ReadSettings

    steering = {"steering_sign": steering_sign, "steering_latency": steering_latency}
    given: dict[str, Any] = {name: value for name, value in steering.items() if value is not None}
    if car is None:
        return vehicle, ReadSettings(dbc=dbc, signals=signals, **STEERING | given, **others)
    named = car_named(car)
    its: dict[str, Any] = {"steering_sign": named.steering_sign, "steering_latency": named.steering_latency}
    return vehicle or named.vehicle, ReadSettings(dbc=dbc or named.dbc, signals=signals or named.signals, **its | given,
                                                  **others)


@dataclass(frozen=True)
class Wires:
    """A car for the live nodes. vehicle, dbc, signals: None where nobody named one. steering: of canedge_bridge, only
    what was said; config/nodes.yaml holds for the rest."""

    vehicle: Path | None
    dbc: Path | None
    signals: Path | None
    steering: dict[str, Any]


def on_the_wires(car: str | None, vehicle: Path | None, dbc: Path | None, signals: Path | None,
                 steering_sign: int | None, steering_latency: float | None) -> Wires:
    """As `whose`, for a bus that is listened to. Raises RunError, also for a car whose bus nobody has described."""
    from st_recordings.car import car_named
    from st_recordings.runs.errors import RunError

    steering = {"steering_sign": steering_sign, "steering_latency": steering_latency}
    given: dict[str, Any] = {name: value for name, value in steering.items() if value is not None}
    if car is None:
        return Wires(vehicle, dbc, signals, given)
    named = car_named(car)
    for file, option in ((dbc or named.dbc, "--dbc"), (signals or named.signals, "--signals")):
        if not file.is_file():
            raise RunError(file, "there is no such file: nobody has described the bus of this car",
                           f"write it, or name another with {option}")
    its: dict[str, Any] = {"steering_sign": named.steering_sign, "steering_latency": named.steering_latency}
    return Wires(vehicle or named.vehicle, dbc or named.dbc, signals or named.signals, its | given)


LEAF = config("car/leaf/vehicle.yaml")


def leaf_or(vehicle: Path | None) -> "tuple[VehicleParameters, Path]":
    """(the car, its file): the Leaf's where none was named. Raises RunError and StCoreError."""
    from st_recordings.car import read_vehicle

    file = vehicle or LEAF
    return read_vehicle(file), file


def say_whose(verb: str, file: Path | str) -> None:
    """One line where nobody named a car and the Leaf was taken."""
    from st_recordings.car import names

    if Path(file).resolve().parent == LEAF.resolve().parent:
        typer.echo(f"st {verb}: no car was named: the Leaf's file {file} is used; --car names another "
                   f"({', '.join(names())}, or a folder)", err=True)


def say_whose_bag(verb: str, bag: Path, vehicle: Path | None) -> None:
    """The same line for a recording that carries no vehicle file. Raises RunError for one that cannot be read."""
    from st_live.configuration import recordings_of
    from st_recordings.recorded import recorded_configuration
    from st_recordings.runs.bag import records_of

    if vehicle is None and recorded_configuration(records_of(recordings_of(bag)[0])).vehicle is None:
        say_whose(verb, LEAF)
