"""Recordings as a sensor source, read by blocks: memory does not grow with the file.

Files of up to `KEPT_BYTES` of frames are read, and checked, before the first frame is used. Of
larger ones a first pass finds range and masks where they are needed and not stated; a second one
yields the frames. A graph need not wait for the range: it begins with that of the first frames.
Before a graph starts, the begin of the file is read alone.
"""

from __future__ import annotations

import hashlib
import os
import shlex
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.errors import MessageError
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.layout.checks import (
    ADD,
    COUNTS,
    check_unit,
    reading,
    shown,
)
from sparseskin.nodes.sensor.layout.layout import (
    EMPTY,
    HOLD,
    KEEP,
    MASK,
    ZERO,
    Layout,
    UnstatedError,
)
from sparseskin.nodes.sensor.missing import MissingReadings
from sparseskin.nodes.sensor.saturation import Clipped
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ, MAX_LINES, Source

from .format import folder_files, recording_of
from .frames import Frames, Stamped
from .recording import File
from .survey import (
    DIGEST_BYTES,
    LOOK_BYTES,
    FrameStore,
    Needs,
    Survey,
    Treatment,
)

MAX_FRAMES = 1 << 31
"""Most frames of a recording, chosen: 24 days at 1 kHz."""
KEPT_BYTES = 1 << 26
"""Frames of a file that are kept in memory, bytes; chosen: of three minutes of 40 x 40 at 60 Hz."""
LARGE_BYTES = 1 << 28
"""Size of a file that is sure to hold more, chosen: a number has at most five bytes of text."""
BEGIN_BYTES = 1 << 20
"""Frames of the begin of such a file, bytes; chosen: they are read in a quarter of a second."""
MIN_WIDENING = 1.25
"""Least ratio of a range to the one before. Chosen: each costs a new skin, Phi and solver."""
EXAMPLES = {
    "fingers": "fingers press on the edge of a hole, Tekscan I-Scan 6900, counts"
}
"""Recordings of this package, as example:NAME, and a few words on each."""
DEFAULT_NEEDS = Needs()
_HEADS: dict[tuple[object, ...], int | None] = {}
"""Number of taxels of the file that was looked at last: a launch asks for it several times."""


