"""Layout, decoding and encoding of the NCOM status channels: byte 62 is the channel number, batch S its 8 bytes.

Fields have the vendor's names (tests/golden/data/ncom), if it names them; angles are in degrees, as in its tools.
Source: NCOM manual 260702 and the behaviour of the vendor's public decoder. Checked by:
tests/golden/test_ncom_vectors.py (every channel), test_channels.py (round trips).
"""

import re
import struct
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from math import degrees
from typing import Any, TypeAlias

from .ncom import LAST_MINUTE, NcomError

Value: TypeAlias = Any
"""Float, int or text, depending on the field; None if invalid."""

LONG_RANGE_CHANNEL = 57
TRIGGER_CHANNELS = {24: "TrigTime", 43: "Trig2Time", 65: "DigitalOutTime", 79: "Trig3Time", 80: "Trig4Time",
                    81: "DigitalOut2Time"}

# Batch S in which every flag byte declares its fields valid; with it, the encoder tests whether raw numbers are valid.
_VALID_FLAGS = bytes(6) + b"\0\x01"
_F32 = struct.Struct("<f")
_INTEGER_FORMATS = {"shifted": "i8", "digits6": "i24", "lo4": "bits0+4", "hi4": "bits4+4"}


@dataclass(frozen=True)
class Validity:
    """Condition under which a field is valid."""

    text: str  # the condition, for error messages
    accepts: Callable[[int, bytes], bool]  # tests the field's raw number and the channel's 8 bytes
    # Raw number written for an invalid value; None if only flag_byte declares it invalid.
    invalid_raw: int | None = None
    # Index of the byte that declares the field valid (value flag_valid) or invalid (0xFF), together with all fields
    # that share this byte; None: there is no such byte.
    flag_byte: int | None = None
    flag_valid: int = 0


ALWAYS = Validity("none", lambda raw, data: True, invalid_raw=0)


