"""Reads the YAML table that assigns a canonical name, sign and unit to DBC signals, and checks it against the DBC."""

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from cantools.database.can import Message as DbcMessage
from cantools.database.can import Signal as DbcSignal
from st_core.errors import ConfigurationError
from st_core.yaml_text import suggest_key

from .checks import CHECKSUM_RULES, CheckSpec, Mode
from .extraction import EXTENDED, Data, Extractor, Field, raw_range
from .ins_time import DATE_TIME_PARTS, GPS_SECONDS_PARTS
from .units import UNITS, find_unit, list_kinds
from .yaml_reader import Entry, read_document, to_one_line

# Canonical signal name -> kind of quantity, a key of UNITS. WRAPPED_SIGNALS are wrapped to [-pi, pi).
CANONICAL_SIGNALS = {
    "steering_wheel_angle": "angle",
    "wheel_speed_front_left": "speed", "wheel_speed_front_right": "speed",
    "wheel_speed_rear_left": "speed", "wheel_speed_rear_right": "speed", "vehicle_speed": "speed",
    "ins_velocity_x": "speed", "ins_velocity_y": "speed", "ins_yaw": "angle", "ins_yaw_rate": "angular rate",
    "ins_unix_time": "time", "gps_year_of_century": "ratio", "gps_century": "ratio", "gps_month": "ratio",
    "gps_day": "ratio", "gps_hour": "time", "gps_minute": "time", "gps_second": "time", "gps_second_fraction": "time",
    "gps_time": "time", "gps_utc_offset": "time",
}
UNCONVERTED_UNITS = {"gps_hour": "h", "gps_minute": "min"}  # signal -> its only unit, which is not converted to SI
WRAPPED_SIGNALS = frozenset({"ins_yaw"})
MAX_SCALING = 1e12  # largest plausible factor or offset of a DBC signal
# Range of the steering-wheel angle to either side [rad] if the table gives none; the signal must reach half this range.
DEFAULT_STEERING_RANGE = math.radians(180)

_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
"""First bytes of a DBC -> its encoding; without them, Windows-1252, which cantools assumes."""
_MESSAGE = re.compile(r"^BO_ +(?P<id>\d+) +(?P<name>\w+) *:.*\n(?:[ \t]+SG_.*\n|[ \t]*\n(?=[ \t]+SG_))*", re.MULTILINE)
_SIGNAL_ATTRIBUTE = re.compile(r'^(?:SIG_VALTYPE_|SG_MUL_VAL_|VAL_(?= +\d+ +\w+(?: +-?\d+ +"[^"\n]*")+ *;)) +'
                               r"(?P<id>\d+) .*;", re.MULTILINE)
MAX_STANDARD_ID, MAX_EXTENDED_ID = 0x7FF, 0x1FFFFFFF


@dataclass(frozen=True)
class SignalSpec:
    """One DBC signal and its conversion: si = gain * physical + bias, with `physical` in the unit of the DBC."""

    extractor: Extractor
    name: str
    unit: str  # one of those in UNITS for its kind of quantity
    gain: float
    bias: float
    factor: float  # converts this unit to SI
    minimum: float  # [unit], with sign, scale and offset applied
    maximum: float  # [unit], with sign, scale and offset applied
    max_rate: float  # largest plausible rate of change [unit/s]
    # Extractor of the sign, if the sensor sends it separately. A sign that is 0 or not in the frame is positive.
    sign: Extractor | None = None

    @property
    def dbc(self) -> DbcSignal:
        return self.extractor.signal

    @property
    def is_limited(self) -> bool:
        """Whether the table gives a range or a maximum rate."""
        return math.isfinite(self.maximum) or math.isfinite(self.max_rate)

    @cached_property
    def named_values(self) -> tuple[float, ...]:
        """Values [unit of the DBC] other than 0 that the DBC names, such as SNA, and that are therefore not angles.
        A DBC may give the raw values of a signed signal as unsigned numbers, such as 65535."""
        raw = list(self.dbc.choices or ()) if self.name == "steering_wheel_angle" else []
        if self.dbc.is_signed:
            raw += [number - (1 << self.dbc.length) for number in raw if number >> self.dbc.length - 1 == 1]
        return tuple(value for number in raw if (value := number * self.dbc.scale + self.dbc.offset))

    def to_si(self, data: Data) -> Any:
        """The signal's value in SI units (or in UNCONVERTED_UNITS), in one frame or in all frames of a log."""
        value = self.extractor.extract(data)
        if isinstance(value, np.ndarray):
            value = np.where(np.isin(value, self.named_values), np.nan, value) if self.named_values else value
        elif value in self.named_values:
            value = math.nan
        if self.sign is not None:
            value = value * (1 - 2 * ((self.sign.extract(data) != 0) & self.sign.is_present(data)))
        value = self.gain * value + self.bias
        return (value + math.pi) % (2 * math.pi) - math.pi if self.name in WRAPPED_SIGNALS else value

    def to_physical(self, si: float) -> float:
        return (si - self.bias) / self.gain


