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
from typing import Any, NamedTuple

import msgpack

from .base import Message, once_a_class, wire_fields
from .errors import (
    FieldError,
    MalformedError,
    OversizedError,
    TruncatedError,
    VersionError,
)
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
_LIMITS = {
    "max_str_len": 4096,
    "max_array_len": MAX_PATCHES,
    "max_map_len": 64,
    "max_ext_len": 0,
}
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
    tuples: tuple[tuple[str, Each], ...]


@once_a_class
def _form(cls: type[Message]) -> _Form:
    fields = wire_fields(cls)

    def of(*kinds: type[FieldKind]) -> Any:
        return tuple(field for field in fields.items() if isinstance(field[1], kinds))

    # Words are of kind `Each`, but travel as texts.
    words = of(Words)
    tuples = tuple(field for field in of(Each) if field not in words)
    return _Form(
        cls=cls,
        names=tuple(fields),
        texts=of(Text, Names) + words,
        arrays=of(Array),
        numbers=of(Number),
        tuples=tuples,
    )


class _SentArray(NamedTuple):
    """An array of a stream, its dtype as it travels, and where it is in the payload."""

    name: str
    kind: Array
    dtype: str
    shape: tuple[int, ...]
    begin: int
    end: int


@dataclass(frozen=True)
class _Stream:
    """What all messages of a description have in common.

    `begin` is their topic and all that follows up to the numbers; `numbers` packs these, which
    begin in the payload at `numbers_at`; `checks` has the field and check of each number,
    `tuple_checks` those of fields that hold one for each of several patches; `values` holds all
    fields in their order, the texts set; `arrays` has the arrays that are sent in the payload,
    which has `n_bytes`.
    """

    form: _Form
    topic: bytes
    begin: bytes
    n_patches: int
    numbers: struct.Struct
    numbers_at: int
    checks: tuple[_Check, ...]
    tuple_checks: tuple[_Check, ...]
    values: dict[str, Any]
    arrays: tuple[_SentArray, ...]
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
    # Numbers of the message come first, then those of its patches, field by field.
    numbers = [values[name] for name, _ in form.numbers]
    for name, _ in form.tuples:
        numbers += values[name]

    # Arrays are not copied; quantised ones state their step among the numbers.
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
    # A number that is optional and not stated travels as NaN.
    if None in numbers:
        numbers = [math.nan if number is None else number for number in numbers]

    pieces: list[Any] = [stream.begin, stream.numbers.pack(*numbers)]
    # Zeros between the arrays keep each of them aligned.
    end = stream.arrays[0].begin
    for place, piece in zip(stream.arrays, data, strict=True):
        if place.begin > end:
            pieces.append(_ZEROS[place.begin - end])
        pieces.append(piece)
        end = place.end
    return pieces


def frame_bytes(message: Message) -> int:
    """Size of the buffer of a message, bytes; raises as `frame_pieces`."""
    stream = _described(message)
    return len(stream.topic) + 1 + stream.n_bytes


def _described(message: Message) -> _Stream:
    """The stream of a message, which is described where it is new."""
    form = _form(type(message))
    values = message.__dict__
    # All that stays the same from frame to frame, as the description has it.
    properties: list[Any] = [form.cls]
    properties += [values[name] for name, _ in form.texts]
    for name, kind in form.arrays:
        value = values[name]
        if value is None:
            properties.append(None)
            continue
        properties.append(value.shape)
        if type(kind) is not Array:
            properties.append(kind.dtype_of(value))

    key = tuple(properties)
    stream = _DESCRIBED.get(key)
    if stream is None:
        stream = _describe(message)
        _remember(_DESCRIBED, key, stream)
    return stream


def decode_frame(topic: bytes, payload: Payload) -> Message:
    """Turn topic and payload of a frame back into the message; its arrays are read-only views.
    Raises MessageError as `decode` does.
    """
    stream = _stream_of(topic, payload)
    form = stream.form
    n_bytes = len(payload)
    if n_bytes != stream.n_bytes:
        text = f"{form.cls.schema}: {n_bytes} bytes, expected {stream.n_bytes}"
        if n_bytes < stream.n_bytes:
            raise TruncatedError(text)
        raise OversizedError(text)

    # Texts were checked when their description first came; numbers are, in each frame.
    values = stream.values.copy()
    numbers = stream.numbers.unpack_from(payload, stream.numbers_at)
    # `checks` is shorter where several patches have numbers of their own.
    for (name, check), number in zip(stream.checks, numbers, strict=False):
        values[name] = check(name, number)
    n_read = len(stream.checks)
    for name, check in stream.tuple_checks:
        end = n_read + stream.n_patches
        values[name] = tuple([check(name, number) for number in numbers[n_read:end]])
        n_read = end

    data = memoryview(payload)
    for name, kind, dtype, shape, begin, end in stream.arrays:
        extra = None
        if dtype != kind.dtype:
            extra = numbers[n_read]
            n_read += 1
        values[name] = kind.of_data(name, dtype, shape, extra, data[begin:end])
    return form.cls.assembled(values)


