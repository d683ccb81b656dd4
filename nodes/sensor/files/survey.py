"""A first pass over the frames of a recording: its range, and what is done with readings that are
not finite or below 0.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.sensor.layout.layout import (
    KEEP,
    MASK,
    OFFSET,
    REFUSE,
    ZERO,
    Layout,
)
from sparseskin.nodes.sensor.missing import FILLED

from .frames import Stamped

DIGEST_BYTES = 8
LOOK_BYTES = 1 << 22
"""Frames of the begin of a file that is looked at, bytes; chosen: a table is read so far in half a
second."""


class Needs(NamedTuple):
    """What is needed of a recording before its first frame. `range`: the largest reading, where no
    range is stated; with `widens` that of its begin is enough, and a larger one widens the range
    when it comes. `in_memory`: all frames are; they are decoded once. `begin`: no more than the
    begin of a file is read, of about `LOOK_BYTES`.
    """

    range: bool = True
    widens: bool = False
    digest: bool = False
    in_memory: bool = False
    begin: bool = False


class FrameStore:
    """Stamps (k,) and frames (k, n_rows, n_cols) in memory, in an array that grows in place."""

    def __init__(self, shape: tuple[int, int]) -> None:
        self.frames: Floats = np.empty((0, *shape), dtype=np.float32)
        self._stamps: list[npt.NDArray[np.int64]] = []

    def add(self, stamp_ns: npt.NDArray[np.int64], frames: Floats) -> None:
        """Add frames. No part of the array may be in use."""
        n = len(self.frames)

        # In place, so that no second copy is needed while it grows.
        self.frames.resize((n + len(frames), *self.frames.shape[1:]), refcheck=False)
        self.frames[n:] = frames
        self._stamps.append(stamp_ns)

    def blocks(self) -> Iterator[Stamped]:
        """The blocks that were added; the frames are parts of the array."""
        n = 0
        for stamp_ns in self._stamps:
            yield stamp_ns, self.frames[n : n + len(stamp_ns)]
            n += len(stamp_ns)


@dataclass
class Survey:
    """Counts and extremes of frames (k, n_rows, n_cols), NaN where a reading is missing."""

    shape: tuple[int, int]
    mask: Mask | None = None
    n_frames: int = 0
    n_missing: int = 0
    n_negative: int = 0
    lowest: float = 0.0  # of 0 and all readings
    highest: float = 0.0
    has_number: Mask = field(init=False)  # (n_rows, n_cols): in some frame
    was_negative: Mask = field(init=False)
    content: hashlib.blake2b | None = None  # hash of all frames, where it is needed

    def __post_init__(self) -> None:
        self.has_number = np.zeros(self.shape, dtype=np.bool_)
        self.was_negative = np.zeros(self.shape, dtype=np.bool_)

    @property
    def exists(self) -> Mask:
        """True where the file states a taxel."""
        if self.mask is not None:
            return self.mask
        return np.ones(self.shape, dtype=np.bool_)

    def add(self, frames: Floats, extremes: tuple[float, float] | None) -> None:
        """Add frames, and their lowest and highest reading; None: they hold NaN."""
        # One pass gathers all that any treatment needs: a file of 2 GB is decoded once.
        self.n_frames += len(frames)
        if self.content is not None:
            self.content.update(np.ascontiguousarray(frames).data)
        if extremes is not None:
            lowest, highest = extremes
            self.has_number[:] = True
        else:
            lowest = float(np.fmin.reduce(frames, axis=None))
            highest = float(np.fmax.reduce(frames, axis=None))
            is_number = np.isfinite(frames)
            self.n_missing += int(is_number.size - np.count_nonzero(is_number))
            self.has_number |= is_number.any(axis=0)
        self.lowest = min(self.lowest, lowest)
        self.highest = max(self.highest, highest)

        # Most frames have none: no second pass over them.
        if lowest < 0:
            is_negative = frames < 0
            self.n_negative += int(np.count_nonzero(is_negative))
            self.was_negative |= is_negative.any(axis=0)


class Treatment:
    """What a layout does with readings that are not valid, after a survey of them all. Cells
    without a taxel stay 0.
    """

    def __init__(self, layout: Layout, survey: Survey, raw: bool) -> None:
        self._layout = layout
        self._survey = survey
        # A calibration converts readings below 0, too.
        self._negative = layout.negative
        if raw and layout.negative == REFUSE:
            self._negative = KEEP
        # A taxel is masked for all frames, so that its place never changes its meaning.
        gone = np.zeros(survey.shape, dtype=np.bool_)
        if layout.nan == MASK:
            gone |= ~survey.has_number
        if self._negative == MASK:
            gone |= survey.was_negative
        self.gone: Mask = gone & survey.exists
        self.offset = survey.lowest if self._negative == OFFSET else 0.0

    @staticmethod
    def needs_survey(layout: Layout) -> bool:
        """True if readings of later frames decide the range or what is done with the first one."""
        return layout.nan == MASK or layout.negative in (MASK, OFFSET, KEEP)

    @property
    def is_signed(self) -> bool:
        """True if readings below 0 are stated to be kept, or to become 0."""
        return self._layout.negative in (KEEP, ZERO)

    @property
    def lower_end(self) -> float:
        """Lower end of the range: below 0 where readings below 0 are kept."""
        if self._layout.negative == KEEP:
            return self._survey.lowest
        return 0.0

    @property
    def n_masked(self) -> int:
        """Number of taxels that are masked for their readings."""
        return int(np.count_nonzero(self.gone))

    def apply(self, frames: Floats) -> Floats:
        """Treated frames; the array is changed."""

        if self.gone.any():
            frames[:, self.gone] = 0
        if self._negative == ZERO:
            np.maximum(frames, 0, out=frames)  # NaN stays
        elif self.offset:
            frames[:, self._survey.exists & ~self.gone] -= np.float32(self.offset)
        return frames

    @property
    def _n_negative(self) -> int:
        """Number of readings below 0 that are treated."""
        if self._layout.negative == REFUSE:
            return 0
        return self._survey.n_negative

    def lines(self, unit: str) -> list[str]:
        """One line for a log on each kind of invalid reading; none where there was none."""
        lines = []
        n_missing = self._survey.n_missing
        if n_missing:
            way = self._layout.missing_way
            line = f"{n_missing} readings of the file are missing: {FILLED[way]}"
            if way == MASK:
                line += ", NaN in arrays"
            lines.append(line)
        if self._n_negative:
            ways = {ZERO: "set to 0", MASK: "masked", KEEP: "kept"}
            subtracted = f"{self.offset:g} {unit} subtracted from all readings"
            way = ways.get(self._negative, subtracted)
            lines.append(f"{self._n_negative} readings of the file are below 0: {way}")
        if lines and self.n_masked:
            lines[-1] += f" ({self.n_masked} taxels masked)"
        return lines

    def counts(self) -> dict[str, Any]:
        """Counts for a summary; none where all readings were valid."""
        survey = self._survey
        if not (survey.n_missing or self._n_negative):
            return {}
        return {
            "not_finite": survey.n_missing,
            "negative": survey.n_negative,
            "masked_taxels": self.n_masked,
            "offset": self.offset,
        }