@dataclass(frozen=True)
class MessageSpec:
    """One message of the table."""

    dbc: DbcMessage
    is_needed: bool  # required on the bus
    period: float  # nominal [s]
    timeout: float  # maximum age [s]
    signals: tuple[SignalSpec, ...]
    counter: CheckSpec | None
    checksum: CheckSpec | None
    fill: Mapping[str, int]  # raw values that only the encoder uses, by DBC name of the signal

    @property
    def name(self) -> str:
        return self.dbc.name

    @property
    def key(self) -> tuple[int, bool]:
        """(arbitration id, whether it has 29 bits)."""
        return self.dbc.frame_id, self.dbc.is_extended_frame

    @cached_property
    def timeout_ns(self) -> int:
        return int(self.timeout * 1e9)

    def to_si(self, data: Data) -> dict[str, Any]:
        """Values by canonical name. A multiplexed signal that is not in the frame is omitted, or NaN in an array."""
        values = {}
        for signal in self.signals:
            is_present = signal.extractor.is_present(data)
            if is_present is not False:
                value = signal.to_si(data)
                values[signal.name] = value if is_present is True else np.where(is_present, value, np.nan)
        return values


@dataclass(frozen=True)
class SignalTable:
    """Checked contents of a DBC and its YAML table. absent_messages: optional messages that the DBC lacks."""

    dbc_file: Path
    signals_file: Path
    database: Any
    messages: Mapping[str, MessageSpec]
    absent_messages: tuple[str, ...]

    def find_steering(self) -> tuple[MessageSpec, SignalSpec] | None:
        """Message and signal of the steering-wheel angle, preferably in a needed message; None if there is none."""
        messages = sorted(self.messages.values(), key=lambda m: not m.is_needed)
        return next(((m, s) for m in messages for s in m.signals if s.name == "steering_wheel_angle"), None)


def load_table(dbc_file: str | Path, signals_file: str | Path, needed: Sequence[str] = ()) -> SignalTable:
    """The signal table of a DBC and its YAML file, checked against each other.

    needed: message names that replace the table's own `needed` (for a bus that carries only some of the messages).
    Raises ConfigurationError for an invalid file, a unit other than the DBC's, a needed message that the DBC lacks, a
    signal that its message lacks, a layout that cannot represent the signal, or a sample that decodes to a wrong value.
    """
    dbc_path, table_path = Path(dbc_file), Path(signals_file)
    root = Entry(str(table_path), "", read_document(table_path))
    root.allow_only("messages")
    entries = root.entry("messages")
    database = load_dbc(dbc_path, entries)
    for name in needed:
        if name not in entries:
            raise ConfigurationError(f"{table_path}: needed message {name} is not in the table; it has "
                                     f"{', '.join(entries)}")
    defined = {m.name: m for m in database.messages}
    messages, absent = {}, []
    for name in entries:
        entry = entries.entry(name)
        if [m.name for m in database.messages].count(name) > 1:
            raise ConfigurationError(f"{dbc_path}: defines {name} more than once; keep one definition")
        is_stated = entry.get("needed", bool)
        is_needed = name in needed if needed else is_stated
        if name in defined:
            messages[name] = _read_message(entry, defined[name], dbc_path, is_needed)
        elif is_needed:
            raise ConfigurationError(f"{dbc_path}: has no message {name}, which "
                                     f"{'needed_messages' if needed else table_path} marks as needed"
                                     f"{suggest_key(name, defined)}")
        else:
            absent.append(name)
    return SignalTable(dbc_path, table_path, database, messages, tuple(absent))


