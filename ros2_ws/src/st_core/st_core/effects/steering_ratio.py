"""Error of the steering ratio in the vehicle file: delta = delta_measured / factor."""

from ._base import ANY, REAR_STEERING, Effect, Parameter, register, scale_entry


@register
class SteeringRatio(Effect):
    physics = "delta = delta_measured / factor: a larger true ratio turns the wheels less"
    excited_by = "transients or two speeds; at one steady speed not separable from front stiffness"
    kind, slot = "vehicle parameters", "steering"
    confounded_with = ("front_stiffness", "roll_steer", "yaw_rate_scale", "speed_scale", "steering_map")
    combinations = ("steady-state yaw gain at 20 m/s",)
    imitated_by = (f"a wrong wheelbase in the vehicle file, {REAR_STEERING}, a speed-dependent steering ratio, a "
                   "steering linkage without Ackermann geometry or a locking differential")
    applies_to = ANY
    order = 40
    parameter = Parameter("factor", "1", null=1.0, initial=1.05, bounds=(0.5, 2.0),
                          meaning="ratio of true steering ratio to the file's",
                          source="identified ratios of one car type vary by 10-20 % in fleets", model_error=0.009)
    fold = scale_entry("steering_ratio")

    @staticmethod
    def inputs(road_wheel_angle, velocity_x_dot, signals, theta):
        return road_wheel_angle / theta.factor, velocity_x_dot