def head_of(topic: bytes, payload: Payload) -> tuple[str, int, int]:
    """Run id, sequence number and stamp of a frame, unchecked.
    Raises MessageError if it has no description, struct.error if it is cut off.
    """
    stream = _stream_of(topic, payload)
    numbers = stream.numbers.unpack_from(payload, stream.numbers_at)
    names = (name for name, _ in stream.form.numbers)
    values = dict(zip(names, numbers, strict=False))
    return stream.values["run_id"], values["seq"], values["stamp_ns"]


def unpacked(raw: Payload, expected: type, n_bytes: int) -> Any:
    """One msgpack object of the expected type; MessageError if it is none."""
    try:
        value = msgpack.unpackb(raw, raw=False, strict_map_key=True, **_LIMITS)
    except msgpack.exceptions.ExtraData as error:
        raise MalformedError("more than one msgpack object in a message") from error
    # msgpack documents no narrower class for malformed bytes, and none for bytes that end early.
    except Exception as error:
        if "incomplete" in str(error):
            raise TruncatedError(f"message cut off after {n_bytes} bytes") from error
        raise MalformedError(
            f"not a msgpack {expected.__name__}: {str(error)[:120]}"
        ) from error
    if not isinstance(value, expected):
        text = f"expected one msgpack {expected.__name__}, got {type(value).__name__}"
        raise MalformedError(text)
    return value


def _remember(streams: dict[Any, _Stream], key: Any, stream: _Stream) -> None:
    # A publisher has few; who sends ever new ones must not fill the memory.
    if len(streams) >= MAX_STREAMS:
        streams.clear()
    streams[key] = stream


def _describe(message: Message) -> _Stream:
    """The stream of a message that was checked."""
    form = _form(type(message))
    values = message.__dict__
    # A reader takes texts by their place: only the last ones can be left out.
    texts = [kind.pack(values[name]) for name, kind in form.texts]
    for _, kind in reversed(form.texts):
        if not isinstance(kind, Words) or texts[-1].strip():
            break
        texts.pop()

    arrays = {}
    for name, kind in form.arrays:
        value = values[name]
        if value is not None:
            arrays[name] = [kind.dtype_of(value), list(value.shape)]
    body = {
        "wire": WIRE_VERSION,
        "schema": message.schema,
        "version": message.version,
        "texts": texts,
        "arrays": arrays,
    }
    description = msgpack.packb(body)
    n_bytes = len(description)
    if n_bytes > MAX_DESCRIPTION_BYTES:
        limit = f"at most {MAX_DESCRIPTION_BYTES}"
        raise OversizedError(f"description of {n_bytes} bytes, {limit}")
    return _learn(description)


def _stream_of(topic: bytes, payload: Payload) -> _Stream:
    """The stream of a payload, or MessageError."""
    n_bytes = len(payload)
    if n_bytes < _BEGIN.size:
        raise TruncatedError(f"message cut off after {n_bytes} bytes")
    _, size = _BEGIN.unpack_from(payload)
    if size > MAX_DESCRIPTION_BYTES:
        raise OversizedError(
            f"description of {size} bytes, at most {MAX_DESCRIPTION_BYTES}"
        )

    # Equal bytes stand for a description that was checked before.
    description = bytes(payload[_BEGIN.size : _BEGIN.size + size])
    stream = _STREAMS.get(description)
    if stream is None:
        # A known description is whole: only a new one can be cut off.
        if len(description) < size:
            raise TruncatedError(f"message cut off after {n_bytes} bytes")
        stream = _learn(description)
    if stream.topic != topic:
        raise FieldError(
            f"a message of {stream.topic.decode()} came under topic {topic!r}"
        )
    return stream


def _learn(description: bytes) -> _Stream:
    """Check a description and remember it, or raise MessageError."""
    body = unpacked(description, dict, len(description))
    form = _form_of(body)
    values = _text_values(form, body["texts"])
    # A message without names is that of one patch.
    n_patches = len(values.get("names") or ()) or 1
    _complete_words(form, values, n_patches)
    arrays = _described_arrays(form, body["arrays"])

    stream = _laid_out(description, form, values, n_patches, arrays)
    _remember(_STREAMS, description, stream)
    return stream