def load_dbc(path: Path, messages: Iterable[str] = ()) -> Any:
    """cantools database of a DBC, KCD, SYM or ARXML file; from an invalid DBC, only the given messages, corrected by
    `_reduce_dbc`. Raises ConfigurationError if the file cannot be read, or the messages are invalid too."""
    try:
        content = path.read_bytes()
        kind = {".kcd": "kcd", ".sym": "sym", ".arxml": "arxml"}.get(path.suffix.lower(), "dbc")
        if match := re.match(rb"\W*<.*?(NetworkDefinition|AUTOSAR)\b", content[:4096], re.DOTALL):
            kind = "kcd" if match[1] == b"NetworkDefinition" else "arxml"  # whatever the extension
        codec = "utf-8" if kind in ("kcd", "arxml") else "cp1252"
        codec = next((name for mark, name in _BYTE_ORDER_MARKS.items() if content.startswith(mark)), codec)
        text = content.decode(codec, "replace")
    except OSError as error:
        raise ConfigurationError(f"{path}: cannot be read: {error.strerror}") from None
    try:
        return cantools.database.load_string(text, kind, strict=False)
    except Exception as error:  # cantools does not wrap the exceptions of its parsers
        reason = error
    try:
        reduced = _reduce_dbc(text, frozenset(messages))
        if reduced:
            return cantools.database.load_string(reduced, "dbc", strict=False)
    except Exception as error:
        reason = error
    raise ConfigurationError(f"{path}: is not a valid {kind.upper()}: {to_one_line(reason)}")


def _reduce_dbc(text: str, names: frozenset[str]) -> str:
    """Text of a DBC with only the named messages; "" if it has none of them. Corrects errors, common in public files,
    that cantools rejects: 29-bit identifiers without the extended flag, names like 0_COUNTER, factors like .25."""
    def add_flag(match: re.Match[str]) -> str:
        number = int(match[2])
        return f"{match[1]}{number | EXTENDED if MAX_STANDARD_ID < number <= MAX_EXTENDED_ID else number}"

    blocks = [block for block in _MESSAGE.finditer(text) if block["name"] in names]
    ids = {block["id"] for block in blocks}
    attributes = [line[0] for line in _SIGNAL_ATTRIBUTE.finditer(text) if line["id"] in ids]
    reduced = "\n".join([*(block[0] for block in blocks), "", *attributes, ""])
    reduced = re.sub(r"^((?:BO_|SIG_VALTYPE_|SG_MUL_VAL_|VAL_) +)(\d+)", add_flag, reduced, flags=re.MULTILINE)
    reduced = re.sub(r"^([ \t]+SG_ +|(?:SIG_VALTYPE_|SG_MUL_VAL_|VAL_) +\d+ +)(?=\d)", r"\1_", reduced,
                     flags=re.MULTILINE)
    reduced = re.sub(r"(?<=[(\[,|])(-?)(?=\.\d)", r"\g<1>0", reduced)
    return f'VERSION ""\n\nBS_:\n\nBU_: X\n\n{reduced}' if blocks else ""


