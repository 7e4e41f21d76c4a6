"""The command `st calibrate`: calibrates bands from the prediction errors of runs, and writes them into a file."""

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from st_core.bands import Band, Bands, CalibrationDomain, ErrorSamples, calibration
from st_core.bands.file import hash_configuration, make_times
from st_core.log_evaluation import MODES
from st_core.models import Model
from st_core.vehicle import VehicleParameters
from st_recordings.results import parse_configuration
from st_recordings.runs import LoadedRun, RunError, RunSource, find_runs, read

from ..checking.gate import RUN_ERRORS, check_before_use, describe_problem
from ..evaluation.work import Task, collect_model_hashes, load_models
from ..terminal import check_is_new, console, print_line, report_problem, write_file


def run_command(runs: Sequence[Path], task: Task, output: Path, levels: Sequence[float], together: bool) -> int:
    """Run the command; returns the exit status: 0 if every run was used, else 1. levels: nominal coverages. together:
    whether the recordings in one entry of `runs` are dependent and count as one run. Raises StCoreError or OutputError
    if no bands can be calibrated or written."""
    check_is_new(output)
    calibration.check_level_range(levels)
    models = load_models(task)
    recordings: dict[str, str] = {}
    problems: list[str] = []
    groups = [collect_errors(find_runs(paths), task, models, recordings, problems)
              for paths in ([[path] for path in runs] if together else [runs])]
    samples = [calibration.join_runs(group) for group in groups if group] if together else groups[0]
    calibration.check_levels(levels, len(samples))
    settings, bands = task.settings.as_dict(), dict[tuple[str, str], Band]()
    time = make_times(task.settings.prediction.horizon, task.settings.prediction.step)
    for model in models:
        for mode in MODES:
            console.print(f"[dim]calibrating {escape(model.name)}, {mode}[/dim]", highlight=False)
            bands[model.name, mode] = calibration.calibrate(samples, (model.name, mode), time, levels)
    hashes = {name: hash_configuration(task.vehicle, settings, digest)
              for name, digest in collect_model_hashes(task, models).items()}
    content = Bands(task.vehicle.name, task.vehicle.hash, settings, recordings, len(samples),
                    CalibrationDomain.from_runs([run.conditions for run in samples]), bands, hashes)
    write_file(output, content.to_yaml())
    starts, highest = sum(len(run.conditions) for run in samples), calibration.compute_highest_level(len(samples))
    print_line(f"{escape(str(output))}: bands of {', '.join(content.models)} from {len(samples)} runs, {starts} "
               f"starts; {len(samples)} runs support levels up to {100 * highest:.1f} %")
    return 1 if problems else 0


def collect_errors(sources: Sequence[RunSource], task: Task, models: Sequence[Model], recordings: dict[str, str],
                   problems: list[str]) -> list[ErrorSamples]:
    """Prediction errors of each run. An unusable run is left out; its problem is printed and added to `problems`. The
    files of the used runs are added to `recordings`: sha256 by file name, or by path if the name occurred before."""
    samples: list[ErrorSamples] = []
    for source in sources:
        try:
            with console.status(escape(source.name)):
                run = read(source, task.vehicle, task.read_settings)
                names_by_digest = {digest: name for name, digest in recordings.items()}
                for digest in run.provenance["files"].values():
                    if digest in names_by_digest:  # a copy is not an independent sample
                        raise RunError(source.path, f"has the same content as {names_by_digest[digest]}",
                                       "give each recording once")
                _check_recorded_car(source, run, task.vehicle)
                check_before_use(source.path, run, task.vehicle, task.force, models, task.settings.prediction.step)
                signals = task.settings.signals(run.log)
                samples.append(calibration.compute_error_samples(models, task.vehicle, signals, task.settings))
        except RUN_ERRORS as error:
            problems.append(describe_problem(error, source))
            report_problem(source.name, problems[-1])
            continue
        for file, digest in run.provenance["files"].items():
            name = Path(file).name
            recordings[file if name in recordings else name] = digest
    return samples


def _check_recorded_car(source: RunSource, run: LoadedRun, vehicle: VehicleParameters) -> None:
    """Raise RunError if the recorded car has another name (its values are not compared), StCoreError if invalid."""
    text = parse_configuration(run.provenance.get("recorded", {})).vehicle
    if text is None:
        return
    name = VehicleParameters.from_yaml(text, f"the vehicle in {source.path}").name
    if name != vehicle.name:
        raise RunError(source.path, f"is a drive of {name!r}, but the vehicle file is for {vehicle.name!r}",
                       "calibrate each car with its own drives")
