"""Accepts messages of the first publisher of an input only. No ROS, no clock.

A message does not name its publisher, but each publisher numbers its messages, so that its messages form a chain of
consecutive numbers. Where two chains meet, none is used: no prediction is better than one from two mixed cars.
"""

from collections.abc import Sequence

# The accepted publisher has ended or hangs after this long without a message; a publisher of the same node name is then
# its restart [s].
SILENCE_TIMEOUT = 1.0
# Messages the accepted publisher may have lost: four seconds at 250 Hz.
MAX_LOST = 1000


class PublisherLock:
    """Accepts or rejects message by message; `warning` names several publishers, empty while there is one.

    names: full node names of all publishers at the last `update`. rejected: messages not used since the start.
    """

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.rejected = 0
        self._several = self._mixed = False
        self._number: int | None = None  # of the newest message accepted
        self._accepted_at: float | None = None  # [s]
        self._others: dict[int, float] = {}  # newest number of each rejected chain -> its time [s]
        self._rejected_at: float | None = None  # [s]

    def update(self, names: Sequence[str]) -> None:
        """names: node of each publisher in the graph."""
        self.names, self._several = tuple(sorted(names)), len(names) > 1
        self._mixed = self._mixed and self._several

    def accept(self, number: int | None, now: float) -> bool:
        """Whether to use a message. number: its publisher's count, None: unknown. now: time of arrival [s]."""
        if not self._several or self._continues_chain(number, now):
            self._number, self._accepted_at = number, now
            return True
        self.rejected += 1
        self._rejected_at = now
        if number is not None:
            self._others.pop(number - 1, None)
            self._others[number] = now
        return False

    def _continues_chain(self, number: int | None, now: float) -> bool:
        if self._mixed or number is None or self._number is None or self._accepted_at is None:
            return False
        self._others = {newest: at for newest, at in self._others.items() if now - at < SILENCE_TIMEOUT}
        if number == self._number + 1:
            self._mixed = self._number in self._others
            return not self._mixed
        if now - self._accepted_at <= SILENCE_TIMEOUT:
            return False
        # Messages were lost, or the node was restarted while the killed one is still in the graph.
        candidates = {newest for newest in self._others if self._may_follow(newest)} - {number - 1}
        return len(set(self.names)) == 1 or (self._may_follow(number) and not candidates)

    def _may_follow(self, number: int) -> bool:
        return self._number is not None and 0 < number - self._number <= MAX_LOST

    def warning(self, now: float) -> str:
        """now: on the clock of `accept` [s]."""
        others = len(set(self.names)) > 1
        # A killed publisher of the same name stays in the graph for a while and sends nothing.
        recent = self._rejected_at is not None and now - self._rejected_at < 10.0 * SILENCE_TIMEOUT
        if not self._several or not (others or recent):
            return ""
        names = ", ".join(self.names)
        if self._mixed or self._number is None:
            return f"published by {len(self.names)} nodes that cannot be distinguished, none is used: {names}"
        return f"published by {len(self.names)} nodes: {names}; only the first one is used"
