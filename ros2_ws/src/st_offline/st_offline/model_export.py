"""Exports a model and its bands for a controller, as CasADi functions or C code, and describes its variables."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, Literal

import casadi
import numpy as np
from st_core import __version__
from st_core.augmented import AugmentedModel
from st_core.backends.casadi_backend import SymbolicModel, build
from st_core.bands import Band, Bands
from st_core.bands.calibration import LEVELS
from st_core.bands.scale import MAX_LOG_SCALE, compute_magnitudes, compute_scalar_features
from st_core.errors import ConfigurationError
from st_core.integrate import lowest_stable_speed
from st_core.models import Model
from st_core.vehicle import VehicleParameters
from st_recordings.paths import json_text

Format = Literal["casadi", "c"]
STEPS = (0.01, 0.02, 0.05, 0.1)  # s; the description states the lowest stable speed for each


def export_model(model: Model, vehicle: VehicleParameters, folder: Path, kind: Format, substeps: int = 1,
                 free: Iterable[str] = (), bands: Bands | None = None) -> list[Path]:
    """Write the functions of a model, model.json and README.md into an existing folder; returns the files.

    free: parameters that remain arguments of the functions. bands: of this car and model (`Bands.check`); each mode and
    level, of LEVELS and the highest, becomes a CasADi function that returns half-widths. Raises ConfigurationError for
    an unknown parameter in `free`.
    """
    symbolic = build(model, vehicle, substeps, free)
    if kind == "casadi":
        files = [folder / f"{function.name()}.casadi" for function in symbolic.functions]
        for file, function in zip(files, symbolic.functions, strict=True):
            function.save(str(file))
    else:
        generator = casadi.CodeGenerator(symbolic.name, {"with_header": True})
        for function in symbolic.functions:
            generator.add(function)
        generator.generate(f"{folder}/")  # the argument is a prefix of the file name
        files = [folder / f"{symbolic.name}.c", folder / f"{symbolic.name}.h"]
    for (model_name, mode), band in bands.bands.items() if bands else ():
        for level in {*LEVELS, max(band.factors)} & band.factors.keys() if model_name == model.name else ():
            name = f"{model.name}_band_{mode}_{100 * level:g}".replace(".", "_")
            files.append(folder / f"{name}.casadi")
            make_half_width_function(band, level, model.effective_vehicle(vehicle), name).save(str(files[-1]))
    description = make_description(symbolic, model, vehicle, [f.name for f in files])
    files += [folder / "model.json", folder / "README.md"]
    files[-2].write_text(json_text(description), encoding="utf-8")
    files[-1].write_text(_format_readme(description, kind), encoding="utf-8")
    return files


def make_description(symbolic: SymbolicModel, model: Model, vehicle: VehicleParameters,
                     files: list[str]) -> dict[str, Any]:
    """Content of model.json; null: no limit or no value."""
    effects: Mapping[str, Mapping[str, float]] = getattr(model, "values", {})
    car = model.effective_vehicle(vehicle)
    return {
        "model": symbolic.name,
        "base": model.base.name if isinstance(model, AugmentedModel) else model.name,
        "effects": {name: dict(values) for name, values in effects.items()},
        "omitted_effects": list(symbolic.omitted_effects),
        "vehicle": {"name": vehicle.name, "hash": vehicle.hash, "cg_to_ins_x": car.cg_to_ins_x,
                    "cg_to_ins_y": car.cg_to_ins_y},
        "version": __version__,
        "frame": "x forward, y left, z up; centre of gravity; map x east, y north; yaw counter-clockwise from east",
        **{key: [{"name": v.name, "unit": v.unit, "lower": v.lower, "upper": v.upper} for v in variables]
           for key, variables in (("states", symbolic.states), ("inputs", symbolic.inputs))},
        "parameters": list(map(asdict, symbolic.parameters)),
        "substeps": symbolic.substeps,
        "stable_above_m_s": {f"{step:g}": round(lowest_stable_speed(model, vehicle, step / symbolic.substeps), 3)
                             for step in STEPS},
        "functions": {f.name(): {role: {name: list(size(k)) for k, name in enumerate(names)} for role, names, size in (
            ("arguments", f.name_in(), f.size_in), ("results", f.name_out(), f.size_out))} for f in symbolic.functions},
        "files": files,
    }


def _format_readme(description: dict[str, Any], kind: Format) -> str:
    name, car, p = description["model"], description["vehicle"], ", p" if description["parameters"] else ""
    states, inputs, parameters = (", ".join(f"{v['name']} [{v['unit']}]" for v in description[key]) or "none"
                                  for key in ("states", "inputs", "parameters"))
    stable = ", ".join(f"{h} s: {v:g} m/s" for h, v in description["stable_above_m_s"].items())
    missing = ", ".join(description["omitted_effects"])
    usage = (f'```python\nimport casadi\nstep = casadi.Function.load("{name}_step.casadi")\n'
             f"x_next = step(x, u, h{p})\n```" if kind == "casadi" else
             f"Compile `{name}.c` (C99, needs libm only) and include `{name}.h`. Matrices are stored column by column, "
             "Jacobians without their structural zeros: `_sparsity_out` returns the positions of the entries. Call "
             f"`{name}_step(arguments, results, iw, w, 0)` with arrays of the sizes that `{name}_step_work` returns.")
    return "\n\n".join(filter(None, (
        f"# {name}: single-track model of {car['name']}",
        f"Base model {description['base']}; effects: {', '.join(description['effects']) or 'none'}. st_core "
        f"{description['version']}, vehicle hash {car['hash'][:12]}. SI units. Frame: "
        f"{description['frame']}. INS {car['cg_to_ins_x']:g} m ahead, {car['cg_to_ins_y']:g} m left of the CG.",
        f"States x: {states}. Inputs u: {inputs}. Parameters p: {parameters}. The road-wheel angle is positive to the "
        "left. velocity_x_dot is the derivative of velocity_x; the longitudinal acceleration is velocity_x_dot - "
        "velocity_y * yaw_rate. Bounds, and the arguments and results of each function, are in model.json; use the "
        "bounds, or narrower ones, as constraints.",
        "`dynamics`: time derivative. `step`: classical Runge-Kutta over h [s], inputs constant, "
        f"{description['substeps']} substep(s). `dynamics_jacobian`, `step_jacobian`: their derivatives A with respect "
        "to x and B with respect to u. `start`: appends the initial values of the additional states to the six states.",
        f"Speed above which a step h is stable (the equations are stiff at low speed): {stable}. By default, "
        "`st evaluate` uses h = 0.05 s.",
        f"Not in the equations: {missing}. These effects act on the steering signal before the model, or on the "
        "sensors; apply them separately." if missing else "",
        f"`{name}_band_...`: half-widths, one row per point after the start: along, across [m], yaw [rad]. Arguments: "
        "x, u, RMS steering rate at the road wheels in the last second [rad/s]. Valid only in the calibration domain."
        if any(file.startswith(f"{name}_band_") for file in description["files"]) else "", usage))) + "\n"


def make_half_width_function(band: Band, level: float, vehicle: VehicleParameters,
                             name: str = "half_widths") -> casadi.Function:
    """CasADi function of the half-widths of a band, one row per point after the start: along, across [m], yaw [rad].

    Its arguments are x: the six states at the CG; u: road_wheel_angle [rad], velocity_x_dot [m/s^2]; steering_activity
    [rad/s]: root mean square rate of the road-wheel angle in the last second. Its values equal `Band.half_widths`; the
    calibration domain is not checked. Raises ConfigurationError for a level without a band.
    """
    if level not in band.factors:
        levels = ", ".join(f"{available:g}" for available in band.factors)
        raise ConfigurationError(f"the bands have no level {level:g}; use {levels}")
    x, u, activity = casadi.SX.sym("x", 6), casadi.SX.sym("u", 2), casadi.SX.sym("steering_activity")
    velocity_x = x[2] - x[5] * vehicle.cg_to_ins_y
    condition = compute_magnitudes(velocity_x, x[5], u[1], activity)
    phi = casadi.vertcat(*compute_scalar_features(condition, casadi.log, casadi.fmax))
    interpolation, floors = casadi.DM(band.scale.interpolation), band.scale.floors
    columns = []
    for axis, coefficients in enumerate(band.scale.coefficients):
        logs = casadi.fmin(casadi.fmax(2.0 * casadi.DM(coefficients) @ phi, -2.0 * MAX_LOG_SCALE), 2.0 * MAX_LOG_SCALE)
        squared = casadi.exp(interpolation @ logs) + casadi.DM(np.square(floors[:, axis]))
        columns.append(band.factors[level] * casadi.sqrt(squared))
    return casadi.Function(name, [x, u, activity], [casadi.horzcat(*columns)], ["x", "u", "steering_activity"],
                           ["half_widths"])
