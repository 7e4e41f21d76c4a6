"""Navigation status (byte 21): what it means and which parts of its packet may be used."""

from typing import NamedTuple


class Rule(NamedTuple):
    """What a packet with this status carries.

    time: bytes 1-2 count in the series of packet times.  imu: batch A.  navigation: position, velocity, angles;
    "approximate" values may be looked at but are no fix.  status: batch S.  trigger: an event, its time is in batch S.
    """

    text: str
    time: bool = False
    imu: bool = False
    navigation: str = "none"  # none, approximate, valid
    status: bool = False
    trigger: bool = False
    kind: str = "empty"  # regular, status, trigger, empty: what the packet is good for
    known: bool = True


RULES: dict[int, Rule] = {
    0: Rule("nothing valid"),
    1: Rule("raw IMU", imu=True, status=True, kind="regular"),
    2: Rule("initialising", time=True, imu=True, navigation="approximate", status=True, kind="regular"),
    3: Rule("locking", time=True, imu=True, navigation="valid", status=True, kind="regular"),
    4: Rule("locked", time=True, imu=True, navigation="valid", status=True, kind="regular"),
    5: Rule("reserved (unlocked)"),
    6: Rule("firmware expired"),
    7: Rule("firmware blocked"),
    10: Rule("status only", status=True, kind="status"),
    11: Rule("structure B"),
    20: Rule(
        "trigger while initialising", imu=True, navigation="approximate", status=True, trigger=True, kind="trigger"
    ),
    21: Rule("trigger while locking", imu=True, navigation="valid", status=True, trigger=True, kind="trigger"),
    22: Rule("trigger while locked", imu=True, navigation="valid", status=True, trigger=True, kind="trigger"),
}
INITIALISING, LOCKING, LOCKED, EXPIRED, BLOCKED, STATUS_ONLY = 2, 3, 4, 6, 7, 10
# Channel 0 of these sets the minute; of status-only packets because files start with them, of 1 not: no time before the
# clock is set.
MINUTE_STATUSES = frozenset((INITIALISING, LOCKING, LOCKED, STATUS_ONLY))
BY_STATUS: tuple[Rule, ...] = tuple(RULES.get(n, Rule(f"reserved ({n})", known=False)) for n in range(256))


def rule(status: int) -> Rule:
    """The rule of byte 21; reserved numbers carry nothing."""
    return BY_STATUS[status]
