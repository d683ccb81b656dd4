"""Kinds of message fields: each checks a value, packs it and unpacks it."""

import dataclasses
import functools
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from .arrays import AnyArray
from .errors import (
    FieldError,
    MalformedError,
    NotFiniteError,
    OversizedError,
    ShapeError,
)
from .quantised import (
    MAX_BITS,
    MIN_BITS,
    Quantised,
    largest_code,
    n_bytes,
    packed,
    unpacked,
)
from .ranges import INT64_MAX, is_real, is_whole
from .topics import MAX_NAME, MAX_NAMES, MAX_PATCHES, check_name

MAX_SIDE = 4096
"""Largest number of rows, or of columns, of a grid of taxels."""
MAX_ELEMENTS = 1 << 20
"""Largest number of elements of one array."""
STEP_MAX = 1e30
"""Upper bound of the step of quantised numbers."""
_ARRAY_KEYS = frozenset({"dtype", "shape", "order", "data"})
_QUANTISED_KEYS = _ARRAY_KEYS | {"step"}


class FieldKind:
    """Wire form of one field. `check` runs whenever a message is made, also by `decode`."""

    def check(self, name: str, value: Any) -> Any:
        """Return the value in its canonical form, or raise MessageError."""
        raise NotImplementedError

    def is_default(self, value: Any, default: Any) -> bool:
        """True if a checked value is the default of its field, and need not be sent."""
        return bool(value == default)

    def pack(self, value: Any) -> Any:
        """Convert a checked value to a msgpack type."""
        return value

    def unpack(self, name: str, raw: Any) -> Any:
        """Inverse of `pack`, with the checks of `check`."""
        return self.check(name, raw)


def _wrong_type(name: str, expected: str, value: Any) -> FieldError:
    return FieldError(f"{name}: expected {expected}, got {type(value).__name__}")


@dataclass(frozen=True)
class Integer(FieldKind):
    """A whole number in [low, high]."""

    low: int = 0
    high: int = INT64_MAX

    def check(self, name: str, value: Any) -> int:
        # Nearly every number of a frame passes this test alone.
        if type(value) is int and self.low <= value <= self.high:
            return value
        if not is_whole(value):
            raise _wrong_type(name, "a whole number", value)
        if not self.low <= value <= self.high:
            raise FieldError(f"{name}: {value} is outside {self.low}..{self.high}")
        # An integer of numpy becomes Python's.
        return int(value)


@dataclass(frozen=True)
class Real(FieldKind):
    """A finite number in [low, high]; None where `optional`."""

    low: float = -math.inf
    high: float = math.inf
    optional: bool = False

    def check(self, name: str, value: Any) -> float | None:
        # As of `Integer`, the usual case.
        if (
            type(value) is float
            and self.low <= value <= self.high
            and math.isfinite(value)
        ):
            return value
        if value is None and self.optional:
            return None

        # Its own reason: the publisher has computed something wrong.
        if isinstance(value, float | np.floating) and not math.isfinite(value):
            raise NotFiniteError(f"{name}: {value} is not a finite number")
        if not is_real(value):
            raise _wrong_type(name, "a number", value)

        # Numbers of numpy become Python's.
        number = float(value)
        if not self.low <= number <= self.high:
            raise FieldError(f"{name}: {number} is outside {self.low}..{self.high}")
        return number


@dataclass(frozen=True)
class Flag(FieldKind):
    """True or false."""

    def check(self, name: str, value: Any) -> bool:
        if not isinstance(value, bool):
            raise _wrong_type(name, "true or false", value)
        return value


