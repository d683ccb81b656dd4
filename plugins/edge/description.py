"""The description of an edge in C, what its program and the host have to agree on; its frames.

A frame on the wire: start, sequence number, version, Phi, step, codes, CRC-16. `compressed` is the
edge in Python: the bytes that its program sends, by the compressor's own Phi.
"""

import struct
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.quantised import (
    Quantised,
    largest_code,
    n_bytes,
    packed,
    unpacked,
)
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import BLOCK, RULES, SUMS
from sparseskin.nodes.compressor.phi.rotation import (
    FIXED,
    ROTATING,
    ROWS,
    check_subsets,
    row_subsets,
)
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.numerics.arrays import Indices, Integers, Mask, mask_texts
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.toml import parse_toml
from sparseskin.plugins.boards.framing import Framing

FILE_VERSION = 1
MAX_CELLS = 1 << 16
"""Largest number of cells of a frame: they are numbered in 16 bits."""
MAX_CHARS = 16 * MAX_CELLS
"""Longest `edge.toml`: a mask of one column has nine characters a cell."""
MAX_BLOCK = 256
"""Largest Hadamard block: 256 readings of 16 bits add up to less than 2^24, so that float32 holds
all sums exactly."""
HEADER_BYTES = 13
"""Bytes before the codes: start (2), sequence number (2), version (1), Phi (4), step (4)."""
CRC_BYTES = 2


