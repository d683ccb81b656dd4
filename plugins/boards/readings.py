"""From the payload of a frame to readings: type, order of the taxels, zero and scale."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Indices

DTYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "float32", "float64")
ORDERS = ("rows", "columns")


def order_of(text: str, n: int) -> list[int] | None:
    """Places in which n rows or columns are sent, from "forward", "reversed" or "2,0,1"; None if
    the text is none of these.
    """
    if text == "forward":
        return list(range(n))
    if text == "reversed":
        return list(range(n))[::-1]
    parts = text.split(",")
    if len(parts) != n or not all(p.strip().isdecimal() and len(p.strip()) < 6 for p in parts):
        return None
    order = [int(part) for part in parts]
    return order if sorted(order) == list(range(n)) else None


@dataclass(frozen=True)
class Layout:
    """The readings in a payload.

    Attributes
    ----------
    n_rows, n_cols : int
        Shape of the skin.
    dtype, byte_order
        Type of a count, one of `DTYPES`; "little" or "big".
    order : "rows" or "columns"
        What is sent as a whole: row after row, or column after column.
    row_order, col_order : list of int
        Of each row (column) that is sent, in order, its place in the skin: permutations.
    scale, zero : float
        A reading is (count - zero) * scale.
    """

    n_rows: int
    n_cols: int
    dtype: str
    byte_order: str
    order: str
    row_order: list[int]
    col_order: list[int]
    scale: float = 1.0
    zero: float = 0.0

    @property
    def n_bytes(self) -> int:
        """Length of the payload."""
        return self.n_rows * self.n_cols * np.dtype(self.dtype).itemsize

    @property
    def highest(self) -> float | None:
        """Reading of the largest count; None of a floating type, which has none."""
        dtype = np.dtype(self.dtype)
        if dtype.kind == "f":
            return None
        return float((np.iinfo(dtype).max - self.zero) * self.scale)


class Decoder:
    """Decodes payloads of one layout."""

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        dtype = np.dtype(layout.dtype)
        self._dtype = dtype.newbyteorder("<" if layout.byte_order == "little" else ">")
        shape = (layout.n_rows, layout.n_cols)
        sent = np.arange(layout.n_rows * layout.n_cols)
        grid = sent.reshape(shape) if layout.order == "rows" else sent.reshape(shape[::-1]).T
        places = np.empty(shape, np.intp)
        places[np.ix_(layout.row_order, layout.col_order)] = grid
        self._places: Indices | None = None if np.array_equal(places.ravel(), sent) else places
        self._shape = shape
        # Counts of up to 24 bits are exact in float32.
        self._wide = dtype.itemsize > 2
        self._plain = layout.zero == 0 and layout.scale == 1

    def __call__(self, payload: bytes) -> Floats:
        """Readings, float32 (n_rows, n_cols); neither clipped nor checked for NaN."""
        counts = np.frombuffer(payload, self._dtype)
        counts = counts.reshape(self._shape) if self._places is None else counts[self._places]
        if self._plain:
            with np.errstate(all="ignore"):  # a float64 beyond float32 becomes infinite
                return counts.astype(np.float32)
        layout = self._layout
        with np.errstate(all="ignore"):
            if self._wide:
                return ((counts.astype(np.float64) - layout.zero) * layout.scale).astype(np.float32)
            return (counts.astype(np.float32) - np.float32(layout.zero)) * np.float32(layout.scale)
