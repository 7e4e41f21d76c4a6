"""Inputs and results of a check: auxiliary data, findings, channel statistics, comparisons, and limits of findings."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

import numpy as np

SCHEMA = 3  # version of check.json; within a version, keys are added but never renamed


class Severity(StrEnum):
    """Effect of a finding on an evaluation: meaningless results (error), biased results (warning), or almost none."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


def _format_yaml(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {_format_yaml(item)}' for key, item in value.items())}}}"
    return f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Advice:
    """Remedy for a finding. line: text to paste, or an instruction.

    kind: "run.yaml": `entry` belongs in run.yaml; "vehicle": `entry` contains values of the vehicle file [SI];
    "option": `line` is a command-line option; "text": `line` is an instruction.
    """

    kind: Literal["run.yaml", "vehicle", "option", "text"]
    line: str
    entry: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def correct(cls, channel: str, **values: float) -> "Advice":
        """Advice to correct a channel in run.yaml; values: fields of `corrections.Correction`."""
        return cls.for_run_yaml({"correct": {channel: values}})

    @classmethod
    def for_run_yaml(cls, entry: Mapping[str, Any]) -> "Advice":
        """Advice to merge an entry into run.yaml. The line contains the first key; the others follow as a comment."""
        return cls("run.yaml", "  # and ".join(f"{key}: {_format_yaml(value)}" for key, value in entry.items()), entry)


@dataclass(frozen=True)
class Alternative:
    """Another cause that fits the drive as well as the cause of a finding does."""

    text: str  # clause that follows "or"
    findings: tuple[str, ...] = ()  # names of the findings of this cause, if there are any


@dataclass(frozen=True)
class Finding:
    """One fault or property of a recording."""

    name: str  # never renamed; listed in docs/manual/checks.md
    severity: Severity
    channels: tuple[str, ...]  # affected fields of DriveLog, or time, wheel_speed, ins_speed, ins
    statement: str  # one sentence, without the alternatives
    value: float | None = None  # estimate [unit]
    unit: str = "1"
    interval: tuple[float, float] | None = None  # 95 % confidence interval of value [unit]
    times: tuple[tuple[float, float], ...] = ()  # [s since the first INS measurement]; empty: the whole run
    effect: float | None = None  # approximate shift of the position at the end of the horizon [m]
    advice: Advice | None = None
    # Prediction error [m] without and with the correction; for severity error, with the corrections of all errors.
    tried: tuple[float, float] | None = None
    # Other possible causes; a correction in `advice` is valid for these too, or results in a mirror image of the drive.
    alternatives: tuple[Alternative, ...] = ()

    @property
    def text(self) -> str:
        """One sentence, with the alternatives."""
        others = "".join(f", or {alternative.text}" for alternative in self.alternatives)
        quantifier = "both" if len(self.alternatives) == 1 else "all"
        return f"{self.statement.removesuffix('?')}{others}: {quantifier} fit this drive" if others else self.statement

    def with_alternative(self, alternative: Alternative, advice: Advice, *channels: str) -> "Finding":
        """The finding with an alternative, which may affect further channels, and this advice; at most a warning."""
        severity = Severity.WARNING if self.severity is Severity.ERROR else self.severity
        return replace(self, severity=severity, channels=tuple(dict.fromkeys((*self.channels, *channels))),
                       alternatives=(*self.alternatives, alternative), advice=advice)

    @property
    def deviation(self) -> float:
        """Distance of the value from that in a recording without faults [unit]."""
        return abs((self.value or 0.0) - neutral_value(self.name))

    @property
    def concerns_only_acceleration(self) -> bool:
        """Whether only accelerations are affected, which identification and discovery use, but predictions do not."""
        return (self.effect is None and bool(self.channels)
                and all(channel.startswith("acceleration") for channel in self.channels))

    def as_dict(self) -> dict[str, Any]:
        """The entry of this finding in check.json."""
        fields = {**asdict(self), "severity": self.severity.value, "text": self.text}
        del fields["statement"]
        return fields


def find(findings: Iterable[Finding], *names: str) -> Finding | None:
    """The first finding with one of the names, or None."""
    return next((finding for finding in findings if finding.name in names), None)


def merge_findings(findings: Iterable[Finding]) -> list[Finding]:
    """The findings, with those of equal name, severity, times and value merged into one for all their channels."""
    groups: dict[tuple, Finding] = {}
    for finding in findings:
        key = (finding.name, finding.severity, finding.times, finding.value)
        if (first := groups.get(key)) is None:
            groups[key] = finding
        else:
            names = (*first.channels, *finding.channels)
            statement = first.statement.replace(", ".join(first.channels), ", ".join(names), 1)
            groups[key] = replace(first, channels=names, statement=statement)
    return list(groups.values())


@dataclass(frozen=True)
class Sampling:
    """Sampling and noise of one channel."""

    unit: str
    samples: int  # number of samples
    rate: float  # samples per second, from the median interval
    gaps: int  # number of intervals longer than `motion.MAX_GAP`
    longest_gap: float  # s
    noise: float  # standard deviation of white noise [unit]
    resolution: float  # quantisation step [unit]; 0 if the values are not quantised
    repeated: float  # fraction of samples equal to the previous one
    missing: int = 0  # number of rows without a usable value


@dataclass(frozen=True, eq=False)
class Comparison:
    """A quantity [unit] from two sources, for a figure."""

    name: str
    title: str
    unit: str
    measured_label: str
    derived_label: str
    time: np.ndarray  # (n,) [s since the first INS measurement]
    measured: np.ndarray  # (n,)
    derived: np.ndarray  # (n,)
    findings: tuple[str, ...] = ()  # names of all findings that this comparison can yield


@dataclass(frozen=True, eq=False)
class DriveCheck:
    """Result of a check."""

    findings: tuple[Finding, ...]  # the most severe first
    channels: Mapping[str, Sampling]
    comparisons: tuple[Comparison, ...]  # in the order of the checks
    # (value, lower and upper 95 % limit) by name of the finding, without ambiguous ones (two possible causes)
    estimates: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def with_severity(self, severity: Severity) -> tuple[Finding, ...]:
        return tuple(finding for finding in self.findings if finding.severity is severity)

    def as_dict(self) -> dict[str, Any]:
        """The part of check.json for this run."""
        return {"findings": [finding.as_dict() for finding in self.findings],
                "channels": {name: asdict(channel) for name, channel in self.channels.items()},
                "estimates": {name: list(values) for name, values in self.estimates.items()}}


@dataclass(frozen=True, eq=False)
class Series:
    """A signal with values (n,) at time_ns (n,), ascending, int64 [ns on the INS clock]."""

    time_ns: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class InsQuality:
    """Status and accuracy reported by the INS, (n,) each; NaN if unknown."""

    time_ns: np.ndarray
    navigation_status: np.ndarray  # NCOM byte 21, 4 = locked
    position_mode: np.ndarray  # NCOM mode: 6 = RTK integer, 5 = RTK float; NaN or -1 if unknown
    position_accuracy: np.ndarray  # horizontal standard deviation [m]


@dataclass(frozen=True, eq=False)
class AuxiliaryData:
    """Data recorded in addition to the drive, all optional."""

    # Recorded time stamps of "INS" and "steering" [int64 ns], before rows were left out.
    stamps: Mapping[str, np.ndarray] = field(default_factory=dict)
    # Number of rows without a usable value, by channel; a row that lacks only an acceleration was kept.
    missing: Mapping[str, int] = field(default_factory=dict)
    wheel_speed: Series | None = None  # forward speed from the wheels or the car's speed signal [m/s]
    ins_speed: Series | None = None  # forward speed [m/s], from CAN frames, or NCOM packets recorded with odometry
    quality: InsQuality | None = None
    corrections: tuple[str, ...] = ()  # descriptions of the corrections in run.yaml
    implausible: tuple[Finding, ...] = ()  # findings about samples that the reader left out, see `plausibility`
    start_ns: int | None = None  # time of the first recorded INS measurement; None: the first one of the drive
    geographic: bool = False  # whether x and y are east and north, computed from latitude and longitude


HORIZON = 5.0  # s; prediction time at which the effect of a fault is evaluated
WHEEL_SCALE_TOLERANCE = 0.03  # relative change of the tyre radius with wear and inflation pressure


@dataclass(frozen=True)
class Limits:
    """Limits of the findings. Effects are shifts of the position at the end of the horizon."""

    min_reported_effect: float = 0.02  # m; an RTK position is accurate to 2 cm
    warning_effect: float = 0.25  # m; the best models have errors of 0.4 m over such horizons
    error_effect: float = 5.0  # m; error of a model that goes straight on in a bend of radius 250 m at 10 m/s
    unit_ratio: float = 1.33  # factor above which a ratio is due to a wrong unit, sign or axis, not to calibration
    channel_unit_ratio: float = 2.0  # the same for accelerations (roll changes them) and wheel speeds (tyre radius)
    yaw_settling_time: float = 0.2  # s; time constant with which a model's initial yaw rate error decays
    lag: float = 0.015  # s; smaller lags are due to filters inside a sensor
    severe_lag: float = 0.05  # s; larger lags would be mistaken for a steering delay
    min_correlation: float = 0.6  # magnitude; two estimates of a quantity with a lower correlation are not compared
    acceleration_bias: float = 0.1  # m/s^2; caused by a tilt of the sensor or the road of 0.6 deg
    lateral_acceleration: float = 13.0  # m/s^2; above the limit of road tyres
    rear_slip: float = 0.2  # rad; slip angle above which the rear tyres slide; they grip best at 0.1 to 0.15
    sliding_acceleration: float = 1.0  # m/s^2; at a smaller lateral acceleration, tyres slide on ice at most
    steering_unit_ratio: float = 1.5  # unit_ratio of the steering; ratio, wheelbase and stiffnesses may be inaccurate
    steering_lag: float = 0.1  # s; possible error of the response time computed with the vehicle file
    steering_offset: float = 0.02  # rad, at the road wheels
    ins_position: float = 0.25  # m; accuracy of a rough measurement of the INS position
    heading_misalignment: float = 0.002  # rad; 0.1 deg, accuracy of a dual-antenna INS
    max_note_fraction: float = 0.01  # largest fraction of faulty samples that is reported as a note

    def severity(self, effect: float, severe: bool = False) -> Severity:
        """Severity of an effect [m]; at least a warning if `severe`."""
        if effect >= self.error_effect:
            return Severity.ERROR
        return Severity.WARNING if severe or effect >= self.warning_effect else Severity.NOTE


LIMITS = Limits()
SYSTEMATIC_UNCERTAINTY = {
    "lag": 0.005, "velocity_lag": 0.01, "velocity_x_lag": 0.01, "acceleration_x_lag": 0.01,
    "acceleration_y_lag": 0.01, "steering_lag": 0.04, "wheel_speed_lag": 0.02, "scale": 0.001,
    "acceleration_x_scale": 0.01, "acceleration_y_scale": 0.01, "wheel_speed_scale": 0.005, "ins_speed_scale": 0.002,
    "steering_scale": 0.05, "steering_sign": 0.05, "yaw_rate_bias": 0.0002, "acceleration_x_bias": 0.01,
    "acceleration_y_bias": 0.01, "yaw_offset": 0.001, "heading_misaligned": 0.001, "steering_offset": 0.001,
    "position_reference": 0.02, "position_side": 0.02, "measuring_point": 0.05,
    "yaw_drift": 2e-5, "map_shear": 0.001, "velocity_x_bias": 0.02, "velocity_y_bias": 0.02,
}
"""Systematic uncertainty of an estimate, half-width of a 95 % interval, in the finding's unit (scales: fraction of the
value), by the finding's name or its last part. It covers filters, interpolation, roll and the car's response to
steering, which the variation between blocks does not show, and is added in quadrature (GUM: type B). The values were
set from the errors on the development drives of bench/checks, not on its test drives."""


def neutral_value(name: str) -> float:
    """Value of a finding's quantity in a recording without faults."""
    return 1.0 if name.endswith("_scale") or name == "steering_sign" else 0.0
