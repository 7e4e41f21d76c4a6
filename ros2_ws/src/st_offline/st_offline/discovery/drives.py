"""Reads the drives of a discovery, and caches its results."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import nullcontext, suppress
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from itertools import repeat
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import st_core
from rich.markup import escape
from rich.progress import Progress
from st_core.augmented import AugmentedModel, augment
from st_core.checks import Finding, pool_estimates
from st_core.discovery import Discovery, DiscoverySettings, discover
from st_core.discovery.result import MODEL_FIELDS
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.models import Model
from st_core.vehicle import VehicleParameters
from st_recordings.paths import json_ready, replace_file
from st_recordings.results import parse_configuration
from st_recordings.runs import ReadSettings, RunSource, read

from ..checking.gate import RUN_ERRORS, check_log, describe_problem, raise_for_errors


@dataclass(frozen=True)
class Drive:
    """One run, read and checked."""

    name: str
    log: DriveLog | None  # None if the run cannot be used
    # For the report, including estimates of the checks and the name of the recorded car ("" if unknown); empty if the
    # run cannot be used.
    metadata: dict[str, Any]
    problem: str = ""
    findings: tuple[Finding, ...] = ()  # of the checks


@dataclass(frozen=True)
class Request:
    """Options of `st discover`, and the drives and hashes of effects read with them."""

    base: str  # name of a model, or a model file
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_text: str  # content of vehicle_file
    settings: DiscoverySettings
    runs: Sequence[Path] = ()  # paths of recordings
    reference: Sequence[Path] = ()  # paths of recordings
    read_settings: ReadSettings = field(default_factory=ReadSettings)
    effects: Path | None = None  # folder of user-defined effects
    output: Path | None = None  # folder, None for runs/discover-<time>
    jobs: int = 1  # number of processes that read, and of threads that search
    formats: tuple[str, ...] = ()  # formats of the figure files
    report: bool = True  # whether to write a page
    use_cache: bool = True  # whether to read and write cached results
    force: bool = False  # whether to use runs with errors
    # Whether to search for a relation beyond the library; if None, this depends on the size of the residual.
    propose: bool | None = None
    drives: Sequence[Drive] = ()  # read from `runs`
    reference_drives: Sequence[Drive] = ()  # read from `reference`
    effect_hashes: Mapping[str, str] = field(default_factory=dict)  # sha256 of each file in `effects`

    @property
    def all_drives(self) -> tuple[Drive, ...]:
        return *self.drives, *self.reference_drives

    @property
    def file_hashes(self) -> dict[str, str]:
        """sha256 of each file of the used drives, by "drive: file name"."""
        return {f"{drive.name}: {Path(file).name}": digest for drive in self.all_drives if drive.log is not None
                for file, digest in drive.metadata["files"].items()}


def read_drives(sources: Sequence[RunSource], vehicle: VehicleParameters, settings: ReadSettings, jobs: int,
                tick: Callable[[], None], force: bool = False) -> list[Drive]:
    """Read all runs, in the order of the sources. jobs: number of processes. tick: called as runs are completed."""
    drives = []
    with ProcessPoolExecutor(jobs) if jobs > 1 and len(sources) > 1 else nullcontext() as pool:
        # A source with a problem is not sent to another process, because its error cannot be pickled.
        futures = {number: pool.submit(read_drive, source, vehicle, settings, force)
                   for number, source in enumerate(sources) if pool and source.problem is None}
        for number, source in enumerate(sources):
            drives.append(futures[number].result() if number in futures else
                          read_drive(source, vehicle, settings, force))
            tick()
    return drives


def read_drive(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings, force: bool = False) -> Drive:
    """Read and check one run. An error becomes the `problem` of the drive."""
    try:
        if source.problem is not None:
            raise source.problem
        run = read(source, vehicle, settings)
        result = check_log(run.log, vehicle, run.auxiliary)
        recorded = parse_configuration(run.provenance.get("recorded", {})).vehicle if source.kind == "bag" else None
        try:
            car = "" if recorded is None else VehicleParameters.from_yaml(recorded, "the vehicle in the recording").name
        except StCoreError:
            car = ""  # recorded by an earlier version, with a value that is now rejected
        metadata = {"files": run.provenance["files"], "duration_s": run.log.duration,
                    "alignment": run.alignment.verdict.value,
                    "clock_deviation_s": json_ready(run.alignment.offset_deviation),
                    "warnings": list(run.warnings), "estimates": json_ready(result.estimates), "vehicle": car}
        raise_for_errors(source.path, result.findings, force)
        return Drive(source.name, run.log, metadata, findings=result.findings)
    except RUN_ERRORS as error:
        return Drive(source.name, None, {}, describe_problem(error, source), getattr(error, "findings", ()))


def get_logs(drives: Sequence[Drive]) -> list[DriveLog]:
    return [d.log for d in drives if d.log is not None]


def pool_sensor_estimates(drives: Sequence[Drive]) -> dict[str, tuple[float, float, float]]:
    """Sensor errors estimated by the checks and pooled over the drives, (value, ends of its 95 % interval) by name."""
    return pool_estimates([d.metadata["estimates"] for d in drives if d.log is not None])


def collect_clock_deviations(drives: Sequence[Drive]) -> dict[str, float]:
    """Standard deviation of the offset of the steering clock [s], by name of each run with an estimated offset."""
    return {d.name: s for d in drives if d.log is not None and (s := d.metadata.get("clock_deviation_s"))}


def read_or_discover(request: Request, base: Model, progress: Progress) -> tuple[Discovery, bool]:
    """(discovery, whether it was read from the cache)."""
    bar = progress.add_task("", total=None)
    logs, reference = get_logs(request.drives), get_logs(request.reference_drives)
    sensors, clocks = pool_sensor_estimates(request.drives), collect_clock_deviations(request.all_drives)
    key = make_result_key(logs, reference, request.vehicle, base, request.settings, request.effect_hashes, sensors,
                          clocks)
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    file = Path(cache, "single_track", "discovery", f"{key}.json")
    use_cache = request.use_cache and file.is_absolute()  # relative without a home directory
    if use_cache and (cached := read_result(file)) is not None:
        return cached, True
    discovery = discover(logs, request.vehicle, base, reference, request.settings,
                         lambda stage, done, total: progress.update(
                             bar, description=escape(stage), completed=done, total=total),
                         sensors, request.jobs, clocks)
    if use_cache:
        write_result(file, discovery)
    return discovery, False


def make_result_key(runs: Sequence[DriveLog], reference: Sequence[DriveLog], vehicle: VehicleParameters, base: Model,
                    settings: DiscoverySettings, effects: Mapping[str, str], sensors: Mapping[str, Sequence[float]],
                    clocks: Mapping[str, float]) -> str:
    """Cache key of a result: hash of its inputs and of the code of st_core and this module. effects: sha256 by file.
    sensors: from `pool_sensor_estimates`. clocks: from `collect_clock_deviations`."""
    values = base.values if isinstance(base, AugmentedModel) else {}
    files = sorted(file for folder in st_core.__path__ for file in Path(folder).rglob("*.py"))
    code = hashlib.sha256(b"".join(file.read_bytes() for file in (*files, Path(__file__)))).hexdigest()
    content = [code, [_compute_digest(log) for log in runs], [_compute_digest(log) for log in reference],
               vehicle.hash, sorted((name, entry.uncertainty) for name, entry in vehicle.provenance.items()),
               _get_base_name(base), values, asdict(settings),
               sorted(effects.items()), sorted((name, list(value)) for name, value in sensors.items()), clocks]
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()[:32]


def write_result(file: Path, discovery: Discovery) -> None:
    """Write a result to the cache; errors such as a full disk are ignored."""
    content = discovery.document() | {name: (model := getattr(discovery, name)) and [
        _get_base_name(model), model.values] for name in MODEL_FIELDS}
    with suppress(OSError):
        file.parent.mkdir(parents=True, exist_ok=True)
        replace_file(file, json.dumps(content, default=dict))  # for Mapping types that json cannot encode


def read_result(file: Path) -> Discovery | None:
    """The result that `write_result` wrote to a file; None if the file is missing or damaged."""
    try:
        return _restore(Discovery, json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StCoreError):
        return None


def _restore(kind: Any, value: Any) -> Any:
    """A value of type `kind` from its JSON form: dicts become dataclasses, lists become tuples or models."""
    origin, inner = get_origin(kind), get_args(kind)
    if kind is AugmentedModel:
        return augment(*value)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{f.name: _restore(hints[f.name], value[f.name]) for f in fields(kind)})
    if origin is tuple:
        return tuple(map(_restore, repeat(inner[0]) if inner[-1] is Ellipsis else inner, value))
    if origin is Mapping:
        return {name: _restore(inner[1], entry) for name, entry in value.items()}
    if NoneType in inner:
        return None if value is None else _restore(next(t for t in inner if t is not NoneType), value)
    return value


def _get_base_name(model: Model) -> str:
    return model.base.name if isinstance(model, AugmentedModel) else model.name


def _compute_digest(log: DriveLog) -> str:
    digest = hashlib.sha256(log.name.encode())
    for column in fields(DriveLog):
        values = getattr(log, column.name)
        if isinstance(values, np.ndarray):
            digest.update(column.name.encode() + values.tobytes())
    return digest.hexdigest()
