"""The wire form of frames: one buffer of a topic, a small head, and the arrays.

It is the topic, a zero byte, `MARK`, the size of the head (16 bits, little-endian), the head, and
the arrays, each from a multiple of `ALIGNMENT` bytes on. The head is a msgpack list: the
description of the stream, and the numbers of the frame. The description is a msgpack map of
everything that stays the same from frame to frame: schema, version, texts, and dtype and shape of
each array. It is checked when it first arrives; after that equal bytes stand for it. Numbers are
checked in each frame, arrays by their size, and for being finite.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack

from .base import Message, once_a_class, wire_fields
from .errors import FieldError, MalformedError, OversizedError, TruncatedError, VersionError
from .fields import Array, FieldKind, Text
from .schemas import class_of
from .topics import topic_of

Payload = bytes | memoryview
"""A message as received, without its topic and the zero byte behind it."""

WIRE_VERSION = 3
"""Version of this form; 1 was one map a message, which states and recordings are still."""
MARK = 0xC1
"""First byte of a frame after its topic; msgpack begins no object with it."""
ALIGNMENT = 16
"""Arrays begin at a multiple of this many bytes from the begin of the topic: received into memory
that is aligned, they need no copy. Chosen: as malloc aligns, and wider than any dtype."""
MAX_HEAD_BYTES = 8192
MAX_STREAMS = 1024
"""Number of descriptions that are known at a time."""
_LIMITS = {"max_str_len": 4096, "max_array_len": 64, "max_map_len": 64, "max_ext_len": 0}
_DESCRIPTION = frozenset({"wire", "schema", "version", "texts", "arrays"})


@dataclass(frozen=True)
class _Form:
    """Fields of a message class by how they travel."""

    cls: type[Message]
    names: tuple[str, ...]
    texts: tuple[tuple[str, FieldKind], ...]
    arrays: tuple[tuple[str, Array], ...]
    numbers: tuple[tuple[str, Callable[[str, Any], Any]], ...]


@once_a_class
def _form(cls: type[Message]) -> _Form:
    fields = wire_fields(cls)
    arrays = tuple((n, kind) for n, kind in fields.items() if isinstance(kind, Array))
    # What msgpack does not carry as it is, arrays apart, is a text: the names of a batch.
    texts = tuple(
        (n, kind)
        for n, kind in fields.items()
        if isinstance(kind, Text) or not (kind.travels_as_it_is or isinstance(kind, Array))
    )
    apart = {name for name, _ in (*texts, *arrays)}
    numbers = tuple((n, kind.check) for n, kind in fields.items() if n not in apart)
    return _Form(cls, tuple(fields), texts, arrays, numbers)


@dataclass(frozen=True)
class _Stream:
    """A description that was checked: what all messages with these bytes have in common.

    `values` holds all fields in their order, the texts set; `arrays` the name, kind, dtype, shape
    and number of bytes of the arrays that are sent; `n_bytes` the bytes of all, each but the last
    padded.
    """

    form: _Form
    topic: bytes
    values: dict[str, Any]
    arrays: tuple[tuple[str, Array, str, tuple[int, ...], int], ...]
    n_bytes: int
    n_numbers: int


_HEAD = struct.Struct("<BH")
_ZEROS = bytes(ALIGNMENT)
_STREAMS: dict[bytes, _Stream] = {}
_DESCRIBED: dict[tuple[Any, ...], tuple[bytes, bytes]] = {}


def is_frame(cls: type[Message]) -> bool:
    """True for messages of frames, with arrays; states and others are one map."""
    return not cls.latched and bool(_form(cls).arrays)


def frame_pieces(message: Message) -> list[Any]:
    """Bytes and arrays, not copied, that follow each other in the buffer of a message.

    Raises
    ------
    MessageError
        If its head is too large to travel.
    """
    form, values = _form(type(message)), message.__dict__
    key: list[Any] = [form.cls, *(values[name] for name, _ in form.texts)]
    data, numbers = [], [values[name] for name, _ in form.numbers]
    for name, kind in form.arrays:
        value = values[name]
        if value is None:
            key.append(None)
            continue
        key += (kind.dtype_of(value), value.shape)
        numbers += kind.extra_of(value)
        data.append(kind.data_of(value))
    described = _DESCRIBED.get(tuple(key))
    if described is None:
        described = _describe(message)
        _remember(_DESCRIBED, tuple(key), described)
    begin, description = described
    head = msgpack.packb([description, *numbers])
    if len(head) > MAX_HEAD_BYTES:
        raise OversizedError(f"head of {len(head)} bytes, at most {MAX_HEAD_BYTES}")
    pieces = [begin, _HEAD.pack(MARK, len(head)), head]
    n_bytes = len(begin) + _HEAD.size + len(head)
    for one in data:
        n_zeros = -n_bytes % ALIGNMENT
        size = one.nbytes if type(one) is memoryview else len(one)
        pieces += (_ZEROS[:n_zeros], one)
        n_bytes += n_zeros + size
    return pieces


def decode_frame(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload of a frame back into the message; its arrays are read-only views.

    Raises
    ------
    MessageError
        As `decode` does.
    """
    description, numbers, end = _read_head(payload)
    stream = _STREAMS.get(description) or _learn(description)
    if stream.topic != topic:
        raise FieldError(f"a message of {stream.topic.decode()} came under topic {topic!r}")
    if len(numbers) != stream.n_numbers:
        schema = stream.form.cls.schema
        raise MalformedError(f"{schema}: {len(numbers)} numbers, expected {stream.n_numbers}")
    at = end + -(len(topic) + 1 + end) % ALIGNMENT
    if len(payload) - at != stream.n_bytes:
        text = f"{stream.form.cls.schema}: {len(payload) - at} bytes of arrays, expected "
        wrong = TruncatedError if len(payload) - at < stream.n_bytes else OversizedError
        raise wrong(f"{text}{stream.n_bytes}")
    values = stream.values.copy()
    rest = iter(numbers)
    for name, check in stream.form.numbers:
        values[name] = check(name, next(rest))
    for name, kind, dtype, shape, n_bytes in stream.arrays:
        extra = next(rest) if dtype != kind.dtype else None
        values[name] = kind.of_data(name, dtype, shape, extra, payload[at : at + n_bytes])
        at += n_bytes + -n_bytes % ALIGNMENT
    return stream.form.cls.assembled(values)


