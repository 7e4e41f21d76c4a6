"""Inputs of a discovery: options, drives as read, and the cache of results."""

import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from itertools import repeat
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
import st_core
from st_core.augmented import AugmentedModel, augment
from st_core.discovery import Discovery, DiscoverySettings
from st_core.discovery.result import MODELS
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.models import Model
from st_core.vehicle import VehicleParameters
from st_recordings.paths import json_ready
from st_recordings.recorded_results import recorded_configuration
from st_recordings.runs import ReadSettings, RunSource, read
from st_recordings.runs.load import hash_files

from ..checking.check_report import findings_as_json
from ..checking.gate import RUN_ERRORS, Refused, check_log, describe_problem, refuse_errors

RESULT_FORMAT = 3  # version of the format of cached results; other versions are not used


@dataclass(frozen=True)
class Drive:
    """One run as read, or the problem why it cannot be used (log is then None).

    about: for the report, with the findings (also of a refused run) and estimates of the checks. vehicle: name of the
    car in the recording, "" if there is none.
    """

    name: str
    log: DriveLog | None
    about: dict[str, Any]
    problem: str = ""


@dataclass(frozen=True)
class Request:
    """base: name or model file. vehicle_text: of vehicle_file. settings: of the search.

    runs, reference: paths of recordings; drives, healthy: the same as read. read: options. effects: folder of
    user-defined effects; own_effects: sha256 of each file in it. output: folder, None for runs/discover-<time>. jobs:
    number of processes. formats: of figure files. report: whether one is written. cached: whether a cached result may
    be used. force: use runs in which a check finds an error. propose: search for a relation beyond the library; None:
    if the residual is large.
    """

    base: str
    vehicle: VehicleParameters
    vehicle_file: str
    vehicle_text: str
    settings: DiscoverySettings
    runs: Sequence[Path] = ()
    reference: Sequence[Path] = ()
    read: ReadSettings = field(default_factory=ReadSettings)
    effects: Path | None = None
    output: Path | None = None
    jobs: int = 1
    formats: tuple[str, ...] = ()
    report: bool = True
    cached: bool = True
    force: bool = False
    propose: bool | None = None
    drives: Sequence[Drive] = ()
    healthy: Sequence[Drive] = ()
    own_effects: Mapping[str, str] = field(default_factory=dict)


def read_drives(sources: Sequence[RunSource], vehicle: VehicleParameters, settings: ReadSettings, jobs: int,
                done: Callable[[], None], force: bool = False) -> list[Drive]:
    """Read every run, in the order of the sources. jobs: number of parallel processes."""
    if jobs <= 1 or len(sources) < 2:
        drives = []
        for source in sources:
            drives.append(read_drive(source, vehicle, settings, force))
            done()
        return drives
    with ProcessPoolExecutor(min(jobs, len(sources))) as pool:
        # A source with a problem is handled here: its error cannot be pickled.
        futures = {number: pool.submit(read_drive, source, vehicle, settings, force)
                   for number, source in enumerate(sources) if source.problem is None}
        for _ in as_completed(futures.values()):
            done()
        return [futures[number].result() if number in futures else read_drive(source, vehicle, settings)
                for number, source in enumerate(sources)]


def read_drive(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings, force: bool = False) -> Drive:
    """Read one run. An error in its files is stored as its `problem`."""
    try:
        if source.problem is not None:
            raise source.problem
        run = read(source, vehicle, settings)
        checked = check_log(run.log, vehicle, run.auxiliary)
        text = recorded_configuration(run.provenance["recorded"]).vehicle if source.kind == "bag" else None
        car = "" if text is None else VehicleParameters.from_yaml(text, "the vehicle in the recording").name
        about = {"files": hash_files((*source.files, *source.can)),
                 "duration_s": run.log.duration, "alignment": run.alignment.verdict.value,
                 "clock_deviation_s": json_ready(run.alignment.offset_deviation),
                 "warnings": list(run.warnings), "findings": findings_as_json(checked.findings),
                 "estimates": json_ready(checked.estimates), "vehicle": car}
        refuse_errors(source.where, checked.findings, force)
        return Drive(source.name, run.log, about)
    except Refused as error:
        return Drive(source.name, None, {"findings": findings_as_json(error.findings)}, str(error))
    except RUN_ERRORS as error:
        return Drive(source.name, None, {}, describe_problem(error, source))


