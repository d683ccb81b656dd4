"""The wire form of frames: one buffer of a topic, a description, numbers and arrays.

It is the topic, a zero byte, `MARK`, the size of the description (16 bits), the description, the
numbers, and the arrays, each from a multiple of `ALIGNMENT` bytes on; all is little-endian. The
description is a msgpack map of everything that stays the same from frame to frame: schema, version,
texts, and dtype and shape of each array. It is checked when it first arrives; after that equal
bytes stand for it. Numbers have 8 bytes, truth values 1; those of the message come first, then
those of its patches, field by field. They are checked in each frame, arrays for being finite.
"""

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import msgpack

from .base import Message, once_a_class, wire_fields
from .errors import FieldError, MalformedError, OversizedError, TruncatedError, VersionError
from .fields import Array, Each, FieldKind, Names, Number, Text, Words
from .schemas import class_of
from .topics import MAX_PATCHES, topic_of

Payload = bytes | memoryview
"""A message as received, without its topic and the zero byte behind it."""

WIRE_VERSION = 3
"""Version of this form; 1 was one map a message, which states and recordings are still."""
MARK = 0xC1
"""First byte of a frame after its topic; msgpack begins no object with it."""
ALIGNMENT = 16
"""Arrays begin at a multiple of this many bytes from the begin of the topic: received into memory
that is aligned, they need no copy. Chosen: as malloc aligns, and wider than any dtype."""
MAX_DESCRIPTION_BYTES = 8192
MAX_STREAMS = 1024
"""Number of descriptions that are known at a time."""
_LIMITS = {"max_str_len": 4096, "max_array_len": MAX_PATCHES, "max_map_len": 64, "max_ext_len": 0}
_DESCRIPTION = frozenset({"wire", "schema", "version", "texts", "arrays"})
_BEGIN = struct.Struct("<BH")
_ZEROS = tuple(map(bytes, range(ALIGNMENT)))


_Check = tuple[str, Callable[[str, Any], Any]]
"""A field, and a function of its name and number."""


@dataclass(frozen=True)
class _Form:
    """Fields of a message class by how they travel."""

    cls: type[Message]
    names: tuple[str, ...]
    texts: tuple[tuple[str, FieldKind], ...]
    arrays: tuple[tuple[str, Array], ...]
    numbers: tuple[tuple[str, Number], ...]
    each: tuple[tuple[str, Each], ...]


@once_a_class
def _form(cls: type[Message]) -> _Form:
    fields = wire_fields(cls)

    def of(*kinds: type[FieldKind]) -> Any:
        return tuple((name, kind) for name, kind in fields.items() if isinstance(kind, kinds))

    words = of(Words)
    numbers = tuple(one for one in of(Each) if one not in words)
    return _Form(cls, tuple(fields), of(Text, Names) + words, of(Array), of(Number), numbers)


@dataclass(frozen=True)
class _Stream:
    """What all messages of a description have in common.

    `begin` is their topic and all that follows up to the numbers; `numbers` packs these, which
    begin in the payload at `numbers_at`; `checks` has the field and check of each number, `each`
    those of fields that hold one for each of several patches; `values` holds all fields in their
    order, the texts set; `arrays` has the name, kind, dtype and shape of the arrays that are sent,
    and where each begins and ends in the payload, which has `n_bytes`.
    """

    form: _Form
    topic: bytes
    begin: bytes
    n_patches: int
    numbers: struct.Struct
    numbers_at: int
    checks: tuple[_Check, ...]
    each: tuple[_Check, ...]
    values: dict[str, Any]
    arrays: tuple[tuple[str, Array, str, tuple[int, ...], int, int], ...]
    n_bytes: int


_STREAMS: dict[bytes, _Stream] = {}
_DESCRIBED: dict[tuple[Any, ...], _Stream] = {}


def is_frame(cls: type[Message]) -> bool:
    """True for messages of frames, with arrays; states and others are one map."""
    return not cls.latched and bool(_form(cls).arrays)


