"""Bias of the lateral accelerometer: its reading at rest on level ground."""

from ._base import ANY, Effect, Parameter, register


@register
class LateralAccelerationBias(Effect):
    physics = "measured a_y = a_y + bias"
    excited_by = ("any driving with the lateral acceleration recorded; to separate it from road bank, the same road "
                  "in both directions")
    kind, slot = "sensors", "acceleration"
    needs = ("acceleration_y",)
    confounded_with = ("road_bank", "crosswind")
    applies_to = ANY
    order = 60
    parameter = Parameter("bias", "m/s^2", null=0.0, initial=0.1, bounds=(-2.0, 2.0), odd=True,
                          meaning="bias of the reading, positive to the left",
                          source="a sensor tilted by 1 deg reads 0.17 m/s^2", identity="acceleration_y_bias")

    @staticmethod
    def observe(measured, theta):
        return measured._replace(acceleration_y=measured.acceleration_y + theta.bias)