def clock_deviations(drives: Sequence[Drive]) -> dict[str, float]:
    """Standard deviation of the steering clock [s] by run, if it was aligned."""
    return {d.name: s for d in drives if d.log is not None and (s := d.about.get("clock_deviation_s"))}


def cache_folder() -> Path | None:
    """Folder of cached results; None without a home directory."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "single_track" / "answers"
    except RuntimeError:
        return None


def result_key(runs: Sequence[DriveLog], reference: Sequence[DriveLog], vehicle: VehicleParameters, base: Model,
               settings: DiscoverySettings, effects: Mapping[str, str],
               sensors: Mapping[str, Sequence[float]], clocks: Mapping[str, float]) -> str:
    """Cache key of a result: hash of all its inputs, including the code."""
    values = base.values if isinstance(base, AugmentedModel) else {}
    files = sorted(file for folder in st_core.__path__ for file in Path(folder).rglob("*.py"))
    code = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()
    content = [RESULT_FORMAT, code, [_digest(log) for log in runs], [_digest(log) for log in reference],
               vehicle.hash, sorted((name, one.uncertainty) for name, one in vehicle.provenance.items()),
               _base(base), {effect: dict(entry) for effect, entry in values.items()}, asdict(settings),
               sorted(effects.items()), sorted((name, list(value)) for name, value in sensors.items()), clocks]
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()[:32]


def write_result(file: Path, found: Discovery) -> None:
    """Write a result for `read_result`, atomically; a failure, such as a full disk, is ignored."""
    def parts(model: AugmentedModel) -> list[Any]:
        return [_base(model), {effect: dict(values) for effect, values in model.values.items()}]

    models = {name: getattr(found, name) for name in MODELS}
    content = found.document() | {name: model and parts(model) for name, model in models.items()}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f".{file.stem}.{os.getpid()}{file.suffix}")
        temporary.write_text(json.dumps(content), encoding="utf-8")
        temporary.replace(file)
    except OSError:
        return


def read_result(file: Path) -> Discovery | None:
    """The result in a file of `write_result`; None for a missing or damaged file."""
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        hints = get_type_hints(Discovery)
        parts = {one.name: _restore(hints[one.name], content[one.name]) for one in fields(Discovery)
                 if one.name not in MODELS}
        parts |= {name: content[name] and augment(*content[name]) for name in MODELS}
        return Discovery(**parts)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, StCoreError):
        return None


def _restore(kind: Any, value: Any) -> Any:
    """Lists and dicts of `Discovery.document` as dataclasses, tuples and mappings of the type `kind`."""
    origin, inner = get_origin(kind), get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = get_type_hints(kind)
        return kind(**{one.name: _restore(hints[one.name], value[one.name]) for one in fields(kind)})
    if origin is tuple:
        return tuple(map(_restore, repeat(inner[0]) if inner[-1] is Ellipsis else inner, value))
    if origin is Mapping:
        return {name: _restore(inner[1], entry) for name, entry in value.items()}
    if NoneType in inner:
        return None if value is None else _restore(next(one for one in inner if one is not NoneType), value)
    return value


def _base(model: Model) -> str:
    return model.base.name if isinstance(model, AugmentedModel) else model.name


def _digest(log: DriveLog) -> str:
    content = hashlib.sha256(log.name.encode())
    for column in fields(DriveLog):
        values = getattr(log, column.name)
        if isinstance(values, np.ndarray):
            content.update(column.name.encode() + values.tobytes())
    return content.hexdigest()
