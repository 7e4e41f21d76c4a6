"""Encodes sensor readings as CAN frames of the Leaf and of the INS."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import can
import numpy as np
from canedge_bridge.decode import Decoder

from .ncom_encoder import Origin
from .sensors import InsReading

STEERING_MESSAGE = "Leaf_Steering"
VEHICLE_BUS, INS_BUS = 1, 2  # CANedge channels of the car and of the INS; on a live bus they share one channel

FRAME_TIME = 0.00025  # s, duration of a frame at 500 kbit/s; frames of one encoder call are sent at this interval
CAR_CAN_RATE = 1750  # frames per second on the Car-CAN of a Leaf, counted in a recording with 52 identifiers

# Periods [ms] of the most frequent other identifiers in that recording, which `--can-rate full` sends in addition.
_BACKGROUND = {
    **dict.fromkeys((0x174, 0x176, 0x180, 0x182, 0x1CA, 0x1CB, 0x1D5, 0x1D6, 0x215, 0x216, 0x245, 0x260), 10),
    **dict.fromkeys((0x280, 0x292, 0x2DE, 0x300), 20),
    **dict.fromkeys((0x354, 0x355), 40),
    **dict.fromkeys((0x358, 0x35D, 0x385, 0x510, 0x551, 0x5C5, 0x5E4, 0x60D, 0x625), 100),
}


@dataclass(frozen=True, slots=True)
class Frame:
    """One frame. bus: VEHICLE_BUS or INS_BUS."""

    message: can.Message
    bus: int


class CanEncoder:
    """Encoder of frames according to a DBC. start_ns: UTC of the start of the drive [ns since 1970]."""

    def __init__(self, codec: Decoder, origin: Origin, start_ns: int):
        self._codec = codec
        self._origin, self._start_ns = origin, start_ns
        self._counters: dict[str, int] = {}

    def encode_steering(self, angle: float, rate: float) -> list[Frame]:
        """The frame with the measured steering-wheel angle [rad, left +] and its rate [rad/s].

        The rate is sent unsigned, as by the car. Its scale on the car is unknown; 4 deg/s per bit is assumed.
        """
        raw = min(round(abs(math.degrees(rate)) / 4), 255)
        return [self._encode_car(STEERING_MESSAGE, {"steering_wheel_angle": angle, "SteeringWheelRateRaw": raw})]

    def encode_wheel_speeds(self, wheel_speeds: Sequence[float], vehicle_speed: float) -> list[Frame]:
        """The frames with the wheel speeds FL, FR, RL, RR and the vehicle speed [m/s]."""
        front_left, front_right, rear_left, rear_right = wheel_speeds
        return [
            self._encode_car("Leaf_WheelSpeedFront", {
                "wheel_speed_front_left": front_left, "wheel_speed_front_right": front_right,
                "vehicle_speed": vehicle_speed}),
            self._encode_car("Leaf_WheelSpeedRear", {
                "wheel_speed_rear_left": rear_left, "wheel_speed_rear_right": rear_right})]

    def encode_gear(self, code: int) -> list[Frame]:
        return [self._encode_car("Leaf_Gear", {"GearCode": code})]

    def encode_ins(self, reading: InsReading) -> list[Frame]:
        """The frames that an RT3000 sends once per epoch: 0x600, 0x601, 0x604, 0x607, 0x608, 0x630, 0x633, 0x634."""
        degrees = math.degrees
        unix_time = (self._start_ns + round(reading.stamp * 1e9)) / 1e9
        latitude, longitude, _ = self._origin.to_geodetic(reading.x, reading.y, reading.z)
        velocity = {"ins_velocity_x": reading.velocity_x, "ins_velocity_y": reading.velocity_y}
        pitch, roll = degrees(reading.pitch), degrees(reading.roll)
        roll_rate, pitch_rate, yaw_rate = reading.rates
        return [
            self._encode_ins("RT_DateTime", {"ins_unix_time": unix_time}),
            self._encode_ins("RT_LatitudeLongitude", {"PosLat": degrees(latitude), "PosLon": degrees(longitude)}),
            self._encode_ins("RT_VelocityLevel", velocity),
            self._encode_ins("RT_HeadingPitchRoll", {"ins_yaw": reading.yaw, "AnglePitch": pitch, "AngleRoll": roll}),
            self._encode_ins("RT_RateVehicle", {"AngRateX": degrees(roll_rate), "AngRateY": -degrees(pitch_rate),
                                                "ins_yaw_rate": yaw_rate}),
            self._encode_ins("RT_MilliTime", {"ins_unix_time": unix_time}),
            # In ISO 8855 axes y points to the left, so pitch is positive nose down.
            self._encode_ins("RT_IsoOrientation", {"ins_yaw": reading.yaw, "IsoPitchAngle": -pitch,
                                                   "IsoRollAngle": roll}),
            self._encode_ins("RT_IsoVsVelocity", {**velocity, "IsoVsVerticalVelocity": reading.velocity_z}),
        ]

    def _encode_car(self, message: str, values: dict[str, float]) -> Frame:
        counter = self._counters.get(message, 0)
        self._counters[message] = counter + 1
        return Frame(self._codec.encode(message, values, counter), VEHICLE_BUS)

    def _encode_ins(self, message: str, values: dict[str, float]) -> Frame:
        return Frame(self._codec.encode(message, values), INS_BUS)


class BackgroundTraffic:
    """Other frames of the Car-CAN, each with constant random data, for a realistic load on filters and queues.

    1540 per second; with the 217 encoded by CanEncoder, about CAR_CAN_RATE. INS frames are additional.
    """

    def __init__(self, seed: int):
        generator = np.random.default_rng([seed, 6])
        self._frames = []
        for index, (identifier, period) in enumerate(_BACKGROUND.items()):
            message = can.Message(arbitration_id=identifier, is_extended_id=False, data=generator.bytes(8))
            self._frames.append((period, index % period, Frame(message, VEHICLE_BUS)))

    def select_frames(self, millisecond: int) -> list[Frame]:
        """The frames sent in a millisecond of the drive."""
        return [frame for period, phase, frame in self._frames if millisecond % period == phase]
