"""Vehicle angles relative to a tilted surface (channel 60), one value per packet with a valid attitude."""

import numpy as np

from .fields import Value
from .file_decoder import EMPTY, Columns

NAMES = ("Surf2OutHeading", "Surf2OutPitch", "Surf2OutRoll")


def surface_angles(
    columns: Columns, surfaces: list[tuple[int, tuple[Value, ...]]]
) -> list[tuple[int, int, str, Value]]:
    """Changes of the three angles [deg], heading 0..360, as (packet, channel of the packet, field, value).

    surfaces: from which packet on which surface angles (heading, pitch, roll from NED [deg], None invalid) hold.
    R_vehicle->surface = R_surface->NED^T R_vehicle->NED, angles read off as for R_no in ncom.md section 10.
    """
    changes: list[tuple[int, int, str, Value]] = []
    ends = [index for index, _ in [*surfaces, (len(columns), ())]][1:]
    before: tuple[float, ...] | None = None
    for (start, angles), end in zip(surfaces, ends, strict=True):
        if None in angles:
            continue
        fix = (columns.kind[start:end] != EMPTY) & ~columns.approximate[start:end]
        attitude = np.array([columns.heading[start:end], columns.pitch[start:end], columns.roll[start:end]])
        usable = np.flatnonzero(fix & ~np.isnan(attitude).any(axis=0))
        surface = rotation(*np.radians(np.array(angles, float)))
        vehicle = rotation(*attitude[:, usable])
        relative = np.einsum("ji...,jkn->ikn", surface, vehicle)
        heading = np.degrees(np.arctan2(relative[1, 0], relative[0, 0])) % 360.0
        pitch = np.degrees(-np.arcsin(np.clip(relative[2, 0], -1, 1)))
        roll = np.degrees(np.arctan2(relative[2, 1], relative[2, 2]))
        for i, *values in zip((usable + start).tolist(), heading.tolist(), pitch.tolist(), roll.tolist(), strict=True):
            old = before or (None, None, None)
            changes.extend(
                (i, int(columns.channel[i]), name, value)
                for name, value, was in zip(NAMES, values, old, strict=True)
                if value != was
            )
            before = tuple(values)
    return changes


def rotation(heading: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """Rz(heading) Ry(pitch) Rx(roll), (3, 3, ...)."""
    sh, ch, sp, cp, sr, cr = (f(angle) for angle in (heading, pitch, roll) for f in (np.sin, np.cos))
    return np.array(
        [
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
