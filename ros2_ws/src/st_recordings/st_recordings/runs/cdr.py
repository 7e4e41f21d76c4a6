"""Many ROS messages of one type at once: columns to serialised bytes (CDR) and back, without a Python object each.

A message whose texts and sequence lengths are the same in all instances is a fixed row of bytes. Where each number lies
in it follows from the definition and one example, so it follows a changed definition.
"""

import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

_DTYPE = {"float64": "<f8", "float32": "<f4", "int64": "<i8", "uint64": "<u8", "int32": "<i4", "uint32": "<u4",
          "int16": "<i2", "uint16": "<u2", "int8": "i1", "uint8": "u1", "byte": "u1", "char": "u1", "bool": "?"}
_STAMP = struct.Struct("<iI")
_ENCAPSULATION = 4  # bytes before the body; alignment counts from behind them


@cache
def typestore(definitions: Path) -> Typestore:
    """The types of ROS 2 Jazzy and those of the .msg files in a folder <package>/msg."""
    store = get_typestore(Stores.ROS2_JAZZY)
    package = definitions.parent.name
    types: dict[str, Any] = {}
    for file in sorted(definitions.glob("*.msg")):
        types.update(get_types_from_msg(file.read_text(), f"{package}/msg/{file.stem}"))
    store.register(types)
    return store


def with_definitions(store: Typestore, definitions: Mapping[str, tuple[str, str]], types: Iterable[str]) -> Typestore:
    """A store in which some types, and the types they use, are as a recording defines them.

    definitions: of the recording (bag_storage.Storage.definitions). The store given where nothing differs from it.
    A definition that cannot be parsed is ignored: the type is then that of the store, or unknown.
    """
    own: dict[str, Any] = {}
    for name in types:
        encoding, text = definitions.get(name, ("", ""))
        try:
            if text:
                own |= get_types_from_idl(text) if encoding == "ros2idl" else get_types_from_msg(text, name)
        except Exception:  # rosbags raises whatever its parser raises
            continue
    different = {name for name, (_, fields) in own.items()
                 if name not in store.fielddefs or _plain(store.fielddefs[name][1]) != _plain(fields)}
    if not different:
        return store
    mixed = get_typestore(Stores.EMPTY)
    try:
        mixed.register({**store.fielddefs, **own})
    except Exception:  # as above: a definition that contradicts itself
        return store
    return mixed


def _plain(fields: Any) -> list[tuple[str, Any]]:
    return [(field[0].lower(), field[1]) for field in fields]


@dataclass(frozen=True)
class Field:
    """A number, or a row of `count` numbers, at a byte of the message."""

    offset: int
    dtype: str
    count: int = 1

    @property
    def width(self) -> int:
        return int(np.dtype(self.dtype).itemsize) * self.count