def _read_message(entry: Entry, dbc: DbcMessage, dbc_path: Path, is_needed: bool) -> MessageSpec:
    entry.allow_only("needed", "period", "timeout", "counter", "checksum", "fill", "samples", "signals")
    if dbc.is_container:
        raise ConfigurationError(f"{dbc_path}: {dbc.name} is a container of other messages, which is not supported")
    try:
        dbc.refresh(strict=True)  # rejects signals that overlap or are outside the message
    except Exception as error:  # any type, as in load_dbc
        raise ConfigurationError(f"{dbc_path}: {dbc.name}: {to_one_line(error)}") from None
    for signal in dbc.signals:
        if signal.start < 0:
            raise ConfigurationError(f"{dbc_path}: {dbc.name}.{signal.name}: start bit {signal.start} is negative")
        if not all(abs(number) <= MAX_SCALING for number in (signal.scale, signal.offset)):
            raise ConfigurationError(f"{dbc_path}: {dbc.name}.{signal.name}: factor or offset beyond {MAX_SCALING:g}")
    signal_entries = entry.entry("signals")
    signals = tuple(_read_signal(signal_entries.entry(name), dbc, _find_signal(dbc, name, dbc_path, entry), dbc_path)
                    for name in signal_entries)
    parts = {s.name for s in signals if s.name.startswith("gps_")}
    if parts and parts not in (set(DATE_TIME_PARTS), set(GPS_SECONDS_PARTS)):
        raise entry.error("signals", f"GPS time needs all of {', '.join(GPS_SECONDS_PARTS)} or all of "
                          f"{', '.join(DATE_TIME_PARTS)}")
    fill = entry.entry("fill") if "fill" in entry else None
    for sample in entry.entries("samples"):
        _check_sample(sample, dbc, signals, dbc_path)
    return MessageSpec(
        dbc=dbc, is_needed=is_needed, signals=signals,
        period=entry.duration("period", 0.0005, 60.0), timeout=entry.duration("timeout", 0.001, 600.0),
        counter=_read_check(entry, "counter", dbc, dbc_path), checksum=_read_check(entry, "checksum", dbc, dbc_path),
        fill={} if fill is None else {name: fill.integer(
            name, 0, 2 ** _find_signal(dbc, name, dbc_path, entry).length - 1) for name in fill})


def _find_signal(dbc: DbcMessage, name: str, dbc_path: Path, entry: Entry) -> DbcSignal:
    if (signal := next((s for s in dbc.signals if s.name == name), None)) is not None:
        return signal
    raise ConfigurationError(f"{dbc_path}: {dbc.name} has no signal {name}, which {entry.origin} names; "
                             f"it has {', '.join(s.name for s in dbc.signals)}")


def _read_signal(entry: Entry, message: DbcMessage, dbc: DbcSignal, dbc_path: Path) -> SignalSpec:
    entry.allow_only("name", "unit", "sign", "sign_signal", "scale", "offset", "range", "max_rate")
    name = entry.choice("name", CANONICAL_SIGNALS)
    unit, factor = _read_unit(entry, name, dbc, dbc_path)
    direction = entry.choice("sign", (1, -1))
    scale = entry.number("scale", 0.01, 100.0, default=1.0)
    offset = entry.number("offset", -1e6, 1e6, default=0.0)
    low, high = entry.interval("range", default=(-math.inf, math.inf))
    sign = entry.get("sign_signal", str) if "sign_signal" in entry else None
    spec = SignalSpec(
        extractor=Extractor(message, dbc), name=name, unit=unit, gain=direction * scale * factor,
        bias=offset * factor, factor=factor, minimum=low, maximum=high,
        max_rate=entry.number("max_rate", 0.0, 1e9, default=math.inf),
        sign=None if sign is None else Extractor(message, _find_signal(message, sign, dbc_path, entry)))
    _check_span(spec, entry, dbc_path)
    return spec


def _read_unit(entry: Entry, name: str, dbc: DbcSignal, dbc_path: Path) -> tuple[str, float]:
    """(unit of a signal, factor to SI). Raises ConfigurationError if the unit contradicts the name or the DBC."""
    text, kind = entry.get("unit", str), CANONICAL_SIGNALS[name]
    possible = [UNCONVERTED_UNITS[name]] if name in UNCONVERTED_UNITS else list(UNITS[kind])
    unit, dbc_unit = find_unit(kind, text), dbc.unit or ""
    if unit not in possible:
        missing = f", and {dbc_path} gives no unit" if not dbc.unit and not text else ""
        raise entry.error("unit", f"{text!r} is not a unit of {kind} ({name}){missing}; "
                          f"write {' or '.join(map(repr, possible))}, the unit of the sensor")
    if list_kinds(dbc_unit) and find_unit("ratio", dbc_unit) != "1" and find_unit(kind, dbc_unit) != unit:
        raise entry.error("unit", f"{text!r}, but {dbc_path} gives {dbc.unit!r}")
    return unit, 1.0 if name in UNCONVERTED_UNITS else UNITS[kind][unit][0]