@dataclass(frozen=True)
class Field:
    """One value of a status channel: physical value = raw number * scale + offset.

    name: from the vendor, or from this project if the vendor gives none. unit: unit of the physical value.
    counter_bits: width of a counter that wraps, else 0; status.StatusTracker unwraps it.
    kind: format of the raw number:
        u8 to u64, i8 to i32, f32: unsigned or signed integer or float, little-endian
        bits<first>+<count>: bits of one byte (count 0: the value is the offset); ibits<first>+<count>: inverted bits
        lo4, hi4: lower, upper nibble of a byte
        shifted: signed 7-bit number above a validity bit; digits6: i24, decoded to text of at least six digits
        text<n>: n characters
    An f32 that is negative or NaN, and an empty text, are invalid.
    """

    name: str
    kind: str
    first_byte: int
    unit: str = "1"
    scale: float = 1
    validity: Validity = ALWAYS
    offset: float = 0
    counter_bits: int = 0

    @cached_property
    def _bit_layout(self) -> tuple[int, int, int, int]:
        """(shift, mask, flip, sign) of the raw number: ((word >> shift & mask ^ flip) ^ sign) - sign.

        word: the 8 bytes as one little-endian integer. flip: mask of inverted bits. sign: weight of the sign bit, or 0.
        """
        kind = _INTEGER_FORMATS.get(self.kind, self.kind)
        prefix, _, bits = kind.partition("bits")
        if bits:
            first, count = bits.split("+")
            mask = (1 << int(count)) - 1
            return 8 * self.first_byte + int(first), mask, mask if prefix == "i" else 0, 0
        width = int(kind[1:])
        return 8 * self.first_byte, (1 << width) - 1, 0, 1 << width - 1 if kind[0] == "i" else 0

    def decode(self, word: int, data: bytes) -> Value:
        """The value in the 8 bytes, given as an integer and as bytes; None if invalid."""
        kind = self.kind
        if kind[0] == "t":
            characters = data[self.first_byte : self.first_byte + int(kind[4:])].split(b"\0")[0]
            # An unprintable byte becomes \\xNN, because a line break would split a CSV row.
            return "".join(chr(c) if 32 <= c < 127 else f"\\x{c:02x}" for c in characters) or None
        if kind == "f32":
            value = _F32.unpack_from(data, self.first_byte)[0]
            return value if value >= 0 else None  # also rejects NaN
        shift, mask, flip, sign = self._bit_layout
        raw = ((word >> shift & mask ^ flip) ^ sign) - sign
        if not self.validity.accepts(raw, data):
            return None
        if kind == "digits6":
            return f"{raw:06d}"
        return (raw >> 1 if kind == "shifted" else raw) * self.scale + self.offset

    def encode(self, buffer: bytearray, value: Value) -> None:
        """Write a value into the 8 bytes, but not its flag byte.

        None: write the code for "invalid", or 0 if there is no code; write nothing if only the flag byte can declare
        the field invalid. A scaled or "shifted" number is limited to the range of its format, and a text to its length;
        another number out of range raises NcomError.
        """
        if self.kind.startswith("text"):
            size = int(self.kind[4:])
            text = re.sub(r"\\x([0-9a-f]{2})", lambda match: chr(int(match[1], 16)), str(value or ""))
            octets = text.encode("latin-1", "replace")[:size].ljust(size, b"\0")
            buffer[self.first_byte : self.first_byte + size] = octets
            return
        if self.kind == "f32":
            try:
                _F32.pack_into(buffer, self.first_byte, -1.0 if value is None else value)
            except OverflowError:
                raise NcomError(f"{self.name}: {value} does not fit into a 32-bit float") from None
            return
        shift, mask, flip, _ = self._bit_layout
        number = self.validity.invalid_raw if value is None else self._to_raw(value)
        if number is None:
            return
        others = int.from_bytes(buffer, "little") & ~(mask << shift)
        buffer[:] = (others | (number & mask ^ flip) << shift).to_bytes(8, "little")

    def _to_raw(self, value: float | int | str) -> int:
        """Raw number of a physical value: the nearest valid one if scaled, else the integer part. Raises NcomError if
        an unscaled value does not fit or is a code for "invalid"."""
        unscaled = self.scale == 1 and not self.offset
        _, mask, _, sign = self._bit_layout
        low, high = -sign, mask - sign
        number = int(value) if unscaled else round(max(low, min(high, (float(value) - self.offset) / self.scale)))
        if self.kind == "shifted":
            return max(-64, min(63, number)) << 1 | 1
        accepts = self.validity.accepts
        if low <= number <= high and accepts(number, _VALID_FLAGS):
            return number
        if unscaled:
            raise NcomError(f"{self.name}: {value} does not fit: range {low} to {high}; condition {self.validity.text}")
        while not accepts(number, _VALID_FLAGS):
            number += 1 if number <= 0 else -1
        return number


F = Field  # abbreviation in the table
FRESH = Validity("byte 6 < 150", lambda raw, data: data[6] < 150, flag_byte=6)
B6_ZERO = Validity("byte 6 = 0", lambda raw, data: data[6] == 0, flag_byte=6)
B6_NOT_255 = Validity("byte 6 < 255", lambda raw, data: data[6] < 255, flag_byte=6)
HIGH_BIT_CLEAR = Validity("bit 7 = 0", lambda raw, data: raw < 0x80, invalid_raw=0xFF)
NOT_NEGATIVE = Validity(">= 0", lambda raw, data: raw >= 0, -1)
POSITIVE = Validity("> 0", lambda raw, data: raw > 0, invalid_raw=0)
BIT0_SET = Validity("bit 0 = 1", lambda raw, data: bool(raw & 1), invalid_raw=0)
WITHIN_MINUTE = Validity("< 60000", lambda raw, data: raw < 60000, invalid_raw=0xFFFF)
GPS_MINUTE = Validity(">= 1000", lambda raw, data: raw >= 1000, invalid_raw=0)
OMNISTAR_STATUS = Validity("byte 4 < 255", lambda raw, data: data[4] < 255, flag_byte=4)
B6_BIT7_CLEAR = Validity("bit 7 of byte 6 = 0", lambda raw, data: data[6] < 0x80, flag_byte=6, flag_valid=0x7F)
B7_BIT7_CLEAR = Validity("bit 7 of byte 7 = 0", lambda raw, data: data[7] < 0x80, flag_byte=7, flag_valid=0x7F)
LONG_RANGE = Validity("byte 6 < 150 and byte 7 > 0", lambda raw, data: data[6] < 150 and data[7] != 0, flag_byte=6)


