"""Relaxation of the tyre force with the distance rolled: length / v d(alpha')/dt = alpha - alpha', force from alpha'.

v is at least minimum_slip_speed, which makes the force decay at standstill. A time constant tau = length / v
below 25 ms would be too stiff for steps of 50 ms. The state then has a time constant of 25 ms and a weight of
tau / 25 ms, which results in the delay tau at low frequency. The states start at the initial slip angles. Source:
Pacejka, Tire and Vehicle Dynamics, ch. 7, single contact point.
"""

from ..ops import absolute, maximum
from ._base import Effect, Parameter, register

MIN_TIME_CONSTANT = 0.025  # s; RK4 with 50 ms steps is stable down to 18 ms


@register
class TyreRelaxation(Effect):
    physics = "force from alpha', length / v d(alpha')/dt = alpha - alpha', both axles"
    excited_by = "sweeps at two speeds, one twice the other: the delay is length / v"
    kind, slot = "physics", "both axles"
    confounded_with = ("yaw_inertia", "steering_delay", "steering_lag")
    extra_states = ("slip_front", "slip_rear")
    extra_units = ("rad", "rad")
    order = 40
    parameter = Parameter("length", "m", null=0.0, initial=0.4, bounds=(0.0, 1.5),
                          meaning="distance rolled to 63 % of the force after a step of slip",
                          source="passenger-car tyres 0.2-0.8 m, more at high load", model_error=0.35)

    @staticmethod
    def constants(vehicle):
        return vehicle.minimum_slip_speed

    @staticmethod
    def slip_angles(slip_front, slip_rear, extra, instant, prepared, theta):
        tau = theta.length / maximum(absolute(instant.velocity_x), theta.constants)
        fraction = tau / maximum(tau, MIN_TIME_CONSTANT)
        return slip_front + fraction * (extra[0] - slip_front), slip_rear + fraction * (extra[1] - slip_rear)

    @staticmethod
    def start(slips, instant, prepared, theta):
        return slips

    @staticmethod
    def rates(extra, slips, forces, instant, prepared, theta):
        tau = maximum(theta.length / maximum(absolute(instant.velocity_x), theta.constants), MIN_TIME_CONSTANT)
        return (slips[0] - extra[0]) / tau, (slips[1] - extra[1]) / tau