def head_of(payload: Payload) -> tuple[str, int, int]:
    """Run id, sequence number and stamp of a frame, unchecked, by its head.

    Raises MessageError, or TypeError, for a head that has none.
    """
    description, numbers, _ = _read_head(payload)
    stream = _STREAMS.get(description) or _learn(description)
    found = dict(zip((name for name, _ in stream.form.numbers), numbers, strict=False))
    return stream.values["run_id"], found["seq"], found["stamp_ns"]


def _remember(known: dict[Any, Any], key: Any, value: Any) -> None:
    if len(known) >= MAX_STREAMS:
        known.clear()
    known[key] = value


def _read_head(payload: Payload) -> tuple[bytes, list[Any], int]:
    """Description and numbers of a head, unchecked, and its end in the payload."""
    if len(payload) < _HEAD.size:
        raise TruncatedError(f"message cut off after {len(payload)} bytes")
    end = _HEAD.size + _HEAD.unpack_from(payload)[1]
    if end > _HEAD.size + MAX_HEAD_BYTES:
        raise OversizedError(f"head of {end - _HEAD.size} bytes, at most {MAX_HEAD_BYTES}")
    read = unpacked(payload[_HEAD.size : end], list, len(payload))
    if not read or not isinstance(read[0], bytes):
        raise MalformedError("expected a head with a description")
    return read[0], read[1:], end


def unpacked(raw: Payload, expected: type, n_bytes: int) -> Any:
    """One msgpack object of the expected type; MessageError if it is none."""
    try:
        found = msgpack.unpackb(raw, raw=False, strict_map_key=True, **_LIMITS)
    except msgpack.exceptions.ExtraData as error:
        raise MalformedError("more than one msgpack object in a message") from error
    except Exception as error:  # msgpack documents no narrower class for malformed bytes
        if "incomplete" in str(error):
            raise TruncatedError(f"message cut off after {n_bytes} bytes") from error
        raise MalformedError(f"not a msgpack {expected.__name__}: {str(error)[:120]}") from error
    if not isinstance(found, expected):
        text = f"expected one msgpack {expected.__name__}, got {type(found).__name__}"
        raise MalformedError(text)
    return found


def _describe(message: Message) -> tuple[bytes, bytes]:
    """Begin of the buffer, the topic and a zero byte, and description of a message."""
    form, values = _form(type(message)), message.__dict__
    arrays = {
        name: [kind.dtype_of(values[name]), list(values[name].shape)]
        for name, kind in form.arrays
        if values[name] is not None
    }
    described = {
        "wire": WIRE_VERSION,
        "schema": message.schema,
        "version": message.version,
        "texts": [kind.pack(values[name]) for name, kind in form.texts],
        "arrays": arrays,
    }
    return message.topic.encode() + b"\0", msgpack.packb(described)


def _learn(description: bytes) -> _Stream:
    """Check a description and remember it, or raise MessageError."""
    body = unpacked(description, dict, len(description))
    if type(body.get("wire")) is int and body["wire"] != WIRE_VERSION:
        raise VersionError(f"wire form {body['wire']}, this program reads 1 and {WIRE_VERSION}")
    cls = class_of(body)
    form = _form(cls)
    if body.keys() != _DESCRIPTION or not is_frame(cls):
        raise MalformedError(f"{cls.schema}: not the description of a stream")
    texts, described = body["texts"], body["arrays"]
    if not isinstance(texts, list) or len(texts) != len(form.texts):
        raise MalformedError(f"{cls.schema}: expected {len(form.texts)} texts")
    if not isinstance(described, dict) or not described.keys() <= {name for name, _ in form.arrays}:
        raise MalformedError(f"{cls.schema}: unknown arrays")
    values: dict[str, Any] = dict.fromkeys(form.names)
    for (name, text), value in zip(form.texts, texts, strict=True):
        values[name] = text.unpack(name, value)
    arrays, n_numbers, n_all = [], len(form.numbers), 0
    for name, kind in form.arrays:
        if name not in described:
            if not kind.optional:
                raise MalformedError(f"{cls.schema}: missing array {name}")
            continue
        dtype, shape, n_bytes = kind.checked_form(name, described[name])
        arrays.append((name, kind, dtype, shape, n_bytes))
        n_all += -n_all % ALIGNMENT + n_bytes
        n_numbers += dtype != kind.dtype
    topic = topic_of(values["patch"], cls.schema).encode()
    stream = _Stream(form, topic, values, tuple(arrays), n_all, n_numbers)
    _remember(_STREAMS, description, stream)
    return stream