def valid_unless(*codes: int, fresh: bool = False) -> Validity:
    """Valid unless the raw number is a code; the first is written for None. fresh: byte 6 must also be below 150."""
    text = "byte 6 < 150 and " * fresh + f"not {', '.join(map(str, codes))}"
    return Validity(text, lambda raw, data: raw not in codes and (not fresh or data[6] < 150), codes[0],
                    flag_byte=6 if fresh else None)


NIBBLE, BYTE, WORD, INT32 = valid_unless(0xF), valid_unless(0xFF), valid_unless(0xFFFF), valid_unless(-(1 << 31))
# Units send 0x8000 for an unknown undulation. The manual gives 0xFFFF, which is also a valid -5 mm: it means unknown
# only while HDOP and PDOP are invalid too.
UNDULATION = Validity("not -32768, and not -1 while HDOP and PDOP are invalid",
                      lambda raw, data: raw != -0x8000 and (raw != -1 or data[2:4] != b"\xff\xff"), -0x8000)


def _byte(name: str, first_byte: int, unit: str = "1", scale: float = 1, offset: float = 0) -> Field:
    """Field of one byte; 0xFF: invalid."""
    return F(name, "u8", first_byte, unit, scale, BYTE, offset)


def _word(name: str, first_byte: int, unit: str = "1", scale: float = 1, offset: float = 0) -> Field:
    """Field of two bytes; 0xFFFF: invalid."""
    return F(name, "u16", first_byte, unit, scale, WORD, offset)


def _triple(names: Iterable[str], kind: str, scale: float, unit: str, validity: Validity) -> list[Field]:
    """Three consecutive two-byte fields from byte 0."""
    return [F(name, kind, 2 * i, unit, scale, validity) for i, name in enumerate(names)]


def _lever_arm(prefix: str, suffix: str = "") -> list[Field]:
    """Components of a lever arm or, with suffix "Acc", their accuracies."""
    kind, scale = ("u16", 1e-4) if suffix else ("i16", 1e-3)
    return _triple([f"{prefix}{axis}{suffix}" for axis in "XYZ"], kind, scale, "m", B6_ZERO)


def _angles(prefix: str) -> list[Field]:
    return _triple([prefix + angle for angle in ("Heading", "Pitch", "Roll")], "i16", degrees(1e-4), "deg", B6_ZERO)


def _innovations(*names: str, first: int = 0) -> list[Field]:
    """Fields of Kalman filter innovations, normalised by their standard deviation."""
    return [F(name, "shifted", first + i, "sigma", 0.1, BIT0_SET) for i, name in enumerate(names)]


def _counters(*names: str) -> list[Field]:
    return [F(name, "u16", 2 * i, counter_bits=16) for i, name in enumerate(names)]


def _receiver_counters(receiver: str) -> list[Field]:
    return _counters(*(f"{receiver}.{name}" for name in ("Chars", "Pkts", "CharsSkipped", "OldPkts")))


def _receiver_status(receiver: str) -> list[Field]:
    return [F(f"{receiver}.AntStatus", "bits0+2", 0, validity=valid_unless(3)),
            F(f"{receiver}.AntPower", "bits2+2", 0, validity=valid_unless(3, 2)),
            _byte(f"{receiver}.CpuUsed", 1, "%"), _byte(f"{receiver}.CoreNoise", 2, "%"),
            _byte(f"{receiver}.SerBaud", 3), _byte(f"{receiver}.NumSats", 4),
            _byte(f"{receiver}.PosMode", 5), _byte(f"{receiver}.CoreTemp", 6, "degC", offset=-70),
            _byte(f"{receiver}.SupplyVolt", 7, "V", 0.1)]


def _nibbles(first_byte: int, low: str, high: str) -> list[Field]:
    return [F(low, "lo4", first_byte, validity=NIBBLE), F(high, "hi4", first_byte, validity=NIBBLE)]


def _trigger(channel: int) -> list[Field]:
    """Fields of the GPS time of an event (minutes, milliseconds, 4 us) and its count; see decode_event_time()."""
    name = TRIGGER_CHANNELS[channel].removesuffix("Time")
    return [F(f"{name}Minutes", "i32", 0, "min", validity=POSITIVE), F(f"{name}Milliseconds", "u16", 4, "ms"),
            F(f"{name}Fine", "i8", 6, "4 us"), F(f"{name}Count", "u8", 7, validity=POSITIVE)]


