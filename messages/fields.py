"""Kinds of message fields: each checks a value, packs it and unpacks it."""

import dataclasses
import functools
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

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


class FieldKind:
    """Wire form of one field. `check` runs whenever a message is made, also by `decode`."""

    def check(self, name: str, value: Any) -> Any:
        """Return the value in its canonical form, or raise MessageError."""
        raise NotImplementedError

    def pack(self, value: Any) -> Any:
        """Convert a checked value to a msgpack type."""
        return value

    def unpack(self, name: str, raw: Any) -> Any:
        """Inverse of `pack`, with the checks of `check`."""
        return self.check(name, raw)


def _wrong_type(name: str, expected: str, value: Any) -> FieldError:
    return FieldError(f"{name}: expected {expected}, got {type(value).__name__}")


class Number(FieldKind):
    """A number or a truth value, which a frame carries in binary; `code` as of module `struct`."""

    code: ClassVar[str]

    @property
    def of_number(self) -> Callable[[str, Any], Any]:
        """Function of name and number as it travelled: its value, or MessageError."""
        return self.check


@dataclass(frozen=True)
class Integer(Number):
    """A whole number in [low, high]."""

    code: ClassVar[str] = "q"

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
class Real(Number):
    """A finite number in [low, high]; None, which travels as NaN, where `optional`."""

    code: ClassVar[str] = "d"

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

    @property
    def of_number(self) -> Callable[[str, Any], Any]:
        if self.optional:
            return self._known_number
        return self.check

    def _known_number(self, name: str, number: Any) -> float | None:
        # Only NaN differs from itself: it stands for None.
        if number != number:
            return None
        return self.check(name, number)


