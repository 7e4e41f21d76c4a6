"""Counts of the predictor's ticks: predicted, skipped and why."""

# A longer step of the clock is a jump of the clock (a replay that was moved on), not an overrun.
LONGEST_OVERRUN_NS = 10_000_000_000


class TickCounter:
    """Counts ticks from the first one with known inputs; rclpy's timer keeps a grid and drops what it missed."""

    def __init__(self) -> None:
        self.predicted = self.stale = self.overrun = self.slow = 0
        self._started = False
        self._next_due_ns: int | None = None
        self._reported_overruns = 0

    def missed(self, next_due_ns: int, period_ns: int) -> int:
        """Ticks dropped since the last call. next_due_ns: when the timer is due next, on the node's clock."""
        before, self._next_due_ns = self._next_due_ns, next_due_ns
        if before is None or not 0 < next_due_ns - before < LONGEST_OVERRUN_NS:
            return 0
        return max(0, round((next_due_ns - before) / period_ns) - 1)

    def count(self, missed: int, skipped: str | None) -> None:
        """One tick, after `missed` others. skipped: None (predicted), "stale" or "slow"."""
        if not self._started and skipped == "stale":
            return
        if self._started:
            self.overrun += missed
        self._started = True
        if skipped is None:
            self.predicted += 1
        elif skipped == "slow":
            self.slow += 1
        else:
            self.stale += 1

    def new_overruns(self) -> int:
        """Overruns since the last call."""
        new, self._reported_overruns = self.overrun - self._reported_overruns, self.overrun
        return new

    def as_dict(self) -> dict[str, int]:
        """The counts under the names of st_msgs/PredictorStatus."""
        return {
            "due": self.predicted + self.stale + self.overrun + self.slow,
            "predicted": self.predicted,
            "skipped_stale": self.stale,
            "skipped_overrun": self.overrun,
            "skipped_slow": self.slow,
        }
