"""Road wheel angle at a measured angle of zero: delta = delta_measured + angle."""

from dataclasses import replace

from ._base import ANY, Effect, Parameter, register


@register
class SteeringOffset(Effect):
    physics = "delta = delta_measured + angle, due to the sensor or the linkage"
    excited_by = "any driving, even straight; two speeds separate it from wind, whose side force increases with speed"
    kind, slot = "vehicle parameters", "steering"
    confounded_with = ("crosswind", "road_bank", "heading_misalignment")
    applies_to = ANY
    order = 60
    parameter = Parameter("angle", "rad", null=0.0, initial=0.005, bounds=(-0.1, 0.1), odd=True,
                          meaning="road wheel angle at a measured angle of zero, positive to the left",
                          source="0.1 rad is 100 deg at a steering wheel with ratio 17, more than any assembly error")

    @staticmethod
    def inputs(road_wheel_angle, velocity_x_dot, signals, theta):
        return road_wheel_angle + theta.angle, velocity_x_dot

    @staticmethod
    def fold(vehicle, theta):
        offset = vehicle.steering_wheel_offset - theta.angle * vehicle.steering_ratio
        return replace(vehicle, steering_wheel_offset=offset)
