"""The wire forms: a topic, a zero byte, and one msgpack map or the head and arrays of a frame.

A message is one buffer, which ZeroMQ carries as one part and selects by its begin. The form of
frames is in `buffers`; recordings hold maps, and a map of any message is read from the wire too.
Nothing on the wire is ever executed.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack
import numpy as np

from .base import Message, omitted_fields, once_a_class, wire_fields
from .buffers import MARK, Payload, decode_frame, frame_pieces, is_frame, unpacked
from .errors import (
    FieldError,
    MalformedError,
    OversizedError,
    TruncatedError,
)
from .fields import MAX_ELEMENTS
from .schemas import SCHEMAS, class_of
from .state import End
from .topics import MAX_TOPIC_BYTES

__all__ = [
    "MAX_MESSAGE_BYTES", "SCHEMAS", "Payload", "decode", "encode", "is_end", "received",
    "size_bytes", "wire_bytes",
]  # fmt: skip

MAX_MESSAGE_BYTES = 8 * MAX_ELEMENTS + 65536
"""Largest payload, bytes: two of the largest float32 arrays and room for the other fields."""

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


def is_end(payload: Payload) -> bool:
    """True if a payload made by `encode` is that of an End, without decoding it."""
    return payload[1 : 1 + len(_END)] == _END


def wire_bytes(message: Message) -> bytes:
    """Turn a message into the buffer that travels."""
    if is_frame(type(message)):
        return b"".join(frame_pieces(message))
    return b"\0".join(encode(message))


def received(buffer: bytes) -> tuple[bytes, Payload]:
    """Topic and payload of a buffer that came; b"" where there is none."""
    end = buffer.find(0)
    if end < 0:
        return buffer, b""
    return buffer[:end], memoryview(buffer)[end + 1 :]


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
    n_bytes = len(payload)
    if len(topic) > MAX_TOPIC_BYTES:
        raise OversizedError(f"topic of {len(topic)} bytes, at most {MAX_TOPIC_BYTES}")
    if n_bytes > MAX_MESSAGE_BYTES:
        raise OversizedError(f"message of {n_bytes} bytes, at most {MAX_MESSAGE_BYTES}")
    if not n_bytes:
        raise TruncatedError("no payload follows the topic: the sender runs another version")
    if payload[0] == MARK:
        return decode_frame(topic, payload)
    body: dict[object, object] = unpacked(payload, dict, n_bytes)
    form = _form(class_of(body))
    values = {name: value for name, value in form.omitted.items() if name not in body}
    if body.keys() | values.keys() != form.keys:
        names = ", ".join(sorted(str(key) for key in (body.keys() | values.keys()) ^ form.keys))
        raise MalformedError(f"{form.cls.schema}: missing or unknown fields {names[:200]}")
    values |= {name: unpack(name, body[name]) for name, unpack in form.unpacks if name in body}
    message = form.cls.assembled({name: values[name] for name, _ in form.unpacks})
    if message.topic.encode() != topic:
        raise FieldError(f"a message of {message.topic} came under topic {topic!r}")
    return message


def size_bytes(message: Message) -> int:
    """Size on the wire in bytes, topic included."""
    if not is_frame(type(message)):
        return len(wire_bytes(message))
    return sum(getattr(one, "nbytes", None) or len(one) for one in frame_pieces(message))
