"""The wire form: a topic and one msgpack map. Nothing on the wire is ever executed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from .base import Message, omitted_fields, once_a_class, wire_fields
from .batches import BATCHES
from .errors import (
    FieldError,
    MalformedError,
    OversizedError,
    TruncatedError,
    UnknownSchemaError,
    VersionError,
)
from .fields import MAX_ELEMENTS
from .frames import Measurements, Reconstruction, Resultant, Taxels, Truth
from .state import Calibration, End, PhiState, SkinState, SolverState
from .topics import MAX_TOPIC_BYTES

MAX_MESSAGE_BYTES = 8 * MAX_ELEMENTS + 65536
"""Largest payload, bytes: two of the largest float32 arrays and room for the other fields."""

_CLASSES: tuple[type[Message], ...] = (
    *(SkinState, Calibration, Truth, Taxels, PhiState, Measurements),
    *(SolverState, Resultant, Reconstruction, End),
    *BATCHES.values(),
)
SCHEMAS: dict[str, type[Message]] = {cls.schema: cls for cls in _CLASSES}
"""Message classes by schema name."""

_END: bytes = msgpack.packb("schema") + msgpack.packb(End.schema)
"""Bytes after the first one, the number of fields, in the payload of an End."""


@dataclass(frozen=True)
class _Form:
    """Keys, packers and unpackers of a message class."""

    cls: type[Message]
    keys: frozenset[object]
    omitted: dict[str, Any]
    packs: tuple[tuple[str, Callable[[Any], Any]], ...]
    unpacks: tuple[tuple[str, Callable[[str, Any], Any]], ...]


@once_a_class
def _form(cls: type[Message]) -> _Form:
    fields = wire_fields(cls)
    return _Form(
        cls=cls,
        keys=frozenset({"schema", "version", *fields}),
        omitted=omitted_fields(cls),
        packs=tuple(
            (name, kind.pack) for name, kind in fields.items() if not kind.travels_as_it_is
        ),
        unpacks=tuple(
            (name, kind.check if kind.travels_as_it_is else kind.unpack)
            for name, kind in fields.items()
        ),
    )


def is_end(payload: bytes) -> bool:
    """True if a payload made by `encode` is that of an End, without decoding it."""
    return payload[1 : 1 + len(_END)] == _END


def encode(message: Message) -> tuple[bytes, bytes]:
    """Turn a message into its two wire parts, (topic, payload)."""
    form = _form(type(message))
    # The attributes of a message are its fields, in order of declaration.
    body = {"schema": message.schema, "version": message.version, **message.__dict__}
    for name, default in form.omitted.items():
        # A default is never an array.
        if not isinstance(body[name], np.ndarray) and body[name] == default:
            del body[name]
    for name, pack in form.packs:
        if name in body:
            body[name] = pack(body[name])
    return message.topic.encode(), msgpack.packb(body)


def decode(topic: bytes, payload: bytes) -> Message:
    """Turn two wire parts back into the message; its arrays are read-only views of `payload`.

    Raises
    ------
    MessageError
        One of its subclasses for every input that `encode` cannot have made: malformed,
        truncated, oversized, an unknown schema or version, a wrong shape, a value out of range,
        NaN or infinity, or another topic than the message's own.
    """
    if len(topic) > MAX_TOPIC_BYTES:
        raise OversizedError(f"topic of {len(topic)} bytes, at most {MAX_TOPIC_BYTES}")
    if len(payload) > MAX_MESSAGE_BYTES:
        raise OversizedError(f"message of {len(payload)} bytes, at most {MAX_MESSAGE_BYTES}")
    body = _unpack(payload)
    form = _form(_class_of(body))
    for name, default in form.omitted.items():
        body.setdefault(name, default)
    if body.keys() != form.keys:
        names = ", ".join(sorted(str(key) for key in body.keys() ^ form.keys))
        raise MalformedError(f"{form.cls.schema}: missing or unknown fields {names[:200]}")
    message = form.cls.assembled({name: unpack(name, body[name]) for name, unpack in form.unpacks})
    if message.topic.encode() != topic:
        raise FieldError(f"a message of {message.topic} came under topic {topic!r}")
    return message


def size_bytes(message: Message) -> int:
    """Size on the wire in bytes, topic and payload."""
    return sum(map(len, encode(message)))


def _unpack(payload: bytes) -> dict[object, object]:
    try:
        limits = {"max_str_len": 4096, "max_array_len": 16, "max_map_len": 64, "max_ext_len": 0}
        body = msgpack.unpackb(payload, raw=False, strict_map_key=True, **limits)
    except msgpack.exceptions.ExtraData as error:
        raise MalformedError("more than one msgpack object in a message") from error
    except Exception as error:  # msgpack documents no narrower class for malformed bytes
        if "incomplete" in str(error):
            raise TruncatedError(f"message cut off after {len(payload)} bytes") from error
        raise MalformedError(f"not a msgpack map: {str(error)[:120]}") from error
    if not isinstance(body, dict):
        raise MalformedError(f"expected one msgpack map, got {type(body).__name__}")
    return body


def _class_of(body: dict[object, object]) -> type[Message]:
    name, version = body.get("schema"), body.get("version")
    if not isinstance(name, str) or name not in SCHEMAS:
        raise UnknownSchemaError(f"schema {str(name)[:64]!r} (known: {', '.join(SCHEMAS)})")
    cls = SCHEMAS[name]
    if type(version) is not int or version != cls.version:
        raise VersionError(f"{name}: version {str(version)[:20]}, this program reads {cls.version}")
    return cls