def frame_pieces(message: Message) -> list[Any]:
    """Bytes and arrays, not copied, that follow each other in the buffer of a message.
    Raises MessageError if its description is too large to travel.
    """
    stream = _described(message)
    form = stream.form
    values = message.__dict__
    numbers = [values[name] for name, _ in form.numbers]
    for name, _ in form.each:
        numbers += values[name]
    data = []
    for name, kind in form.arrays:
        value = values[name]
        if value is None:
            continue
        if type(kind) is Array:
            data.append(value)
            continue
        numbers += kind.extra_of(value)
        data.append(kind.data_of(value))
    if None in numbers:
        numbers = [math.nan if number is None else number for number in numbers]
    pieces: list[Any] = [stream.begin, stream.numbers.pack(*numbers)]
    end = stream.arrays[0][-2]
    for (*_, begin, last), one in zip(stream.arrays, data, strict=True):
        if begin > end:
            pieces.append(_ZEROS[begin - end])
        pieces.append(one)
        end = last
    return pieces


def frame_bytes(message: Message) -> int:
    """Size of the buffer of a message, bytes; raises as `frame_pieces`."""
    stream = _described(message)
    return len(stream.topic) + 1 + stream.n_bytes


def _described(message: Message) -> _Stream:
    """The stream of a message, which is described where it is new."""
    form = _form(type(message))
    values = message.__dict__
    key: list[Any] = [form.cls, *(values[name] for name, _ in form.texts)]
    for name, kind in form.arrays:
        value = values[name]
        key.append(None if value is None else value.shape)
        if value is not None and type(kind) is not Array:
            key.append(kind.dtype_of(value))
    stream = _DESCRIBED.get(tuple(key))
    if stream is None:
        stream = _describe(message)
        _remember(_DESCRIBED, tuple(key), stream)
    return stream


