"""Reads NCOM packets of an INS from .ncom and .xcom files and network captures, in the axes of `DriveLog`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from oxts_bridge import file_decoder
from oxts_bridge.channels import decode_channel
from oxts_bridge.file_decoder import Columns
from oxts_bridge.geometry import Attitude, LocalFrame, Vector
from oxts_bridge.motion import Motion
from oxts_bridge.ncom import BATCH_S, DUPLICATE, LATE, NEW, SAME, STATUS_RULES, NcomError
from st_core.checks import InsQuality
from st_core.log import INS_SIGNALS

from .errors import RunError, check_readable, format_count
from .ins_log import MAX_LOST_FRACTION, InsLog, select_usable_rows

ACCURACIES = {3: ("EastAcc", "NorthAcc", "AltAcc"), 4: ("VeAcc", "VnAcc", "VdAcc"),
              5: ("RollAcc", "PitchAcc", "HeadingAcc")}
"""Status channel -> names of its standard deviations of position, velocity or attitude."""


@dataclass(frozen=True, kw_only=True)
class NcomLog(InsLog):
    """INS log of NCOM packets, with all their content."""

    columns: Columns  # all packets of the file
    rows: np.ndarray  # indices of the packets that are samples of the log
    motion: Motion  # of the samples
    position: Vector  # of the samples relative to the origin, east, north, up [m]

    def select_attitude(self, rows: slice) -> Attitude:
        """Orientation at the given samples."""
        return Attitude(self.values["yaw"][rows], self.motion.attitude.pitch[rows], self.motion.attitude.roll[rows])


def read_ncom(file: Path) -> NcomLog:
    """Reads packets with a fix; the first is at the map origin. Raises RunError without valid packets, fix or time."""
    check_readable(file)
    try:
        columns = file_decoder.decode_file(file)
    except NcomError as error:
        problem = str(error).removeprefix(f"{file}: ")
        raise RunError(file, problem, "remove the file from the command, or name the right one") from None
    warnings = _describe_damage(columns, file)
    is_regular = (columns.kind == file_decoder.REGULAR) & (columns.order == NEW)
    has_fix = is_regular & ~columns.is_approximate & np.isfinite(columns.latitude) & np.isfinite(columns.heading)
    has_fix &= np.isfinite(columns.velocity_ned).all(axis=0) & np.isfinite(columns.angular_rate).all(axis=0)
    if not has_fix.any():
        counts = zip(*(a.tolist() for a in np.unique(columns.navigation_status, return_counts=True)), strict=True)
        statuses = ", ".join(f"{status} ({STATUS_RULES[status].text}) in {count} packets" for status, count in counts)
        raise RunError(file, f"no packet has a fix; navigation status: {statuses}",
                       "record again after the unit has locked (status 4), or post-process the raw data")
    has_time = has_fix & (columns.utc_ns != file_decoder.UNKNOWN_TIME)
    if not has_time.any():
        raise RunError(file, "no packet has the GPS minute (status channel 0 is missing)",
                       "record for more than a few seconds; the unit sends it at least once in 200 packets")
    samples, total = np.flatnonzero(has_time), int(is_regular.sum())
    if (lost := total - len(samples)) > MAX_LOST_FRACTION * total:
        warnings.append(f"{file}: {format_count(lost, total, 'packets')} have no fix, no time or an invalid value; "
                        "they were left out")
    usable, row_warnings = select_usable_rows(columns.utc_ns[samples], "packets")
    rows = samples[usable]
    warnings += [f"{file}: {warning}" for warning in row_warnings]
    motion = Motion.from_packet(columns.take(rows))
    origin = float(motion.latitude[0]), float(motion.longitude[0]), float(motion.altitude[0])
    is_stamped = (columns.kind == file_decoder.REGULAR) & (columns.utc_ns != file_decoder.UNKNOWN_TIME)
    position = motion.locate(LocalFrame(*origin))
    channels = zip((*INS_SIGNALS, "acceleration_x", "acceleration_y"), (
        *position[:2], np.unwrap(np.pi / 2 - columns.heading[rows]), *motion.body_velocity[:2],
        motion.angular_velocity[2], *motion.acceleration[:2]), strict=True)
    values = {name: column for name, column in channels if np.isfinite(column).any()}
    return NcomLog(
        file=file, time_ns=columns.utc_ns[rows], values=values, origin=origin, stamps_ns=columns.utc_ns[is_stamped],
        quality=collect_quality(columns, rows), columns=columns, rows=rows, motion=motion, position=position,
        warnings=tuple(warnings))


def _describe_damage(columns: Columns, file: Path) -> list[str]:
    faults = []
    with file.open("rb") as stream:
        is_capture = stream.read(4) in file_decoder.CAPTURE_MAGIC  # a capture has headers between the packets
    if columns.skipped_bytes and not is_capture:
        faults.append(f"{format_count(columns.skipped_bytes, file.stat().st_size, 'bytes')} are not part of a packet")
    if (errors := columns.checksum_errors):
        faults.append(f"{errors} packet{'s have' if errors > 1 else ' has'} a wrong checksum")
    if duplicates := np.count_nonzero(columns.order == DUPLICATE):
        faults.append(f"{duplicates} packet{'s are duplicates' if duplicates > 1 else ' is a duplicate'}")
    warnings = [f"{file}: {', '.join(faults)}; they were left out"] if faults else []
    is_regular = columns.kind == file_decoder.REGULAR
    is_out_of_order = is_regular & np.isin(columns.order, (SAME, LATE))
    if is_out_of_order.sum() > MAX_LOST_FRACTION * is_regular.sum():
        count = format_count(int(is_out_of_order.sum()), int(is_regular.sum()), "packets")
        warnings.append(f"{file}: {count} are out of order or have the time of an earlier packet but different "
                        "content; they were left out; if two units were recorded, export the packets of one "
                        "(tshark -Y 'ip.src == ADDRESS')")
    return warnings


def decode_status_channel(columns: Columns, channel: int, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(indices of the packets that carry a status channel, its values (n, len(names)), NaN where invalid)."""
    packets = np.flatnonzero((columns.channel == channel) & columns.has_status)
    batches = np.ascontiguousarray(columns.raw[packets, BATCH_S]).view("<u8").ravel()
    distinct_batches, inverse = np.unique(batches, return_inverse=True)
    fields = [decode_channel(channel, batch.tobytes()) for batch in distinct_batches.astype("<u8")]
    values = np.array([[field.get(name) for name in names] for field in fields], float).reshape(-1, len(names))
    return packets, values[inverse]


def select_latest_values(source_packets: np.ndarray, values: np.ndarray, packets: np.ndarray) -> np.ndarray:
    """Latest values (n, k) up to each of the ascending `packets` (n,); NaN before the first. values: (m, k), sent in
    `source_packets` (m,)."""
    if not len(source_packets):
        return np.full((len(packets), values.shape[1]), np.nan)
    latest = np.searchsorted(source_packets, packets, side="right") - 1
    return np.where((latest >= 0)[:, None], values[np.maximum(latest, 0)], np.nan)


def collect_quality(columns: Columns, packets: np.ndarray) -> InsQuality:
    """Quality reported by the unit, at packets in order of time."""
    position = select_latest_values(*decode_status_channel(columns, 3, ACCURACIES[3]), packets)
    return InsQuality(columns.utc_ns[packets], columns.navigation_status[packets].astype(float),
                      select_latest_values(*decode_status_channel(columns, 0, ("GpsPosMode",)), packets)[:, 0],
                      np.hypot(position[:, 0], position[:, 1]))
