"""An NCOM file as CSV: what the unit said, packet by packet, and every change of its status. Called by `st ncom`."""

import csv
from pathlib import Path

import numpy as np

from .channels import FIELDS
from .derived import Settings, derive, float_seconds
from .fields import INVERTED_B6, Value
from .file_decoder import EMPTY, KINDS, STATUS, TRIGGER, UNKNOWN_TIME, Columns, decode_file
from .gps_time import WEEK_MS
from .ncom import NcomError
from .status import PARTS, StatusTracker
from .surface import surface_angles

TRIGGER_NAMES = {24: "in1down", 43: "in1up", 65: "out1", 79: "in2down", 80: "in2up", 81: "out2"}
# The vendor shows robot interface codes it has no name for as 10.
_LARGEST_CODE = {"UmacStatus": 10}
# Their invalid mark means "nothing new": the last value stands, as in the vendor's tools.
_KEPT = frozenset(
    name
    for fields in FIELDS.values()
    for name, field in fields.items()
    if name.startswith("Inn") or name == "Undulation" or field.validity is INVERTED_B6
)
_ROWS_AT_ONCE = 1 << 12


def write_csv(ncom_path: str | Path, csv_path: str | Path, status_path: str | Path | None = None) -> int:
    """Write all packets of an .ncom file (and, if asked, its status changes) as CSV; returns the number of packets.

    csv_path: columns of `_table`, one row per accepted packet; empty = invalid. m, m/s, m/s^2, deg,
    deg/s, GPS seconds.
    status_path: pkt,channel,field,valid,value, one row per change of value or validity.
    Raises NcomError (no packet in the file: names the file and what was found; an output that is the recording itself
    or the other output) and OSError.
    """
    outputs = [Path(path).resolve() for path in (csv_path, status_path) if path is not None]
    if Path(ncom_path).resolve() in outputs:
        raise NcomError(f"{ncom_path}: is the recording itself; name another file for the CSV")
    if len(set(outputs)) < len(outputs):
        raise NcomError(f"{csv_path}: named for both values and status; they are two files")
    columns = decode_file(ncom_path)
    changes, settings = _read_status(columns)
    table = _table(columns, settings)
    names = list(table)
    with Path(csv_path).open("w", encoding="ascii", newline="") as file:
        file.write(",".join(names) + "\n")
        for start in range(0, len(columns), _ROWS_AT_ONCE):
            rows = slice(start, start + _ROWS_AT_ONCE)
            texts = [_texts(table[name][rows]) for name in names]
            file.writelines(",".join(row) + "\n" for row in zip(*texts, strict=True))
    if status_path is not None:
        with Path(status_path).open("w", encoding="ascii", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(("pkt", "channel", "field", "valid", "value"))
            writer.writerows((packet, channel, name, int(value is not None), value)
                             for packet, channel, name, value in changes)
    return len(columns)


def _table(columns: Columns, settings: Settings) -> dict[str, np.ndarray]:
    n = len(columns)
    in_series = (columns.gps_ns != UNKNOWN_TIME) & (columns.kind != TRIGGER)
    gps_ms = np.where(in_series, columns.gps_ns // 1_000_000, 0)
    degrees = np.degrees
    heading = degrees(columns.heading)
    navigation = (columns.kind != EMPTY) & (columns.kind != STATUS) & (columns.navigation_status > 1)
    quality = np.where(navigation, np.where(columns.approximate, "approx", "valid"), "")
    return {
        "pkt": np.arange(n),
        "start_offset": columns.offset,
        "out_type": _out_types(columns),
        "nav_mode": columns.navigation_status,
        "channel": columns.channel,
        "time": float_seconds(columns),
        "week": _optional(gps_ms // WEEK_MS, in_series),
        "tow": np.where(in_series, gps_ms % WEEK_MS / 1e3, np.nan),
        "quality": quality,
        **dict(zip(("Ax", "Ay", "Az"), columns.acceleration, strict=True)),
        **dict(zip(("Wx", "Wy", "Wz"), degrees(columns.angular_rate), strict=True)),
        "Lat": degrees(columns.latitude),
        "Lon": degrees(columns.longitude),
        "Alt": columns.altitude,
        **dict(zip(("Vn", "Ve", "Vd"), columns.velocity_ned, strict=True)),
        "Heading": np.where(heading < 0, heading + 360.0, heading),
        "Pitch": degrees(columns.pitch),
        "Roll": degrees(columns.roll),
        **derive(columns, settings),
    }


def _optional(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    return np.where(valid, values.astype(str), "")


def _out_types(columns: Columns) -> np.ndarray:
    names = np.array(KINDS, "<U8")[columns.kind]
    for i in np.flatnonzero(columns.kind == TRIGGER):
        names[i] = TRIGGER_NAMES[int(columns.channel[i])]
    return names


def _texts(column: np.ndarray) -> list[str]:
    """Shortest digits that read back as the same number; NaN becomes empty."""
    if column.dtype.kind == "f":
        return ["" if value != value else repr(value) for value in column.tolist()]  # noqa: PLR0124 - NaN, 50 million times
    return [str(value) for value in column.tolist()]


Change = tuple[int, int, str, Value]


def _read_status(columns: Columns) -> tuple[list[Change], Settings]:
    """Every change of a status field as (packet, channel, field, value or None), and what derived columns need of
    it."""
    tracker = StatusTracker()
    known: dict[str, Value] = {}
    changes: list[Change] = []
    settings = Settings([], [], [])
    surfaces: list[tuple[int, tuple[Value, ...]]] = []
    positions = np.array([columns.latitude, columns.longitude, columns.altitude]).T
    for i in np.flatnonzero(columns.has_status).tolist():
        channel = int(columns.channel[i])
        seconds = None if columns.gps_ns[i] == UNKNOWN_TIME else columns.gps_ns[i] / 1e9
        position = tuple(positions[i]) if channel == 25 and not np.isnan(positions[i]).any() else None
        fields = tracker.update(channel, columns.batch_s(i), seconds, position)
        for name, value in fields.items():
            shown = min(value, _LARGEST_CODE[name]) if name in _LARGEST_CODE and value is not None else value
            if name in PARTS or (shown is None and name in _KEPT):
                continue
            if known.get(name) != shown:
                known[name] = shown
                changes.append((i, channel, name, shown))
        # Status counts from the packet after the one that carries it; an event packet is interpreted with its own.
        since = i if columns.kind[i] == TRIGGER else i + 1
        if channel == 4 and fields:
            north, east = tracker.number("VnAcc"), tracker.number("VeAcc")
            settings.speed_accuracy.append((since, 2 * (north**2 + east**2) ** 0.5))
        elif channel == 74 and fields:
            settings.acceleration_filter.append((since, (tracker.get("LinAccFiltFreq"), tracker.get("LinAccFiltZeta"))))
        elif channel == 63 and fields:
            settings.rate_filter.append((since, (tracker.get("AngAccFiltFreq"), tracker.get("AngAccFiltZeta"))))
        elif channel == 60 and fields:
            surfaces.append((since, tuple(tracker.get(f"Ned2Surf{angle}") for angle in ("Heading", "Pitch", "Roll"))))
    changes.extend(surface_angles(columns, surfaces))
    changes.sort(key=lambda change: change[0])
    return changes, settings
