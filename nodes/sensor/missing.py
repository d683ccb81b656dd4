"""Readings that are missing: cells of a frame that hold no number."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Bytes, Floats, Mask, mean_of_near

from .layout.layout import HOLD, MASK, ZERO

FILLED = {
    ZERO: "set to 0",
    HOLD: "replaced by the last ones",
    MASK: "replaced by the mean of their neighbours",
}
"""What is done with missing readings, for the log."""
RENEWAL_NS = 1_000_000_000
"""Least time between two skins, nanoseconds; chosen: each sets Phi and solver up anew."""


class MissingReadings:
    """Fills the readings of a frame that are missing (NaN, infinite), marks and counts them.

    A linear measurement of a frame needs a number for each taxel, so each gets one: the mean of the
    neighbours that have a reading (0 where none has), the last reading, or 0. That number travels
    marked, and is no measurement. Frames without any reading are left out, and counted.

    `way` is "mask", "hold" or "zero". With `learns`, cells that no frame has held a number of are
    masked, first by the first frame. One that then holds one is a taxel from the next renewal on.

    `skin` is without the masked cells; `is_news` is True once it has changed, until whoever
    publishes it sets it to False.
    """

    def __init__(self, way: str, skin: Skin, learns: bool) -> None:
        self.skin = skin
        self.is_news = False
        self.learns = learns
        self.n_cells = 0  # missing readings so far
        self.n_now = 0  # missing readings of the newest frame
        self.n_empty = 0  # frames without any reading
        self._way = way
        self._whole = skin
        #: Cells of it that no frame has held a number of.
        self._silent: Mask = skin.exists
        self._renewed_ns: int | None = None  # stamp of the frame that set `skin` last
        self._previous: Floats = np.zeros(skin.shape, np.float32)
        self._lines: list[str] = []

    def fill(self, forces: Floats, stamp_ns: int) -> tuple[Floats, Bytes | None] | None:
        """Fill a frame of `stamp_ns`, as of its source: float32 (n_rows, n_cols), not modified.

        Returns its forces, 0 in masked cells, and the bits of those that are missing, as in
        `Sensed`; None of a frame without any reading.
        """
        # Of the whole skin: a masked cell that gives a number now is a taxel.
        is_number = np.isfinite(forces) & self._whole.exists
        if not is_number.any():
            self.n_empty += 1
            return None
        if self.learns:
            self._learn(is_number, stamp_ns)

        # After `_learn`, which may have changed the mask.
        exists = self.skin.exists
        missing = exists & ~is_number
        is_number &= exists
        filled: Floats = np.where(is_number, forces, np.float32(0))
        self.n_now = int(np.count_nonzero(missing))
        if not self.n_now:
            self._previous = filled
            return filled, None

        # The first time is worth a line.
        if not self.n_cells:
            self._lines.append(
                f"missing readings are {FILLED[self._way]}: {self.n_now} at first"
            )

        # Of the way "zero" they are 0 already.
        self.n_cells += self.n_now
        if self._way == MASK:
            filled[missing] = mean_of_near(filled, is_number)[missing]
        elif self._way == HOLD:
            filled[missing] = self._previous[missing]
        self._previous = filled
        return filled, np.packbits(missing)

    def widen(self, f_max: float) -> None:
        """Raise the upper end of the range."""
        self._whole = replace(self._whole, f_max=f_max)
        self.skin = replace(self.skin, f_max=f_max)

    def take_lines(self) -> Iterable[str]:
        """Lines for the log since the last call."""
        lines = self._lines
        self._lines = []
        return lines

    def state(self) -> dict[str, int]:
        """Counts for the state of the sensor."""
        n_masked = self._whole.n_taxels - self.skin.n_taxels
        return {
            "missing": self.n_cells,
            "missing_now": self.n_now,
            "silent_taxels": n_masked,
        }

    def report(self) -> dict[str, int]:
        """Counts for a summary; empty where no reading was missing."""
        counts = {"missing": self.n_cells, "empty_frames": self.n_empty}
        return {name: n for name, n in counts.items() if n}

    @property
    def is_known(self) -> bool:
        """False while the first frame is still to show which cells hold a number."""
        return not self.learns or self._renewed_ns is not None

    def _learn(self, is_number: Mask, stamp_ns: int) -> None:
        """Renew the skin by the first frame, and where cells hold a number that have held none."""
        self._silent = self._silent & ~is_number
        n_silent = int(np.count_nonzero(self._silent))

        n_masked = self._whole.n_taxels - self.skin.n_taxels
        if self._renewed_ns is None:
            if n_silent:
                self._lines.append(
                    f"{n_silent} of {self._whole.n_taxels} taxels give no number: "
                    "masked until they do"
                )
        elif n_silent < n_masked and stamp_ns - self._renewed_ns >= RENEWAL_NS:
            self._lines.append(
                f"{n_masked - n_silent} masked taxels give numbers now: used"
            )
        else:
            return

        self._renewed_ns = stamp_ns
        self.is_news = True
        self.skin = self._whole
        if n_silent:
            self.skin = self._whole.without(self._silent)
