"""Messages of one topic as columns, an array for each field, and back: the layout of an .npz."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Message, Reconstruction, Taxels, Truth
from sparseskin.messages.base import wire_fields
from sparseskin.messages.fields import Array, FieldKind, Flag, Integer, Real, Samples, Text
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.wire import SCHEMAS

LOG_TIME = "log_time_ns"
"""Column of the times of recording."""
MAIN = {
    (Taxels.schema, "forces"): "forces",
    (Taxels.schema, "stamp_ns"): "stamp_ns",
    (Truth.schema, "forces"): Truth.schema,
    (Measurements.schema, "y"): Measurements.schema,
    (Reconstruction.schema, "forces"): Reconstruction.schema,
}
"""Columns with a short name; that of all others is SCHEMA_FIELD."""
BITS, STEP = "bits", "step"
"""Columns of the quantiser of measurements; 0 bits: sent as float32."""
_DTYPES: dict[type[FieldKind], Any] = {Integer: np.int64, Real: np.float64, Flag: np.bool_}
_DENSE = ("forces", "sd")
"""Arrays that have one shape in all messages of a topic."""


def column_name(schema: str, name: str) -> str:
    """Name of the array of a field of a schema."""
    return MAIN.get((schema, name), f"{schema}_{name}")


def fields_of(schema: str) -> dict[str, FieldKind]:
    """Fields that become columns: all but the patch, which is that of the file."""
    kinds = wire_fields(SCHEMAS[schema])
    return {name: kind for name, kind in kinds.items() if name != "patch"}


@dataclass
class Layout:
    """Sizes of the columns of one topic, found by a first reading of all its messages.

    Attributes
    ----------
    n : int
        Number of messages.
    shape : tuple of int
        Shape of the frames; the largest M of measurements.
    lengths : dict of str to int
        Of a text its largest number of characters; of an array of any length the elements of
        all messages together; 1 of any other field that some message has.
    """

    schema: str
    n: int = 0
    shape: tuple[int, ...] = ()
    n_elements: int = 0
    quantised: bool = False
    lengths: dict[str, int] = field(default_factory=dict)

    def add(self, message: Message) -> None:
        """Count a message."""
        self.n += 1
        for name, kind in fields_of(self.schema).items():
            value = getattr(message, name)
            if value is None:
                continue
            if isinstance(kind, Text):
                length = max(self.lengths.get(name, 1), len(value))
            elif isinstance(kind, Array) and name not in _DENSE and not isinstance(kind, Samples):
                length = self.lengths.get(name, 0) + value.size
            else:
                length = 1
            self.lengths[name] = length
        if isinstance(message, Measurements):
            self.shape = max(self.shape, message.y.shape)
            self.n_elements += message.y.size
            self.quantised |= isinstance(message.y, Quantised)
        elif (forces := getattr(message, "forces", None)) is not None:
            self.shape = forces.shape


class ColumnWriter:
    """Writes the messages of one topic to .npy files: a recording may be larger than the memory.

    `files` are their paths, NAME.npy for each column. A column that no message has is left out.
    """

    def __init__(self, layout: Layout, folder: Path) -> None:
        self._layout, self._folder = layout, folder
        self._columns: dict[str, npt.NDArray[Any]] = {}
        self._ends: dict[str, int] = {}
        self._n = 0
        self.files: list[Path] = []
        n, schema = layout.n, layout.schema
        for name, kind in fields_of(schema).items():
            if name not in layout.lengths:
                continue
            if isinstance(kind, Samples) or name in _DENSE:
                self._open(name, np.float32, (n, *layout.shape))
            elif isinstance(kind, Array):
                self._open(name, np.dtype(kind.dtype), (layout.lengths[name],))
                self._open(f"{name}_end", np.int64, (n,))
                self._open(f"{name}_shape", np.int64, (n, kind.ndim))
            elif isinstance(kind, Text):
                self._open(name, np.dtype(f"<U{layout.lengths[name]}"), (n,))
            else:
                self._open(name, _DTYPES[type(kind)], (n,))
        self._open(LOG_TIME, np.int64, (n,))
        if layout.quantised:
            self._open(BITS, np.int64, (n,))
            self._open(STEP, np.float64, (n,))

    def _open(self, name: str, dtype: Any, shape: tuple[int, ...]) -> None:
        path = self._folder / f"{column_name(self._layout.schema, name)}.npy"
        self.files.append(path)
        self._columns[name] = np.lib.format.open_memmap(path, mode="w+", dtype=dtype, shape=shape)

    def add(self, message: Message, log_time_ns: int) -> None:
        """Write one message behind those before it."""
        k = self._n
        self._n += 1
        for name, kind in fields_of(self._layout.schema).items():
            column = self._columns.get(name)
            if column is None:
                continue
            value = getattr(message, name)
            if isinstance(kind, Samples):
                column[k] = np.nan
                column[k, : len(value)] = value
            elif f"{name}_end" in self._columns:
                begin = self._ends.get(name, 0)
                end = begin + (0 if value is None else value.size)
                if value is not None:
                    column[begin:end] = value.ravel()
                    self._columns[f"{name}_shape"][k] = value.shape
                self._ends[name] = self._columns[f"{name}_end"][k] = end
            else:
                column[k] = np.nan if value is None else value
        self._columns[LOG_TIME][k] = log_time_ns
        if self._layout.quantised:
            y = getattr(message, "y")  # noqa: B009
            quantised = isinstance(y, Quantised)
            self._columns[BITS][k] = y.bits if quantised else 0
            self._columns[STEP][k] = y.step if quantised else 0.0


def rebuilt(
    schema: str, patch: str, arrays: Mapping[str, npt.NDArray[Any]]
) -> Iterator[tuple[int, Message]]:
    """The messages of columns, with their times of recording; the inverse of `ColumnWriter`.

    Raises
    ------
    ValueError
        If a column is missing, has another dtype or shape, or holds what no message may hold.
    """
    cls = SCHEMAS[schema]
    held = {
        name: arrays[column_name(schema, name)]
        for name in [*fields_of(schema), LOG_TIME, BITS, STEP]
        if column_name(schema, name) in arrays
    }
    ends, shapes = (
        {
            name: arrays[column_name(schema, f"{name}_{what}")]
            for name, kind in fields_of(schema).items()
            if column_name(schema, f"{name}_{what}") in arrays and isinstance(kind, Array)
        }
        for what in ("end", "shape")
    )
    if ends.keys() != shapes.keys():
        raise ValueError(f"arrays of {schema}: _end and _shape, expected both or none")
    needed = ("stamp_ns", LOG_TIME, *((STEP,) if BITS in held else ()))
    for name in needed:
        if name not in held:
            raise ValueError(f"holds no array {column_name(schema, name)!r}")
    n = len(held["stamp_ns"]) if held["stamp_ns"].ndim else 0
    for name, column in {**held, **{f"{name}_end": end for name, end in ends.items()}}.items():
        if (name not in ends) and (not column.ndim or len(column) != n):
            raise ValueError(
                f"array {column_name(schema, name)!r}: shape {column.shape}; expected one entry "
                f"for each of {n} messages"
            )
    for k in range(n):
        values: dict[str, Any] = {"patch": patch}
        for name, kind in fields_of(schema).items():
            if name in held:
                values[name] = _value(kind, name, held, ends, k)
            elif getattr(kind, "optional", False):
                values[name] = None
        if "y" in values and BITS in held and (bits := int(held[BITS][k])):
            values["y"] = _quantised(values["y"], bits, float(held[STEP][k]))
        for name, shape in shapes.items():
            if values.get(name) is not None:
                values[name] = values[name].reshape([int(side) for side in shape[k]])
        yield int(held[LOG_TIME][k]), cls(**values)


def _value(
    kind: FieldKind,
    name: str,
    held: Mapping[str, npt.NDArray[Any]],
    ends: Mapping[str, npt.NDArray[Any]],
    k: int,
) -> Any:
    column = held[name]
    if isinstance(kind, Samples):
        row = column[k]
        if row.ndim != 1 or row.dtype != np.float32:
            raise ValueError(f"array {name!r}: expected float32, one row a message")
        numbers = ~np.isnan(row)
        return row[: int(numbers.nonzero()[0].max(initial=-1)) + 1]
    if name in ends:
        begin, end = (int(ends[name][k - 1]) if k else 0), int(ends[name][k])
        if not 0 <= begin <= end <= len(column):
            raise ValueError(f"array '{name}_end': {end} after {begin}, of {len(column)}")
        return column[begin:end] if end > begin else None
    value = column[k]
    if isinstance(kind, Array):
        return None if kind.optional and np.isnan(value).all() else value
    if isinstance(kind, Real):
        number = float(value)
        return None if kind.optional and math.isnan(number) else number
    return cast(Any, value.item())


def _quantised(y: npt.NDArray[Any], bits: int, step: float) -> Quantised:
    if not step > 0:
        raise ValueError(f"array 'measurements_step': {step} must be above 0")
    codes = np.rint(y / np.float32(step)).astype(np.int32)
    return Quantised.of(codes, bits, step)
