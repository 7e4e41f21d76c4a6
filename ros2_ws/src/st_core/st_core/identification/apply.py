"""Identified values put into a vehicle with their provenance; warnings about dependent and conflicting values."""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

from ..provenance import Provenance
from ..vehicle import DERIVED, TYRES, VehicleParameters
from .result import Estimate, Identification, contradiction, quantity

STIFFNESS = {"tyre_front": "cornering_stiffness_front", "tyre_rear": "cornering_stiffness_rear"}


def apply(vehicle: VehicleParameters, found: Iterable[Identification], date: str) -> VehicleParameters:
    """The vehicle with every identified or doubtful value of a parameter it has; unidentifiable ones stay as they were.

    date: YYYY-MM-DD, into the provenance. A lambda_ky that was derived from the stiffness is derived again.
    Raises ConfigurationError, naming the key and the limit, when a value lies outside what a vehicle file may hold.
    """
    values: dict[str, float] = {}
    sources, provenance = dict(vehicle.sources), dict(vehicle.provenance)
    for identification in found:
        for estimate in identification.estimates:
            if quantity(estimate.parameter) is None or estimate.status == "unidentifiable":
                continue
            key = estimate.parameter
            values[key] = estimate.value
            doubt = ", doubtful" if estimate.status == "doubtful" else ""
            sources[key] = f"st identify {identification.what}{doubt}"
            spread = estimate.standard_uncertainty if math.isfinite(estimate.standard_uncertainty) else None
            provenance[key] = Provenance(spread, estimate.method, ", ".join(estimate.runs), date)
    own: dict[str, Any] = {key: value for key, value in values.items() if "." not in key}
    tyres: dict[str, Any] = {}
    for tyre in TYRES:
        changes = {key.partition(".")[2]: value for key, value in values.items() if key.startswith(f"{tyre}.")}
        tyres[tyre] = getattr(vehicle, tyre)._replace(**changes)
    changed = replace(vehicle, **own, **tyres, sources=sources, provenance=provenance)
    derived = [tyre for tyre in TYRES if sources.get(f"{tyre}.lambda_ky") == DERIVED]
    return changed.with_derived_scales(derived)


def stale_scales(vehicle: VehicleParameters, found: Iterable[Identification]) -> tuple[str, ...]:
    """A sentence for each tyre with a lambda_ky set in the file although a value it depends on has changed."""
    changed = {estimate.parameter for one in found for estimate in one.estimates if estimate.status != "unidentifiable"}
    sentences = []
    for tyre, stiffness in STIFFNESS.items():
        fixed = vehicle.sources.get(f"{tyre}.lambda_ky") != DERIVED and f"{tyre}.lambda_ky" not in changed
        base = (stiffness, "mass", "cg_to_front_axle")
        causes = sorted(key for key in changed if key in base or key.startswith(f"{tyre}."))
        if fixed and causes:
            sentences.append(f"{tyre}.lambda_ky was set in the vehicle file before {', '.join(causes)} changed: run "
                             "`st identify lambda` on the new file.")
    return tuple(sentences)


def against_file(vehicle: VehicleParameters, estimate: Estimate) -> str:
    """A sentence when the value contradicts the one the vehicle file has with an uncertainty, else an empty text."""
    before = vehicle.provenance.get(estimate.parameter)
    if before is None or before.uncertainty is None or estimate.status == "unidentifiable":
        return ""
    origin = f"the vehicle file ({before.method or vehicle.sources[estimate.parameter]}, {before.date or 'no date'})"
    return contradiction(estimate, value_of(vehicle, estimate.parameter), before.uncertainty, origin)


def value_of(vehicle: VehicleParameters, parameter: str) -> float:
    """A parameter by its name in the vehicle file ("mass", "tyre_front.p_cy1"), SI."""
    tyre, _, key = parameter.partition(".")
    return getattr(getattr(vehicle, tyre), key) if key else getattr(vehicle, parameter)