def _check_span(spec: SignalSpec, entry: Entry, dbc_path: Path) -> None:
    """Raises ConfigurationError if the signal, such as an unsigned one, cannot reach half of its range on each side."""
    low, high, expectation = spec.minimum, spec.maximum, f"{entry.origin} ({entry.path}.range) expects"
    if not math.isfinite(high) and spec.name == "steering_wheel_angle":
        low, high = -DEFAULT_STEERING_RANGE / spec.factor, DEFAULT_STEERING_RANGE / spec.factor
        expectation = f"without {entry.path}.range in {entry.origin} the default range is"
    if not math.isfinite(high) or spec.dbc.is_float:
        return
    physical = [raw * spec.dbc.scale + spec.dbc.offset for raw in raw_range(spec.dbc)]
    if spec.sign is not None:
        physical += [-value for value in physical]
    ends = [(spec.gain * value + spec.bias) / spec.factor for value in physical]
    # Half of the range suffices, because some sensors do not cover the whole range; no sensor covers less than half.
    if min(ends) > low / 2 or max(ends) < high / 2:
        order = "low byte first" if spec.dbc.byte_order == "little_endian" else "high byte first"
        raise ConfigurationError(
            f"{dbc_path}: {spec.dbc.name} can only decode to {min(ends):g} .. {max(ends):g} {spec.unit}, but "
            f"{expectation} {low:g} .. {high:g}: correct its layout "
            f"({spec.dbc.length} bits, {order}, {'signed' if spec.dbc.is_signed else 'unsigned'}, "
            f"factor {spec.dbc.scale:g}) or, if another signal contains the sign, name that one as sign_signal")


def _read_check(message: Entry, key: str, dbc: DbcMessage, dbc_path: Path) -> CheckSpec | None:
    """The "counter" or "checksum" of a message; None if the table gives none."""
    if key not in message:
        return None
    entry = message.entry(key)
    entry.allow_only(*(("signal", "rule", "check") if key == "checksum" else ("signal", "check")))
    signal = _find_signal(dbc, entry.get("signal", str), dbc_path, entry)
    field = Field.from_signal(signal)
    if signal.is_signed or signal.is_float or field.high_bytes:
        raise entry.error("signal", f"{signal.name} cannot be a counter or checksum: it must be unsigned and within "
                          f"one byte in {dbc_path}")
    bits, rule = CHECKSUM_RULES[entry.choice("rule", CHECKSUM_RULES)] if key == "checksum" else (field.bits, None)
    if bits != field.bits:
        raise entry.error("rule", f"needs {bits} bits, but {signal.name} has {field.bits}")
    return CheckSpec(signal.name, field, Mode(entry.choice("check", [str(m) for m in Mode])), rule)


def _check_sample(entry: Entry, dbc: DbcMessage, signals: tuple[SignalSpec, ...], dbc_path: Path) -> None:
    """Raises ConfigurationError if a sample does not decode to its value, apart from the sign (see steering_sign)."""
    entry.allow_only("data", "signal", "value", "unit")
    try:
        data = bytes.fromhex(entry.get("data", str))
    except ValueError:
        raise entry.error("data", "not hexadecimal bytes") from None
    spec = {s.dbc.name: s for s in signals}[entry.choice("signal", [s.dbc.name for s in signals])]
    expected = entry.number("value", -1e9, 1e9)
    entry.choice("unit", (spec.unit,))
    frame = f"the recorded frame {data.hex(' ').upper()} of {dbc.name}"
    if len(data) != dbc.length:
        raise entry.error("data", f"{frame} has {len(data)} bytes, but the DBC gives {dbc.length}")
    value = (spec.gain * spec.extractor.extract(data) + spec.bias) / spec.factor
    if not math.isclose(abs(value), abs(expected), rel_tol=1e-6, abs_tol=abs(spec.dbc.scale) / 2):
        raise ConfigurationError(
            f"{dbc_path}: {spec.dbc.name} decodes {frame} incorrectly: {value:g} {spec.unit} instead of {expected:g} "
            f"({entry.origin}: {entry.path}); correct its layout or factor in the DBC, or the entries in the table")
