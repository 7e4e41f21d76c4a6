"""Encodes sensor readings as NCOM packets of an RT3000 with RTK and two antennas, and as CAN frames of Leaf and INS.

The packets contain WGS84 positions, NED velocities, FRD accelerations and rates, and the status of a converged filter.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence

import can
import numpy as np
from canedge_bridge.decode import Decoder
from oxts_bridge.channels import encode_channel
from oxts_bridge.ncom import INITIALISING, LOCKED, RAW_IMU, Packet, encode

from .sensors import ACCURACY, InsReading

# WGS84 ellipsoid, semi-major axis in m.
SEMI_MAJOR = 6378137.0
FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)
UNDULATION = 45.5  # m, geoid above the ellipsoid (EGM96 near Eindhoven); units send altitude above the geoid by default
GPS_EPOCH_UNIX_NS = 315_964_800_000_000_000
LEAP_SECONDS_NS = 18_000_000_000  # GPS time has been 18 s ahead of UTC since 2017

NO_DATA = 0  # navigation status without valid data
_INVALID = (math.nan, math.nan, math.nan)
CYCLE_LENGTH = 200  # packets after which the sequence of channels repeats
MINUTES = 0  # channel with the GPS time in minutes
UP_TIME_AT_START = 1800.0  # s
_RTK, _SATELLITES = 6, 14  # code of the position mode, number of satellites
_RECEIVER = {"AntStatus": 0, "AntPower": 0, "CpuUsed": 34, "CoreNoise": 12, "SerBaud": 14, "NumSats": _SATELLITES,
             "PosMode": _RTK, "CoreTemp": 41, "SupplyVolt": 12.1}
# Channels with constant values; those that the suite does not use are sent with all fields invalid.
_CONSTANT_CHANNELS: Mapping[int, Mapping[str, float | str]] = {
    **{channel: {} for channel in (*range(6, 12), *range(13, 16), 17, 21, 22, 24, 26, *range(28, 30), *range(31, 37),
                                   38, 39, *range(41, 48), *range(49, 55), *range(57, 66), *range(72, 77), 78)},
    3: {"NorthAcc": ACCURACY["position"], "EastAcc": ACCURACY["position"], "AltAcc": 2 * ACCURACY["position"]},
    4: {"VnAcc": ACCURACY["velocity"], "VeAcc": ACCURACY["velocity"], "VdAcc": 1.5 * ACCURACY["velocity"],
        "ProcessingMethod": 1},
    5: {"HeadingAcc": math.degrees(ACCURACY["heading"]), "PitchAcc": math.degrees(ACCURACY["roll_pitch"]),
        "RollAcc": math.degrees(ACCURACY["roll_pitch"])},
    **{channel: {"GAPx": 0.35, "GAPy": 0.0, "GAPz": -1.05} for channel in (12, 57)},
    16: {"Imu2VehHeading": 0.0, "Imu2VehPitch": 0.0, "Imu2VehRoll": 0.0, "TimeUtcOffset": -18},
    19: {"DevId": "250101.1"},
    20: {"GpsDiffAge": 1.0, "BaseStationId": "0021"},
    27: {"HeadQuality": 3, "HeadSearchType": 3, "HeadSearchStatus": 0, "HeadSearchReady": 1, "HeadSearchInit": 40,
         "HeadSearchNum": 1},
    30: {"OsVersion1": 1, "OsVersion2": 2, "OsVersion3": 3, "OsScriptId": "250101", "SerialNumber": 4711},
    37: {"HeadingMisAlign": 0.0, "HeadingMisAlignAcc": 0.05, "NumSatsUsedPos": _SATELLITES,
         "NumSatsUsedVel": _SATELLITES, "NumSatsUsedAtt": 8},
    40: {"NcomVersion": 22, "OutputLatency": 0.0, "SerialNumber24": 4711},
    48: {"Undulation": UNDULATION, "HDOP": 0.7, "PDOP": 1.3, "OutputDatum": 0, "DatumEllipsoid": 0,
         "DatumEarthFrame": 0},
    55: {f"GpsPrimary.{name}": value for name, value in _RECEIVER.items()},
    56: {f"GpsSecondary.{name}": value for name, value in _RECEIVER.items()},
    59: {"ImuTemperature": 38.5},
    76: {"NtripStatus": 6},
}
_CHANGING_CHANNELS = (MINUTES, 1, 2, 18, 23)
# Channels by period [packets]; all others are sent every 100th packet.
_PERIODS: Mapping[int, Sequence[int]] = {
    10: (0, 1), 25: (32, 45), 50: (3, 4, 5, 20, 24, 43, 65, 66, 67), 100: (),
    200: (46, 47, 49, 50, 51, 52, 53, 54, 58, 60, 61, 62, 63, 64, 72, 73, 74, 75, 76, 78)}
VEHICLE_BUS, INS_BUS = 1, 2  # CANedge channels of the car and of the INS; on a live bus they share one channel

FRAME_TIME = 0.00025  # s, duration of a frame at 500 kbit/s; frames of one encoder call are sent at this interval

# Periods [ms] of the most frequent other identifiers on the Car-CAN of a Leaf, counted in a recording with 52
# identifiers and 1750 frames per second; `--can-rate full` sends them in addition.
_BACKGROUND = {
    **dict.fromkeys((0x174, 0x176, 0x180, 0x182, 0x1CA, 0x1CB, 0x1D5, 0x1D6, 0x215, 0x216, 0x245, 0x260), 10),
    **dict.fromkeys((0x280, 0x292, 0x2DE, 0x300), 20),
    **dict.fromkeys((0x354, 0x355), 40),
    **dict.fromkeys((0x358, 0x35D, 0x385, 0x510, 0x551, 0x5C5, 0x5E4, 0x60D, 0x625), 100),
}


class Origin:
    """Origin of the map with axes x east, y north, z up; latitude and longitude [deg], ellipsoidal height [m]."""

    def __init__(self, latitude_deg: float, longitude_deg: float, height: float):
        self.latitude_deg, self.longitude_deg, self.height = latitude_deg, longitude_deg, height
        latitude, longitude = math.radians(latitude_deg), math.radians(longitude_deg)
        self._rotation = math.sin(latitude), math.cos(latitude), math.sin(longitude), math.cos(longitude)
        self._ecef = to_ecef(latitude, longitude, height)

    def to_geodetic(self, x: float, y: float, z: float) -> tuple[float, float, float]:
        """Latitude, longitude [rad] and ellipsoidal height [m] of a map point [m]."""
        s_lat, c_lat, s_lon, c_lon = self._rotation
        outward = c_lat * z - s_lat * y
        x0, y0, z0 = self._ecef
        return from_ecef(x0 - s_lon * x + c_lon * outward, y0 + c_lon * x + s_lon * outward, z0 + c_lat * y + s_lat * z)


def to_ecef(latitude: float, longitude: float, height: float) -> tuple[float, float, float]:
    """Earth-centred x, y, z [m] of geodetic latitude, longitude [rad] and ellipsoidal height [m]."""
    normal = SEMI_MAJOR / math.sqrt(1 - _ECCENTRICITY2 * math.sin(latitude) ** 2)
    radius = (normal + height) * math.cos(latitude)
    z = (normal * (1 - _ECCENTRICITY2) + height) * math.sin(latitude)
    return radius * math.cos(longitude), radius * math.sin(longitude), z


def from_ecef(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Latitude, longitude [rad], height [m] by Bowring's formula: error below 1 um near the ground (test_stream.py)."""
    radius = math.hypot(x, y)
    semi_minor = SEMI_MAJOR * (1 - FLATTENING)
    second_eccentricity2 = _ECCENTRICITY2 / (1 - _ECCENTRICITY2)
    reduced_latitude = math.atan2(z * SEMI_MAJOR, radius * semi_minor)
    latitude = math.atan2(z + second_eccentricity2 * semi_minor * math.sin(reduced_latitude) ** 3,
                          radius - _ECCENTRICITY2 * SEMI_MAJOR * math.cos(reduced_latitude) ** 3)
    sine = math.sin(latitude)
    normal = SEMI_MAJOR / math.sqrt(1 - _ECCENTRICITY2 * sine**2)
    height = radius * math.cos(latitude) + z * sine - SEMI_MAJOR**2 / normal
    return latitude, math.atan2(y, x), height


