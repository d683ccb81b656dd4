"""The wire forms: a topic, a zero byte, and one msgpack map or the head and arrays of a frame.

A message is one buffer, which ZeroMQ carries as one part and selects by its begin. The form of
frames is in `buffers`; recordings hold maps, and a map of any message is read from the wire too.
Nothing on the wire is ever executed.
"""

import msgpack
import numpy as np

from .base import Message, omitted_fields, wire_fields
from .buffers import (
    MARK,
    Payload,
    decode_frame,
    frame_bytes,
    frame_pieces,
    is_frame,
    unpacked,
)  # fmt: skip
from .errors import FieldError, MalformedError, OversizedError, TruncatedError
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


def is_end(payload: Payload) -> bool:
    """True if a payload made by `encode` is that of an End, without decoding it."""
    return payload[1 : 1 + len(_END)] == _END


def wire_bytes(message: Message) -> bytes:
    """Turn a message into the buffer that travels."""
    # States are sent rarely: one map is enough for them.
    if is_frame(type(message)):
        return b"".join(frame_pieces(message))
    return b"\0".join(encode(message))


def received(buffer: bytes) -> tuple[bytes, Payload]:
    """Topic and payload of a buffer that came; b"" where there is none."""
    # No topic has a zero byte.
    end = buffer.find(0)
    if end < 0:
        return buffer, b""
    return buffer[:end], memoryview(buffer)[end + 1 :]


def encode(message: Message) -> tuple[bytes, bytes]:
    """Turn a message into topic and payload, one map: the form of recordings."""
    cls = type(message)
    body = {"schema": message.schema, "version": message.version}
    omitted = omitted_fields(cls)
    for name, kind in wire_fields(cls).items():
        value = message.__dict__[name]
        # A default is never an array.
        if (
            name not in omitted
            or isinstance(value, np.ndarray)
            or value != omitted[name]
        ):
            body[name] = kind.pack(value)
    return message.topic.encode(), msgpack.packb(body)


def decode(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload back into the message; its arrays are read-only views of `payload`.

    Raises MessageError, one of its subclasses, for every input that the encoders cannot have made:
    malformed, truncated, oversized, an unknown schema or version, a wrong shape, a value out of
    range, NaN or infinity, or another topic than the message's own.
    """
    # Sizes first: nothing below reads more than they allow.
    n_bytes = len(payload)
    if len(topic) > MAX_TOPIC_BYTES:
        raise OversizedError(f"topic of {len(topic)} bytes, at most {MAX_TOPIC_BYTES}")
    if n_bytes > MAX_MESSAGE_BYTES:
        raise OversizedError(f"message of {n_bytes} bytes, at most {MAX_MESSAGE_BYTES}")
    if not n_bytes:
        raise TruncatedError(
            "no payload follows the topic: the sender runs another version"
        )
    if payload[0] == MARK:
        return decode_frame(topic, payload)

    message = _of_map(unpacked(payload, dict, n_bytes))
    if message.topic.encode() != topic:
        raise FieldError(f"a message of {message.topic} came under topic {topic!r}")
    return message


def _of_map(body: dict[object, object]) -> Message:
    """Message of a map, or MessageError."""
    cls = class_of(body)
    fields = wire_fields(cls)
    omitted = omitted_fields(cls)

    sent = body.keys() - {"schema", "version"}
    # Fields that may be omitted are not missing.
    unknown = sent - fields.keys()
    missing = fields.keys() - omitted.keys() - sent
    if unknown or missing:
        names = ", ".join(sorted(map(str, unknown | missing)))
        raise MalformedError(f"{cls.schema}: missing or unknown fields {names[:200]}")

    # A field that is omitted has its default.
    values = {}
    for name, kind in fields.items():
        if name in sent:
            values[name] = kind.unpack(name, body[name])
        else:
            values[name] = omitted[name]
    return cls.assembled(values)


def size_bytes(message: Message) -> int:
    """Size on the wire in bytes, topic included."""
    if not is_frame(type(message)):
        return len(wire_bytes(message))
    return frame_bytes(message)