@dataclass(frozen=True)
class Flag(Number):
    """True or false."""

    code: ClassVar[str] = "?"

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

    @property
    def of_number(self) -> Callable[[str, Any], Any]:
        """As `Number.of_number`, of the number of the only patch of a message."""
        check = self.kind.of_number
        return lambda name, number: (check(name, number),)

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

    def check(self, name: str, value: Any) -> npt.NDArray[Any] | None:
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

    def pack(self, value: Any) -> Any:
        if value is None:
            return None
        form: dict[str, Any] = {
            "dtype": self.dtype_of(value),
            "shape": list(value.shape),
            "order": "C",
        }
        for step in self.extra_of(value):
            form["step"] = step
        form["data"] = bytes(self.data_of(value))
        return form

    def unpack(self, name: str, raw: Any) -> npt.NDArray[Any] | None:
        if raw is None and self.optional:
            return None
        if not isinstance(raw, dict) or raw.keys() - {"step"} != _ARRAY_KEYS:
            raise MalformedError(
                f"{name}: expected a map of dtype, shape, order and data"
            )
        # The sizes are checked before any byte is looked at.
        dtype, shape, size = self.checked_form(name, [raw["dtype"], raw["shape"]])
        if raw["order"] != "C":
            raise ShapeError(f"{name}: expected order C, got {str(raw['order'])[:8]!r}")
        is_quantised = dtype != self.dtype
        if ("step" in raw) != is_quantised:
            raise MalformedError(
                f"{name}: expected a step with dtype intB, and with no other"
            )

        data = raw["data"]
        if not isinstance(data, bytes):
            raise MalformedError(f"{name}: data must be a bin field")
        if len(data) != size:
            raise ShapeError(
                f"{name}: {list(shape)} of {dtype} does not fit {len(data)} bytes"
            )
        return self.of_data(name, dtype, shape, raw.get("step"), data)

    def dtype_of(self, value: Any) -> str:
        """Dtype of a checked array as it travels."""
        return self.dtype

    def extra_of(self, value: Any) -> tuple[float, ...]:
        """Numbers of a frame that its array needs: the step of a quantised one."""
        return ()

    def data_of(self, value: Any) -> Any:
        """Bytes of a checked array, not copied where it has them already."""
        return value.data

    def checked_form(self, name: str, form: Any) -> tuple[str, tuple[int, ...], int]:
        """Dtype, shape and number of bytes of an array, by [dtype, shape], or MessageError."""
        if not isinstance(form, list) or len(form) != 2:
            raise MalformedError(f"{name}: expected dtype and shape")
        dtype, shape = form
        bits = self._bits_of(name, dtype)
        # Not isinstance: True is an integer of Python, but no side.
        is_list = isinstance(shape, list)
        if not is_list or not all(type(side) is int for side in shape):
            raise MalformedError(f"{name}: shape must be a list of whole numbers")
        self._check_shape(name, tuple(shape))
        return dtype, tuple(shape), n_bytes(math.prod(shape), bits)

    def of_data(
        self,
        name: str,
        dtype: str,
        shape: tuple[int, ...],
        extra: Any,
        data: bytes | memoryview,
    ) -> npt.NDArray[Any]:
        """The array of bytes, as many as `checked_form` returned; MessageError if not finite."""
        # numpy would take any byte but 0 for true, and keep it.
        if self._dtype.kind == "b" and max(data, default=0) > 1:
            raise MalformedError(f"{name}: a boolean byte other than 0 and 1")
        value: npt.NDArray[Any] = np.ndarray(shape, self._dtype, data)
        self._check_finite(name, value)
        return value

    def _bits_of(self, name: str, dtype: Any) -> int:
        """Number of bits of an element of a dtype as it travels, or MessageError."""
        if dtype != self.dtype:
            raise ShapeError(
                f"{name}: expected dtype {self.dtype}, got {str(dtype)[:32]!r}"
            )
        return 8 * self._dtype.itemsize

    @functools.cached_property
    def _dtype(self) -> np.dtype[Any]:
        return np.dtype(self.dtype)

    def _check_finite(self, name: str, value: npt.NDArray[Any]) -> None:
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

    def check(self, name: str, value: Any) -> npt.NDArray[Any] | None:
        checked = super().check(name, value)
        if checked is None or not isinstance(value, Quantised):
            return checked
        _check_quantiser(name, value.bits, value.step)
        # `checked` is a plain array: `ascontiguousarray` drops bits and step.
        return value.reshape(checked.shape)

    def dtype_of(self, value: Any) -> str:
        if isinstance(value, Quantised):
            return f"int{value.bits}"
        return self.dtype

    def extra_of(self, value: Any) -> tuple[float, ...]:
        if isinstance(value, Quantised):
            return (value.step,)
        return ()

    def data_of(self, value: Any) -> Any:
        if isinstance(value, Quantised):
            return packed(value.codes(), value.bits)
        return super().data_of(value)

    def of_data(
        self,
        name: str,
        dtype: str,
        shape: tuple[int, ...],
        extra: Any,
        data: bytes | memoryview,
    ) -> npt.NDArray[Any]:
        if dtype == self.dtype:
            return super().of_data(name, dtype, shape, extra, data)

        bits = self._bits_of(name, dtype)
        if type(extra) is not float:
            raise MalformedError(f"{name}: step must be a float")
        _check_quantiser(name, bits, extra)

        # The largest code of `bits` bits is 1 less than they could hold.
        codes = unpacked(data, math.prod(shape), bits)
        if codes.max() > largest_code(bits):
            raise MalformedError(f"{name}: a code beyond {largest_code(bits)}")
        return Quantised.of(codes.reshape(shape), bits, extra)

    def _bits_of(self, name: str, dtype: Any) -> int:
        if dtype == self.dtype:
            return super()._bits_of(name, dtype)
        # At most four digits: int() of thousands takes long.
        match = None
        if isinstance(dtype, str):
            match = re.fullmatch("int([1-9][0-9]{0,3})", dtype)
        if match is None:
            raise ShapeError(f"{name}: expected dtype intB, got {str(dtype)[:32]!r}")
        bits = int(match[1])
        _check_quantiser(name, bits, 1.0)
        return bits


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