class Layout:
    """Row of bytes of one message type, with the texts and sequence lengths of an example.

    template: the example, serialised. fields: path, as "pose.pose.position.x", -> place of the number; a time is one
    field under its own path ("header.stamp"), in ns outside and sec, nanosec inside.
    """

    def __init__(self, store: Typestore, type_name: str, example: Any):
        """Raises ValueError for a type with wide texts, which no message of ours has."""
        self._store = store
        self.type_name = type_name
        self.example = example
        self.template = np.frombuffer(bytes(store.serialize_cdr(example, type_name)), np.uint8)
        self.fields: dict[str, Field] = {}
        end = self._walk(type_name, example, "", 0) + _ENCAPSULATION
        if not end <= len(self.template) < end + 4:
            raise ValueError(f"{type_name}: laid out {end} bytes, serialised {len(self.template)}")
        self._fixed = np.ones(len(self.template), dtype=bool)
        self._fixed[: _ENCAPSULATION] = self._fixed[end:] = False
        for field in self.fields.values():
            self._fixed[field.offset : field.offset + field.width] = False
        edges = np.flatnonzero(np.diff(self._fixed, prepend=False, append=False)).reshape(-1, 2).tolist()
        self._spans = [(begin, end, self.template[begin:end].tobytes()) for begin, end in edges]

    def __len__(self) -> int:
        return len(self.template)

    def _walk(self, type_name: str, value: Any, path: str, at: int) -> int:
        """Notes the fields of one (nested) message; `at` and the result count from behind the encapsulation."""
        if type_name in ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration"):
            at = _aligned(at, 4)
            self.fields[path] = Field(at + _ENCAPSULATION, "<i4", 2)
            return at + 8
        prefix = f"{path}." if path else ""
        for name, (node, detail) in self._store.fielddefs[type_name][1]:
            at = self._walk_member(node, detail, getattr(value, name), prefix + name, at)
        return at

    def _walk_member(self, node: int, detail: Any, value: Any, path: str, at: int) -> int:
        if node == Nodetype.NAME:
            return self._walk(detail, value, path, at)
        if node == Nodetype.BASE:
            if detail[0] == "string":
                return _aligned(at, 4) + 4 + len(value.encode()) + 1
            return self._numbers(_DTYPE[detail[0]], 1, path, at)
        (inner, inner_detail), _ = detail
        if node == Nodetype.SEQUENCE:
            at = _aligned(at, 4) + 4
        if inner == Nodetype.BASE and inner_detail[0] != "string":
            return self._numbers(_DTYPE[inner_detail[0]], len(value), path, at) if len(value) else at
        for index, element in enumerate(value):
            at = self._walk_member(inner, inner_detail, element, f"{path}.{index}", at)
        return at

    def _numbers(self, dtype: str, count: int, path: str, at: int) -> int:
        field = Field(_aligned(at, np.dtype(dtype).itemsize) + _ENCAPSULATION, dtype, count)
        self.fields[path] = field
        return field.offset - _ENCAPSULATION + field.width

    def rows(self, n: int, columns: Mapping[str, np.ndarray]) -> np.ndarray:
        """(n, length) uint8: the messages; what no column gives is as in the example.

        columns: path -> (n,) or (n, count); times in ns.
        """
        rows = np.repeat(self.template[None, :], n, axis=0)
        for path, given in columns.items():
            field, values = self.fields[path], np.asarray(given)
            if path.endswith("stamp"):
                values = np.stack(np.divmod(values, 1_000_000_000), axis=1)
            typed = np.ascontiguousarray(values.reshape(n, field.count), dtype=field.dtype)
            rows[:, field.offset : field.offset + field.width] = typed.view(np.uint8).reshape(n, field.width)
        return rows

    def column(self, buffer: np.ndarray, starts: np.ndarray, path: str) -> np.ndarray:
        """One field of the messages that begin at `starts` in a uint8 buffer: (n,), or (n, count); times in ns."""
        field = self.fields[path]
        windows = np.ndarray((max(len(buffer) - field.width + 1, 0), field.width), np.uint8, buffer.data, 0, (1, 1))
        values = windows[starts + field.offset].view(field.dtype)
        if path.endswith("stamp"):
            return values[:, 0].astype(np.int64) * 1_000_000_000 + values[:, 1].astype(np.uint32).astype(np.int64)
        return values if field.count > 1 else values[:, 0]

    def fits_in(self, sizes: Any) -> Any:
        """Whether messages of so many bytes can have this layout: the middleware fills up to a multiple of four."""
        return (sizes >= len(self)) & (sizes < len(self) + 4)

    def fits(self, buffer: np.ndarray, starts: np.ndarray) -> bool:
        """Whether the messages at `starts` have the example's texts and sequence lengths, and so this layout."""
        return all((buffer[starts + k] == self.template[k]).all() for k in np.nonzero(self._fixed)[0])

    def fits_one(self, data: bytes) -> bool:
        """As `fits`, of one message."""
        return self.fits_in(len(data)) and all(data[begin:end] == text for begin, end, text in self._spans)

    def value(self, data: bytes, path: str) -> Any:
        """One field of one message: a number, or a row of them (a view of `data`); a time in ns."""
        field = self.fields.get(path)
        if field is None:  # a sequence of length 0
            return np.empty(0)
        if path.endswith("stamp"):
            sec, nanosec = _STAMP.unpack_from(data, field.offset)
            return sec * 1_000_000_000 + nanosec
        values = np.frombuffer(data, field.dtype, field.count, field.offset)
        return values if field.count > 1 else values[0]


class Layouts:
    """The layouts of one type whose messages differ in texts and sequence lengths: one for each combination met."""

    MAXIMUM = 64  # of one length, looked through for each message; the oldest gives way

    def __init__(self, store: Typestore, type_name: str):
        self._store = store
        self._type_name = type_name
        self._known: dict[int, list[Layout]] = {}

    def of(self, data: bytes) -> Layout:
        """Raises what rosbags raises for a damaged message."""
        known = self._known.setdefault(len(data), [])
        for layout in known:
            if layout.fits_one(data):
                return layout
        layout = Layout(self._store, self._type_name, self._store.deserialize_cdr(data, self._type_name))
        known.insert(0, layout)
        del known[self.MAXIMUM :]
        return layout


def _aligned(at: int, size: int) -> int:
    return -(-at // size) * size