@dataclass(frozen=True)
class Each(FieldKind):
    """A tuple of numbers, one for each patch of a message; that of one patch may be made of the
    number alone. `unstated` holds that of a patch where a message states none; it is empty where
    all have to be stated.
    """

    kind: Any
    unstated: tuple[Any, ...] = ()

    def check(self, name: str, value: Any) -> tuple[Any, ...]:
        if type(value) is not tuple:
            value = (value,)
        check = self.kind.check
        # This runs in each frame: the usual case, of one patch, makes no list.
        if len(value) == 1:
            return (check(name, value[0]),)
        return tuple([check(name, number) for number in value])

    def is_default(self, value: Any, default: Any) -> bool:
        # A message states the number of each patch; its reader does so where it was not sent.
        return bool(value == self.unstated * len(value))

    def unpack(self, name: str, raw: Any) -> tuple[Any, ...]:
        if not isinstance(raw, list | tuple):
            raise _wrong_type(name, "a list", raw)
        return self.check(name, tuple(raw))


@dataclass(frozen=True)
class Words(Each):
    """As `Each`, of words: they travel as one text, in which spaces separate them."""

    def pack(self, value: Any) -> str:
        return " ".join(value)

    def unpack(self, name: str, raw: Any) -> tuple[Any, ...]:
        if isinstance(raw, str):
            raw = raw.split(" ")
        return super().unpack(name, raw)


@dataclass(frozen=True)
class Names(FieldKind):
    """Names of patches, a tuple of different texts; its wire form is one text, in which spaces
    separate them.
    """

    def check(self, name: str, value: Any) -> tuple[str, ...]:
        if value == ():
            return ()
        is_tuple = isinstance(value, tuple)
        if not is_tuple or not all(isinstance(text, str) for text in value):
            raise _wrong_type(name, "a tuple of texts", value)
        return _names(name, " ".join(value))

    def pack(self, value: Any) -> str:
        return " ".join(value)

    def unpack(self, name: str, raw: Any) -> tuple[str, ...]:
        if not isinstance(raw, str):
            raise _wrong_type(name, "a text", raw)
        return _names(name, raw)


@functools.lru_cache(maxsize=64)
def _names(place: str, text: str) -> tuple[str, ...]:
    """Names in a text; the same few texts recur in every frame."""
    if not text:
        return ()

    # Sizes first: they bound the time of all that follows.
    if len(text) > MAX_NAMES:
        raise OversizedError(f"{place}: {len(text)} characters, at most {MAX_NAMES}")
    names = text.split(" ")
    if len(names) > MAX_PATCHES:
        raise OversizedError(f"{place}: {len(names)} names, at most {MAX_PATCHES}")
    for name in names:
        check_name(place, name)
    # A reader tells patches apart by their names alone.
    if len(set(names)) < len(names):
        raise FieldError(f"{place}: a name occurs twice")
    return tuple(names)


@dataclass(frozen=True)
class Text(FieldKind):
    """A text of at most `longest` characters that fully matches `pattern`."""

    longest: int = 256
    pattern: str = r"[^\x00-\x1f\x7f\ud800-\udfff]*"

    def check(self, name: str, value: Any) -> str:
        if not isinstance(value, str):
            raise _wrong_type(name, "a text", value)
        if len(value) > self.longest:
            raise OversizedError(
                f"{name}: {len(value)} characters, at most {self.longest}"
            )
        if not _matches(self.pattern, value):
            raise FieldError(f"{name}: {value!r} does not match {self.pattern}")
        return value


def _matches(pattern: str, value: str) -> bool:
    # The same few words recur in every frame; long texts are not kept.
    if len(value) > MAX_NAME:
        return re.fullmatch(pattern, value) is not None
    return _short_text_matches(pattern, value)


@functools.lru_cache(maxsize=1024)
def _short_text_matches(pattern: str, value: str) -> bool:
    return re.fullmatch(pattern, value) is not None