def decode_frame(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload of a frame back into the message; its arrays are read-only views.
    Raises MessageError as `decode` does.
    """
    stream = _stream_of(topic, payload)
    n_bytes = len(payload)
    if n_bytes != stream.n_bytes:
        text = f"{stream.form.cls.schema}: {n_bytes} bytes, expected {stream.n_bytes}"
        raise (TruncatedError if n_bytes < stream.n_bytes else OversizedError)(text)
    values = stream.values.copy()
    form = stream.form
    numbers = stream.numbers.unpack_from(payload, stream.numbers_at)
    for (name, check), number in zip(stream.checks, numbers, strict=False):
        values[name] = check(name, number)
    n_read = len(stream.checks)
    for name, check in stream.each:
        begin, n_read = n_read, n_read + stream.n_patches
        values[name] = tuple([check(name, number) for number in numbers[begin:n_read]])
    data = memoryview(payload)
    for name, kind, dtype, shape, begin, end in stream.arrays:
        extra = None
        if dtype != kind.dtype:
            extra, n_read = numbers[n_read], n_read + 1
        values[name] = kind.of_data(name, dtype, shape, extra, data[begin:end])
    return form.cls.assembled(values)


def head_of(topic: bytes, payload: Payload) -> tuple[str, int, int]:
    """Run id, sequence number and stamp of a frame, unchecked.
    Raises MessageError if it has no description, struct.error if it is cut off.
    """
    stream = _stream_of(topic, payload)
    numbers = stream.numbers.unpack_from(payload, stream.numbers_at)
    found = dict(zip((name for name, _ in stream.form.numbers), numbers, strict=False))
    return stream.values["run_id"], found["seq"], found["stamp_ns"]


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


def _remember(known: dict[Any, Any], key: Any, value: Any) -> None:
    if len(known) >= MAX_STREAMS:
        known.clear()
    known[key] = value


def _describe(message: Message) -> _Stream:
    """The stream of a message that was checked."""
    form = _form(type(message))
    values = message.__dict__
    arrays = {
        name: [kind.dtype_of(values[name]), list(values[name].shape)]
        for name, kind in form.arrays
        if values[name] is not None
    }
    texts = [kind.pack(values[name]) for name, kind in form.texts]
    while isinstance(form.texts[len(texts) - 1][1], Words) and not texts[-1].strip():
        texts.pop()
    described = {
        "wire": WIRE_VERSION,
        "schema": message.schema,
        "version": message.version,
        "texts": texts,
        "arrays": arrays,
    }
    description = msgpack.packb(described)
    if len(description) > MAX_DESCRIPTION_BYTES:
        most = f"at most {MAX_DESCRIPTION_BYTES}"
        raise OversizedError(f"description of {len(description)} bytes, {most}")
    return _learn(description)


def _stream_of(topic: bytes, payload: Payload) -> _Stream:
    """The stream of a payload, or MessageError."""
    n_bytes = len(payload)
    if n_bytes < _BEGIN.size:
        raise TruncatedError(f"message cut off after {n_bytes} bytes")
    size = _BEGIN.unpack_from(payload)[1]
    if size > MAX_DESCRIPTION_BYTES:
        raise OversizedError(f"description of {size} bytes, at most {MAX_DESCRIPTION_BYTES}")
    description = bytes(payload[_BEGIN.size : _BEGIN.size + size])
    stream = _STREAMS.get(description)
    if stream is None:
        if len(description) < size:
            raise TruncatedError(f"message cut off after {n_bytes} bytes")
        stream = _learn(description)
    if stream.topic != topic:
        raise FieldError(f"a message of {stream.topic.decode()} came under topic {topic!r}")
    return stream


def _learn(description: bytes) -> _Stream:
    """Check a description and remember it, or raise MessageError."""
    body = unpacked(description, dict, len(description))
    if type(body.get("wire")) is int and body["wire"] != WIRE_VERSION:
        raise VersionError(f"wire form {body['wire']}, this program reads 1 and {WIRE_VERSION}")
    cls = class_of(body)
    form = _form(cls)
    if body.keys() != _DESCRIPTION or not is_frame(cls):
        raise MalformedError(f"{cls.schema}: not the description of a stream")
    texts = body["texts"]
    described = body["arrays"]
    n_words = sum(isinstance(kind, Words) for _, kind in form.texts)
    if not isinstance(texts, list) or not 0 <= len(form.texts) - len(texts) <= n_words:
        raise MalformedError(f"{cls.schema}: expected {len(form.texts)} texts")
    if not isinstance(described, dict) or not described.keys() <= {name for name, _ in form.arrays}:
        raise MalformedError(f"{cls.schema}: unknown arrays")
    values: dict[str, Any] = dict.fromkeys(form.names)
    for (name, text), value in zip(form.texts, texts, strict=False):
        values[name] = text.unpack(name, value)
    n_patches = len(values.get("names") or ()) or 1
    for name, words in form.texts:
        if isinstance(words, Words):  # left out where none is stated
            values[name] = values[name] or words.unstated * n_patches
            if len(values[name]) != n_patches:
                raise MalformedError(f"{cls.schema}: {name}: expected {n_patches} words")
    sent = []
    codes = [kind.code for _, kind in form.numbers]
    codes += [each.kind.code * n_patches for _, each in form.each]
    for name, kind in form.arrays:
        if name in described:
            dtype, shape, n_bytes = kind.checked_form(name, described[name])
            sent.append((name, kind, dtype, shape, n_bytes))
            if dtype != kind.dtype:
                codes.append("d")
        elif not kind.optional:
            raise MalformedError(f"{cls.schema}: missing array {name}")
    topic = topic_of(values["patch"], cls.schema).encode()
    begin = topic + b"\0" + _BEGIN.pack(MARK, len(description)) + description
    n_numbers = struct.calcsize("<" + "".join(codes))
    n_zeros = -(len(begin) + n_numbers) % ALIGNMENT
    at = len(begin) - len(topic) - 1
    end = at + n_numbers + n_zeros
    arrays: list[tuple[str, Array, str, tuple[int, ...], int, int]] = []
    for name, kind, dtype, shape, n_bytes in sent:
        first = end + -(len(topic) + 1 + end) % ALIGNMENT
        end = first + n_bytes
        arrays.append((name, kind, dtype, shape, first, end))
    numbers = struct.Struct(f"<{''.join(codes)}{n_zeros}x")
    checks = tuple((name, kind.of_number) for name, kind in form.numbers)
    if n_patches == 1:
        checks += tuple((name, each.of_number) for name, each in form.each)
    several = [(name, each.kind) for name, each in form.each if n_patches > 1]
    stream = _Stream(
        form=form,
        topic=topic,
        begin=begin,
        n_patches=n_patches,
        numbers=numbers,
        numbers_at=at,
        checks=checks,
        each=tuple((name, kind.of_number) for name, kind in several),
        values=values,
        arrays=tuple(arrays),
        n_bytes=end,
    )
    _remember(_STREAMS, description, stream)
    return stream