class RecordedSource(Source):
    """The frames of a recording; may be iterated any number of times. `open_file` makes it."""

    def __init__(self, path: str, layout: Layout, raw: bool, needs: Needs) -> None:
        self._path = path
        self._layout = layout
        self._raw = raw
        self._needs = needs
        self._store: FrameStore | None = None
        self._lines: deque[str] = deque(maxlen=MAX_LINES)
        self._is_told = False
        self.clipped = Clipped()
        with opened(path, layout, raw) as frames:
            self.name = Path(frames.name).stem
            if Path(path).is_dir():
                self.name = Path(path).stem
            survey = self._surveyed(frames)
            self._survey = survey
            self._treatment = Treatment(layout, survey, raw)
            self.skin = _skin(frames, survey, self._treatment)
            self.notes = self._noted(frames, survey)
            self.rate_hz = layout.rate_hz or frames.head.rate_hz
            if self.rate_hz is None and frames.is_timed and frames.last_ns:
                # Of a large file the mean rate of its begin, which is all that is known.
                rate_hz = (frames.n_frames - 1) * 1e9 / frames.last_ns
                self.rate_hz = float(f"{rate_hz:.6g}")
        self.n_frames = survey.n_frames or frames.head.n_items
        self.clipped.mask = self.skin.mask
        #: Lower end of the range: below 0 where readings below 0 are kept.
        self.f_min = self._treatment.lower_end

    def blocks(self) -> Iterator[Stamped]:
        """Yield blocks of stamps and frames, as `Stamped`."""
        for stamp_ns, readings in self._readings():
            yield stamp_ns, self._treatment.apply(readings)

    def _readings(self) -> Iterator[Stamped]:
        """Yield blocks of stamps and readings, which may be changed, before they are treated."""
        if self._store is not None:
            # A copy: the frames in memory are read again in the next round.
            for stamp_ns, part in self._store.blocks():
                yield stamp_ns, part.copy()
            return
        with opened(self._path, self._layout, self._raw) as frames:
            for stamp_ns, part in frames.blocks():
                if self._widens:
                    self._widen(part)
                elif self._needs.range:
                    self._check_range(part)
                yield stamp_ns, part
            if not self._is_told:
                self._is_told = True
                self._lines.extend(frames.notes())

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        watches = self._treatment.is_signed and not self._raw
        for stamp_ns, readings in self._readings():
            signed = readings.copy() if watches else readings
            frames = self._treatment.apply(readings)
            for k, stamp in enumerate(stamp_ns.tolist()):
                # Readings below 0 show the sign before they become 0.
                if watches:
                    self.clipped.watch(signed[k], self.f_min, self.skin.f_max)
                yield stamp, frames[k]

    def filled(self) -> Iterator[tuple[int, Floats, npt.NDArray[np.uint8] | None]]:
        """Yield stamps, frames whose missing readings are filled in, and the bits of these, as
        `MissingReadings.fill`; frames without any reading are left out.
        """
        readings = MissingReadings(self._layout.missing_way, self.skin, learns=False)
        for stamp_ns, forces in self:
            filled = readings.fill(forces, stamp_ns)
            if filled is not None:
                yield stamp_ns, *filled

    def take_all(self) -> Stamped:
        """Stamps and frames of a recording that is in memory, which then is no more. Readings that
        are missing are treated as stated: filled in by "zero" and "hold", else NaN. Frames without
        any reading are left out.
        """
        # The array is handed over, not copied: half the memory.
        store = self._store
        assert store is not None
        self._store = None
        way = self._layout.missing_way
        readings = MissingReadings(way, self.skin, learns=False)
        stamps: list[npt.NDArray[np.int64]] = []
        n = 0
        for stamp_ns, part in store.blocks():
            frames = self._treatment.apply(part)
            if self._survey.n_missing:
                if way in (ZERO, HOLD):
                    _fill(readings, stamp_ns, frames)
                holds_any = np.isfinite(frames[:, self.skin.exists]).any(axis=1)
                stamp_ns = stamp_ns[holds_any]
                store.frames[n : n + len(stamp_ns)] = frames[holds_any]
            stamps.append(stamp_ns)
            n += len(stamp_ns)
        return np.concatenate(stamps), store.frames[:n]

    @property
    def frames(self) -> Floats:
        """All frames, float32 (n_frames, n_rows, n_cols)."""
        return np.concatenate([frames for _, frames in self.blocks()])

    @property
    def stamp_ns(self) -> npt.NDArray[np.int64]:
        """Stamps of all frames, int64 (n_frames,), nanoseconds since the first."""
        return np.concatenate([stamp_ns for stamp_ns, _ in self.blocks()])

    def take_lines(self) -> list[str]:
        lines = list(self._lines)
        self._lines.clear()
        return lines

    def report(self) -> dict[str, Any]:
        invalid = self._treatment.counts()
        if not invalid:
            return {}
        return {"invalid": invalid}

    @property
    def digest(self) -> str:
        """A hash of the frames and of what is done with them, where it was needed."""
        content = self._survey.content
        assert content is not None
        content = content.copy()
        content.update(f"{self._layout.missing_way} {self._layout.negative}".encode())
        return content.hexdigest()

    def _surveyed(self, frames: Frames) -> Survey:
        """A survey of all frames; of the first blocks of a large file that needs no more."""
        survey = Survey(frames.shape, frames.mask)
        if self._needs.digest:
            survey.content = hashlib.blake2b(digest_size=DIGEST_BYTES)
        has_range = (self._layout.f_max or frames.head.f_max) is not None
        needs_range = self._needs.range and not has_range
        self._reads_twice = False
        self._widens = False
        self._is_begin = False
        needs_all = self._needs.digest or Treatment.needs_survey(self._layout)
        waits_for_range = needs_range and not self._needs.widens
        store: FrameStore | None = FrameStore(frames.shape)
        limit = KEPT_BYTES
        if frames.n_bytes > LARGE_BYTES and not self._needs.in_memory:
            limit = BEGIN_BYTES
        if self._needs.begin:
            limit = LOOK_BYTES
        for stamp_ns, part in frames.blocks():
            survey.add(part, frames.extremes)

            if survey.n_frames > MAX_FRAMES:
                raise SourceError(f"{frames.name}: more than {MAX_FRAMES} frames")
            if store is not None:
                store.add(stamp_ns, part)
                if self._needs.begin and store.frames.nbytes > limit:
                    self._is_begin = True
                    break
                if self._needs.in_memory or store.frames.nbytes <= limit:
                    continue
                store = None
            # A range of zeros alone is none.
            has_begun = not needs_range or survey.highest > 0
            if not (needs_all or waits_for_range) and has_begun:
                self._widens = needs_range
                self._n_seen = survey.n_frames
                survey.n_frames = 0  # not known
                return survey
            self._reads_twice = needs_range and not self._needs.digest
        self._store = store
        return survey

    def _noted(self, frames: Frames, survey: Survey) -> tuple[str, ...]:
        """Lines on what was read, assumed, treated."""
        lines: list[str] = []
        if survey.n_frames:
            lines += frames.notes()
            self._is_told = True
        if self._is_begin:
            begin = f"the first {survey.n_frames} frames alone were read"
            lines.append(f"{begin}: import reads and checks all")
        # An assumption is said where it is made, with what changes it.
        if not (self._layout.unit or frames.head.unit or self._raw):
            line = f"states no unit: taken as {self.skin.unit}; set unit where it is another"
            if self.skin.unit == COUNTS:
                line = "whole numbers without a unit: shown as counts; a calibration "
                line += "makes newtons of them"
            lines.append(line)
        if not (frames.is_timed or self._layout.rate_hz or frames.head.rate_hz):
            hint = "set rate_hz where it is another"
            lines.append(f"states no rate: taken as {DEFAULT_RATE_HZ:g} Hz; {hint}")
        if self._widens:
            seen = f"f_max={self.skin.f_max:g} is the largest of the first {self._n_seen} frames"
            lines.append(f"{seen}: a larger reading widens the range; state f_max")
        if self._reads_twice:
            f_max = f"f_max={self.skin.f_max:g}"
            lines.append(
                f"the whole file was read for its range first: {f_max} begins at once"
            )
        lines += self._treatment.lines(self.skin.unit)
        self._lines.extend(lines)
        return tuple(lines)

    def _widen(self, frames: Floats) -> None:
        """Make the range one that holds these frames, where it was that of the first ones."""
        highest = float(np.fmax.reduce(frames, axis=None))
        if highest <= self.skin.f_max:
            return
        # By a quarter at least: a load that grows slowly would widen it with each frame.
        f_max = max(highest, MIN_WIDENING * self.skin.f_max)
        line = f"a reading is {highest:g}: the range is wider from there on, f_max={f_max:g}"
        self._lines.append(line)
        self.skin = replace(self.skin, f_max=f_max)

    def _check_range(self, frames: Floats) -> None:
        """Raise SourceError at a reading above the range, which was stated before all were read."""
        highest = float(np.fmax.reduce(frames, axis=None)) - self._treatment.offset
        if highest > np.float32(self.skin.f_max):
            fault = f"f_max = {self.skin.f_max:g} is below a reading, {highest:g}"
            raise SourceError(f"{self.name}: {fault}")