@dataclass(frozen=True)
class Array(FieldKind):
    """An array of one dtype, `ndim` dimensions, no side empty; None where `optional`. A side of one
    with several dimensions has at most `longest` elements. The first side of one of `patches` is
    the patches of the message, in their order; a message of one may be made without it. Where
    `sparse`, the array may hold only the patches that have something to send, also none; of one
    that is not of `patches`, the first side may be 0.

    Its wire form is a map {dtype, shape, order, data}: `dtype` in numpy's array-interface form
    with the byte order ("<f4"), `order` always "C", `data` a msgpack bin field.
    """

    dtype: str
    ndim: int
    optional: bool = False
    longest: int = MAX_SIDE
    patches: bool = False
    sparse: bool = False

    def check(self, name: str, value: Any) -> AnyArray | None:
        if value is None and self.optional:
            return None
        if not isinstance(value, np.ndarray):
            raise _wrong_type(name, "an array", value)
        # A message of one patch may be made without the axis of patches.
        if self.patches and value.ndim == self.ndim - 1:
            value = value[np.newaxis]
        if value.dtype != self._dtype:
            raise ShapeError(
                f"{name}: expected dtype {self.dtype}, got {value.dtype.str}"
            )
        self._check_shape(name, value.shape)
        self._check_finite(name, value)
        # Its bytes are sent as they lie in memory; it is copied where they do not lie in order.
        return np.ascontiguousarray(value)

    def is_default(self, value: Any, default: Any) -> bool:
        return value is default

    def pack(self, value: Any) -> Any:
        if value is None:
            return None
        # Not copied: msgpack takes the bytes from where they are.
        data = value.data.cast("B") if value.size else b""
        return {
            "dtype": self.dtype,
            "shape": value.shape,
            "order": "C",
            "data": data,
        }

    def unpack(self, name: str, raw: Any) -> AnyArray | None:
        if raw is None and self.optional:
            return None
        if not isinstance(raw, dict) or raw.keys() != _ARRAY_KEYS:
            raise MalformedError(
                f"{name}: expected a map of dtype, shape, order and data"
            )
        dtype = raw["dtype"]
        if dtype != self.dtype:
            raise ShapeError(
                f"{name}: expected dtype {self.dtype}, got {str(dtype)[:32]!r}"
            )

        # The sizes are checked before any byte is looked at.
        shape = self._shape_of(name, raw)
        data = _data_of(name, raw, math.prod(shape) * self._dtype.itemsize)
        # numpy would take any byte but 0 for true, and keep it.
        if self._dtype.kind == "b" and max(data, default=0) > 1:
            raise MalformedError(f"{name}: a boolean byte other than 0 and 1")
        value: AnyArray = np.ndarray(shape, self._dtype, data)
        self._check_finite(name, value)
        return value

    def _shape_of(self, name: str, raw: dict[str, Any]) -> tuple[int, ...]:
        """Shape of an array by its map, or MessageError."""
        if raw["order"] != "C":
            raise ShapeError(f"{name}: expected order C, got {str(raw['order'])[:8]!r}")
        sides = raw["shape"]
        # By their types: True is an integer of Python, but no side.
        if not isinstance(sides, list) or set(map(type, sides)) - {int}:
            raise MalformedError(f"{name}: shape must be a list of whole numbers")
        shape = tuple(sides)
        self._check_shape(name, shape)
        return shape

    @functools.cached_property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    def _check_finite(self, name: str, value: AnyArray) -> None:
        if value.dtype.kind != "f":
            return
        # One pass over the values; where they are huge their squares overflow, and each is tested.
        energy = np.vdot(value, value)
        if math.isfinite(energy) or np.isfinite(value).all():
            return
        indices = np.argwhere(~np.isfinite(value))[0].tolist()
        number = value[tuple(indices)]
        # Who sends one patch has no axis of patches.
        if self.patches and len(value) == 1:
            del indices[0]
        raise NotFiniteError(f"{name}{indices}: {number} is not a finite number")

    def _check_shape(self, name: str, shape: tuple[int, ...]) -> None:
        # A side that counts what is sent may be 0.
        sides = shape[1:] if self.sparse else shape
        if len(shape) != self.ndim or min(sides, default=1) < 1:
            expected = f"expected {self.ndim} dimensions, none empty"
            raise ShapeError(f"{name}: {expected}, got {list(shape)}")

        # An array of one dimension is limited by its number of elements.
        is_too_long = self.ndim > 1 and max(shape) > self.longest
        if is_too_long or math.prod(shape) > MAX_ELEMENTS:
            allowed = f"at most {MAX_ELEMENTS} elements and {self.longest} a side"
            raise OversizedError(f"{name}: shape {list(shape)}, {allowed}")


