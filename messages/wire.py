"""The wire forms: a topic and one msgpack map, or for frames a head and arrays (`parts`).

Frames travel in parts; recordings hold maps, and a map of any message is read from the wire too.
Nothing on the wire is ever executed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from .base import Message, omitted_fields, once_a_class, wire_fields
from .errors import (
    FieldError,
    MalformedError,
    OversizedError,
)
from .fields import MAX_ELEMENTS
from .parts import Parts, decode_parts, encode_parts, travels_in_parts, unpacked
from .schemas import SCHEMAS, class_of
from .state import End
from .topics import MAX_TOPIC_BYTES

__all__ = [
    "MAX_MESSAGE_BYTES", "SCHEMAS", "Payload", "decode", "encode", "is_end", "payload_of",
    "size_bytes", "wire_parts",
]  # fmt: skip

MAX_MESSAGE_BYTES = 8 * MAX_ELEMENTS + 65536
"""Largest payload, bytes: two of the largest float32 arrays and room for the other fields."""

MAX_PARTS = 16
"""Largest number of parts, its topic included."""

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


Payload = bytes | Parts
"""A message as received, without its topic: one map, or head and arrays."""


def is_end(payload: Payload) -> bool:
    """True if a payload made by `encode` is that of an End, without decoding it."""
    return isinstance(payload, bytes) and payload[1 : 1 + len(_END)] == _END


def wire_parts(message: Message) -> tuple[Any, ...]:
    """Turn a message into the parts that travel: its topic first, and bytes or arrays of them."""
    return encode_parts(message) if travels_in_parts(type(message)) else encode(message)


def payload_of(parts: Sequence[bytes]) -> Payload:
    """Payload of the parts of a received message, its topic first; b"" where there is none."""
    if len(parts) == 2:
        return parts[1]
    return tuple(parts[1:]) if 2 < len(parts) <= MAX_PARTS else b""


def encode(message: Message) -> tuple[bytes, bytes]:
    """Turn a message into topic and payload, one map: the form of recordings."""
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


def decode(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload back into the message; its arrays are read-only views of `payload`.

    Raises
    ------
    MessageError
        One of its subclasses for every input that the encoders cannot have made: malformed,
        truncated, oversized, an unknown schema or version, a wrong shape, a value out of range,
        NaN or infinity, or another topic than the message's own.
    """
    if len(topic) > MAX_TOPIC_BYTES:
        raise OversizedError(f"topic of {len(topic)} bytes, at most {MAX_TOPIC_BYTES}")
    n_bytes = len(payload) if isinstance(payload, bytes) else sum(map(len, payload))
    if n_bytes > MAX_MESSAGE_BYTES:
        raise OversizedError(f"message of {n_bytes} bytes, at most {MAX_MESSAGE_BYTES}")
    if not isinstance(payload, bytes):
        return decode_parts(topic, payload)
    body: dict[object, object] = unpacked(payload, dict, n_bytes)
    form = _form(class_of(body))
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
    """Size on the wire in bytes, topic and all other parts."""
    return sum(getattr(part, "nbytes", None) or len(part) for part in wire_parts(message))
