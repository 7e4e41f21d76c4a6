"""Inputs and results of a check: auxiliary data of a recording, findings, channels and the identities behind them."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

import numpy as np

SCHEMA = 1  # of check.json; keys are added, never renamed, within a number


class Severity(StrEnum):
    """error: an evaluation would be meaningless. warning: it would be biased. note: harmless here."""

    ERROR = "error"
    WARNING = "warning"
    NOTE = "note"


@dataclass(frozen=True)
class Advice:
    """What removes a finding. line: to be pasted, one line.

    kind: "run.yaml": `entry` is to be merged into the run's run.yaml; "vehicle": a value of the vehicle file;
    "option": of the command line; "look": nothing to paste, `line` names what to look at.
    """

    kind: Literal["run.yaml", "vehicle", "option", "look"]
    line: str
    entry: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def correct(cls, channel: str, **values: float) -> "Advice":
        """Of a channel of the run; values: fields of `corrections.Correction`."""
        words = ", ".join(f"{key}: {value:g}" for key, value in values.items())
        return cls("run.yaml", f"correct: {{{channel}: {{{words}}}}}", {"correct": {channel: values}})


@dataclass(frozen=True)
class Finding:
    """One fault or property of a recording.

    name: stable, a key of docs/manual/checks.md. channels: fields of DriveLog (or time, wheel_speed, ins) it is about.
    value, interval: estimate and its 95 % interval in `unit`; None if nothing is estimated. text: one
    sentence. where: stretches in s after the first INS measurement; empty for the whole run. effect: by about how much
    it moves the predicted or measured position after 5 s [m]; None where that means nothing. tried: prediction error
    of the run after 5 s before and after the correction [m]; None where it was not tried.
    """

    name: str
    severity: Severity
    channels: tuple[str, ...]
    text: str
    value: float | None = None
    unit: str = "1"
    interval: tuple[float, float] | None = None
    where: tuple[tuple[float, float], ...] = ()
    effect: float | None = None
    advice: Advice | None = None
    tried: tuple[float, float] | None = None

    @property
    def of_acceleration(self) -> bool:
        """Whether no prediction depends on it: only identification and discovery use measured accelerations."""
        named = [channel.startswith("acceleration") for channel in self.channels]
        return self.effect is None and bool(named) and all(named)

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as check.json has them."""
        return {
            "name": self.name, "severity": self.severity.value, "channels": list(self.channels), "value": self.value,
            "unit": self.unit, "interval": None if self.interval is None else list(self.interval), "text": self.text,
            "where": [list(stretch) for stretch in self.where], "effect": self.effect,
            "cure": None if self.advice is None else {"kind": self.advice.kind, "line": self.advice.line,
                                                    "entry": dict(self.advice.entry)},
            "tried": None if self.tried is None else list(self.tried),
        }


def merged(findings: Iterable[Finding]) -> list[Finding]:
    """One finding for channels that are wrong in the same way, at the same times, by the same value."""
    found: dict[tuple, Finding] = {}
    for one in findings:
        key = (one.name, one.severity, one.where, one.value)
        if before := found.get(key):
            names = (*before.channels, *one.channels)
            text = before.text.replace(", ".join(before.channels), ", ".join(names), 1)
            one = replace(before, channels=names, text=text)  # noqa: PLW2901
        found[key] = one
    return list(found.values())


@dataclass(frozen=True)
class Channel:
    """What was measured of one channel; all in its own `unit`.

    rate: samples per second, median. gaps: intervals longer than 0.25 s; longest_gap [s]. noise: standard deviation of
    what a second difference shows beyond motion. resolution: smallest step of its values, 0 where none is seen.
    repeated: share of samples equal to the one before. missing: rows that held no number and were left out.
    """

    unit: str
    samples: int
    rate: float
    gaps: int
    longest_gap: float
    noise: float
    resolution: float
    repeated: float
    missing: int = 0

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Identity:
    """Two roads to one quantity: measured against derived, (n,) each, at `time` [s after the first INS measurement].

    findings: names of those that rest on it.
    """

    name: str
    title: str
    unit: str
    measured_label: str
    derived_label: str
    time: np.ndarray
    measured: np.ndarray
    derived: np.ndarray
    findings: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Checked:
    """findings: the gravest first. channels: by name. identities: in the order they are judged.

    estimates: (value, low, high), 95 %, by the name of the finding they would be: what was measured, right or wrong.
    """

    findings: tuple[Finding, ...]
    channels: Mapping[str, Channel]
    identities: tuple[Identity, ...]
    estimates: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)

    def of(self, severity: Severity) -> tuple[Finding, ...]:
        return tuple(one for one in self.findings if one.severity is severity)

    def as_dict(self) -> dict[str, Any]:
        """The run's part of check.json."""
        return {"findings": [one.as_dict() for one in self.findings],
                "channels": {name: channel.as_dict() for name, channel in self.channels.items()},
                "estimates": {name: list(values) for name, values in self.estimates.items()}}


@dataclass(frozen=True, eq=False)
class Series:
    """time_ns: int64, rising, on the INS clock. values: (n,)."""

    time_ns: np.ndarray
    values: np.ndarray


