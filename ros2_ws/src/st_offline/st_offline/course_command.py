"""The command `st course build`: writes the paths of runs, with speed and curvature, into a course file."""

import math
from collections.abc import Sequence
from pathlib import Path

from oxts_bridge.geometry import compute_origin_offset
from rich.markup import escape
from st_core.course import SPACING, Course, Pass, split_into_passes
from st_core.errors import ConfigurationError
from st_core.vehicle import VehicleParameters
from st_recordings.runs import ReadSettings, find_runs, read

from .checking.gate import RUN_ERRORS, describe_problem
from .terminal import check_is_new, console, format_count, print_line, report_problem, write_file


def build_course(runs: Sequence[Path], vehicle: VehicleParameters, read_settings: ReadSettings, output: Path) -> int:
    """Run the command; returns the exit status: 0 if every run was used, else 1. Raises ConfigurationError or
    OutputError if no course can be built or written."""
    check_is_new(output)
    passes: list[Pass] = []  # in the map of the first run with an origin; runs without one are not shifted
    origin: tuple[float, float] | None = None
    without_origin: list[str] = []
    failed = 0
    for source in find_runs(runs):
        try:
            with console.status(escape(source.name)):
                run = read(source, vehicle, read_settings)
                run_passes: Sequence[Pass] = split_into_passes(run.log, list(run.provenance["files"].values()))
                if "origin" in run.provenance:
                    latitude, longitude = map(math.degrees, run.provenance["origin"][:2])
                    origin = origin or (latitude, longitude)
                    offset = compute_origin_offset(origin, latitude, longitude)
                    run_passes = Course(tuple(run_passes)).shift(*offset).passes
                else:
                    without_origin.append(source.name)
        except RUN_ERRORS as error:
            failed += 1
            report_problem(source.name, describe_problem(error, source))
            continue
        passes += run_passes
        length = 1e-3 * SPACING * sum(len(pass_.points) for pass_ in run_passes)  # km
        print_line(f"{escape(source.name)}: {length:.2f} km in {format_count(len(run_passes), 'part')}")
    if not passes:
        raise ConfigurationError("no run can be used for a course, for the reasons above")
    if origin and without_origin:
        print_line(f"[yellow]warning: {escape(', '.join(without_origin))}: without a map origin, and therefore "
                   "not shifted; valid only if recorded in the map frame of the first run with an origin[/yellow]")
    write_file(output, Course(tuple(passes), origin).to_yaml())
    print_line(f"{escape(str(output))}: course of {format_count(len({pass_.recording for pass_ in passes}), 'drive')}")
    return 1 if failed else 0
