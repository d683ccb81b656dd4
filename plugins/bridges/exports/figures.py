"""Figures of messages as a protobuf message of doubles, which plots of any viewer can read."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Mapping

from sparseskin.messages import Message, Reconstruction, Resultant
from sparseskin.messages.base import wire_fields
from sparseskin.messages.fields import Flag, Integer, Real

PACKAGE = "sparseskin"
_OPTIONAL, _DOUBLE, _INT64, _BOOL = 1, 1, 3, 8
"""Label and types of fields in descriptor.proto of protobuf."""
_KINDS = {Real: _DOUBLE, Integer: _INT64, Flag: _BOOL}
_NOT_PLOTTED = ("run_id", "seq")


def figure_names(cls: type[Message]) -> dict[str, int]:
    """Names of the numbers of a message class, and their protobuf types; frames: the sum first."""
    found = {"total_force": _DOUBLE} if "forces" in wire_fields(cls) else {}
    for name, kind in wire_fields(cls).items():
        if type(kind) in _KINDS and name not in _NOT_PLOTTED:
            found[name] = _KINDS[type(kind)]
    return found


def figure_values(message: Message) -> dict[str, float]:
    """The numbers of a message; those that it does not have are left out, and `trusted` where
    nothing estimates it.
    """
    values = {name: getattr(message, name, None) for name in figure_names(type(message))}
    if (forces := getattr(message, "forces", None)) is not None:
        values["total_force"] = float(forces.sum(dtype="f8"))
    return {name: value for name, value in values.items() if value is not None}


def has_figures(cls: type[Message]) -> bool:
    """True if a message class has more to plot than the stamps of its frames."""
    return cls in (Reconstruction, Resultant) or "forces" in wire_fields(cls)


def encoded(cls: type[Message], values: Mapping[str, float]) -> bytes:
    """Values as the protobuf message of their class. Source: encoding.html of protobuf."""
    parts = []
    for number, (name, kind) in enumerate(figure_names(cls).items(), start=1):
        if name not in values:
            continue
        if kind == _DOUBLE:
            parts.append(_varint(number << 3 | 1) + struct.pack("<d", values[name]))
        else:
            parts.append(_varint(number << 3) + _varint(int(values[name]) & (1 << 64) - 1))
    return b"".join(parts)


def schema_name(cls: type[Message]) -> str:
    """Full name of the protobuf message of a class."""
    return f"{PACKAGE}.{cls.__name__}Figures"


def descriptor(cls: type[Message]) -> bytes:
    """FileDescriptorSet of the protobuf message of a class, proto3, its fields optional."""
    name = f"{cls.__name__}Figures"
    fields = [
        _message(
            2,
            _text(1, field)
            + _number(3, number)
            + _number(4, _OPTIONAL)
            + _number(5, kind)
            + _number(9, number - 1)  # the group of one that proto3 makes of an optional field
            + _number(17, 1),
        )
        for number, (field, kind) in enumerate(figure_names(cls).items(), start=1)
    ]
    groups = [_message(8, _text(1, f"_{field}")) for field in figure_names(cls)]
    message = _message(4, _text(1, name) + _joined(fields) + _joined(groups))
    file = _text(1, f"{PACKAGE}/{name}.proto") + _text(2, PACKAGE) + message + _text(12, "proto3")
    return _message(1, file)


def _joined(parts: Iterable[bytes]) -> bytes:
    return b"".join(parts)


def _varint(value: int) -> bytes:
    found = bytearray()
    while value > 0x7F:
        found.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*found, value])


def _number(field: int, value: int) -> bytes:
    return _varint(field << 3) + _varint(value)


def _message(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


def _text(field: int, text: str) -> bytes:
    return _message(field, text.encode())
