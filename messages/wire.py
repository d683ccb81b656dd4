"""The wire form: a topic and one msgpack map. Nothing on the wire is ever executed."""

from __future__ import annotations

import msgpack
import numpy as np

from .base import Message, omitted_fields, wire_fields
from .errors import (
    FieldError,
    MalformedError,
    OversizedError,
    TruncatedError,
    UnknownSchemaError,
    VersionError,
)
from .fields import MAX_ELEMENTS, FieldKind
from .frames import Measurements, Reconstruction, Resultant, Taxels, Truth
from .state import End, PhiState, SkinState, SolverState
from .topics import MAX_TOPIC_BYTES

MAX_MESSAGE_BYTES = 8 * MAX_ELEMENTS + 65536
"""Largest payload: two of the largest float32 arrays and room for the other fields."""

SCHEMAS: dict[str, type[Message]] = {
    cls.schema: cls
    for cls in (
        SkinState,
        Truth,
        Taxels,
        PhiState,
        Measurements,
        SolverState,
        Resultant,
        Reconstruction,
        End,
    )
}


def encode(message: Message) -> tuple[bytes, bytes]:
    """Turn a message into its two wire parts, (topic, payload)."""
    body: dict[str, object] = {"schema": message.schema, "version": message.version}
    omitted = omitted_fields(type(message))
    for name, kind in wire_fields(type(message)).items():
        value = getattr(message, name)
        # The default stands for itself: an array is never one.
        if name not in omitted or isinstance(value, np.ndarray) or value != omitted[name]:
            body[name] = kind.pack(value)
    return message.topic.encode(), msgpack.packb(body, use_bin_type=True)


def decode(topic: bytes, payload: bytes) -> Message:
    """Turn two wire parts back into the message they came from.

    Arrays in it are read-only views of `payload`.

    Raises
    ------
    MessageError
        One of its subclasses for every input that `encode` cannot have made: malformed,
        truncated, oversized, of an unknown schema or version, of a wrong shape, with a
        value out of range, with NaN or infinity, or under another topic than its own.
    """
    if len(topic) > MAX_TOPIC_BYTES:
        raise OversizedError(f"topic of {len(topic)} bytes, at most {MAX_TOPIC_BYTES}")
    if len(payload) > MAX_MESSAGE_BYTES:
        raise OversizedError(f"message of {len(payload)} bytes, at most {MAX_MESSAGE_BYTES}")
    body = _unpack(payload)
    cls, fields = _schema_of(body)
    body = omitted_fields(cls) | body
    if body.keys() != fields.keys() | {"schema", "version"}:
        names = sorted(str(key) for key in body.keys() ^ (fields.keys() | {"schema", "version"}))
        raise MalformedError(f"{cls.schema}: missing or unknown fields {', '.join(names)[:200]}")
    message = cls.assembled({name: kind.unpack(name, body[name]) for name, kind in fields.items()})
    if message.topic.encode() != topic:
        raise FieldError(f"a message of {message.topic} came under topic {topic!r}")
    return message


def size_bytes(message: Message) -> int:
    """How many bytes the message takes on the wire, topic and payload."""
    return sum(map(len, encode(message)))


def _unpack(payload: bytes) -> dict[object, object]:
    try:
        body = msgpack.unpackb(
            payload,
            raw=False,
            strict_map_key=True,
            max_str_len=4096,
            max_array_len=16,
            max_map_len=64,
            max_ext_len=0,
        )
    except msgpack.exceptions.ExtraData as error:
        raise MalformedError("more than one msgpack object in a message") from error
    except Exception as error:  # msgpack promises no narrower family for hostile bytes
        if "incomplete" in str(error):
            raise TruncatedError(f"message cut off after {len(payload)} bytes") from error
        raise MalformedError(f"not a msgpack map: {str(error)[:120]}") from error
    if not isinstance(body, dict):
        raise MalformedError(f"expected one msgpack map, got {type(body).__name__}")
    return body


def _schema_of(body: dict[object, object]) -> tuple[type[Message], dict[str, FieldKind]]:
    name, version = body.get("schema"), body.get("version")
    if not isinstance(name, str) or name not in SCHEMAS:
        raise UnknownSchemaError(f"schema {str(name)[:64]!r} (known: {', '.join(SCHEMAS)})")
    cls = SCHEMAS[name]
    if type(version) is not int or version != cls.version:
        raise VersionError(f"{name}: version {str(version)[:20]}, this program reads {cls.version}")
    return cls, wire_fields(cls)
