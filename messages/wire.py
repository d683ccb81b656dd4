"""The wire form: a topic, a zero byte, and one msgpack map of a message's fields.

A message is one buffer, which ZeroMQ carries as one part and selects by its begin. Recordings hold
the same maps. Nothing on the wire is ever executed.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack

from .base import Message, omitted_fields, wire_fields
from .errors import FieldError, MalformedError, OversizedError, TruncatedError
from .fields import MAX_ELEMENTS
from .schemas import SCHEMAS, class_of
from .state import End
from .topics import MAX_PATCHES, MAX_TOPIC_BYTES

__all__ = [
    "MAX_MESSAGE_BYTES", "SCHEMAS", "Payload", "decode", "encode", "head_of", "is_end",
    "received", "size_bytes", "size_of", "wire_bytes",
]  # fmt: skip

Payload = bytes | memoryview
"""A message as received, without its topic and the zero byte behind it."""

MAX_MESSAGE_BYTES = 8 * MAX_ELEMENTS + 65536
"""Largest payload, bytes: two of the largest float32 arrays and room for the other fields."""
_LIMITS = {
    "max_str_len": 4096,
    "max_array_len": MAX_PATCHES,
    "max_map_len": 64,
    "max_ext_len": 0,
}
_MARKS = frozenset({"schema", "version"})
"""Keys of a map that are no fields of the message."""
_END: bytes = msgpack.packb("schema") + msgpack.packb(End.schema)
"""Bytes after the first one, the number of fields, in the payload of an End."""
_N_FORMS = 256
"""Sets of fields that are known at a time: a graph has some ten."""


def is_end(payload: Payload) -> bool:
    """True if a payload made by `encode` is that of an End, without decoding it."""
    return payload[1 : 1 + len(_END)] == _END


def wire_bytes(message: Message) -> bytes:
    """Turn a message into the buffer that travels."""
    return b"\0".join(encode(message))


def received(buffer: bytes) -> tuple[bytes, Payload]:
    """Topic and payload of a buffer that came; b"" where there is none."""
    # No topic has a zero byte.
    end = buffer.find(0)
    if end < 0:
        return buffer, b""
    return buffer[:end], memoryview(buffer)[end + 1 :]


class _Latest:
    """The message that was encoded or decoded last, and its size in bytes: a node that counts bytes
    asks for it next.
    """

    #: Replaced as a whole: threads may share it.
    entry: tuple[Message | None, int] = (None, 0)


def encode(message: Message) -> tuple[bytes, bytes]:
    """Turn a message into topic and payload, one map: the form of recordings."""
    topic = message.topic.encode()
    payload: bytes = msgpack.packb(_map_of(message))
    _Latest.entry = message, size_of(topic, payload)
    return topic, payload


def _map_of(message: Message) -> dict[str, Any]:
    cls = type(message)
    values = message.__dict__
    body = {"schema": cls.schema, "version": cls.version}
    omitted = omitted_fields(cls)
    for name, kind in wire_fields(cls).items():
        value = values[name]
        if name in omitted and kind.is_default(value, omitted[name]):
            continue
        body[name] = kind.pack(value)
    return body


def size_bytes(message: Message) -> int:
    """Size on the wire in bytes, topic included."""
    latest, n_bytes = _Latest.entry
    if latest is message:
        return n_bytes
    return size_of(*encode(message))


def size_of(topic: bytes, payload: Payload) -> int:
    """Size on the wire in bytes of what `encode` returned, or `received`."""
    # With the zero byte between them.
    return len(topic) + 1 + len(payload)


def decode(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload back into the message; its arrays are read-only.

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

    message = _of_map(_unpacked(payload))
    if message.topic.encode() != topic:
        raise FieldError(f"a message of {message.topic} came under topic {topic!r}")
    _Latest.entry = message, size_of(topic, payload)
    return message


def head_of(payload: Payload) -> tuple[str, int, int, bool]:
    """Run id, sequence number and stamp of a message, unchecked, and True if it ends its stream;
    the number is then that of its messages. Raises MessageError if it is no map, KeyError if it
    lacks a field.
    """
    body = _unpacked(payload)
    ends = body["schema"] == End.schema
    seq = body["n_messages" if ends else "seq"]
    return str(body["run_id"]), seq, body["stamp_ns"], ends


def _unpacked(payload: Payload) -> dict[str, Any]:
    """The msgpack map of a payload, its values unchecked, or MessageError."""
    n_bytes = len(payload)
    try:
        body = msgpack.unpackb(payload, raw=False, strict_map_key=True, **_LIMITS)
    except msgpack.exceptions.ExtraData as error:
        raise MalformedError("more than one msgpack object in a message") from error
    # msgpack documents no narrower class for malformed bytes, and none for bytes that end early.
    except Exception as error:
        if "incomplete" in str(error):
            raise TruncatedError(f"message cut off after {n_bytes} bytes") from error
        reason = str(error)[:120] or type(error).__name__
        raise MalformedError(f"not a msgpack map: {reason}") from error
    if not isinstance(body, dict):
        text = f"expected one msgpack map, got {type(body).__name__}"
        raise MalformedError(text)
    return body


@dataclass(frozen=True)
class _Form:
    """Fields that a message of a class was sent with: the function that reads each, and all fields
    in their order, those that are omitted with their default.
    """

    fields: tuple[tuple[str, Callable[[str, Any], Any]], ...]
    values: dict[str, Any]


# From frame to frame the same fields come: what follows from their names is looked up once. A set
# that is refused is not kept, so that hostile messages fill no memory.
@functools.lru_cache(maxsize=_N_FORMS)
def _form_of(schema: str, keys: tuple[str, ...]) -> _Form:
    """Form of a message of a known schema with these keys, or MalformedError."""
    cls = SCHEMAS[schema]
    fields = wire_fields(cls)
    omitted = omitted_fields(cls)

    sent = set(keys) - _MARKS
    # Fields that may be omitted are not missing.
    unknown = sent - fields.keys()
    missing = fields.keys() - omitted.keys() - sent
    if unknown or missing:
        names = ", ".join(sorted(map(str, unknown | missing)))
        raise MalformedError(f"{cls.schema}: missing or unknown fields {names[:200]}")

    readers = []
    values = {}
    for name, kind in fields.items():
        values[name] = omitted.get(name)
        if name in sent:
            readers.append((name, kind.unpack))
    return _Form(tuple(readers), values)


def _of_map(body: dict[Any, Any]) -> Message:
    """Message of a map, or MessageError."""
    cls = class_of(body)
    form = _form_of(cls.schema, tuple(body))
    values = form.values.copy()
    for name, unpack in form.fields:
        values[name] = unpack(name, body[name])
    return cls.assembled(values)
