"""Exports an NCOM file to CSV for `st ncom`: the values of every packet, and every change of the status."""

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from .channels import B6_BIT7_CLEAR, FIELDS, Value
from .derived import SettingHistory, compute_gps_seconds, derive_columns
from .file_decoder import EMPTY, KINDS, REGULAR, TRIGGER, UNKNOWN_TIME, Columns, decode_file
from .ncom import RAW_IMU, WEEK_MS, NcomError
from .status import RAW_FIELDS, StatusTracker

Change: TypeAlias = tuple[int, int, str, Value]
"""Change of a status field: packet, channel, field, value (None: invalid)."""

TRIGGER_NAMES = {24: "in1down", 43: "in1up", 65: "out1", 79: "in2down", 80: "in2up", 81: "out2"}
_LARGEST_UMAC_STATUS = 10  # the vendor's tools write larger codes of the robot interface as this one
# In these fields "invalid" means "no new value": the last value stays valid, as in the vendor's tools.
_RETAINED = frozenset(
    name for fields in FIELDS.values() for name, field in fields.items()
    if name.startswith("Inn") or name == "Undulation" or field.validity is B6_BIT7_CLEAR)
_DERIVATION_FIELDS = {4: ("VnAcc", "VeAcc"), 60: ("Ned2SurfHeading", "Ned2SurfPitch", "Ned2SurfRoll"),
                      63: ("AngAccFiltFreq", "AngAccFiltZeta"), 74: ("LinAccFiltFreq", "LinAccFiltZeta")}
"""Status channel -> fields that derived columns and surface angles depend on."""
_SURFACE_ANGLES = ("Surf2OutHeading", "Surf2OutPitch", "Surf2OutRoll")
_ROWS_PER_WRITE = 1 << 12


def write_csv(ncom_path: str | Path, csv_path: str | Path, status_path: str | Path | None = None) -> int:
    """Write the packets of an .ncom file, and optionally its status changes, as CSV; returns the number of packets.

    csv_path: columns of `_make_table`, one row per accepted packet; empty: invalid. Units: m, m/s, m/s^2, deg,
    deg/s, deg/s^2; times in GPS seconds. status_path: pkt,channel,field,valid,value, one row per change of value or
    validity.
    Raises NcomError for a file without packets and if two of the three files are the same; OSError for one that cannot
    be read or written.
    """
    outputs = [Path(path) for path in (csv_path, status_path) if path is not None]
    for output in outputs:
        if output.exists() and output.samefile(ncom_path):
            raise NcomError(f"output {output} is the recording itself: name another file")
    if len({output.resolve() for output in outputs}) < len(outputs):
        raise NcomError(f"values and status would both be written to {csv_path}: name two files")
    columns = decode_file(ncom_path)
    changes, history = _read_status(columns)
    table = _make_table(columns, history)
    with Path(csv_path).open("w", encoding="ascii", newline="") as file:
        file.write(",".join(table) + "\n")
        for start in range(0, len(columns), _ROWS_PER_WRITE):
            rows = slice(start, start + _ROWS_PER_WRITE)
            # str() gives the shortest text that reads back as the same number; NaN becomes empty.
            cells = [["" if text == "nan" else text for text in map(str, column[rows].tolist())]
                     for column in table.values()]
            file.writelines(",".join(row) + "\n" for row in zip(*cells, strict=True))
    if status_path is not None:
        with Path(status_path).open("w", encoding="ascii", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("pkt", "channel", "field", "valid", "value"))
            writer.writerows((packet, channel, name, int(value is not None), value)
                             for packet, channel, name, value in changes)
    return len(columns)