class NcomEncoder:
    """Encoder of the packets of one INS. start_ns: UTC of the start [ns since 1970], in whole milliseconds, as NCOM
    requires. rate: packets per second."""

    def __init__(self, origin: Origin, start_ns: int, rate: int):
        self._origin, self._rate = origin, rate
        self._start_gps_ns = start_ns - GPS_EPOCH_UNIX_NS + LEAP_SECONDS_NS
        self._packet_count = 0
        self._schedule = make_schedule()
        map_origin = {  # heading 90 deg: x of the local frame is east
            66: {"RefLat": origin.latitude_deg, "RefLon": origin.longitude_deg},
            67: {"RefAlt": origin.height - UNDULATION, "RefHeading": 90.0}}
        self._constant_batches = {channel: encode_channel(channel, values)
                                  for channel, values in {**_CONSTANT_CHANNELS, **map_origin}.items()}

    def encode_packet(self, reading: InsReading, status: int = LOCKED) -> bytes:
        """The 72-byte packet of an epoch. Data that `status` excludes are 0 (time, position) or invalid (others)."""
        total_ms = round((self._start_gps_ns + round(reading.stamp * 1e9)) / 1_000_000)
        minutes, milliseconds = divmod(total_ms, 60_000)
        channel = self._schedule[self._packet_count % CYCLE_LENGTH]
        self._packet_count += 1
        batch_s = self._constant_batches.get(channel) or encode_channel(channel, _make_changing_values(
            self._packet_count / self._rate, minutes if status >= INITIALISING else None)[channel])
        roll_rate, pitch_rate, yaw_rate = reading.rates
        force_x, force_y, force_z = reading.specific_force
        packet = Packet(
            milliseconds=milliseconds if status >= INITIALISING else 0, navigation_status=status,
            # Body axes FLU -> FRD.
            acceleration=(force_x, -force_y, -force_z) if status >= RAW_IMU else _INVALID,
            angular_rate=(roll_rate, -pitch_rate, -yaw_rate) if status >= RAW_IMU else _INVALID,
            latitude=0.0, longitude=0.0, altitude=0.0, channel=channel, batch_s=batch_s)
        if status >= INITIALISING:
            packet.latitude, packet.longitude, height = self._origin.to_geodetic(reading.x, reading.y, reading.z)
            packet.altitude = height - UNDULATION
            c, s = math.cos(reading.yaw), math.sin(reading.yaw)
            packet.velocity_ned = (s * reading.velocity_x + c * reading.velocity_y,
                                   c * reading.velocity_x - s * reading.velocity_y, -reading.velocity_z)
            packet.heading = math.remainder(math.pi / 2 - reading.yaw, 2 * math.pi)
            packet.pitch, packet.roll = reading.pitch, reading.roll
        return encode(packet)


