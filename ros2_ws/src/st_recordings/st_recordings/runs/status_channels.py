"""Status channels of NCOM packets as columns: modes and accuracies, each held until the next is sent."""

import numpy as np
from oxts_bridge.channels import decode_channel
from oxts_bridge.file_decoder import Columns
from oxts_bridge.ncom import BATCH_S
from st_core.checks import InsQuality

ACCURACIES = {3: ("EastAcc", "NorthAcc", "AltAcc"), 4: ("VeAcc", "VnAcc", "VdAcc"),
              5: ("RollAcc", "PitchAcc", "HeadingAcc")}


def sent(columns: Columns, channel: int, names: tuple[str, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(places of the packets that carry a status channel, (n, len(names)) values as in its table, NaN = invalid)."""
    index = np.flatnonzero((columns.channel == channel) & columns.has_status)
    batches = np.ascontiguousarray(columns.raw[index, BATCH_S]).view("<u8").ravel()
    different, which = np.unique(batches, return_inverse=True)
    fields = [decode_channel(channel, batch.tobytes()) for batch in different.astype("<u8")]
    values = np.array([[_number(field.get(name)) for name in names] for field in fields]).reshape(-1, len(names))
    return index, values[which]


def held(index: np.ndarray, values: np.ndarray, packets: np.ndarray) -> np.ndarray:
    """What was `sent` last, at packets (places, rising): (n, k), NaN before the first."""
    if not len(index):
        return np.full((len(packets), values.shape[1]), np.nan)
    newest = np.searchsorted(index, packets, side="right") - 1
    return np.where((newest >= 0)[:, None], values[np.maximum(newest, 0)], np.nan)


def ins_quality(columns: Columns, packets: np.ndarray) -> InsQuality:
    """Quality that the unit reports at some of its packets (places, with a time that rises)."""
    position = held(*sent(columns, 3, ACCURACIES[3]), packets)
    heading = held(*sent(columns, 5, ("HeadingAcc",)), packets)[:, 0]
    return InsQuality(columns.utc_ns[packets], columns.navigation_status[packets].astype(float),
                      held(*sent(columns, 0, ("GpsPosMode",)), packets)[:, 0],
                      np.hypot(position[:, 0], position[:, 1]), np.radians(heading))


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)
