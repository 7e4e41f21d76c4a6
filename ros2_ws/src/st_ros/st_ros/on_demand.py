"""A publisher that knows whether anybody listens: filling a message for nobody costs as much as for somebody."""

from typing import Any

from rclpy.publisher import Publisher

# How often it is asked whether anyone listens to a topic [s]: asking costs as much as filling a message.
LISTENERS_PERIOD = 0.05


class OnDemand:
    """publisher None: switched off."""

    def __init__(self, publisher: Publisher | None):
        self._publisher = publisher
        self._asked = float("-inf")
        self._wanted = False

    def wanted(self, now: float) -> bool:
        """now: a monotonic clock [s]."""
        if self._publisher is not None and now - self._asked > LISTENERS_PERIOD:
            self._asked = now
            self._wanted = self._publisher.get_subscription_count() > 0
        return self._wanted

    def publish(self, message: Any) -> None:
        if self._publisher is not None:
            self._publisher.publish(message)