@dataclass(frozen=True, eq=False)
class InsQuality:
    """Status reported by the unit, each (n,) at time_ns [ns]; NaN where not known.

    navigation_status: NCOM byte 21, 4 = locked. position_mode: NCOM mode number, 6 = RTK integer, 5 = RTK float, -1 or
    NaN unknown. position_accuracy: horizontal standard deviation [m]. heading_accuracy: standard deviation [rad].
    """

    time_ns: np.ndarray
    navigation_status: np.ndarray
    position_mode: np.ndarray
    position_accuracy: np.ndarray
    heading_accuracy: np.ndarray


@dataclass(frozen=True, eq=False)
class AuxiliaryData:
    """stamps: of "INS" and "steering" in the order of the recording, before anything was left out, int64 ns.

    missing: channel -> rows that held no usable value and were left out. wheel_speed: of the wheels or the car's own
    speed signal [m/s]. ins_speed: forward speed from a second output of the INS (its CAN frames, the NCOM packets
    recorded with an odometry) [m/s]. corrected: what run.yaml corrected, a phrase each. implausible: findings
    of samples that the reader left out, see `plausibility`. start_ns: first recorded INS measurement; None for that of
    the drive.
    """

    stamps: Mapping[str, np.ndarray] = field(default_factory=dict)
    missing: Mapping[str, int] = field(default_factory=dict)
    wheel_speed: Series | None = None
    ins_speed: Series | None = None
    quality: InsQuality | None = None
    corrected: tuple[str, ...] = ()
    implausible: tuple[Finding, ...] = ()
    start_ns: int | None = None


HORIZON = 5.0  # s, over which effects are judged
WHEEL_SCALE = 0.03  # 1; tyres wear and are pumped up by that


@dataclass(frozen=True)
class Limits:
    """min_reported_effect [m]: what a fault must move the position after 5 s by; an RTK position is known to 2 cm.

    warning [m]: a quarter metre; the best models are wrong by 0.4 m over such horizons. error [m]: 5 m; a model that
    drove straight on in a bend of 250 m would be as wrong at 10 m/s, so nothing is left to compare.
    unit: factor beyond which a ratio is a unit, a sign or an axis and no calibration; channel_unit: the same of an
    accelerometer or a wheel, which a rolling body or a tyre may change more. settling [s]: for so long a model
    remembers a wrong start of its yaw rate. lag [s]: below it is filtering inside a sensor; from grave_lag on it would
    pass for a delay of the steering. correlation: two estimates
    of a quantity below it are not compared.
    bias_acceleration [m/s^2]: 0.1 is 0.6 degrees of mounting or road. tyre [m/s^2]: no road tyre gives more.
    steering_unit: factor by which steering and curvature of any healthy car may differ beyond the understeer of its
    file (ratio, wheelbase, guessed stiffnesses). steering_lag [s]: what a car itself may need. steering_offset [rad]:
    at the road wheels.
    mounting [m]: accuracy of a tape measure. heading [rad]: 0.1 degree, accuracy of a dual antenna.
    """

    min_reported_effect: float = 0.02
    warning: float = 0.25
    error: float = 5.0
    unit: float = 1.33
    channel_unit: float = 2.0
    settling: float = 0.2
    lag: float = 0.015
    grave_lag: float = 0.05
    correlation: float = 0.6
    bias_acceleration: float = 0.1
    tyre: float = 13.0
    steering_unit: float = 1.5
    steering_lag: float = 0.1
    steering_offset: float = 0.02
    mounting: float = 0.25
    heading: float = 0.002

    def severity(self, effect: float, grave: bool = False) -> Severity:
        """Of an effect on the position after 5 s [m]; grave: at least a warning."""
        if effect >= self.error:
            return Severity.ERROR
        return Severity.WARNING if grave or effect >= self.warning else Severity.NOTE


LIMITS = Limits()

SYSTEMATIC = {
    "lag": 0.005, "velocity_lag": 0.01, "acceleration_x_lag": 0.01, "acceleration_y_lag": 0.01, "steering_lag": 0.04,
    "wheel_speed_lag": 0.02, "scale": 0.001, "acceleration_x_scale": 0.01, "acceleration_y_scale": 0.01,
    "wheel_speed_scale": 0.005, "ins_speed_scale": 0.002, "steering_scale": 0.05, "steering_sign": 0.05,
    "yaw_rate_bias": 0.0002, "acceleration_x_bias": 0.01, "acceleration_y_bias": 0.01, "yaw_offset": 0.001,
    "heading_misaligned": 0.001, "steering_offset": 0.001, "position_reference": 0.02, "measuring_point": 0.05,
    "map_shear": 0.001, "velocity_x_bias": 0.02, "velocity_y_bias": 0.02,
}
"""Systematic uncertainty of an identity, half of a 95 % interval, in the finding's unit (scales: share of the value):
filters, interpolation between samples, roll, and for the steering the car's own response, which resampling does not
cover. By finding, else by the last part of its name. Added in quadrature (GUM: type B to type A). Set from the errors
of the estimates on the development drives of bench/checks; the sealed drives were not used."""
