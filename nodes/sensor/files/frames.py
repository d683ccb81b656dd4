"""Frames of an open recording: its items arranged by the layout, checked, and stamped."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import INT64_MAX
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.sensor.layout.arrangement import Arrangement, arrange
from sparseskin.nodes.sensor.layout.checks import COUNTS, MAX_READING, NAN_HINT
from sparseskin.nodes.sensor.layout.layout import KEEP, REFUSE, UnstatedError
from sparseskin.nodes.sensor.layout.times import Stamps, unit_of

from .recording import Block, File, Recording

UNTIMED_PERIOD_NS = 10_000_000
"""Time between frames where neither file nor caller states one, chosen: stamps must rise."""
ISOLATED = 10
"""A number below 0 stands for no reading if all others lie above it by so many times its size;
chosen: of -1 among readings of 10 and more."""
_UNIT_HINT = "state unit: N, kPa, V, counts or another text"

Stamped = tuple[npt.NDArray[np.int64], Floats]
"""Stamps (k,), nanoseconds since the first frame, and frames (k, n_rows, n_cols), NaN where a
reading is missing, 0 in cells without a taxel."""


class Frames:
    """The frames of an open recording, read from its begin by each call of `blocks`.

    Raises UnstatedError if shape, unit or times are not stated, SourceError if what is stated
    contradicts the file.
    """

    def __init__(self, file: File, recording: Recording) -> None:
        self.name = file.name
        self._parts = file.parts
        self.layout = file.layout
        self.raw = file.raw
        self.recording = recording
        self.head = recording.head()
        self.n_repeated = 0
        self.last_ns = 0
        #: Frames that the last `blocks` has yielded.
        self.n_frames = 0
        #: Lowest and highest reading of the block that was yielded last; None: it holds NaN.
        self.extremes: tuple[float, float] | None = None
        self._sample_block: Block | None = None
        self.arrangement = self._arranged()
        self.mask = self._arranged_mask()

    @property
    def n_bytes(self) -> int:
        """Size of the file, and of those that go on with it."""
        return sum(Path(name).stat().st_size for name in (self.name, *self._parts))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.arrangement.shape

    @property
    def n_taxels(self) -> int:
        """Number of cells that the file states to be taxels."""
        if self.mask is not None:
            return int(np.count_nonzero(self.mask))
        n_rows, n_cols = self.shape
        return n_rows * n_cols

    @property
    def is_timed(self) -> bool:
        """True if stamps follow from times of the file, and no rate is stated in their place."""
        return self.head.is_timed and self.layout.rate_hz is None

    @property
    def is_whole(self) -> bool:
        """True if the readings are whole numbers, as a converter gives them."""
        return self._holds_whole_numbers(self.arrangement)

    @property
    def time_unit(self) -> str:
        """Unit of the times; the first block is read for it where nothing states it."""
        if self._unit_stated or not self.is_timed:
            return self._unit_stated or "ns"
        return unit_of([float(time) for time in self._sample().times or ()], self.name)

    @property
    def _unit_stated(self) -> str:
        return self.head.time_unit or self.layout.time_unit

    def blocks(self) -> Iterator[Stamped]:
        """Read all frames. Raises SourceError at the first reading, time or item that is none."""
        stamps: Stamps | None = None
        if self.is_timed:
            stamps = Stamps(self.time_unit, self.layout.time_wrap)
        self.n_frames = 0
        # The reader decodes; here its numbers become readings of taxels, at their time.
        for block in self.recording.blocks():
            frames = self._checked(self.arrangement.frames(block.numbers))
            if stamps is not None:
                stamp_ns = stamps.stamps(block.times or (), self.name)
                self.n_repeated = stamps.n_repeated
            else:
                stamp_ns = self._even(len(frames))
            self.n_frames += len(frames)
            self.last_ns = int(stamp_ns[-1])
            yield stamp_ns, frames

        if stamps is not None:
            stamps.check(self.name)
        self.recording.tally.check(self.name)
        if not self.n_frames:
            raise SourceError(f"{self.name}: the recording holds no frame")

    def notes(self) -> Sequence[str]:
        """Lines on how the file was read, after its end."""
        lines = [*self.head.notes, *self.arrangement.notes]
        if self.is_timed:
            time_name = self.head.time_name
            if not self._unit_stated:
                lines.append(
                    f"times: {time_name or 'of each item'}, taken as {self.time_unit}"
                )
            elif time_name:
                lines.append(f"times: {time_name} in {self.time_unit}")
        elif self.head.is_timed:
            time_name = self.head.time_name or "those of each item"
            lines.append(f"times: {time_name}, not read, since a rate is stated")
        # A logger with a coarse clock, or frames that were sent twice.
        if self.n_repeated:
            lines.append(
                f"{self.n_repeated} times repeat the one before: 1 ns later each"
            )
        lines.append(self.recording.tally.text)
        return lines

    def _arranged(self) -> Arrangement:
        """The arrangement. Raises UnstatedError with all that is not stated: shape, unit of the
        readings, unit of the times.
        """
        faults: list[UnstatedError] = []

        # All that is missing is named at once.
        arrangement: Arrangement | None = None
        try:
            arrangement = arrange(
                self.layout, self.head.axes, self.name, self.head.usable
            )
        except UnstatedError as error:
            faults.append(error)
        if self.head.asks_unit and not (self.layout.unit or self.raw):
            faults.append(self._unstated_unit(arrangement))
        if faults:
            # Where nothing else is missing, the times are looked at with the first frame.
            try:
                _ = self.time_unit
            except UnstatedError as error:
                faults.append(error)
        if arrangement is None or faults:
            raise _together(faults, self.name)
        return arrangement

    def _arranged_mask(self) -> Mask | None:
        mask = self.head.mask
        if mask is None:
            return None
        if mask.size == 0 or not mask.any():
            raise SourceError(
                f"{self.name}: no cell of the skin is a taxel, all are masked"
            )
        arranged: Mask = self.arrangement.frames(mask[None])[0]
        return arranged

    def _sample(self) -> Block:
        """The first block; read once."""
        if self._sample_block is None:
            self._sample_block = next(iter(self.recording.blocks()), None)
            if self._sample_block is None:
                raise SourceError(f"{self.name}: the recording holds no frame")
        return self._sample_block

    def _holds_whole_numbers(self, arrangement: Arrangement | None) -> bool:
        numbers = self._sample().numbers
        if numbers.dtype.kind in "iu":
            return True
        if arrangement is not None:
            numbers = arrangement.frames(numbers)
        elif self.head.usable is not None:
            numbers = numbers[:, list(self.head.usable)]
        # A file that holds floats may hold counts.
        readings = numbers[np.isfinite(numbers)]
        return self.head.asks_unit and bool((readings == np.rint(readings)).all())

    def _unstated_unit(self, arrangement: Arrangement | None) -> UnstatedError:
        fault = f"{self.name}: the unit of the readings is not stated; {_UNIT_HINT}"
        if self._holds_whole_numbers(arrangement):
            return UnstatedError(fault, {"unit": COUNTS})
        return UnstatedError(fault)

    def _even(self, n: int) -> npt.NDArray[np.int64]:
        """Stamps of the next n frames at an even rate."""
        rate_hz = self.layout.rate_hz or self.head.rate_hz

        # From the number of the frame, so that rounding does not add up.
        period_ns = UNTIMED_PERIOD_NS if rate_hz is None else 1e9 / rate_hz
        stamps = np.rint(np.arange(self.n_frames, self.n_frames + n) * period_ns)
        if stamps[-1] > INT64_MAX:
            raise SourceError(f"{self.name}: the recording lasts longer than 2**63 ns")
        whole: npt.NDArray[np.int64] = stamps.astype(np.int64)
        return whole

    def _checked(self, readings: npt.NDArray[Any]) -> Floats:
        """Readings as float32, NaN where one is missing. Raises SourceError, with the place, at one
        that is not allowed.
        """
        layout = self.layout
        # What float32 does not hold becomes infinite, and is refused below.
        with np.errstate(all="ignore"):
            frames: Floats = readings.astype(np.float32)
        for number in layout.missing_numbers:
            frames[readings == number] = np.nan
        if self.mask is not None:
            frames[:, ~self.mask] = 0

        with np.errstate(invalid="ignore"):
            lowest = frames.min()
            highest = frames.max()
        allows_below = self.raw or layout.negative != REFUSE
        lower_end = -MAX_READING if allows_below else 0.0
        if lower_end <= lowest and highest <= MAX_READING:  # False for a NaN
            self.extremes = (float(lowest), float(highest))
            return frames

        self.extremes = None
        is_number = np.isfinite(frames)
        if not layout.accepts_missing:
            self._refuse(readings, ~is_number, f"is not finite; {NAN_HINT}")
        # Infinite readings are missing, too.
        frames[~is_number] = np.nan
        with np.errstate(invalid="ignore"):
            too_large = frames > MAX_READING
            below = frames < lower_end
        self._refuse(readings, too_large, f"is above {MAX_READING:g}")
        if below.any() and allows_below:
            self._refuse(readings, below, f"is below {lower_end:g}")
        if below.any():
            self._refuse_negative(readings, frames, below)
        return frames

    def _refuse(self, readings: npt.NDArray[Any], is_bad: Mask, fault: str) -> None:
        if is_bad.any():
            raise SourceError(f"{self._place(readings, is_bad)} {fault}")

    def _place(self, readings: npt.NDArray[Any], is_bad: Mask) -> str:
        frame, row, col = np.argwhere(is_bad)[0]
        place = f"{self.name}: frame {self.n_frames + frame}, row {row}, column {col}"
        return f"{place}: {float(readings[frame, row, col]):.9g}"

    def _refuse_negative(
        self, readings: npt.NDArray[Any], frames: Floats, below: Mask
    ) -> None:
        """Raise what may be stated of readings below 0. One number far below all others stands for
        no reading; else they are noise around 0, or a signed quantity.
        """
        values = np.unique(frames[below])
        other_readings = frames[~below & np.isfinite(frames)]
        place = self._place(readings, below)
        ways = f"state negative={KEEP}, zero, offset or mask"

        # Noise has many values; a code for "no reading" has one.
        is_marker = values.size == 1 and other_readings.size > 0
        marker = float(values[0])
        if is_marker and other_readings.min() > marker + ISOLATED * abs(marker):
            option = {"missing": f"{marker:g}"}
            raise UnstatedError(f"{place} is below 0, as no other reading", option)
        hint = ""
        if is_marker:
            hint = f"; or missing={marker:g}, if it stands for no reading"
        raise UnstatedError(f"{place} is below 0; {ways}{hint}")


def _together(faults: Sequence[UnstatedError], name: str) -> UnstatedError:
    """One error of several, whose options are combined as far as there is one of each."""
    texts = [str(faults[0])]
    texts += [str(error).removeprefix(f"{name}: ") for error in faults[1:]]
    text = "; ".join(texts)
    options = [error.options for error in faults if error.options]
    if any(len(ways) > 1 for ways in options):
        return UnstatedError(text, *faults[0].options)

    together: dict[str, Any] = {}
    for (way,) in options:
        together |= way
    if not together:
        return UnstatedError(text)
    return UnstatedError(text, together)