TABLE: dict[int, list[Field]] = {
    **{channel: _trigger(channel) for channel in TRIGGER_CHANNELS},
    0: [F("GpsMinutes", "i32", 0, "min", validity=GPS_MINUTE), F("GpsNumObs", "u8", 4, validity=HIGH_BIT_CLEAR),
        F("GpsPosMode", "u8", 5, validity=HIGH_BIT_CLEAR), F("GpsVelMode", "u8", 6, validity=HIGH_BIT_CLEAR),
        F("GpsAttMode", "u8", 7, validity=HIGH_BIT_CLEAR)],
    1: _innovations("InnPosX", "InnPosY", "InnPosZ", "InnVelX", "InnVelY", "InnVelZ", "InnPitch", "InnHeading"),
    2: _receiver_counters("GpsPrimary"),
    3: [*_triple(("NorthAcc", "EastAcc", "AltAcc"), "u16", 1e-3, "m", FRESH), _byte("UmacStatus", 7)],
    4: [*_triple(("VnAcc", "VeAcc", "VdAcc"), "u16", 1e-3, "m/s", FRESH),
        F("ProcessingMethod", "u8", 7, validity=POSITIVE)],
    5: _triple(("HeadingAcc", "PitchAcc", "RollAcc"), "u16", degrees(1e-5), "deg", FRESH),
    6: [*_triple(("WxBias", "WyBias", "WzBias"), "i16", degrees(5e-6), "deg/s", FRESH),
        *_nibbles(7, "GpsPrimary.NumGpsL1", "GpsPrimary.NumGpsL2")],
    7: [*_triple(("AxBias", "AyBias", "AzBias"), "i16", 1e-4, "m/s^2", FRESH),
        *_nibbles(7, "GpsSecondary.NumGpsL1", "GpsSecondary.NumGpsL2")],
    8: [*_triple(("WxSf", "WySf", "WzSf"), "i16", 1e-6, "1", FRESH),
        *_nibbles(7, "GpsExternal.NumGpsL1", "GpsExternal.NumGpsL2")],
    9: [*_triple(("WxBiasAcc", "WyBiasAcc", "WzBiasAcc"), "u16", degrees(1e-6), "deg/s", FRESH),
        *_nibbles(7, "GpsPrimary.NumGloL1", "GpsPrimary.NumGloL2")],
    # The manual swaps L1 and L2 in channel 10 only, which is probably a misprint.
    10: [*_triple(("AxBiasAcc", "AyBiasAcc", "AzBiasAcc"), "u16", 1e-5, "m/s^2", FRESH),
         *_nibbles(7, "GpsSecondary.NumGloL1", "GpsSecondary.NumGloL2")],
    11: [*_triple(("WxSfAcc", "WySfAcc", "WzSfAcc"), "u16", 1e-6, "1", FRESH),
         *_nibbles(7, "GpsExternal.NumGloL1", "GpsExternal.NumGloL2")],
    12: _triple(("GAPx", "GAPy", "GAPz"), "i16", 1e-3, "m", FRESH),
    13: [F("AtH", "i16", 0, "deg", degrees(1e-4), FRESH), F("AtP", "i16", 2, "deg", degrees(1e-4), FRESH),
         F("BaseLineLength", "u16", 4, "m", 1e-3, valid_unless(0, 0xFFFF, fresh=True)),
         *_nibbles(7, "HeadNumGpsAvailable", "HeadNumGpsUsed")],
    14: [*_triple(("GAPxAcc", "GAPyAcc", "GAPzAcc"), "u16", 1e-4, "m", FRESH),
         *_nibbles(7, "NumGpsUsedInPos", "NumGloUsedInPos")],
    15: [F("AtHAcc", "u16", 0, "deg", degrees(1e-5), FRESH), F("AtPAcc", "u16", 2, "deg", degrees(1e-5), FRESH),
         F("BaseLineLengthAcc", "u16", 4, "m", 1e-4, valid_unless(0xFFFF, fresh=True)),
         *_nibbles(7, "HeadNumGloAvailable", "HeadNumGloUsed")],
    16: [*_angles("Imu2Veh"), F("TimeUtcOffset", "shifted", 7, "s", 1, BIT0_SET)],
    17: _receiver_counters("GpsSecondary"),
    18: [F("ImuChars", "u32", 0), F("ImuPkts", "u16", 4, counter_bits=16),
         F("ImuCharsSkipped", "u16", 6, counter_bits=16)],
    19: [F("DevId", "text8", 0)],
    20: [F("GpsDiffAge", "i16", 0, "s", 0.01, valid_unless(-1)), F("BaseStationId", "text4", 2)],
    21: [F("DiskSpace", "i32", 0, "byte", 1024, NOT_NEGATIVE), F("FileSize", "i32", 4, "byte", 1024, NOT_NEGATIVE)],
    22: [_word("TimeMismatch", 0), _byte("ImuTimeDiff", 2, "ms"), _byte("ImuTimeMargin", 3, "ms"),
         _word("ImuLoopTime", 4, "ms"), _word("OpLoopTime", 6, "ms")],
    23: [_word("BnsLag", 0, "ms"), _word("UpTimeCode", 2), _byte("GPSPosReject", 4), _byte("GPSVelReject", 5),
         _byte("GPSAttReject", 6), F("PtpStatus", "u8", 7, validity=POSITIVE)],
    25: [F("OldRefX", "i24", 0, "m", 1.2e-3, valid_unless(-0x800000, 0x7FFFFF)),
         F("OldRefY", "i24", 3, "m", 1.2e-3, valid_unless(-0x800000, 0x7FFFFF)),
         F("OldRefHeading", "i16", 6, "deg", degrees(1e-4), valid_unless(-0x8000))],
    26: _lever_arm("RemoteLeverArm"),
    27: [_byte("HeadQuality", 0), _byte("HeadSearchType", 1), _byte("HeadSearchStatus", 2), _byte("HeadSearchReady", 3),
         _word("HeadSearchInit", 4), _word("HeadSearchNum", 6)],
    28: [*(_byte(f"HeadSearch{name}", i, "PRN", offset=1) for i, name in enumerate(
             ("Master", "Slave1", "Slave2", "Slave3"))),
         F("HeadSearchTime", "u16", 4, "s"), F("HeadSearchConstr", "u16", 6)],
    29: [F(f"Option{name}", "u8", i, validity=HIGH_BIT_CLEAR) for i, name in enumerate(
        ("Level", "Vibration", "GpsAcc", "Udp", "Ser1", "Ser2", "Heading", "Heave"))],
    30: [_byte("OsVersion1", 0), _byte("OsVersion2", 1), _byte("OsVersion3", 2),
         F("OsScriptId", "digits6", 3, validity=NOT_NEGATIVE), _word("SerialNumber", 6)],
    31: [_byte("ImuType", 0), _byte("GpsPrimary.Type", 1), _byte("GpsSecondary.Type", 2), _byte("InterPcbType", 3),
         _byte("FrontPcbType", 4), _byte("InterSwId", 5), _byte("HwConfig", 6),
         *(F(name, f"ibits{bit}+1", 7, validity=B7_BIT7_CLEAR) for name, bit in (
             ("PsrDiffEnabled", 0), ("SBASEnabled", 1), ("OmniVBSEnabled", 3), ("OmniHPEnabled", 4),
             ("L1DiffEnabled", 5), ("L1L2DiffEnabled", 6)))],
    32: [*_innovations("InnZeroVelX", "InnZeroVelY", "InnZeroVelZ", "InnNoSlipH", "InnHeadingH", "InnWSpeed"),
         *_innovations("InnClockOffset", "InnClockDrift", first=6)],
    33: _lever_arm("ZeroVelLeverArm"),
    34: _lever_arm("ZeroVelLeverArm", "Acc"),
    35: _lever_arm("NoSlipLeverArm"),
    36: _lever_arm("NoSlipLeverArm", "Acc"),
    37: [F("HeadingMisAlign", "i16", 0, "deg", degrees(1e-4), B6_NOT_255),
         F("HeadingMisAlignAcc", "u16", 2, "deg", degrees(1e-5), B6_NOT_255), _byte("NumSatsUsedPos", 4),
         _byte("NumSatsUsedVel", 5), _byte("NumSatsUsedAtt", 7)],
    38: [_byte("OptionSZVDelay", 0, "s"), _byte("OptionSZVPeriod", 1, "s", 0.1), _word("OptionTopSpeed", 2, "m/s", 0.5),
         _byte("OptionInitSpeed", 4, "m/s", 0.1), F("OptionSer3", "u8", 5, validity=HIGH_BIT_CLEAR)],
    39: [_byte("OptionNSDelay", 0, "s", 0.1), _byte("OptionNSPeriod", 1, "s", 0.02),
         _word("OptionNSAngleStd", 2, "deg", degrees(1e-5)), _byte("OptionNSHAccel", 4, "m/s^2", 0.04),
         _byte("OptionNSVAccel", 5, "m/s^2", 0.04), _byte("OptionNSSpeed", 6, "m/s", 0.1),
         _byte("OptionNSRadius", 7, "m", 0.5)],
    40: [F("NcomVersion", "u16", 0, validity=POSITIVE), _word("OutputLatency", 2, "s", 0.01),
         F("SerialNumber24", "u24", 4, validity=valid_unless(0xFFFFFF))],
    41: [F("OptionSer1Baud", "u8", 0), F("OptionSer2Baud", "u8", 1), F("OptionSer3Baud", "u8", 2),
         F("OptionCanBaud", "u8", 3), *(_byte(f"WifiIp{i}", 3 + i) for i in (1, 2, 3, 4))],
    42: [_byte("OptionHLDelay", 0, "s"), _byte("OptionHLPeriod", 1, "s", 0.1),
         _word("OptionHLAngleStd", 2, "deg", degrees(1e-5)), _byte("OptionStatDelay", 4, "s"),
         _byte("OptionStatSpeed", 5, "m/s", 0.01), F("GnssSources", "u8", 6, validity=HIGH_BIT_CLEAR)],
    44: [_word("WSpeedScale", 0, "pulse/m", 0.1), _word("WSpeedScaleStd", 2, "%", 0.002),
         _byte("OptionWSpeedDelay", 4, "s", 0.1), _byte("OptionWSpeedZVDelay", 5, "s", 0.1),
         _byte("OptionWSpeedNoiseStd", 6, "pulse", 0.1), _byte("WarmupStatus", 7)],
    45: [F("WSpeedCount", "u32", 0, "pulse"), F("WSpeedMilliseconds", "u16", 4, "ms", validity=WITHIN_MINUTE),
         _byte("WSpeedTimeUnchanged", 6, "s", 0.1), _byte("GadStatus", 7)],
    46: _lever_arm("WSpeedLeverArm"),
    47: _lever_arm("WSpeedLeverArm", "Acc"),
    48: [F("Undulation", "i16", 0, "m", 5e-3, UNDULATION), _byte("HDOP", 2, "1", 0.1), _byte("PDOP", 3, "1", 0.1),
         _byte("OutputDatum", 5), _byte("DatumEllipsoid", 6), _byte("DatumEarthFrame", 7)],
    49: [_word("OmniStarFreq", 0, "Hz", 1000, 1.52e9), _byte("OmniStarSNR", 2, "dB", 0.2),
         _byte("OmniStarLockTime", 3, "s"),
         *(F(f"OmniStatus{name}", f"bits{bit}+1", 4, validity=OMNISTAR_STATUS) for bit, name in enumerate((
             "VbsExpired", "VbsOutOfRegion", "VbsNoRemoteSites", "HpExpired", "HpOutOfRegion", "HpNoRemoteSites",
             "HpNotConverged", "HpKeyInvalid"))),
         F("OmniStarSerial", "u24", 5, validity=valid_unless(0xFFFFFF))],
    50: _counters("CmdChars", "CmdPkts", "CmdCharsSkipped", "CmdErrors"),
    **{channel: _lever_arm(f"SlipPoint{i}") for i, channel in enumerate((51, 52, 53, 54, 68, 69, 70, 71), 1)},
    55: _receiver_status("GpsPrimary"),
    56: _receiver_status("GpsSecondary"),
    57: _triple(("GAPx", "GAPy", "GAPz"), "i16", 1e-3, "m", LONG_RANGE),  # multiplied by byte 7, see decode_channel()
    58: _angles("VehicleToOutput"),
    59: [F("ImuMissedPkts", "u16", 0, counter_bits=16), F("ImuResetCount", "u8", 2, counter_bits=8),
         F("ImuErrorCount", "u8", 3, counter_bits=8), _word("ImuCalibrationDay", 4, "day"),
         _word("ImuTemperature", 6, "degC", 0.01, -70)],
    60: _angles("Ned2Surf"),
    61: _receiver_counters("GpsExternal"),
    62: _receiver_status("GpsExternal"),
    63: [F("AngAccFiltFreq", "f32", 0, "Hz"), F("AngAccFiltZeta", "f32", 4)],
    64: [_byte("CpuPcbType", 0), _byte("GpsExternal.Type", 1), _byte("GpsExternal.Format", 2),
         _byte("DualPortRamStatus", 3), *_nibbles(4, "GpsPrimary.PosRate", "GpsPrimary.VelRate"),
         *_nibbles(5, "GpsPrimary.RawRate", "GpsSecondary.RawRate"),
         # By the vendor's convention, a unit that sends this channel has GPS but not BeiDou; neither has a bit.
         F("GnssGpsEnabled", "bits0+0", 6, offset=1), F("GnssBeiDouEnabled", "bits0+0", 6, offset=0),
         *(F(name, f"ibits{bit}+1", 6, validity=B6_BIT7_CLEAR) for bit, name in enumerate(
             ("GnssGlonassEnabled", "GnssGalileoEnabled", "RawRngEnabled", "RawDopEnabled", "RawL1Enabled",
              "RawL2Enabled", "RawL5Enabled"))),
         _byte("ProductType", 7)],
    66: [F("RefLat", "i32", 0, "deg", 1e-7, INT32), F("RefLon", "i32", 4, "deg", 1e-7, INT32)],
    67: [F("RefAlt", "i32", 0, "m", 1e-3, INT32), F("RefHeading", "i32", 4, "deg", 1e-7, INT32)],
    72: [*_triple(("AxSf", "AySf", "AzSf"), "i16", 1e-6, "1", FRESH), *_nibbles(7, "DiffNumGpsL1", "DiffNumGpsL2")],
    73: [*_triple(("AxSfAcc", "AySfAcc", "AzSfAcc"), "u16", 1e-6, "1", FRESH),
         *_nibbles(7, "DiffNumGloL1", "DiffNumGloL2")],
    74: [F("LinAccFiltFreq", "f32", 0, "Hz"), F("LinAccFiltZeta", "f32", 4)],
    75: [_word("FirmwareExpiryDay", 0, "day"), _byte("SupplyVoltage", 2, "V", 0.2), _word("ImuRate", 3, "Hz", 0.02)],
    76: [*_counters("DiffChars", "DiffPkts", "DiffCharsSkipped"), _byte("NtripStatus", 6), _byte("WifiStatus", 7)],
    77: [_byte("DiffFormat", 0), _byte("DiffType", 1), _byte("DiffNumStations", 2)],
    78: [F("CanTx", "u16", 0, counter_bits=16), F("CanRx", "u16", 2, counter_bits=16), _byte("CanTxOkPercent", 4, "%"),
         _byte("CanRxOkPercent", 5, "%"), F("CanErrors", "u8", 6, counter_bits=8), F("CanLastError", "u8", 7)],
    85: [F("KitDevId", "u64", 0)],
    87: [F("JerkFiltType", "lo4", 0), F("JerkFiltOrder", "hi4", 0, validity=POSITIVE),
         F("JerkFiltFreq", "f32", 1, "Hz"), F("JerkFiltWindow", "u24", 5, "ms")],
    88: _innovations("InnVerticalSlip"),
    89: [*_lever_arm("VerticalSlipLeverArm"), F("WifiApStatus", "u8", 7, validity=POSITIVE)],
    90: [*_lever_arm("VerticalSlipLeverArm", "Acc"), F("WifiRegion", "u8", 7)],
    91: [F("PitchMisalign", "i16", 0, "deg", degrees(1e-4), B6_ZERO),
         F("PitchMisalignAcc", "u16", 2, "deg", degrees(1e-5), B6_ZERO)],
    93: [*_nibbles(1, "NumGalUsedInPos", "NumBdsUsedInPos"), F("NmeaEnabled", "lo4", 2), F("PtpEpoch", "hi4", 2),
         F("PpsStatus", "lo4", 3, validity=NIBBLE), F("LidarIpLastByte", "u8", 4),
         F("TimingSource", "lo4", 5, validity=NIBBLE)],
    94: [*_nibbles(0, "GpsPrimary.NumGalE1", "GpsPrimary.NumGalE5"),
         *_nibbles(1, "GpsSecondary.NumGalE1", "GpsSecondary.NumGalE5"),
         *_nibbles(2, "GpsExternal.NumGalE1", "GpsExternal.NumGalE5"),
         *_nibbles(3, "GpsPrimary.NumBdsB1", "GpsPrimary.NumBdsB2"),
         *_nibbles(4, "GpsSecondary.NumBdsB1", "GpsSecondary.NumBdsB2"),
         *_nibbles(5, "GpsExternal.NumBdsB1", "GpsExternal.NumBdsB2"), *_nibbles(6, "DiffNumGalE1", "DiffNumGalE5"),
         *_nibbles(7, "DiffNumBdsB1", "DiffNumBdsB2")],
    95: [F("GadStreamId", "u8", 0, validity=POSITIVE), _byte("GadRejected", 1),
         *_innovations("GadInn1", "GadInn2", "GadInn3", first=2), F("GadTime", "u16", 5, "s", 1e-3, WITHIN_MINUTE)],
}

