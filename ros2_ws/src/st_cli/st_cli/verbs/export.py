"""The command `st export`: writes a model as functions for a controller."""

import importlib.util
from pathlib import Path
from typing import Literal

import typer

from . import _options as shared


def export(
    model: str = typer.Argument(..., help="kinematic, linear, nonlinear, or a model file (.yaml).", show_default=False),
    kind: Literal["casadi", "c"] = typer.Option("casadi", "--format", help="CasADi functions, or C with a header."),
    effects: shared.EffectsOfFile = None,
    car: shared.CarName = None,
    vehicle: shared.VehicleFile = None,
    output: Path | None = typer.Option(None, help="Folder of the files; default runs/export-<time>."),
    substeps: int = typer.Option(1, help="Integration substeps in one call of step(x, u, h).", min=1, max=64),
    bands: Path | None = typer.Option(
        None, help="Bands of `st calibrate`; their half-widths are written as functions of state and inputs (CasADi).",
        **shared.FILE),
    free: list[str] = typer.Option(
        [], help="Parameter that stays an argument of the functions, such as road_bank.angle; repeatable."),
) -> None:
    """Write a model as functions: dynamics, Runge-Kutta step, Jacobians; with names, units and bounds.

    acados and other tools based on CasADi load the .casadi files directly; see examples/mpc.
    """
    from st_core.bands import Bands
    from st_core.effects import load_folder
    from st_recordings.paths import new_folder

    if importlib.util.find_spec("casadi") is None:
        typer.echo("st export: CasADi is not installed: run pip install '.[mpc]' or pip install casadi", err=True)
        raise typer.Exit(2)
    from st_offline.model_export import export_model
    from st_recordings.car import read_model

    with shared.report_errors("export", OSError):
        named = shared.ReadOptions(car, vehicle).resolve_car().vehicle
        parameters, file = shared.load_vehicle_or_default(named)
        if effects is not None:
            load_folder(str(effects.absolute()))
        exported, model_vehicle = read_model(model, parameters, str(file), named is not None)
        parsed_bands = None if bands is None else Bands.from_yaml(bands.read_text(encoding="utf-8"), str(bands))
        folder = new_folder(output, "export")
        paths = export_model(exported, model_vehicle, folder, kind, substeps, free, parsed_bands)
    if model_vehicle is parameters:
        shared.report_default_car("export", named, file)
    for path in paths:
        typer.echo(path)
