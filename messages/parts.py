"""The wire form of frames: a small head, and each array as a part of its own.

The head is a msgpack list: the description of the stream, and the numbers of the frame. The
description is a msgpack map of everything that stays the same from frame to frame: schema, version,
texts, and dtype and shape of each array. It is checked when it first arrives; after that equal
bytes stand for it. Numbers are checked in each frame, arrays by their size, and for being finite.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack

from .base import Message, once_a_class, wire_fields
from .errors import FieldError, MalformedError, OversizedError, TruncatedError, VersionError
from .fields import Array, FieldKind, Text
from .schemas import class_of
from .topics import topic_of

Parts = tuple[bytes, ...]
"""Head and arrays of a message, without its topic."""

WIRE_VERSION = 2
"""Version of this form; 1 was one map a message, which is still read."""
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
    and number of bytes of the arrays that are sent.
    """

    form: _Form
    topic: bytes
    values: dict[str, Any]
    arrays: tuple[tuple[str, Array, str, tuple[int, ...], int], ...]
    n_numbers: int


_STREAMS: dict[bytes, _Stream] = {}
_DESCRIBED: dict[tuple[Any, ...], tuple[bytes, bytes]] = {}


def travels_in_parts(cls: type[Message]) -> bool:
    """True for messages of frames, with arrays; states and others are one map."""
    return not cls.latched and bool(_form(cls).arrays)


def encode_parts(message: Message) -> tuple[Any, ...]:
    """Turn a message into its wire parts: topic, head, and the arrays, not copied."""
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
    topic, description = described
    return (topic, msgpack.packb([description, *numbers]), *data)


def decode_parts(topic: bytes, parts: Parts) -> Message:
    """Turn topic, head and arrays back into the message; its arrays are read-only views.

    Raises
    ------
    MessageError
        As `decode` does.
    """
    head, *arrays = parts
    description, numbers = _read_head(head)
    stream = _STREAMS.get(description) or _learn(description)
    if stream.topic != topic:
        raise FieldError(f"a message of {stream.topic.decode()} came under topic {topic!r}")
    if len(numbers) != stream.n_numbers:
        schema = stream.form.cls.schema
        raise MalformedError(f"{schema}: {len(numbers)} numbers, expected {stream.n_numbers}")
    if len(arrays) != len(stream.arrays):
        found = f"{len(arrays)} arrays, expected {len(stream.arrays)}"
        wrong = TruncatedError if len(arrays) < len(stream.arrays) else MalformedError
        raise wrong(f"{stream.form.cls.schema}: {found}")
    values = stream.values.copy()
    rest = iter(numbers)
    for name, check in stream.form.numbers:
        values[name] = check(name, next(rest))
    for (name, kind, dtype, shape, n_bytes), data in zip(stream.arrays, arrays, strict=True):
        if len(data) != n_bytes:
            text = f"{name}: shape {list(shape)} does not fit {len(data)} bytes of data"
            raise (TruncatedError if len(data) < n_bytes else OversizedError)(text)
        extra = next(rest) if dtype != kind.dtype else None
        values[name] = kind.of_data(name, dtype, shape, extra, data)
    return stream.form.cls.assembled(values)


def head_of(head: bytes) -> tuple[str, int, int]:
    """Run id, sequence number and stamp of a message, unchecked, by its head.

    Raises MessageError, or TypeError, for a head that has none.
    """
    description, numbers = _read_head(head)
    stream = _STREAMS.get(description) or _learn(description)
    found = dict(zip((name for name, _ in stream.form.numbers), numbers, strict=False))
    return stream.values["run_id"], found["seq"], found["stamp_ns"]


def _remember(known: dict[Any, Any], key: Any, value: Any) -> None:
    if len(known) >= MAX_STREAMS:
        known.clear()
    known[key] = value


def _read_head(head: bytes) -> tuple[bytes, list[Any]]:
    """Description and numbers of a head, unchecked."""
    if len(head) > MAX_HEAD_BYTES:
        raise OversizedError(f"head of {len(head)} bytes, at most {MAX_HEAD_BYTES}")
    read = unpacked(head, list, len(head))
    if not read or not isinstance(read[0], bytes):
        raise MalformedError("expected a head with a description")
    return read[0], read[1:]


def unpacked(raw: bytes, expected: type, n_bytes: int) -> Any:
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
    """Topic and description of a message."""
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
    return message.topic.encode(), msgpack.packb(described)


def _learn(description: bytes) -> _Stream:
    """Check a description and remember it, or raise MessageError."""
    body = unpacked(description, dict, len(description))
    if type(body.get("wire")) is int and body["wire"] != WIRE_VERSION:
        raise VersionError(f"wire form {body['wire']}, this program reads 1 and {WIRE_VERSION}")
    cls = class_of(body)
    form = _form(cls)
    if body.keys() != _DESCRIPTION or not travels_in_parts(cls):
        raise MalformedError(f"{cls.schema}: not the description of a stream")
    texts, described = body["texts"], body["arrays"]
    if not isinstance(texts, list) or len(texts) != len(form.texts):
        raise MalformedError(f"{cls.schema}: expected {len(form.texts)} texts")
    if not isinstance(described, dict) or not described.keys() <= {name for name, _ in form.arrays}:
        raise MalformedError(f"{cls.schema}: unknown arrays")
    values: dict[str, Any] = dict.fromkeys(form.names)
    for (name, text), value in zip(form.texts, texts, strict=True):
        values[name] = text.unpack(name, value)
    arrays, n_numbers = [], len(form.numbers)
    for name, kind in form.arrays:
        if name not in described:
            if not kind.optional:
                raise MalformedError(f"{cls.schema}: missing array {name}")
            continue
        dtype, shape, n_bytes = kind.checked_form(name, described[name])
        arrays.append((name, kind, dtype, shape, n_bytes))
        n_numbers += dtype != kind.dtype
    topic = topic_of(values["patch"], cls.schema).encode()
    stream = _Stream(form, topic, values, tuple(arrays), n_numbers)
    _remember(_STREAMS, description, stream)
    return stream