@dataclass(frozen=True)
class EdgeDescription(Settings):
    """The matrix (`rule`: that of its rows, as in `SbhePhi`), the quantiser and the input of an
    edge. Raises SparseskinError if a value is not allowed.
    """

    n_rows: int = setting(1, "rows of the grid of cells", low=1, high=MAX_SIDE)
    n_cols: int = setting(1, "its columns; at most 65536 cells", low=1, high=MAX_SIDE)
    m: int = setting(1, "number of measurements a frame", low=1)
    bits: int = setting(8, "bits of a measurement", low=4, high=16)
    rows: str = setting(FIXED, "as in the settings of the compressor", choices=ROWS)
    block: int = setting(
        BLOCK, "size of the Hadamard blocks, a power of two", low=1, high=MAX_BLOCK
    )
    seed: int = setting(0, "seed of the matrix", low=0, high=2**32 - 1)
    rule: int = setting(SUMS, "rule by which its rows are chosen, 1 or 3")
    adc_bits: int = setting(
        12, "bits of a reading: counts are 0 .. 2^adc_bits - 1", low=1, high=16
    )
    mask: tuple[str, ...] | None = setting(
        None,
        "a text a row, 1 where a taxel exists and 0 where none does; all do by default",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.block & (self.block - 1):
            raise SettingsError(
                f"block: {self.block} is not a power of two (1, 2, 4 ...)"
            )
        if self.rule not in RULES:
            allowed = ", ".join(map(str, RULES))
            raise SettingsError(f"rule: {self.rule} is not allowed; allowed: {allowed}")
        if self.n_cells > MAX_CELLS:
            raise SettingsError(
                f"n_rows: {self.n_cells} cells; allowed: {MAX_CELLS} or fewer"
            )
        if self.mask is not None:
            self._check_mask(self.mask)
        if self.m > self.n_taxels:
            raise SettingsError(
                f"m: {self.m} is not allowed; allowed: 1..{self.n_taxels}"
            )
        # Rotating rows need as many taxels as subsets of m rows use.
        if self.rows == ROTATING:
            check_subsets(self.n_taxels, self.m)

    def _check_mask(self, mask: tuple[str, ...]) -> None:
        """Raise SettingsError if a mask is not of this grid, or leaves no taxel."""
        if len(mask) != self.n_rows or {len(row) for row in mask} != {self.n_cols}:
            raise SettingsError(
                f"mask: expected {self.n_rows} texts of {self.n_cols} characters"
            )
        if set("".join(mask)) - {"0", "1"}:
            raise SettingsError("mask: expected texts of 0 and 1")
        if not self.n_taxels:
            raise SettingsError("mask: leaves no taxel")

    @classmethod
    def chosen(
        cls,
        n_rows: int,
        n_cols: int,
        *,
        ratio: float,
        m: int | None = None,
        rows: str | None = None,
        mask: Mask | None = None,
        **values: Any,
    ) -> Self:
        """Describe an edge by its compression ratio, or M, with the rows and M that the compressor
        node chooses for them. Raises SparseskinError as the class, and if the compressor refuses
        them.
        """
        texts = None
        if mask is not None:
            texts = tuple(mask_texts(mask))
        # The number of measurements depends on that of the taxels, which the mask decides.
        description = cls(
            n_rows,
            n_cols,
            m=1,
            mask=texts,
            **values,
        )
        settings = CompressorSettings(
            phi="sbhe",
            ratio=ratio,
            m=m,
            rows=rows,
        )
        resolved, n_measurements = settings.rows_and_m(description.n_taxels)
        return replace(description, rows=resolved, m=n_measurements)

    @property
    def n_cells(self) -> int:
        """Number of cells of a frame, with a taxel or without."""
        return self.n_rows * self.n_cols

    @cached_property
    def exists(self) -> Mask:
        """True where a taxel exists, bool, shape (n_rows, n_cols)."""
        texts = self.mask or ("1" * self.n_cols,) * self.n_rows
        return np.array([[cell == "1" for cell in row] for row in texts])

    @cached_property
    def cells(self) -> Indices:
        """Cell of each taxel, intp, shape (n_taxels,), ascending."""
        return np.flatnonzero(self.exists)

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
        # Fixed rows are one subset.
        phis = row_subsets(phi, self.rows)
        return [subset for subset in phis if isinstance(subset, SbhePhi)]

    @cached_property
    def tags(self) -> dict[int, str]:
        """Fingerprint of each row subset's matrix, by its first 8 digits as a number. Raises
        SettingsError if two are the same.
        """
        by_tag = {int(phi.fingerprint[:8], 16): phi.fingerprint for phi in self.subsets}
        if len(by_tag) < len(self.subsets):
            raise SettingsError(
                "seed: two row subsets have the same short fingerprint; allowed: others"
            )
        return by_tag

    def to_toml(self) -> str:
        """Return the text of `edge.toml`."""
        values: dict[str, Any] = {"version": FILE_VERSION}
        values |= {field.name: getattr(self, field.name) for field in fields(self)}
        # A text a row is written below, as a person reads it.
        del values["mask"]
        values["fingerprint"] = self.phi.fingerprint
        lines = [
            "# What the program of this folder measures: the settings `source` and `description`",
            "# of a node of type edge read it.",
            *(f"{name} = {_quoted(value)}" for name, value in values.items()),
        ]
        if self.mask is not None:
            lines += ["# 1 where a taxel exists, a text a row.", "mask = ["]
            lines += [*(f'    "{row}",' for row in self.mask), "]"]
        return "\n".join([*lines, ""])

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read an `edge.toml`. Raises SettingsError if it cannot be read, has unknown or missing
        keys or values that are not allowed, or its seed gives another matrix here.
        """
        try:
            with path.open(encoding="utf-8") as file:
                values = parse_toml(file.read(MAX_CHARS + 1), MAX_CHARS)
        except OSError as error:
            raise SettingsError(f"{path}: cannot be read: {error.strerror}") from error
        except ValueError as error:
            raise SettingsError(f"{path}: no TOML: {error}") from error
        try:
            return cls._of(values)
        except SparseskinError as error:
            raise SettingsError(f"{path}: {error}") from error

    @classmethod
    def _of(cls, values: dict[str, Any]) -> Self:
        version = values.pop("version", None)
        fingerprint = values.pop("fingerprint", None)
        if version != FILE_VERSION:
            raise SettingsError(
                f"version: {version!r} is not allowed; allowed: {FILE_VERSION}"
            )
        description = cls.from_mapping(values)
        for field in fields(cls):
            if field.name not in {*values, "mask"}:
                raise SettingsError(f"{field.name}: is missing")
        fingerprint_here = description.phi.fingerprint
        # A matrix that differs by one row would give wrong forces without a sign of it.
        if fingerprint_here != fingerprint:
            seed = description.seed
            raise SettingsError(
                f"fingerprint: {fingerprint!r}, but seed {seed} gives Phi {fingerprint_here} here: "
                "the file was changed, or the generators differ"
            )
        # Read now, as it raises if two tags are the same.
        _ = description.tags
        return description


def _quoted(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    return str(value)


Counts = npt.NDArray[np.uint16]
_HEAD = struct.Struct("<BIf")
VERSION = 1
"""Form of a frame, its first byte after the sequence number."""


class EdgeFrame(NamedTuple):
    """Payload of a frame: fingerprint of its matrix, counts of a code's step, codes int32 (m,)."""

    phi: str
    step: float
    codes: Integers

    def measurements(self, bits: int, unit: float) -> Quantised:
        """Return the measurements; `unit` is the force of one count."""
        # Codes are in counts; the step turns them into forces.
        return Quantised.of(self.codes, bits, self.step * unit)


def framing_of(description: EdgeDescription) -> Framing:
    return Framing(
        _HEAD.size + description.code_bytes,
        start=b"\xaa\x55",
        sequence_bytes=2,
        checksum="crc16",
    )


def frame_bytes(
    description: EdgeDescription, seq: int, phi: str, y: Quantised
) -> bytes:
    """The bytes that the edge sends for frame `seq`, modulo 65536, of the matrix with fingerprint
    `phi`; `y`: measurements (m,) in counts, of `description.bits` bits.
    """
    # Eight digits of the fingerprint name the matrix in four bytes.
    head = _HEAD.pack(VERSION, int(phi[:8], 16), y.step)
    payload = head + packed(y.codes(), description.bits)
    return framing_of(description).encode(payload, seq)


def compressed(
    description: EdgeDescription, frames: Iterable[Counts]
) -> Iterator[bytes]:
    """Yield the bytes that the edge sends for successive frames of counts, uint16 (n_rows, n_cols);
    those above full scale are read as full scale.

    Sums of counts are exact in float32, so that they are the same in integers. The float32
    operations that follow (a product with 1 / sqrt(B), two quotients) are rounded as IEEE 754
    states, which the program does in integers.
    """
    subsets = description.subsets
    for seq, counts in enumerate(frames):
        phi = subsets[seq % len(subsets)]
        of_taxels = counts.reshape(-1)[description.cells]
        # As the program does: a converter has no more bits.
        readings = np.minimum(of_taxels, description.full_scale)
        y = quantised(phi.forward(readings.astype(np.float32)), description.bits)
        yield frame_bytes(description, seq, phi.fingerprint, y)


def stated(payload: bytes) -> str:
    """Version and matrix of a payload, for a person."""
    version, tag, _ = _HEAD.unpack_from(payload)
    if version != VERSION:
        return f"form {version}, read is {VERSION}"
    return f"{tag:08x}"


def read_frame(description: EdgeDescription, payload: bytes) -> EdgeFrame | None:
    """Read a payload; None if its form or matrix is another one, or its step not above 0."""
    d = description
    version, tag, step = _HEAD.unpack_from(payload)
    phi = d.tags.get(tag)
    if version != VERSION or phi is None or not 0 < step < np.inf:
        return None

    codes = unpacked(payload[_HEAD.size :], d.m, d.bits)
    # One code more than the quantiser uses fits the bits.
    np.minimum(codes, largest_code(d.bits), out=codes)
    return EdgeFrame(phi, step, codes)
