"""The `virtual_leaf` command: sends the sensor data of a simulated or recorded drive in real time, or writes files."""

import argparse
import atexit
import contextlib
import json
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import NoReturn

from canedge_bridge.decode import Decoder
from st_core.errors import ConfigurationError

from .driver import SimulatedCar
from .encoders import CanEncoder, NcomEncoder, Origin
from .files import LogFile, Mf4File, TruthFile, choose_truth_file, make_folder
from .recorded_drive import RecordedDrive
from .scenarios import SCENARIOS, load_plan
from .sensors import Ins, SteeringSensor
from .settings import SETTINGS, find_overrides, read_vehicle, resolve_settings
from .stream import LiveOutput, Output, Report, Source, Stream, send

DEFAULT_DURATION, MAX_DURATION = 60.0, 1e6  # s
START_GRID_NS = 20_000_000  # drives start on this UTC grid, a multiple of the periods at 100 and 250 Hz
LEAD_NS = 20_000_000  # minimum time before the start, to prepare the outputs
FILE_EPOCH_NS = 1_756_900_800_000_000_000  # 2025-09-03 12:00 UTC: start of a drive written to files with seed 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return 0, also after SIGINT or SIGTERM, or 2 after an error, with one line on stderr."""
    stop_requested = _watch_signals()
    try:
        options = _make_parser().parse_args(arguments)
        if options.list:
            for name, (_, meaning) in SCENARIOS.items():
                print(f"{name:28} {meaning}")
            for s in SETTINGS.values():
                print(f"{s.name:28} {s.group}: {s.meaning} [{s.unit}], {s.low:g} to {s.high:g}; ideal: {s.null:g}")
        elif options.to_files:
            _write_files(options, stop_requested)
        else:
            _run_live(options, stop_requested)
    except (OSError, ValueError) as error:
        print(f"virtual_leaf: {' '.join(str(error).split())}", file=sys.stderr)
        return 2
    return 0


def check_arguments(arguments: Sequence[str]) -> None:
    """Check arguments as main() does before it starts. Raises ConfigurationError with a one-line message."""
    try:
        _Run(_make_parser().parse_args(arguments))
    except (OSError, ValueError) as error:
        raise ConfigurationError(" ".join(str(error).split())) from None


def _watch_signals() -> Callable[[], bool]:
    """Install handlers of SIGINT and SIGTERM; returns a function that checks whether a signal has arrived."""
    received: list[int] = []  # not an Event: a second signal during its `set` would cause a deadlock
    for number in (signal.SIGINT, signal.SIGTERM):
        # ValueError: only the main thread can install handlers; tests may call from a different one.
        with contextlib.suppress(ValueError):
            signal.signal(number, lambda number, _: received.append(number))
            # The interpreter removes the handlers before it exits; a signal after that would change the exit status.
            atexit.register(signal.signal, number, signal.SIG_IGN)
    return lambda: bool(received)


class _Run:
    """Checked inputs of a run. metadata: content of the metadata record `run` in truth.mcap."""

    def __init__(self, options: argparse.Namespace):
        if not options.vehicle:
            raise ConfigurationError("--vehicle is missing; the Leaf is config/vehicle/leaf.yaml")
        integers = {"--seed": (options.seed, 0, 2**31 - 1), "--ncom-port": (options.ncom_port, 1, 65535)}
        for option, (value, low, high) in integers.items():
            if not low <= value <= high:
                raise ConfigurationError(f"{option} {value}: not within {low} to {high}")
        self._options, self._car = options, read_vehicle(options.vehicle)
        self._codec = Decoder(*_find_can_tables(options))
        if options.drive:
            if options.plant:
                raise ConfigurationError("--plant cannot be combined with --drive: a recorded drive has no plant")
            self.settings = resolve_settings("ideal", options.effect)
            for name in find_overrides(self.settings):
                if SETTINGS[name].group not in ("ins", "can"):
                    raise ConfigurationError(f"--effect {name} cannot be combined with --drive: not a sensor effect")
            self._source: Source = RecordedDrive(options.drive, self._car)
        else:
            self.settings = resolve_settings(options.plant or "realistic", options.effect)
            self._source = SimulatedCar(self._car, self.settings, load_plan(options.scenario), options.seed)
        drive_duration = self._source.duration
        self.duration = options.duration if options.duration is not None else drive_duration or DEFAULT_DURATION
        if not 0 < self.duration <= MAX_DURATION:
            raise ConfigurationError(f"--duration {self.duration:g}: must be above 0 and at most {MAX_DURATION:.0f} s")
        if drive_duration is not None:
            self.duration = min(self.duration, drive_duration)
        self.metadata = {
            "scenario": "" if options.drive else options.scenario, "drive": options.drive.name if options.drive else "",
            "vehicle": self._car.name, "plant": options.plant or "", "seed": options.seed,
            "ncom_rate": options.ncom_rate, "changed_settings": json.dumps(find_overrides(self.settings))}
        self._origin = _parse_origin(options.origin)

    def generate_outputs(self, start_ns: int) -> Iterator[Output]:
        options, settings, rate = self._options, self.settings, self._options.ncom_rate
        return Stream(self._source, settings, Ins(self._car, settings, 1 / rate, options.seed),
                      SteeringSensor(self._car, settings, options.seed), NcomEncoder(self._origin, start_ns, rate),
                      CanEncoder(self._codec, self._origin, start_ns), rate, options.seed, options.can_rate == "full",
                      options.startup).generate_outputs(self.duration)


