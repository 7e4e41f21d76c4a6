"""Results of identification: values with uncertainty and status, and their application to a vehicle file."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from ..errors import StCoreError
from ..regression import Z95
from ..vehicle import DERIVED_SOURCE, FILE_QUANTITIES, TYRES, Provenance, VehicleParameters, value_of

if TYPE_CHECKING:  # `checks` takes a second to import, and nodes do not need it
    from ..checks.finding import Finding

Status = Literal["identified", "doubtful", "unidentifiable"]


class IdentificationError(StCoreError):
    """The data do not permit an identification. The message is one line: problem, numbers, remedy."""


@dataclass(frozen=True)
class ParameterEstimate:
    """Estimate of a parameter, named as in the vehicle file ("mass", "tyre_front.p_ky1"), in SI units."""

    parameter: str
    value: float
    unit: str
    standard_uncertainty: float  # one standard deviation; may be infinite or NaN if unidentifiable
    interval95: tuple[float, float]  # lower and upper end of the 95 % interval, which may be asymmetric
    method: str  # short text
    runs: tuple[str, ...]  # names of the drives or tables
    verdict: str  # sentences for the user
    status: Status = "identified"


@dataclass(frozen=True)
class Coverage:
    """Number of samples in each bin of the range of a signal, and the required minimum."""

    signal: str
    unit: str
    edges: np.ndarray  # of the bins, (n + 1,)
    counts: np.ndarray  # number of samples, (n,)
    min_samples: int = 1  # minimum number of samples in a filled bin
    min_filled_bins: int = 1  # minimum number of filled bins

    @property
    def filled_bins(self) -> int:
        return int(np.count_nonzero(np.asarray(self.counts) >= self.min_samples))

    @property
    def sufficient(self) -> bool:
        return self.filled_bins >= self.min_filled_bins

    def describe(self) -> str:
        return (f"{self.signal}: {self.filled_bins} of {len(self.counts)} bins from {self.edges[0]:.4g} to "
                f"{self.edges[-1]:.4g} {self.unit} have at least {self.min_samples} "
                f"sample{'s' * (self.min_samples > 1)} (needed: {self.min_filled_bins})")


@dataclass(frozen=True)
class Identification:
    """Result of one experiment. An estimate whose 95 % interval contains zero is doubtful, or unidentifiable if only
    positive values are possible. This does not apply to parameters of the Magic Formula, for which zero is valid."""

    experiment: str  # name in `st identify`
    estimates: tuple[ParameterEstimate, ...]
    used_data: tuple[str, ...]  # names of the drives or tables
    rejected_data: tuple[tuple[str, str], ...] = ()  # (name of the drive or table, reason)
    correlation: np.ndarray | None = None  # matrix, in the order of the estimates
    coverage: tuple[Coverage, ...] = ()  # excitation by signal
    warnings: tuple[str, ...] = ()  # sentences
    figure: Mapping[str, Any] = field(default_factory=dict)  # data of the figure
    findings: "Mapping[str, tuple[Finding, ...]]" = field(default_factory=dict)  # by drive, used or rejected

    def __post_init__(self) -> None:
        estimates = list(self.estimates)
        for k, estimate in enumerate(estimates):
            low, high = estimate.interval95
            if not low <= 0.0 <= high or estimate.status == "unidentifiable" or "." in estimate.parameter:
                continue
            quantity = FILE_QUANTITIES.get(estimate.parameter)
            if quantity is not None and quantity.minimum > 0.0:
                verdict = f"Not identifiable: zero is inside the interval. {estimate.verdict}"
                estimates[k] = replace(estimate, status="unidentifiable", verdict=verdict)
            else:
                note = f" {estimate.parameter} is not distinguishable from zero."
                estimates[k] = replace(estimate, status="doubtful", verdict=estimate.verdict.removesuffix(note) + note)
        object.__setattr__(self, "estimates", tuple(estimates))

    def __getitem__(self, parameter: str) -> ParameterEstimate:
        return {estimate.parameter: estimate for estimate in self.estimates}[parameter]

    def to_document(self) -> dict[str, dict[str, Any]]:
        """Body of identification.json: {parameter: {value, unit, standard_uncertainty, interval95, method, runs, ...}};
        None for a number that is not finite."""
        return {e.parameter: {
            "value": _finite_or_none(e.value), "unit": e.unit,
            "standard_uncertainty": _finite_or_none(e.standard_uncertainty),
            "interval95": [_finite_or_none(end) for end in e.interval95], "method": e.method, "runs": list(e.runs),
            "verdict": e.verdict} for e in self.estimates}


def describe_contradiction(estimate: ParameterEstimate, value: float, standard_uncertainty: float, origin: str) -> str:
    """A sentence if an estimate differs significantly (two-sided, 5 %) from a value of another origin, else "".

        z = (x_1 - x_2) / sqrt(u_1^2 + u_2^2),    reported if |z| > 1.96
    """
    uncertainty = math.hypot(estimate.standard_uncertainty, standard_uncertainty)
    difference = estimate.value - value
    if not math.isfinite(uncertainty) or abs(difference) <= Z95 * uncertainty:
        return ""
    ratio = f"is {abs(difference) / uncertainty:.1f} times the" if uncertainty > 0.0 else "exceeds the zero"
    factor, unit = (math.degrees(1.0), " deg") if estimate.unit == "rad" else (1.0, f" {estimate.unit}".rstrip(" 1"))
    return (f"{estimate.parameter} {factor * estimate.value:.5g} contradicts {factor * value:.5g}{unit} of {origin}: "
            f"the difference {factor * difference:+.3g} {ratio} combined uncertainty.")


def describe_correlations(names: Sequence[str], correlation: np.ndarray, limit: float = 0.95) -> tuple[str, ...]:
    """A sentence for each pair of parameters with a |correlation| above a limit."""
    return tuple(f"The correlation of {names[i]} and {names[j]} is {correlation[i, j]:+.3f}: the data determine a "
                 "combination of the two better than either one alone."
                 for i in range(len(names)) for j in range(i + 1, len(names)) if abs(correlation[i, j]) > limit)


def _finite_or_none(number: float) -> float | None:
    return float(number) if math.isfinite(number) else None


def apply_to_vehicle(vehicle: VehicleParameters, identifications: Iterable[Identification],
                     date: str) -> VehicleParameters:
    """The vehicle with all identified and doubtful values, and with derived lambda_ky recomputed. date: YYYY-MM-DD.
    Raises ConfigurationError, naming the key and the limit, for a value outside the limits of a vehicle file."""
    values: dict[str, float] = {}
    sources: dict[str, str] = {}
    provenance: dict[str, Provenance] = {}
    for identification in identifications:
        for estimate in identification.estimates:
            if estimate.parameter not in FILE_QUANTITIES or estimate.status == "unidentifiable":
                continue
            key = estimate.parameter
            values[key] = estimate.value
            note = ", doubtful" if estimate.status == "doubtful" else ""
            sources[key] = f"st identify {identification.experiment}{note}"
            provenance[key] = Provenance(_finite_or_none(estimate.standard_uncertainty), estimate.method,
                                         ", ".join(estimate.runs), date)
    changed = vehicle.with_values(values)
    return replace(changed, sources={**changed.sources, **sources}, provenance={**vehicle.provenance, **provenance})


def describe_stale_lambda(vehicle: VehicleParameters, identifications: Iterable[Identification]) -> tuple[str, ...]:
    """A sentence for each tyre whose lambda_ky is stated in the vehicle file, but depends on a changed value."""
    changed = {estimate.parameter for identification in identifications for estimate in identification.estimates
               if estimate.status != "unidentifiable"}
    sentences = []
    for tyre in TYRES:
        is_fixed = vehicle.sources.get(f"{tyre}.lambda_ky") != DERIVED_SOURCE and f"{tyre}.lambda_ky" not in changed
        inputs = (tyre.replace("tyre", "cornering_stiffness"), "mass", "cg_to_front_axle")
        causes = sorted(key for key in changed if key in inputs or key.startswith(f"{tyre}."))
        if is_fixed and causes:
            sentences.append(f"{tyre}.lambda_ky of the vehicle file is outdated, as {', '.join(causes)} changed: run "
                             "`st identify lambda` on the new file.")
    return tuple(sentences)


def get_stated_uncertainty(vehicle: VehicleParameters, key: str) -> float:
    """Standard uncertainty of a value [SI] that the vehicle file states; 0 if it states none."""
    return vehicle.provenance.get(key, Provenance()).uncertainty or 0.0


def compare_with_file(vehicle: VehicleParameters, estimate: ParameterEstimate) -> str:
    """A sentence if the estimate differs significantly (5 %) from a value with uncertainty in the file, else ""."""
    provenance = vehicle.provenance.get(estimate.parameter)
    if provenance is None or not provenance.uncertainty or estimate.status == "unidentifiable":
        return ""
    origin = (f"the vehicle file ({provenance.method or vehicle.sources[estimate.parameter]}, "
              f"{provenance.date or 'no date'})")
    return describe_contradiction(estimate, value_of(vehicle, estimate.parameter), provenance.uncertainty, origin)