def _make_table(columns: Columns, history: Mapping[int, SettingHistory]) -> dict[str, np.ndarray]:
    """Columns of the CSV by name. history: values of the fields in _DERIVATION_FIELDS, by channel."""
    is_timed = (columns.gps_ns != UNKNOWN_TIME) & (columns.kind != TRIGGER)
    gps_ms = np.where(is_timed, columns.gps_ns // 1_000_000, 0)
    degrees, out_type = np.degrees, np.array(KINDS, "<U8")[columns.kind]
    for i in np.flatnonzero(columns.kind == TRIGGER):
        out_type[i] = TRIGGER_NAMES[int(columns.channel[i])]
    heading = degrees(columns.heading)
    has_navigation = np.isin(columns.kind, (REGULAR, TRIGGER)) & (columns.navigation_status != RAW_IMU)
    return {
        "pkt": np.arange(len(columns)), "start_offset": columns.offset, "out_type": out_type,
        "nav_mode": columns.navigation_status, "channel": columns.channel, "time": compute_gps_seconds(columns),
        "week": np.where(is_timed, (gps_ms // WEEK_MS).astype(str), ""),
        "tow": np.where(is_timed, gps_ms % WEEK_MS / 1e3, np.nan),
        "quality": np.where(has_navigation, np.where(columns.approximate, "approx", "valid"), ""),
        **dict(zip(("Ax", "Ay", "Az"), columns.acceleration, strict=True)),
        **dict(zip(("Wx", "Wy", "Wz"), degrees(columns.angular_rate), strict=True)),
        "Lat": degrees(columns.latitude), "Lon": degrees(columns.longitude), "Alt": columns.altitude,
        **dict(zip(("Vn", "Ve", "Vd"), columns.velocity_ned, strict=True)),
        "Heading": np.where(heading < 0, heading + 360.0, heading),
        "Pitch": degrees(columns.pitch), "Roll": degrees(columns.roll),
        **derive_columns(columns, velocity_accuracy=history[4], acceleration_filter=history[74],
                         rate_filter=history[63]),
    }


def _read_status(columns: Columns) -> tuple[list[Change], Mapping[int, SettingHistory]]:
    """Changes of all status fields, and the values of the fields in _DERIVATION_FIELDS by channel."""
    tracker = StatusTracker()
    last_values: dict[str, Value] = {}
    changes: list[Change] = []
    history: dict[int, list[tuple[int, tuple[Value, ...]]]] = {channel: [] for channel in _DERIVATION_FIELDS}
    positions = np.array([columns.latitude, columns.longitude, columns.altitude]).T
    for i in np.flatnonzero(columns.has_status).tolist():
        channel = int(columns.channel[i])
        seconds = None if columns.gps_ns[i] == UNKNOWN_TIME else columns.gps_ns[i] / 1e9
        position = tuple(positions[i]) if channel == 25 and not np.isnan(positions[i]).any() else None
        fields = tracker.update(channel, columns.batch_s[:, i].tobytes(), seconds, position)
        for name, sent in fields.items():
            value = min(sent, _LARGEST_UMAC_STATUS) if name == "UmacStatus" and sent is not None else sent
            is_reported = name not in RAW_FIELDS and (value is not None or name not in _RETAINED)
            if is_reported and last_values.get(name) != value:
                last_values[name] = value
                changes.append((i, channel, name, value))
        if fields and channel in _DERIVATION_FIELDS:
            # A status applies from the next packet on; in a trigger packet, it applies from this packet on.
            first_packet = i if columns.kind[i] == TRIGGER else i + 1
            history[channel].append((first_packet, tuple(map(tracker.get, _DERIVATION_FIELDS[channel]))))
    changes.extend(_compute_surface_angles(columns, history[60]))
    return sorted(changes, key=lambda change: change[0]), history


def _compute_surface_angles(columns: Columns, surfaces: SettingHistory) -> list[Change]:
    """Changes of the vehicle angles relative to a tilted surface (channel 60) [deg], heading 0..360.

        R_vehicle->surface = R_surface->NED^T R_vehicle->NED,   R = Rz(heading) Ry(pitch) Rx(roll)

    surfaces: index of the first packet and (heading, pitch, roll) of the surface in NED [deg], None: invalid.
    """
    changes: list[Change] = []
    ends = [index for index, _ in [*surfaces, (len(columns), ())]][1:]
    previous: list[float | None] = [None, None, None]
    for (start, angles), end in zip(surfaces, ends, strict=True):
        if None in angles:
            continue
        fix = (columns.kind[start:end] != EMPTY) & ~columns.approximate[start:end]
        attitude = np.array([columns.heading[start:end], columns.pitch[start:end], columns.roll[start:end]])
        usable = np.flatnonzero(fix & ~np.isnan(attitude).any(axis=0))
        surface = Rotation.from_euler("ZYX", np.array(angles, float), degrees=True)
        relative = surface.inv() * Rotation.from_euler("ZYX", attitude[:, usable].T)
        heading, pitch, roll = relative.as_euler("ZYX", degrees=True).T
        heading %= 360.0
        for i, *values in zip((usable + start).tolist(), heading.tolist(), pitch.tolist(), roll.tolist(), strict=True):
            changes.extend((i, int(columns.channel[i]), name, value)
                           for name, value, old in zip(_SURFACE_ANGLES, values, previous, strict=True) if value != old)
            previous = values
    return changes
