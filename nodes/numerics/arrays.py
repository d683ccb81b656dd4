"""Array types that all nodes share."""

import hashlib
import sys
from collections.abc import Callable
from typing import Any, TypeVar
from weakref import WeakValueDictionary

import numpy as np
import numpy.typing as npt

from sparseskin.messages.arrays import AnyArray as AnyArray
from sparseskin.messages.arrays import Bytes as Bytes
from sparseskin.messages.arrays import Doubles as Doubles
from sparseskin.messages.arrays import Floats as Floats
from sparseskin.messages.arrays import Indices as Indices
from sparseskin.messages.arrays import Integers as Integers
from sparseskin.messages.arrays import Mask as Mask

TINY = 1e-30
"""Added to a divisor that can be 0, or the least of it: far below the squares of float32 forces
that differ from 0, so that no other quotient changes."""
LARGEST = 1e30
"""Largest size of a force: sums of 256 are within float32."""


def mask_texts(mask: Mask) -> list[str]:
    """A text a row, of 1 (a taxel) and 0 (none): a person reads it as a picture."""
    return ["".join(row) for row in np.where(mask, "1", "0")]


def has_masked(given: object) -> bool:
    """True for a masked array of NumPy of which some entries are masked."""
    # Whoever has one has imported its module; NumPy itself imports it late, since it takes long.
    if "numpy.ma" not in sys.modules:
        return False
    return isinstance(given, np.ma.MaskedArray) and bool(np.ma.is_masked(given))


def real_floats(given: npt.ArrayLike, name: str, error: type[Exception]) -> Floats:
    """Return an array of real numbers as contiguous float32.
    Raises `error`, with the `name` of what was given, for complex numbers, objects and the like,
    and for a masked array.
    """
    if has_masked(given):
        raise error(
            f"{name}: entries are masked; allowed: an array without, as of .filled(0)"
        )
    try:
        array = np.asarray(given)
    except ValueError:  # lists of several lengths
        array = np.asarray(given, dtype=object)
    if array.dtype.kind not in "fiu":
        raise error(f"{name}: type {array.dtype}; allowed: real numbers, as of float32")
    return np.ascontiguousarray(array, dtype=np.float32)


def each_frame(
    apply: Callable[[Floats, Floats], None],
    given: Floats,
    shapes: tuple[tuple[int, ...], tuple[int, ...]],
    name: str,
    error: type[Exception],
) -> Floats:
    """What an operator makes of a frame, or of each of several: `apply` writes its result of the
    first array to the second, both contiguous float32, one frame.

    `given` is float32 of the first of `shapes`, or (k, *shape); the result, a fresh array, of the
    second. `error` is raised, with the name of `given` as in "sbhe: x", if the shape is another.
    """
    given = real_floats(given, name, error)
    expected, made = shapes
    several = given.ndim - len(expected)
    if several not in (0, 1) or given.shape[several:] != expected:
        raise error(
            f"{name} has shape {given.shape}; expected {expected}, or several of them"
        )
    out = np.empty((*given.shape[:several], *made), dtype=np.float32)
    if several:
        for argument, result in zip(given, out, strict=True):
            apply(argument, result)
    else:
        apply(given, out)
    return out


_Table = TypeVar("_Table", bound=AnyArray)
_TABLES: WeakValueDictionary[tuple[Any, ...], Any] = WeakValueDictionary()


def shared(table: _Table) -> _Table:
    """The one array that stands for all equal ones, while it is used: the tables of patches that
    are alike take memory, and cache, once. It must not be modified.
    """
    digest = hashlib.sha256(table.tobytes()).digest()
    key = table.dtype, table.shape, digest
    first_alike: _Table = _TABLES.setdefault(key, table)
    return first_alike


def edged(field: AnyArray) -> AnyArray:
    """A field, (n_rows, n_cols), within an edge of zeros: (n_rows + 2, n_cols + 2)."""
    n_rows, n_cols = field.shape
    # A tenth of the time of np.pad.
    padded = np.zeros((n_rows + 2, n_cols + 2), dtype=field.dtype)
    padded[1:-1, 1:-1] = field
    return padded


def of_nine(field: AnyArray, combine: np.ufunc) -> AnyArray:
    """Each cell and its eight neighbours, combined: an array as `field`, (n_rows, n_cols); beyond
    the edge is 0.
    """
    padded = edged(field)
    # Rows, then columns: four operations a cell in place of eight.
    upper_two = combine(padded[:-2], padded[1:-1])
    rows = combine(upper_two, padded[2:])
    left_two = combine(rows[:, :-2], rows[:, 1:-1])
    combined: AnyArray = combine(left_two, rows[:, 2:])
    return combined


def mean_of_near(values: Floats, is_known: Mask) -> Floats:
    """Mean of the known values of each cell and its eight neighbours, 0 where none is known:
    float32 and bool (n_rows, n_cols) to float32.
    """
    known_values = np.where(is_known, values, np.float32(0))
    sums = of_nine(known_values, np.add)
    n_known = of_nine(is_known.astype(np.float32), np.add)
    return np.divide(sums, np.maximum(n_known, 1))
