"""Of several publishers of an input only the one that was there is listened to. No ROS, no clock.

A message does not say whose it is, but each publisher numbers its own, so that each is a chain of numbers. Where two
chains meet, none is used: better no prediction than one of two cars mixed.
"""

from collections.abc import Sequence

# The one that was there has ended or hangs when it was not heard for so long; another of its name is then itself,
# started again [s].
PATIENCE = 1.0
# Messages the one that was there may have lost on the way: four seconds at 250 Hz.
LOST = 1000


class OnePublisher:
    """Decides message by message; `says` is what a person should know, empty while there is one publisher.

    names: full node names of all publishers as last given. unused: messages left aside since the start.
    """

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.unused = 0
        self._several = self._mixed = False
        self._number: int | None = None  # of the newest message used
        self._heard: float | None = None  # when it came [s]
        self._others: dict[int, float] = {}  # newest number of each chain left aside -> when it came [s]
        self._left_aside: float | None = None  # when the newest other one came [s]

    def look(self, names: Sequence[str]) -> None:
        """names: node of each publisher the middleware knows of."""
        self.names, self._several = tuple(sorted(names)), len(names) > 1
        self._mixed = self._mixed and self._several

    def use(self, number: int | None, now: float) -> bool:
        """Whether to use a message. number: its publisher's count, None: not known. now: when it came [s]."""
        if not self._several:
            self._number, self._heard = number, now
            return True
        if self._is_ours(number, now):
            self._number, self._heard = number, now
            return True
        self.unused += 1
        self._left_aside = now
        if number is not None:
            self._others.pop(number - 1, None)
            self._others[number] = now
        return False

    def _is_ours(self, number: int | None, now: float) -> bool:
        if self._mixed or number is None or self._number is None or self._heard is None:
            return False
        self._others = {newest: heard for newest, heard in self._others.items() if now - heard < PATIENCE}
        if number == self._number + 1:
            self._mixed = self._number in self._others
            return not self._mixed
        if now - self._heard <= PATIENCE:
            return False
        # Some were lost on the way, or it was started again while the dead one is still in the graph.
        may_be = {newest for newest in self._others if self._may_follow(newest)} - {number - 1}
        return len(set(self.names)) == 1 or (self._may_follow(number) and not may_be)

    def _may_follow(self, number: int) -> bool:
        return self._number is not None and 0 < number - self._number <= LOST

    def says(self, now: float) -> str:
        """now: on the clock of `use` [s]."""
        others = len(set(self.names)) > 1
        # A dead publisher of the same name stays in the graph for a while and sends nothing.
        recent = self._left_aside is not None and now - self._left_aside < 10.0 * PATIENCE
        if not self._several or not (others or recent):
            return ""
        whose = ", ".join(self.names)
        if self._mixed or self._number is None:
            return f"published by {len(self.names)} nodes that cannot be told apart, none is used: {whose}"
        return f"published by {len(self.names)} nodes: {whose}; only the one that was there is used"
