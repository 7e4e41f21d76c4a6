"""Play in the steering: the wheels follow only at the ends of it."""

from ._base import ANY, Effect, Parameter, register
from ._scan import clamp, scan


@register
class SteeringBacklash(Effect):
    name = "steering_backlash"
    physics = "delta stays until delta_measured leaves delta +- play / 2, then is dragged along"
    excited_by = "small steering to and fro around straight ahead; large amplitudes hide it"
    kind, slot = "physics", "steering"
    twins = ("steering_delay", "steering_lag", "steering_ratio")
    applies_to = ANY
    order = 20
    parameters = (
        Parameter("play", "rad", null=0.0, initial=0.003, bounds=(0.0, 0.02),
                  meaning="total, at the road wheels; times the ratio at the steering wheel",
                  source="0.02 rad is 20 deg at a steering wheel of ratio 17, twice what inspections pass"),
    )

    @staticmethod
    def steering(time, angle, begins, theta):
        half = 0.5 * theta.play * ~begins
        return time, scan((angle - half, angle + half), clamp)[0]
