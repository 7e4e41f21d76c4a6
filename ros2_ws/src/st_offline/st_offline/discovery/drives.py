"""Recordings into drives, with a memory: what was read once is not decoded again when a discovery is started anew."""

import hashlib
import json
import os
import zipfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass, fields
from functools import cache as remembered
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
from st_core import checks
from st_core.errors import StCoreError
from st_core.log import DriveLog
from st_core.vehicle import VehicleParameters
from st_recordings.plain_json import finite
from st_recordings.recorded import recorded_configuration
from st_recordings.runs import LoadedRun, ReadSettings, RunSource, read
from st_recordings.runs.load import hashes, report
from st_recordings.runs.run_types import signal_files

from ..checking.check_document import documents, findings_in
from ..checking.gate import PROBLEMS, Refused, checked_log, in_words, refuse

FORMAT = 3  # of what is kept; another number makes older files useless


@dataclass(frozen=True)
class Drive:
    """One run as it was read, or the reason why it cannot be used (then log is None).

    about: for the report; its findings are there for a run that was refused as well. Its estimates are those of the
    checks, its vehicle the name of the car that a recording says it is of, "" where it does not.
    """

    name: str
    log: DriveLog | None
    about: dict[str, Any]
    problem: str = ""


def read_drives(sources: Sequence[RunSource], vehicle: VehicleParameters, settings: ReadSettings, jobs: int,
                cache: Path | None, done: Callable[[], None], force: bool = False) -> list[Drive]:
    """Every run, in the order of the sources. jobs: processes side by side. cache: folder of what is kept; None: no.

    force: whether runs are used of which the checks say that it means nothing.
    """
    if jobs <= 1 or len(sources) < 2:
        drives = []
        for source in sources:
            drives.append(read_drive(source, vehicle, settings, cache, force))
            done()
        return drives
    with ProcessPoolExecutor(min(jobs, len(sources))) as pool:
        # What is no recording at all is answered here: its error does not travel between processes.
        futures = {number: pool.submit(read_drive, source, vehicle, settings, cache, force)
                   for number, source in enumerate(sources) if source.problem is None}
        for _ in as_completed(futures.values()):
            done()
        return [futures[number].result() if number in futures else read_drive(source, vehicle, settings, None)
                for number, source in enumerate(sources)]


def read_drive(source: RunSource, vehicle: VehicleParameters, settings: ReadSettings, cache: Path | None,
               force: bool = False) -> Drive:
    """One run, from what is kept of it where its files are still the same. What is wrong becomes its `problem`."""
    try:
        if source.problem is not None:
            raise source.problem
        files = hashes(source)
        kept = cache / f"{_key(source, files, vehicle, settings)}.npz" if cache else None
        drive = _restored(kept) if kept else None
        if drive is None:
            run = read(source, vehicle, settings)
            checked = checked_log(run.log, vehicle, run.auxiliary)
            about = {"files": files, "duration_s": run.log.duration, "alignment": run.alignment.verdict.value,
                     "warnings": list(run.warnings), "findings": documents(checked.findings),
                     "estimates": finite(checked.estimates), "vehicle": _recorded_vehicle(source, run)}
            drive = Drive(source.name, run.log, about)
            if kept:
                _keep(kept, drive)
        else:
            report(drive.about["warnings"])
        refuse(source.where, findings_in(drive.about), force)
        return drive
    except Refused as error:
        return Drive(source.name, None, {"findings": documents(error.findings)}, str(error))
    except PROBLEMS as error:
        return Drive(source.name, None, {}, in_words(error, source))


def cache_folder(name: str = "drives") -> Path | None:
    """Where drives, or answers, are kept between starts; None where there is no home."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "single_track" / name
    except RuntimeError:
        return None


def name_of(content: Any) -> str:
    """A file name for everything that what is kept depends on."""
    return hashlib.sha256(json.dumps(content, default=str).encode()).hexdigest()[:32]


@remembered
def code_of(package: ModuleType) -> str:
    """Of the code of a package: what another version found is not believed."""
    files = sorted(file for folder in package.__path__ for file in Path(folder).rglob("*.py"))
    return hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()


def put(file: Path, write: Callable[[Path], object]) -> None:
    """Written beside and moved into place, so that a start cut short leaves nothing half. A full disk is no reason."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        temporary = file.with_name(f".{file.stem}.{os.getpid()}{file.suffix}")
        write(temporary)
        temporary.replace(file)
    except OSError:
        return


def _recorded_vehicle(source: RunSource, run: LoadedRun) -> str:
    if source.kind != "bag":
        return ""
    text = recorded_configuration(run.provenance["recorded"]).vehicle
    return "" if text is None else VehicleParameters.from_yaml(text, "the vehicle in the recording").name


def _key(source: RunSource, files: dict[str, str], vehicle: VehicleParameters, settings: ReadSettings) -> str:
    """Of everything the drive depends on: contents, not paths, except that its name is kept in it."""
    tables = signal_files(source, settings) if source.can else ()
    table = [hashlib.sha256(f.read_bytes()).hexdigest() for f in tables]
    options = {k: v for k, v in asdict(settings).items() if k not in ("dbc", "signals")}
    content = [FORMAT, code_of(checks), source.name, source.kind, sorted(files.values()), table, vehicle.hash, options,
               {k: v for k, v in source.settings.items() if k not in ("dbc", "signals")}]
    return name_of(content)


def _keep(file: Path, drive: Drive) -> None:
    arrays = {f.name: getattr(drive.log, f.name) for f in fields(DriveLog)
              if isinstance(getattr(drive.log, f.name), np.ndarray)}
    about = json.dumps({"name": drive.name, **drive.about})
    put(file, lambda temporary: np.savez(temporary, about=about, **arrays))


def _restored(file: Path) -> Drive | None:
    try:
        with np.load(file, allow_pickle=False) as kept:
            about = json.loads(str(kept["about"]))
            name = about.pop("name")
            return Drive(name, DriveLog(name, **{k: kept[k] for k in kept.files if k != "about"}), about)
    except (OSError, ValueError, KeyError, TypeError, StCoreError, zipfile.BadZipFile, EOFError):
        return None