def make_schedule() -> list[int]:
    """Status channel of each packet of a cycle; packets without a periodic channel have channel 0 (MINUTES)."""
    others = {*_CONSTANT_CHANNELS, *_CHANGING_CHANNELS}.difference(*_PERIODS.values())
    slots: list[int | None] = [None] * CYCLE_LENGTH
    for period, channels in {**_PERIODS, 100: sorted(others)}.items():
        for channel in channels:
            phase = next(phase for phase in range(period) if set(slots[phase::period]) == {None})
            slots[phase::period] = [channel] * (CYCLE_LENGTH // period)
    return [MINUTES if channel is None else channel for channel in slots]


def _make_changing_values(seconds: float, gps_minutes: int | None) -> dict[int, dict[str, float | None]]:
    """Values of _CHANGING_CHANNELS. seconds: since the start. gps_minutes: GPS time in minutes; None while unknown."""
    names = ("InnPosX", "InnPosY", "InnPosZ", "InnVelX", "InnVelY", "InnVelZ", "InnPitch", "InnHeading")
    up_time = UP_TIME_AT_START + seconds  # sent in seconds up to 3 h, then in minutes with an offset
    return {
        MINUTES: {"GpsMinutes": gps_minutes, "GpsNumObs": _SATELLITES, "GpsPosMode": _RTK, "GpsVelMode": _RTK,
                  "GpsAttMode": _RTK},
        # Small, slow innovations, as from a converged filter.
        1: {name: round(0.4 * math.sin(0.7 * seconds + i), 1) for i, name in enumerate(names)},
        2: {"GpsPrimary.Chars": int(900 * seconds) & 0xFFFF, "GpsPrimary.Pkts": int(12 * seconds) & 0xFFFF,
            "GpsPrimary.CharsSkipped": 0, "GpsPrimary.OldPkts": 0},
        18: {"ImuChars": int(4200 * seconds) & 0xFFFFFFFF, "ImuPkts": int(100 * seconds) & 0xFFFF,
             "ImuCharsSkipped": 0},
        23: {"BnsLag": 4, "UpTimeCode": int(up_time) if up_time <= 10800 else int(up_time / 60) + 10620,
             "GPSPosReject": 0, "GPSVelReject": 0, "GPSAttReject": 0},
    }


class CanEncoder:
    """Encoder of frames according to a DBC. start_ns: UTC of the start of the drive [ns since 1970]. The attribute
    `channel` of a frame is VEHICLE_BUS or INS_BUS."""

    def __init__(self, codec: Decoder, origin: Origin, start_ns: int):
        self._codec = codec
        self._origin, self._start_ns = origin, start_ns
        self._counters: Counter[str] = Counter()

    def encode_steering(self, angle: float, rate: float) -> list[can.Message]:
        """The frame with the measured steering-wheel angle [rad, positive to the left] and its rate [rad/s]. The rate
        is sent unsigned, as by the car. Its scale on the car is unknown; 4 deg/s per bit is assumed."""
        raw = min(round(abs(math.degrees(rate)) / 4), 255)
        return [self._encode("Leaf_Steering", {"steering_wheel_angle": angle, "SteeringWheelRateRaw": raw})]

    def encode_wheel_speeds(self, wheel_speeds: Sequence[float], vehicle_speed: float) -> list[can.Message]:
        """The frames with the wheel speeds FL, FR, RL, RR and the vehicle speed [m/s]."""
        names = [f"wheel_speed_{axle}_{side}" for axle in ("front", "rear") for side in ("left", "right")]
        values = list(zip(names, wheel_speeds, strict=True))
        return [self._encode("Leaf_WheelSpeedFront", {**dict(values[:2]), "vehicle_speed": vehicle_speed}),
                self._encode("Leaf_WheelSpeedRear", dict(values[2:]))]

    def encode_gear(self, code: int) -> list[can.Message]:
        return [self._encode("Leaf_Gear", {"GearCode": code})]

    def encode_ins(self, reading: InsReading) -> list[can.Message]:
        """The frames that an RT3000 sends once per epoch: 0x600, 0x601, 0x604, 0x607, 0x608, 0x630, 0x633, 0x634."""
        degrees = math.degrees
        unix_time = (self._start_ns + round(reading.stamp * 1e9)) / 1e9
        latitude, longitude, _ = self._origin.to_geodetic(reading.x, reading.y, reading.z)
        velocity = {"ins_velocity_x": reading.velocity_x, "ins_velocity_y": reading.velocity_y}
        pitch, roll = degrees(reading.pitch), degrees(reading.roll)
        roll_rate, pitch_rate, yaw_rate = reading.rates
        frames = {
            "RT_DateTime": {"ins_unix_time": unix_time},
            "RT_LatitudeLongitude": {"PosLat": degrees(latitude), "PosLon": degrees(longitude)},
            "RT_VelocityLevel": velocity,
            "RT_HeadingPitchRoll": {"ins_yaw": reading.yaw, "AnglePitch": pitch, "AngleRoll": roll},
            "RT_RateVehicle": {
                "AngRateX": degrees(roll_rate), "AngRateY": -degrees(pitch_rate), "ins_yaw_rate": yaw_rate},
            "RT_MilliTime": {"ins_unix_time": unix_time},
            # In ISO 8855 axes y points to the left, so pitch is positive nose down.
            "RT_IsoOrientation": {"ins_yaw": reading.yaw, "IsoPitchAngle": -pitch, "IsoRollAngle": roll},
            "RT_IsoVsVelocity": {**velocity, "IsoVsVerticalVelocity": reading.velocity_z},
        }
        return [self._encode(name, values) for name, values in frames.items()]

    def _encode(self, name: str, values: dict[str, float]) -> can.Message:
        frame = self._codec.encode(name, values, self._counters[name])
        frame.channel = INS_BUS if name.startswith("RT_") else VEHICLE_BUS
        self._counters[name] += 1
        return frame


class BackgroundTraffic:
    """Other frames of the Car-CAN, each with constant random data, for a realistic load on filters and queues: 1540
    frames per second. Together with the 217 of CanEncoder, these are about as many as in a Leaf, without INS frames."""

    def __init__(self, seed: int):
        generator = np.random.default_rng([seed, 6])
        self._frames = [
            (period, index % period, can.Message(arbitration_id=identifier, is_extended_id=False,
                                                 data=generator.bytes(8), channel=VEHICLE_BUS))
            for index, (identifier, period) in enumerate(_BACKGROUND.items())]

    def select_frames(self, millisecond: int) -> list[can.Message]:
        """The frames sent in the given millisecond of the drive."""
        return [frame for period, phase, frame in self._frames if millisecond % period == phase]