def _find_can_tables(options: argparse.Namespace) -> tuple[Path, Path]:
    """Find the DBC and signal table of the Leaf; the virtual car sends Leaf messages whatever the vehicle file. They
    are expected in --config; by default in the parent of the folder of the vehicle file, or in config/ of the checkout,
    of the current folder or of its parents."""
    roots = [Path(os.environ.get("ST_ENVIRONMENT") or Path.cwd()), Path.cwd(), *Path.cwd().parents]
    defaults = [options.vehicle.absolute().parent.parent, *(root / "config" for root in roots)]
    for folder in [options.config] if options.config else defaults:
        dbc, signals = folder / "can" / "leaf_ze0.dbc", folder / "can" / "leaf_ze0.yaml"
        if dbc.exists() and signals.exists() and "Leaf_Steering:" in signals.read_text(encoding="utf-8"):
            return dbc, signals
    raise ConfigurationError(f"--config {options.config or 'is missing'}: can/leaf_ze0.dbc and can/leaf_ze0.yaml, the "
                             "CAN tables of the virtual car, were not found; give the folder config/ of the project")


def _parse_origin(text: str) -> Origin:
    try:
        latitude, longitude, height = map(float, text.split(","))
    except ValueError:
        raise ConfigurationError(f"--origin {text}: must be latitude,longitude,height in degrees and metres") from None
    if not (abs(latitude) < 89 and abs(longitude) <= 180 and abs(height) < 9000):
        raise ConfigurationError(f"--origin {text}: not within latitude +-89 deg, longitude +-180 deg, height +-9000 m")
    return Origin(latitude, longitude, height)


def _run_live(options: argparse.Namespace, stop_requested: Callable[[], bool]) -> None:
    run = _Run(options)
    with contextlib.ExitStack() as resources:
        output = LiveOutput(options.ncom_host, options.ncom_port, options.can_interface, options.can_channel)
        resources.callback(output.close)
        now_ns, monotonic = time.time_ns(), time.monotonic()
        start_ns = -(-(now_ns + LEAD_NS) // START_GRID_NS) * START_GRID_NS
        start_time = monotonic + (start_ns - now_ns) / 1e9
        truth = None
        if options.output:
            path = choose_truth_file(make_folder("--output", options.output))
            truth = TruthFile(path, start_ns, run.settings, run.metadata)
            resources.callback(truth.close)
        outputs = run.generate_outputs(start_ns)
        # A higher priority, if permitted, helps to meet the deadlines.
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, -10)
        time.sleep(max(0.0, start_time - time.monotonic()))
        _report(state="sending", start_ns=start_ns, duration=run.duration)
        send(outputs, output.send_ncom, output.send_frame, truth.write if truth else None, stop_requested,
             output.report, start_time)
    _report(state="done", **asdict(output.report), **({"fault": truth.fault} if truth and truth.fault else {}))


