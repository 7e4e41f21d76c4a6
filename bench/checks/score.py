"""Scores the findings of `check` on a corrupted drive.

The true value for a virtual drive follows from its sensors. A real drive has unknown deviations: its estimate as
recorded is multiplied by the factor, or added to the offset, of the edit. Fractions, counts and durations are those of
the edit, also for real drives.
"""

import zlib
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from st_core.checks import DriveCheck, Finding, Severity, check

from . import drives
from .corruptions import FAULTS, Fault, Size
from .recording import Recording, middle_half

COUNT_TOLERANCE = 1e-6
MIN_SIZE_FACTOR, MAX_SIZE_FACTOR = 0.7, 1.5
"""Range of the sizes of the sealed set, relative to those of the development set."""
Record = dict[str, Any]


def run_check(recording: Recording) -> DriveCheck:
    return check(recording.log, recording.vehicle, recording.auxiliary)


def try_check(recording: Recording) -> tuple[DriveCheck, str]:
    """(result, error message): an exception in a check is scored as a wrong answer."""
    try:
        return run_check(recording), ""
    except Exception as error:
        return DriveCheck((), {}, ()), f"{type(error).__name__}: {error}"[:200]


@cache
def check_as_recorded(recording: Recording) -> DriveCheck:
    """The result for a drive as recorded; each drive is checked only once."""
    return run_check(recording)


class Drive:
    """A recording, prepared for each fault only once."""

    def __init__(self, recording: Recording):
        self.recording = recording
        self._prepared: dict[tuple, Recording] = {}

    def clean(self, fault: Fault, size: Size) -> Recording:
        key = size.part, fault.prepare
        if key not in self._prepared:
            part = middle_half(self.recording) if size.part else self.recording
            self._prepared[key] = fault.prepare(part) if fault.prepare else part
        return self._prepared[key]


def score_case(drive: Drive, fault: Fault, size: Size) -> Record | None:
    """The record of a case; None if the drive cannot show the fault."""
    clean = drive.clean(fault, size)
    if not fault.is_visible(clean, size.value):
        return None
    value = size.value * choose_sign(fault, clean)
    corrupted, change = fault.edit(clean, value)
    result, raised = try_check(corrupted)
    before = check_as_recorded(clean)
    finding = find_finding(result, fault)
    truth, source = true_value(fault, size, clean, change)
    inside = finding is not None and is_inside(fault, finding, truth)
    named = finding is not None
    collateral = new_findings(result, before, fault)
    return {
        "drive": clean.name, "real": clean.real, "kind": fault.name, "size": size.label, "edit": value, "truth": truth,
        "truth_from": source, "named": named, "inside": inside, "right": named and inside,
        "as_note": named and finding.severity is Severity.NOTE,
        "reported": raised or (None if finding is None else format_finding(finding)),
        "new": {severity.value: [format_finding(f) for f in collateral if f.severity is severity]
                for severity in Severity},
    }


def find_finding(result: DriveCheck, fault: Fault) -> Finding | None:
    """The most severe finding with a correct name and channel."""
    for finding in result.findings:
        if finding.name in fault.findings and (fault.channel is None or fault.channel in finding.channels):
            return finding
    return None


def true_value(fault: Fault, size: Size, clean: Recording, change: float) -> tuple[float | None, str]:
    """(true value of the finding, its source: "edit" or "drive")."""
    if fault.operation == "named":
        return None, "edit"
    if fault.operation == "is":
        return change, "edit"
    if not clean.real:
        known = [clean.baseline[name] for name in fault.findings if name in clean.baseline]
        return combine(fault.operation, known[0], change) if known else change, "edit"
    own = estimate_as_recorded(fault, clean)
    return (change, "edit") if own is None else (combine(fault.operation, own, change), "drive")


def estimate_as_recorded(fault: Fault, clean: Recording) -> float | None:
    """The estimate for the drive as recorded, or the value of its finding; None if there is neither."""
    result = check_as_recorded(clean)
    values = {finding.name: finding.value for finding in result.findings}
    values |= {name: estimate for name, (estimate, _, _) in result.estimates.items()}
    if "yaw_rate_lag" in values:  # it may be the opposite lag of yaw, which then has no estimate
        values.setdefault("yaw_lag", -values["yaw_rate_lag"])
    return next((values[name] for name in fault.findings if name in values), None)


def choose_sign(fault: Fault, clean: Recording) -> int:
    return -1 if fault.follows_sign and clean.real and (estimate_as_recorded(fault, clean) or 0.0) < 0 else 1


def combine(operation: str, own: float, change: float) -> float:
    return own * change if operation == "times" else own + change


def is_inside(fault: Fault, finding: Finding, truth: float | None) -> bool:
    """Whether the truth is in the interval of the finding, or within the tolerance of the fault."""
    if truth is None:
        return True
    if finding.value is None:
        return False
    if finding.interval is not None and finding.interval[0] <= truth <= finding.interval[1]:
        return True
    return abs(finding.value - truth) <= max(fault.tolerance * abs(truth), COUNT_TOLERANCE)


def new_findings(result: DriveCheck, before: DriveCheck, fault: Fault) -> list[Finding]:
    """Findings that the fault causes in addition to the expected and permitted ones."""
    known = {finding.name for finding in before.findings} | {*fault.findings, *fault.also_permitted}
    return [finding for finding in result.findings if finding.name not in known]


def format_finding(finding: Finding) -> str:
    """Text such as: error yaw_rate_scale 1.05 (1.04 to 1.06) [yaw_rate]"""
    value = "" if finding.value is None else f" {finding.value:.4g}"
    if finding.interval is not None:
        value += f" ({finding.interval[0]:.4g} to {finding.interval[1]:.4g})"
    unit = "" if finding.unit == "1" or finding.value is None else f" {finding.unit}"
    return f"{finding.severity.value} {finding.name}{value}{unit} [{', '.join(finding.channels)}]"


def scale_size(size: Size, operation: str, factor: float) -> Size:
    """The same fault, `factor` times as large; the size of a factor is its difference from 1."""
    if size.fixed:
        return size
    value = 1 + (size.value - 1) * factor if operation == "times" else size.value * factor
    return replace(size, value=value, label=f"{value:.3g} {size.label.partition(' ')[2]}".strip())


def score_drive(task: tuple[str, str, tuple[str, ...]]) -> list[Record]:
    set_, name, kinds = task
    drive = Drive(drives.load(name, set_))
    return [record for fault in map(FAULTS.__getitem__, kinds) for size in choose_sizes(fault, name, set_)
            if (record := score_case(drive, fault, size)) is not None]


def choose_sizes(fault: Fault, drive: str, set_: str) -> list[Size]:
    if set_ == "development":
        return list(fault.sizes)
    generator = np.random.default_rng(zlib.crc32(f"{set_} {drive} {fault.name}".encode()))
    factors = generator.uniform(MIN_SIZE_FACTOR, MAX_SIZE_FACTOR, len(fault.sizes))
    return [scale_size(size, fault.operation, factor)
            for size, factor in zip(fault.sizes, factors.tolist(), strict=True)]
