"""The commands `st effects` and `st export`: list and test physical effects, and write a model for a controller."""

import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import typer

from . import _options as shared
from ._options import console

if TYPE_CHECKING:
    from st_core.vehicle import VehicleParameters

HOOK_LABELS = {
    "vehicle": "vehicle parameters", "steering": "recorded steering",
    "inputs": "steering angle or forward acceleration", "slip_angles": "slip angles", "axle_forces": "axle forces",
    "acceleration": "accelerations", "rates": "additional states", "specific_force": "accelerations",
    "observe": "sensor readings"}


def effects(
    action: Literal["list", "check"] = typer.Argument("list", help="list, or check."),
    files: list[Path] = typer.Argument(None, help="check: effect files (.py); default all effects of the library."),
    car: shared.CarName = None,
    vehicle: shared.VehicleFile = None,
    own_effects: Path | None = typer.Option(
        None, "--effects", help="Folder of your own effects to include.", **shared.FOLDER),
) -> None:
    """List the effects (kind, what they act on, confounded effects, channels needed), or check your own effect files.

    check: with its null values an effect must not change the base model; within its bounds its results must be finite,
    stable, left-right symmetric, and equal for floats, arrays, compiled code and CasADi. Exit status: 0 all
    requirements met, 1 a requirement violated, 2 a file cannot be loaded.
    """
    from st_core.effects import load_folder

    with shared.report_errors("effects", OSError):
        if own_effects is not None:
            load_folder(str(own_effects.absolute()))
        if action == "list":
            _print_library()
            return
        given_file = shared.ReadOptions(car, vehicle).fill_in_car().vehicle
        parameters, file = shared.load_vehicle_or_default(given_file)
        all_met = _check_effects(files or (), parameters)
        shared.report_default_car("effects", given_file, file)
    raise typer.Exit(0 if all_met else 1)


def _print_library() -> None:
    """Print one paragraph per effect, because a table of eight columns does not fit a terminal."""
    from rich.markup import escape
    from rich.padding import Padding
    from st_core.effects import EFFECTS, find_confounded_effects

    for name, effect in sorted(EFFECTS.items(), key=lambda item: (item[1].kind, item[0])):
        hooks = dict.fromkeys(label for hook, label in HOOK_LABELS.items() if getattr(effect, hook))
        lines = {"": effect.physics, "acts on": ", ".join((*hooks, *(f"signal {s}" for s in effect.signals))),
                 "excited by": effect.excited_by,
                 "hard to separate from": ", ".join(sorted(find_confounded_effects(name))),
                 "needs": ", ".join(effect.needs)}
        console.print(f"[bold]{name}[/bold]  {effect.kind}, {effect.slot}", highlight=False)
        for key, text in lines.items():
            if text:
                console.print(Padding(f"{key + ': ' if key else ''}{escape(text)}", (0, 0, 0, 2)), highlight=False)


def _check_effects(files: Sequence[Path], car: "VehicleParameters") -> bool:
    from st_core.contract import check_effect
    from st_core.effects import EFFECTS, load_file
    from st_core.errors import ConfigurationError

    for file in files:
        if file.suffix != ".py":
            raise ConfigurationError(f"{file}: the name of an effect file must end in .py")
        if not file.is_file():
            raise ConfigurationError(f"{file}: does not exist")
    selected = [e for f in files for e in load_file(str(f.resolve().parent), f.stem)] if files else EFFECTS.values()
    all_met = True
    for effect in selected:
        results = check_effect(effect, car)
        violated = [text for text, problem in results.items() if problem]
        all_met &= not violated
        verdict = f"{len(violated)} of {len(results)} requirements violated" if violated else "all requirements met"
        lines = [f"{effect.name}: {verdict}"]
        lines += [f"  FAIL {text}: {results[text]}" for text in violated]
        lines += [f"  ok   {text}" for text in results if files and text not in violated]
        console.print("\n".join(lines), markup=False, highlight=False)
    return all_met


def export(
    model: str = typer.Argument(..., help="kinematic, linear, nonlinear, or a model file (.yaml).", show_default=False),
    kind: Literal["casadi", "c"] = typer.Option("casadi", "--format", help="CasADi functions, or C with a header."),
    effects: shared.ModelEffects = None,
    car: shared.CarName = None,
    vehicle: shared.VehicleFile = None,
    output: Path | None = typer.Option(None, help="Folder for the files; default runs/export-<time>."),
    substeps: int = typer.Option(1, help="Integration substeps in one call of step(x, u, h).", min=1, max=64),
    bands: Path | None = typer.Option(
        None, help="Bands of `st calibrate`; their half-widths are written as functions of state and inputs (CasADi).",
        **shared.FILE),
    free: list[str] = typer.Option(
        [], help="Parameter that remains an argument of the functions, such as road_bank.angle; repeatable."),
) -> None:
    """Write a model as functions: dynamics, Runge-Kutta step, Jacobians; with names, units and bounds.

    acados and other tools based on CasADi load the .casadi files directly; see examples/mpc.
    """
    from st_core.bands import Bands
    from st_core.effects import load_folder
    from st_core.models import MODELS
    from st_recordings.paths import new_folder

    if importlib.util.find_spec("casadi") is None:
        typer.echo("st export: CasADi is not installed: run pip install '.[mpc]' or pip install casadi", err=True)
        raise typer.Exit(2)
    from st_offline.model_export import export_model
    from st_recordings.car import read_model, read_model_file, read_text

    with shared.report_errors("export", OSError):
        given_file = shared.ReadOptions(car, vehicle).fill_in_car().vehicle
        parameters, file = shared.load_vehicle_or_default(given_file)
        if effects is not None:
            load_folder(str(effects.absolute()))
        exported, model_vehicle = read_model(model, parameters, str(file), given_file is not None)
        parsed_bands = None if bands is None else Bands.from_yaml(read_text(bands), str(bands))
        if parsed_bands is not None:
            parsed_bands.check(model_vehicle, {exported.name: "" if model in MODELS else read_model_file(model).hash})
        paths = export_model(exported, model_vehicle, new_folder(output, "export"), kind, substeps, free, parsed_bands)
    if model_vehicle is parameters:
        shared.report_default_car("export", given_file, file)
    for path in paths:
        typer.echo(path)