def _write_files(options: argparse.Namespace, stop_requested: Callable[[], bool]) -> None:
    """Write the drive to files. CAN frames are stamped by the clock of the logger, with its offset and drift."""
    run = _Run(options)
    start_ns = FILE_EPOCH_NS + options.seed * 3_600_000_000_000  # one hour later for each seed
    folder = make_folder("--to-files", options.to_files)
    offset, drift = run.settings["logger_clock_offset"], run.settings["logger_clock_drift"]
    start_time = time.monotonic()
    with contextlib.ExitStack() as files:
        ncom = files.enter_context((folder / "run.ncom").open("wb"))
        frames = LogFile(folder / "run.log") if options.can_format == "log" else Mf4File(folder / "run.mf4", start_ns)
        files.callback(frames.stop)
        truth = TruthFile(folder / "truth.mcap", start_ns, run.settings, run.metadata)
        files.callback(truth.close)
        last_due = send(
            run.generate_outputs(start_ns), ncom.write,
            lambda frame, due: frames.write(start_ns + round((due * (1 + drift) + offset) * 1e9), frame),
            truth.write, stop_requested, Report())
    _report(state="done", duration=round(last_due, 3), computing_time=round(time.monotonic() - start_time, 3))


def _report(**values: object) -> None:
    """Print one line of JSON, unless the pipe is closed."""
    with contextlib.suppress(BrokenPipeError):
        print(json.dumps(values), flush=True)


class _Parser(argparse.ArgumentParser):
    """Argument parser that raises ConfigurationError for a bad argument."""

    def error(self, message: str) -> NoReturn:
        raise ConfigurationError(message)


def _make_parser() -> argparse.ArgumentParser:
    parser = _Parser(prog="virtual_leaf", description=__doc__)
    source = parser.add_mutually_exclusive_group()
    source.add_argument("--scenario", default="S6", help=f"{', '.join(SCENARIOS)}, or a .yaml file; default S6")
    source.add_argument("--drive", type=Path, metavar="FILE.csv", help="a recorded drive instead of a simulated one")
    parser.add_argument("--vehicle", type=Path, metavar="FILE.yaml", help="config/vehicle/<car>.yaml")
    parser.add_argument(
        "--config", type=Path, metavar="DIR", help="folder with can/leaf_ze0.dbc and can/leaf_ze0.yaml; default: that "
        "of the vehicle file, of the checkout or of the current folder")
    parser.add_argument("--duration", type=float, metavar="S", help="default: 60 s, or the whole recorded drive")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random numbers")
    parser.add_argument("--plant", help="ideal, realistic (default) or FILE.yaml with {preset: ..., name: value}")
    parser.add_argument("--effect", nargs="+", action="extend", default=[], metavar="NAME=VALUE",
                        help="override settings; see --list")
    parser.add_argument("--origin", default="51.448,5.49,65.0", metavar="LAT,LON,HEIGHT",
                        help="map origin [deg, deg, m above the ellipsoid]")
    parser.add_argument("--startup", action="store_true", help="begin with the start-up of the INS, before it locks")
    parser.add_argument("--ncom-host", default="127.0.0.1", help="host to which the NCOM packets are sent")
    parser.add_argument("--ncom-port", type=int, default=3000, help="UDP port of that host")
    parser.add_argument("--ncom-rate", type=int, choices=(100, 250), default=100,
                        help="NCOM packets, and epochs of the INS on CAN, per second; default 100")
    parser.add_argument("--can-interface", default="udp_multicast", help="python-can interface")
    parser.add_argument("--can-channel", default="239.74.163.2", help="channel of that interface")
    parser.add_argument("--can-rate", choices=("realistic", "full"), default="realistic",
                        help="frames of the car: realistic (default): steering, wheel speeds and gear, 217 per second; "
                             "full: also the other frames of a Leaf, about 1750 per second in all")
    parser.add_argument("--output", type=Path, metavar="DIR",
                        help="folder for truth.mcap, or truth_2.mcap and so on if it exists")
    parser.add_argument("--to-files", type=Path, metavar="DIR",
                        help="folder for run.ncom, run.log or run.mf4, and truth.mcap; nothing is sent")
    parser.add_argument("--can-format", choices=("mf4", "log"), default="log", help="format of the CAN log")
    parser.add_argument("--list", action="store_true", help="print scenarios and settings")
    return parser


if __name__ == "__main__":
    sys.exit(main())
