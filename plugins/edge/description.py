"""The description of an edge in C: what its program and the host have to agree on."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.quantised import n_bytes
from sparseskin.messages.ranges import is_whole
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import BLOCK, RANDOM, SPREAD
from sparseskin.nodes.compressor.phi.rotation import ROTATING, ROWS, check_subsets, row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError, SettingsError, SparseskinError
from sparseskin.nodes.lookup import did_you_mean, nearest_of

FILE_VERSION = 1
MAX_CELLS = 1 << 16
"""Largest number of cells of a frame: they are numbered in 16 bits."""
MAX_BLOCK = 256
"""Largest Hadamard block: 256 readings of 16 bits add up to less than 2^24, so that float32 holds
all sums exactly."""
HEADER_BYTES = 12
"""Bytes before the codes: start (2), sequence number (2), Phi (4), step (4)."""
CRC_BYTES = 2


class EdgeError(SparseskinError):
    """An edge that cannot be described, exported or read as asked."""


@dataclass(frozen=True, eq=False)
class EdgeDescription:
    """The matrix, the quantiser and the input of an edge. Raises EdgeError if a value is not
    allowed; the text begins with its name.

    Attributes
    ----------
    n_rows, n_cols : int
        Size of the grid of cells, at most 65536 cells.
    m : int
        Number of measurements a frame.
    bits : int
        Bits of a measurement, 4..16.
    rows : "fixed" or "rotating"
        As in the settings of the compressor.
    block : int
        Size of the Hadamard blocks, a power of two, 1..256.
    seed : int
        Seed of the matrix.
    rule : int
        Rule by which its rows are chosen, as in `SbhePhi`.
    adc_bits : int
        Bits of a reading, 1..16: counts are 0 .. 2^adc_bits - 1.
    mask : ndarray of bool, shape (n_rows, n_cols), or None
        True where a taxel exists; None if all do.
    """

    n_rows: int
    n_cols: int
    m: int
    bits: int = 8
    rows: str = "fixed"
    block: int = BLOCK
    seed: int = 0
    rule: int = SPREAD
    adc_bits: int = 12
    mask: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        for name, low, high in (
            ("n_rows", 1, MAX_SIDE),
            ("n_cols", 1, MAX_SIDE),
            ("bits", 4, 16),
            ("block", 1, MAX_BLOCK),
            ("seed", 0, 2**32 - 1),
            ("rule", RANDOM, SPREAD),
            ("adc_bits", 1, 16),
        ):
            value = getattr(self, name)
            if not is_whole(value, low, high):
                raise EdgeError(f"{name}: {value!r} is not allowed; allowed: {low}..{high}")
        if self.block & (self.block - 1):
            raise EdgeError(f"block: {self.block} is not a power of two (1, 2, 4 ...)")
        if self.rows not in ROWS:
            raise EdgeError(f"rows: {self.rows!r} is not allowed{nearest_of(self.rows, ROWS)}")
        if self.n_cells > MAX_CELLS:
            raise EdgeError(f"n_rows: {self.n_cells} cells; allowed: {MAX_CELLS} or fewer")
        if self.mask is not None:
            shape = (self.n_rows, self.n_cols)
            if self.mask.shape != shape or self.mask.dtype != np.bool_:
                raise EdgeError(
                    f"mask: {self.mask.dtype} of shape {self.mask.shape}; expected bool of {shape}"
                )
            if not self.mask.any():
                raise EdgeError("mask: leaves no taxel")
        if not is_whole(self.m, 1, self.n_taxels):
            raise EdgeError(f"m: {self.m!r} is not allowed; allowed: 1..{self.n_taxels}")
        if self.rows == ROTATING:
            try:
                check_subsets(self.n_taxels, self.m)
            except PhiError as error:
                raise EdgeError(str(error)) from error

    @classmethod
    def chosen(
        cls,
        n_rows: int,
        n_cols: int,
        *,
        ratio: float,
        m: int | None = None,
        rows: str | None = None,
        mask: npt.NDArray[np.bool_] | None = None,
        **others: Any,
    ) -> Self:
        """Describe an edge by its compression ratio, or M, with the rows and M that the compressor
        node chooses for them. Raises EdgeError as for the class, and if the compressor refuses
        ratio or rows.
        """
        made = cls(n_rows, n_cols, m=1, mask=mask, **others)
        try:
            settings = CompressorSettings(phi="sbhe", ratio=ratio, m=m, rows=rows)
            resolved, n_measurements = settings.rows_and_m(made.n_taxels)
            made = replace(made, rows=resolved, m=n_measurements)
        except (SettingsError, PhiError) as error:
            raise EdgeError(str(error)) from error
        return made

    @property
    def n_cells(self) -> int:
        """Number of cells of a frame, whether they hold a taxel or not."""
        return self.n_rows * self.n_cols

    @cached_property
    def cells(self) -> npt.NDArray[np.intp]:
        """Cell of each taxel, intp, shape (n_taxels,), ascending."""
        exists = np.ones(self.n_cells, bool) if self.mask is None else self.mask.ravel()
        return np.flatnonzero(exists)

    @property
    def n_taxels(self) -> int:
        """Number of cells that hold a taxel."""
        return self.cells.size

    @property
    def full_scale(self) -> int:
        """Largest count."""
        return int((1 << self.adc_bits) - 1)

    @property
    def count_bytes(self) -> int:
        """Bytes of a count."""
        return 1 if self.adc_bits <= 8 else 2

    @property
    def code_bytes(self) -> int:
        """Bytes of the codes of a frame."""
        return n_bytes(self.m, self.bits)

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame on the wire."""
        return HEADER_BYTES + self.code_bytes + CRC_BYTES

    @cached_property
    def phi(self) -> SbhePhi:
        """The measurement matrix; the first one where rows rotate."""
        return self.subsets[0]

    @cached_property
    def subsets(self) -> list[SbhePhi]:
        """The matrix of each row subset."""
        phi = SbhePhi(self.n_taxels, self.m, self.seed, self.block, self.rule)
        found = row_subsets(phi, self.rows)
        return [one for one in found if isinstance(one, SbhePhi)]

    @cached_property
    def tags(self) -> dict[int, str]:
        """Fingerprint of each row subset's matrix, by its first 8 digits as a number. Raises
        EdgeError if two are the same.
        """
        found = {int(phi.fingerprint[:8], 16): phi.fingerprint for phi in self.subsets}
        if len(found) < len(self.subsets):
            raise EdgeError(
                "seed: two row subsets have the same short fingerprint; allowed: others"
            )
        return found

    def to_toml(self) -> str:
        """Return the text of `edge.toml`."""
        values: dict[str, Any] = {
            "version": FILE_VERSION,
            **{field.name: getattr(self, field.name) for field in fields(self)},
            "fingerprint": self.phi.fingerprint,
        }
        del values["mask"]
        lines = [
            "# What the program of this folder measures: the settings `source` and `description`",
            "# of a node of type edge read it.",
            *(f"{k} = {_quoted(v)}" for k, v in values.items()),
        ]
        if self.mask is not None:
            rows = ("".join("01"[int(cell)] for cell in row) for row in self.mask)
            lines += ["# 1 where a taxel exists, a text a row.", "mask = ["]
            lines += [*(f'    "{row}",' for row in rows), "]"]
        return "\n".join([*lines, ""])

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an `edge.toml`. Raises EdgeError if it cannot be read, has unknown or missing keys
        or values that are not allowed, or its seed gives another matrix here.
        """
        try:
            tree = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise EdgeError(f"{path}: cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise EdgeError(f"{path}: no TOML: {error}") from error
        try:
            return cls._of(tree)
        except SparseskinError as error:
            raise EdgeError(f"{path}: {error}") from error

    @classmethod
    def _of(cls, tree: Mapping[str, Any]) -> Self:
        names = [field.name for field in fields(cls)]
        known = [*names, "version", "fingerprint"]
        for key in tree:
            if key not in known:
                raise EdgeError(f"{key}: unknown key{did_you_mean(key, known)}")
        tree = {"rule": RANDOM, **tree}  # files of version 0.1 state none
        missing = [name for name in known if name not in tree and name != "mask"]
        if missing:
            raise EdgeError(f"{missing[0]}: is missing")
        if tree["version"] != FILE_VERSION:
            raise EdgeError(f"version: {tree['version']!r} is not allowed; allowed: {FILE_VERSION}")
        values = {name: tree[name] for name in names if name in tree}
        for name, value in values.items():
            if name not in ("rows", "mask") and not is_whole(value):
                raise EdgeError(f"{name}: {value!r} is not allowed; allowed: a whole number")
        if not isinstance(values["rows"], str):
            raise EdgeError(f"rows: {values['rows']!r} is not allowed; allowed: {', '.join(ROWS)}")
        if "mask" in values:
            values["mask"] = _mask_of(values["mask"])
        made = cls(**values)
        if made.phi.fingerprint != tree["fingerprint"]:
            raise EdgeError(
                f"fingerprint: {tree['fingerprint']!r}, but seed {made.seed} gives Phi "
                f"{made.phi.fingerprint} here: the file was changed, or the generators differ"
            )
        _ = made.tags
        return made


def _mask_of(rows: Any) -> npt.NDArray[np.bool_]:
    if not isinstance(rows, list) or not all(isinstance(row, str) for row in rows):
        raise EdgeError("mask: expected a list of texts of 0 and 1")
    if not rows or len({len(row) for row in rows}) > 1 or set("".join(rows)) - {"0", "1"}:
        raise EdgeError("mask: expected texts of 0 and 1, all of one length")
    return np.array([[cell == "1" for cell in row] for row in rows])


def _quoted(value: Any) -> str:
    return f'"{value}"' if isinstance(value, str) else str(value)
