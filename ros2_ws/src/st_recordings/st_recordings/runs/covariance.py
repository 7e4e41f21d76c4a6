"""Accuracies reported by the INS as the 6 x 6 covariances of nav_msgs/Odometry, in columns."""

import numpy as np
from oxts_bridge.file_decoder import Columns

from .ncom import NcomLog
from .status_channels import ACCURACIES, held, sent

# As in oxts_bridge.convert: large enough that filters ignore it, finite so that none breaks.
UNKNOWN_VARIANCE = 1e6


class Covariances:
    """Accuracies of one file; each is valid from the packet that carries it until the next."""

    def __init__(self, columns: Columns):
        self._held = {}
        for channel, names in ACCURACIES.items():
            index, values = sent(columns, channel, names)
            self._held[channel] = index, np.radians(values) if channel == 5 else values

    def of(self, ins: NcomLog, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """(pose, twist) covariances, (n, 36) each, of the odometry of some fixes.

        Pose: east, north, up, then rotations about the fixed axes. Twist: body axes. Variances that the unit does
        not report, and those of angular rates, are UNKNOWN_VARIANCE.
        """
        packets = ins.rows[rows]
        yaw, pitch, roll = (a[rows] for a in (ins.yaw, ins.pitch, ins.roll))
        pose, twist = np.zeros((len(packets), 6, 6)), np.zeros((len(packets), 6, 6))
        position, known = self._at(3, packets)
        pose[:, :3, :3] = _diagonal(position, known)
        angles, known = self._at(5, packets)
        turn = _rotation(yaw, np.zeros_like(yaw), np.zeros_like(yaw))
        pose[:, 3:, 3:] = _turned(angles, known, np.swapaxes(turn, 1, 2))
        velocity, known = self._at(4, packets)
        twist[:, :3, :3] = _turned(velocity, known, _rotation(yaw, pitch, roll))
        twist[:, 3:, 3:] = np.eye(3) * UNKNOWN_VARIANCE
        return pose.reshape(-1, 36), twist.reshape(-1, 36)

    def _at(self, channel: int, packets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(n, 3) standard deviations at packets, and where all three are known."""
        found = held(*self._held[channel], packets)
        known = np.isfinite(found).all(axis=1)
        return np.where(known[:, None], found, 0.0), known


def _diagonal(deviation: np.ndarray, known: np.ndarray) -> np.ndarray:
    variance = np.where(known[:, None], deviation**2, UNKNOWN_VARIANCE)
    return variance[:, :, None] * np.eye(3)


def _turned(deviation: np.ndarray, known: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """R^T diag(variance) R, (n, 3, 3)."""
    turned = np.einsum("nij,ni,nik->njk", rotation, deviation**2, rotation)
    return np.where(known[:, None, None], turned, np.eye(3) * UNKNOWN_VARIANCE)


def _rotation(yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    """(n, 3, 3) body axes to map axes, Rz(yaw) Ry(pitch) Rx(roll)."""
    (sy, cy), (sp, cp), (sr, cr) = ((np.sin(a), np.cos(a)) for a in (yaw, pitch, roll))
    return np.stack([cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr,
                     sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr,
                     -sp, cp * sr, cp * cr], axis=1).reshape(-1, 3, 3)