def _form_of(body: dict[Any, Any]) -> _Form:
    """Form of the class in a description, whose parts have the right types, or MessageError."""
    # Another version may have another schema, too: this is reported first.
    version = body.get("wire")
    if type(version) is int and version != WIRE_VERSION:
        raise VersionError(
            f"wire form {version}, this program reads 1 and {WIRE_VERSION}"
        )
    cls = class_of(body)
    form = _form(cls)
    if body.keys() != _DESCRIPTION or not is_frame(cls):
        raise MalformedError(f"{cls.schema}: not the description of a stream")

    texts = body["texts"]
    # Words come last among the texts, and may be left out.
    n_texts = len(form.texts)
    n_words = sum(isinstance(kind, Words) for _, kind in form.texts)
    if not isinstance(texts, list) or not n_texts - n_words <= len(texts) <= n_texts:
        raise MalformedError(f"{cls.schema}: expected {n_texts} texts")

    arrays = body["arrays"]
    if not isinstance(arrays, dict) or not arrays.keys() <= dict(form.arrays).keys():
        raise MalformedError(f"{cls.schema}: unknown arrays")
    return form


def _text_values(form: _Form, texts: list[Any]) -> dict[str, Any]:
    """All fields by name, those of texts set, the others None."""
    # All keys at once: messages are then made in the order of their fields.
    values: dict[str, Any] = dict.fromkeys(form.names)
    for (name, kind), text in zip(form.texts, texts, strict=False):
        values[name] = kind.unpack(name, text)
    return values


def _complete_words(form: _Form, values: dict[str, Any], n_patches: int) -> None:
    """Set words that were left out because none is stated, or raise MessageError."""
    for name, kind in form.texts:
        if not isinstance(kind, Words):
            continue
        if not values[name]:
            values[name] = kind.unstated * n_patches
        if len(values[name]) != n_patches:
            raise MalformedError(
                f"{form.cls.schema}: {name}: expected {n_patches} words"
            )


def _described_arrays(form: _Form, described: dict[str, Any]) -> list[_SentArray]:
    """The arrays that are sent, as if each began at 0, or MessageError."""
    arrays = []
    for name, kind in form.arrays:
        if name in described:
            dtype, shape, n_bytes = kind.checked_form(name, described[name])
            # Its place is not known before the numbers are counted.
            arrays.append(_SentArray(name, kind, dtype, shape, 0, n_bytes))
        elif not kind.optional:
            raise MalformedError(f"{form.cls.schema}: missing array {name}")
    return arrays


def _laid_out(
    description: bytes,
    form: _Form,
    values: dict[str, Any],
    n_patches: int,
    arrays: list[_SentArray],
) -> _Stream:
    """The stream of a checked description: where its numbers and arrays are in the payload."""
    topic = topic_of(values["patch"], form.cls.schema).encode()
    begin = topic + b"\0" + _BEGIN.pack(MARK, len(description)) + description
    # Arrays are aligned from the begin of the topic, which the payload lacks.
    n_topic = len(topic) + 1
    numbers_at = len(begin) - n_topic
    numbers = _numbers_struct(form, n_patches, arrays, len(begin))

    end = numbers_at + numbers.size
    placed = []
    for array in arrays:
        # The least one at or behind `end` that is aligned.
        first_byte = end + -(n_topic + end) % ALIGNMENT
        end = first_byte + array.end
        placed.append(array._replace(begin=first_byte, end=end))

    checks = [(name, kind.of_number) for name, kind in form.numbers]
    # Nearly all messages are of one patch: its numbers need no list of their own.
    tuple_checks: list[_Check] = []
    if n_patches == 1:
        checks += [(name, kind.of_number) for name, kind in form.tuples]
    else:
        tuple_checks = [(name, kind.kind.of_number) for name, kind in form.tuples]
    return _Stream(
        form=form,
        topic=topic,
        begin=begin,
        n_patches=n_patches,
        numbers=numbers,
        numbers_at=numbers_at,
        checks=tuple(checks),
        tuple_checks=tuple(tuple_checks),
        values=values,
        arrays=tuple(placed),
        n_bytes=end,
    )


def _numbers_struct(
    form: _Form, n_patches: int, arrays: list[_SentArray], n_before: int
) -> struct.Struct:
    """The numbers behind `n_before` bytes, and zeros up to the first array."""
    codes = "".join(kind.code for _, kind in form.numbers)
    # Field by field: all patches of one, then of the next.
    codes += "".join(kind.kind.code * n_patches for _, kind in form.tuples)
    for array in arrays:
        # A quantised array is sent with its step.
        if array.dtype != array.kind.dtype:
            codes += "d"
    n_numbers = struct.calcsize(f"<{codes}")
    n_zeros = -(n_before + n_numbers) % ALIGNMENT
    return struct.Struct(f"<{codes}{n_zeros}x")