FIELDS: dict[int, dict[str, Field]] = {channel: {f.name: f for f in fields} for channel, fields in TABLE.items()}
UTC_CHANNEL = 16


def decode_channel(channel: int, data: bytes) -> dict[str, Value]:
    """Values of a channel by field name, in the units of the table; None: invalid. Empty for an unknown channel.

    Counters are not unwrapped; status.StatusTracker unwraps them and adds derived values.
    """
    word = int.from_bytes(data, "little")
    values = {name: field.decode(word, data) for name, field in FIELDS.get(channel, {}).items()}
    # Byte 7 multiplies all three lengths; 0xFF means that they are saturated and not multiplied.
    if channel == LONG_RANGE_CHANNEL and values["GAPx"] is not None and data[7] != 0xFF:
        values = {name: value * data[7] for name, value in values.items()}
    return values


def decode_event_time(channel: int, data: bytes) -> int | None:
    """GPS time of an event [ns since 1980-01-06, in steps of 4 us] from the 8 bytes of a trigger channel.

    None for any other channel, a count of 0 (no event yet), and an invalid minute.
    """
    if channel not in TRIGGER_CHANNELS:
        return None
    minutes, milliseconds, fine, count = struct.unpack("<iHbB", data)
    if not 0 < minutes <= LAST_MINUTE or not count:
        return None
    return int(minutes * 60_000_000_000 + milliseconds * 1_000_000 + fine * 4_000)