def open_file(
    path: str | os.PathLike[str],
    layout: Layout = EMPTY,
    raw: bool = False,
    needs: Needs = DEFAULT_NEEDS,
) -> RecordedSource:
    """Open a recording; its format follows from the suffix, and of some from the content.

    Parameters
    ----------
    path : str or path
        A file with one of the suffixes in `format.suffixes()`, a folder of one of them, or
        example:NAME of `EXAMPLES`.
    layout : Layout
        What the file does not state, or must agree with.
    raw : bool
        True if a calibration converts the readings, which are of any unit and sign.
    needs : Needs
        What is needed before the first frame.

    Returns
    -------
    RecordedSource
        Frames float32 of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells; NaN where a
        reading is missing and the layout allows it. Stamps are the file's, or follow from the rate,
        or are 10 ms apart where there is neither.

    Raises
    ------
    SourceError
        If the file is missing, empty or of no known format, anything in it is malformed, a reading
        is not allowed, or a statement contradicts the file. If something is not stated, the line
        names it, and proposes the settings with which the whole file can be read, if there is
        exactly one way.
    """
    name = str(path)
    check_unit(name, layout.unit)
    with proposing(name, layout, raw, needs.begin):
        return RecordedSource(name, layout, raw, needs)


def n_taxels(path: str, layout: Layout = EMPTY, raw: bool = False) -> int | None:
    """Number of taxels of a recording, from the begin of its file, which a launch checks so; None
    where later frames decide it. Raises SourceError as `open_file`.
    """
    # A launch asks several times: the answer holds until the file changes.
    with (
        proposing(path, layout, raw),
        located(path) as (name, _),
        reading(name) as file,
    ):
        status = os.fstat(file.fileno())
        key = (name, status.st_mtime_ns, status.st_size, layout, raw)
        if key not in _HEADS:
            with opened(path, layout, raw) as frames:
                _HEADS.clear()
                _HEADS[key] = frames.n_taxels
        n = _HEADS[key]
    if MASK in (layout.nan, layout.negative):
        return None
    return n


@contextmanager
def opened(path: str, layout: Layout, raw: bool) -> Iterator[Frames]:
    """The frames of a file, an example, or a folder. Raises SourceError as `open_file`."""
    with located(path) as (name, parts), reading(name) as file:
        of_file = File(file, name, parts, layout, raw)
        yield Frames(of_file, recording_of(of_file))