@dataclass(frozen=True)
class Samples(Array):
    """A float32 array of the samples of each patch, `Quantised` or not.

    The map of a quantised one has dtype "intB", B the number of bits, `step`, and the codes as
    packed by `sparseskin.messages.quantised.packed`.
    """

    dtype: str = "<f4"
    ndim: int = 2
    longest: int = MAX_ELEMENTS
    patches: bool = True

    def check(self, name: str, value: Any) -> AnyArray | None:
        checked = super().check(name, value)
        if checked is None or not isinstance(value, Quantised):
            return checked
        _check_quantiser(name, value.bits, value.step)
        # `checked` is a plain array: `ascontiguousarray` drops bits and step.
        return value.reshape(checked.shape)

    def pack(self, value: Any) -> Any:
        form = super().pack(value)
        if isinstance(value, Quantised):
            form["dtype"] = f"int{value.bits}"
            form["step"] = value.step
            form["data"] = packed(value.codes(), value.bits)
        return form

    def unpack(self, name: str, raw: Any) -> AnyArray | None:
        if not isinstance(raw, dict) or raw.keys() != _QUANTISED_KEYS:
            return super().unpack(name, raw)
        bits = _bits_of(name, raw["dtype"])
        step = raw["step"]
        if type(step) is not float:
            raise MalformedError(f"{name}: step must be a float")
        _check_quantiser(name, bits, step)
        shape = self._shape_of(name, raw)
        n_codes = math.prod(shape)
        data = _data_of(name, raw, n_bytes(n_codes, bits))

        # The largest code of `bits` bits is 1 less than they could hold.
        codes = unpacked(data, n_codes, bits)
        if codes.max() > largest_code(bits):
            raise MalformedError(f"{name}: a code beyond {largest_code(bits)}")
        return Quantised.of(codes.reshape(shape), bits, step)


def _data_of(name: str, raw: dict[str, Any], size: int) -> bytes:
    """Bytes of an array by its map, of which there must be `size`, or MessageError."""
    data = raw["data"]
    if not isinstance(data, bytes):
        raise MalformedError(f"{name}: data must be a bin field")
    if len(data) != size:
        form = f"{raw['shape']} of {raw['dtype']}"
        raise ShapeError(f"{name}: {form} does not fit {len(data)} bytes")
    return data


def _bits_of(name: str, dtype: Any) -> int:
    """Bits of a quantised number by the dtype "intB", or MessageError."""
    # At most four digits: int() of thousands takes long.
    match = None
    if isinstance(dtype, str):
        match = re.fullmatch("int([1-9][0-9]{0,3})", dtype)
    if match is None:
        raise ShapeError(f"{name}: expected dtype intB, got {str(dtype)[:32]!r}")
    return int(match[1])


def _check_quantiser(name: str, bits: int, step: float) -> None:
    if not MIN_BITS <= bits <= MAX_BITS:
        raise FieldError(f"{name}: {bits} bits is outside {MIN_BITS}..{MAX_BITS}")
    if not 0 < step < STEP_MAX:
        raise FieldError(f"{name}: a step of {step} is outside 0..{STEP_MAX:g}")


def wire(kind: FieldKind, **options: Any) -> Any:
    """Declare a dataclass field of a kind; options as of `dataclasses.field`."""
    return dataclasses.field(metadata={"wire": kind, "omitted": False}, **options)


def omitted(kind: FieldKind, default: Any = None) -> Any:
    """Declare a dataclass field that is sent only where it differs from its default, so that
    messages of programs without that field can be read, and those that do not use it keep their
    bytes.
    """
    return dataclasses.field(metadata={"wire": kind, "omitted": True}, default=default)