def decode_utc_offset(data: bytes) -> int | None:
    """UTC - GPS time [s] from the 8 bytes of channel 16; None if invalid or positive (UTC is never ahead of GPS)."""
    offset = FIELDS[UTC_CHANNEL]["TimeUtcOffset"].decode(int.from_bytes(data, "little"), data)
    return None if offset is None or offset > 0 else int(offset)


def encode_channel(channel: int, values: Mapping[str, Value]) -> bytes:
    """The 8 bytes of a channel.

    A missing field, None or NaN is encoded as invalid, or as 0 without such a code. The multiplier of the long-range
    lever arm (channel 57) is 1, so its components are limited to 32.767 m. Raises NcomError for an unknown channel or
    field, an unscaled number out of range, or a missing field without a code if its flag byte declares others valid.
    """
    fields = FIELDS.get(channel)
    if fields is None:
        raise NcomError(f"status channel {channel} has no published layout")
    for name in values:
        if name not in fields:
            raise NcomError(f"channel {channel} has no field {name}; it has {', '.join(fields)}")
    values = {name: None if value != value else value for name, value in values.items()}  # noqa: PLR0124 - NaN
    flags = {field.validity.flag_byte: field.validity.flag_valid for name, field in fields.items()
             if values.get(name) is not None and field.validity.flag_byte is not None}
    buffer = bytearray(flags.get(k, 0xFF) for k in range(8))
    if channel == LONG_RANGE_CHANNEL:
        buffer[7] = 1
    for name, field in fields.items():
        if values.get(name) is None and field.validity.invalid_raw is None and field.validity.flag_byte in flags:
            raise NcomError(f"channel {channel}: {name} is missing; give all or none of the fields that are "
                            f"valid if {field.validity.text}")
        field.encode(buffer, values.get(name))
    return bytes(buffer)