@contextmanager
def located(path: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """The first file of a path, and those that go on with it."""
    folder = Path(path)
    kind, _, example = path.partition(":")
    if kind == "example" and not folder.exists():
        if example not in EXAMPLES:
            raise SourceError(
                f"{path}: there is no such{nearest_of(example, EXAMPLES)}"
            )
        yield str(Path(__file__).with_name("examples") / f"{example}.npz"), ()
        return
    with folder_files(path) as (name, parts):
        yield name, parts


@contextmanager
def proposing(
    path: str, layout: Layout, raw: bool, of_begin: bool = False
) -> Iterator[None]:
    """Add to an error on what is not stated the settings with which the whole file can be read, or
    its begin, if there is exactly one way.
    """
    try:
        yield
    except UnstatedError as error:
        text = str(error)

        # A way that fails later in the file is none to propose; the unit of readings never is.
        unit = {"unit": layout.unit or COUNTS}
        ways = [
            option
            for option in error.options
            if _reads(path, layout.stating({**unit, **option}), raw, of_begin)
        ]
        if len(ways) == 1:
            settings = [
                f"{key}={shlex.quote(str(value))}" for key, value in ways[0].items()
            ]
            text = f"{text}{ADD}{' '.join(settings)}"
        raise SourceError(text) from error


def _reads(path: str, layout: Layout, raw: bool, of_begin: bool) -> bool:
    """True if all of a file can be read so, or its begin, or only something else is not stated
    then.
    """
    try:
        with opened(path, layout, raw) as frames:
            n_bytes = 0
            for _, block in frames.blocks():
                n_bytes += block.nbytes
                if of_begin and n_bytes > LOOK_BYTES:
                    break
    except UnstatedError:
        return True
    except SparseskinError:
        return False
    return True


def _fill(
    readings: MissingReadings, stamp_ns: npt.NDArray[np.int64], frames: Floats
) -> None:
    """Fill the missing readings of frames in place; those without any reading become NaN."""
    # Whole frames, too: the readings of the last one are held.
    for k in range(len(frames)):
        filled = readings.fill(frames[k], int(stamp_ns[k]))
        frames[k] = np.nan if filled is None else filled[0]


def _skin(frames: Frames, survey: Survey, treatment: Treatment) -> Skin:
    """The skin that a file states."""
    head = frames.head
    layout = frames.layout
    try:
        # A mask of all cells is none: nothing is left out of messages for it.
        has_mask = frames.mask is not None and not frames.mask.all()
        skin = Skin(
            *frames.shape,
            f_max=_range(frames, survey, treatment),
            unit=_unit(frames),
            pitch_m=head.pitch_m,
            mask=frames.mask if has_mask else None,
            points=head.points,
        )
        if head.points is not None:
            skin = replace(skin, point_rows=head.point_rows)
        if treatment.n_masked:
            skin = skin.without(treatment.gone)
        return skin
    except MessageError as error:
        fault = str(error)
        if treatment.n_masked:
            settings = f"nan={layout.nan} negative={layout.negative}"
            fault = f"no taxel is left: all are masked ({settings})"
        raise SourceError(f"{frames.name}: {fault}") from error


def _range(frames: Frames, survey: Survey, treatment: Treatment) -> float:
    """Upper end of the range: stated, that of the file, or the largest reading."""
    f_max = frames.layout.f_max
    if f_max is None and frames.head.f_max is not None:
        f_max = frames.head.f_max - treatment.offset
    peak = survey.highest - treatment.offset
    if frames.layout.negative == KEEP:
        peak = max(peak, -survey.lowest)
    if frames.raw:
        return max(peak, f_max or 1.0)
    # In float32 as the frames are: 0.1 in a float32 recording is above 0.1 in float64.
    if f_max is not None and np.float32(peak) > np.float32(f_max):
        fault = f"f_max = {f_max:g} is below the largest reading, {peak:g}"
        raise SourceError(f"{frames.name}: {fault}")
    if f_max is None and peak <= 0:
        fault = "all readings are 0, so its range is unknown; state f_max"
        raise SourceError(f"{frames.name}: {fault}")
    return float(peak if f_max is None else f_max)


def _unit(frames: Frames) -> str:
    """Unit of the readings: stated, that of the file, or an assumption."""
    # A unit that contradicts the file is refused: kPa read as N is a wrong force.
    setting = frames.layout.unit
    of_file = frames.head.unit
    check_unit(frames.name, of_file)
    if setting and of_file and setting != of_file:
        fault = (
            f"unit = {shown(setting)} is stated, but the file states {shown(of_file)}"
        )
        raise SourceError(f"{frames.name}: {fault}")
    assumed = COUNTS
    if not (setting or of_file or frames.is_whole):
        assumed = "raw" if frames.raw else "N"
    return setting or of_file or assumed
