"""Recordings as a sensor source: a file is read whole and checked, then yields its frames.

Before a graph starts, the begin of the file is read alone.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_ELEMENTS, MAX_SIDE
from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.missing import MissingReadings
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ, Source

from .format import recording_of
from .recording import (
    ADD,
    COUNTS,
    DEFAULT_POLICY,
    FILLED,
    MASK,
    MAX_READING,
    OFFSET,
    REFUSE,
    ZERO,
    File,
    Head,
    Parsed,
    Policy,
    Recording,
    check_grid,
    check_number,
    check_readings,
    check_stated_shape,
    check_unit,
    reading,
    shape_text,
    shown,
)

MAX_FRAMES = 1 << 24
"""Most frames of a recording, chosen: four hours at 1 kHz; each has a stamp, a Python integer."""
UNTIMED_PERIOD_NS = 10_000_000
"""Time between frames where neither file nor caller states one, chosen: stamps must rise."""
EXAMPLES = {"fingers": "fingers press on the edge of a hole, Tekscan I-Scan 6900, counts"}
"""Recordings of this package, as example:NAME, and a few words on each."""
_MAX_RATE_HZ = 1e9
_HEADS: dict[tuple[object, ...], Head] = {}
"""The begin of the file that was read last: a launch asks for it several times."""


@dataclass(frozen=True)
class Treated:
    """Counts of invalid readings of a file."""

    not_finite: int = 0
    negative: int = 0
    masked_taxels: int = 0  # for them
    offset: float = 0.0  # subtracted from all readings, in their unit; 0 or less

    def lines(self, policy: Policy, unit: str) -> list[str]:
        """One line for a log on each kind of invalid reading; none where there was none."""
        done = {ZERO: "set to 0", MASK: "masked"}
        way = done.get(policy.negative, f"{self.offset:g} {unit} subtracted from all readings")
        found = []
        if n := self.not_finite:
            found.append(f"{n} readings of the file are not finite: {FILLED[policy.nan]}")
        if n := self.negative:
            found.append(f"{n} readings of the file are below 0: {way}")
        if self.masked_taxels:
            found[-1] += f" ({self.masked_taxels} taxels masked)"
        return found

    def counts(self) -> dict[str, Any]:
        """Counts for a summary; none where all readings were valid."""
        return vars(self).copy() if self.not_finite or self.negative else {}


@dataclass(eq=False)
class RecordedSource(Source):
    """The frames of a recording, in memory and checked; may be iterated any number of times.

    `treated` counts the readings that were not valid, and were treated by `policy`; `notes` are for
    the log.
    """

    name: str
    skin: Skin
    frames: Floats
    stamp_ns: Sequence[int]
    rate_hz: float | None = None
    policy: Policy = DEFAULT_POLICY
    treated: Treated = field(default_factory=Treated)
    notes: tuple[str, ...] = ()
    n_frames: int | None = field(init=False)
    _is_new: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self.n_frames = len(self.frames)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        for stamp, frame in zip(self.stamp_ns, self.frames, strict=True):
            yield stamp, frame.copy()

    def filled(self) -> Iterator[tuple[int, Floats, npt.NDArray[np.uint8] | None]]:
        """Yield stamps, frames whose missing readings are filled in, and the bits of these, as
        `MissingReadings.fill`; frames without any reading are left out.
        """
        readings = MissingReadings(self.policy.nan, self.skin, learns=False)
        for stamp_ns, forces in self:
            if (found := readings.fill(forces, stamp_ns)) is not None:
                yield stamp_ns, *found

    def take_lines(self) -> list[str]:
        is_new, self._is_new = self._is_new, False
        lines = [*self.notes, *self.treated.lines(self.policy, self.skin.unit)]
        return lines if is_new else []

    def report(self) -> dict[str, Any]:
        invalid = self.treated.counts()
        return {"invalid": invalid} if invalid else {}


def open_file(
    path: str | os.PathLike[str],
    *,
    unit: str | None = None,
    f_max: float | None = None,
    rate_hz: float | None = None,
    policy: Policy = DEFAULT_POLICY,
    **stated: Any,
) -> RecordedSource:
    """Open a recording; its format follows from the suffix, and for .csv from the content.

    Parameters
    ----------
    path : str or path
        A file with one of the suffixes in `format.suffixes()`, the folder of a ROS 2 bag,
        or example:NAME of `EXAMPLES`.
    unit : str, optional
        Unit of the readings. Required for a table; of arrays that state none "counts", where they
        are integers, or else "N"; must agree with a unit that the file states.
    f_max : float, optional
        Upper end of the range, in `unit`; by default that of the file, or else the largest
        reading of the recording.
    rate_hz : float, optional
        Frame rate, 1e-9..1e9, in place of the file's own rate and stamps.
    policy : Policy
        Ways to treat readings that are not finite or below 0; refused by default.
    **stated
        n_rows, n_cols : int, shape of a frame, where the file does not state it (one of them is
        enough), else it must agree; columns, topic : str, as of `File`.

    Returns
    -------
    RecordedSource
        Frames float32 of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells; NaN where a
        reading is not finite and `policy` allows it. Stamps are the file's, or follow from the
        rate, or are 10 ms apart where there is neither; a rate that nothing states follows from
        the stamps.

    Raises
    ------
    SourceError
        If the file is missing, empty or of no known format, anything in it is malformed, it does
        not state its shape or unit, which are then named with the rate in one line, a reading is
        negative or not finite, a setting contradicts the file, `f_max` is below the largest
        reading, or all readings are 0 and no `f_max` is stated.
    """
    name = str(path)
    for what in ("n_rows", "n_cols"):
        if (side := stated.get(what)) is not None and not is_whole(side, 1, MAX_SIDE):
            expected = f"expected a whole number in 1..{MAX_SIDE}"
            raise SourceError(f"{name}: {what} = {shown(side)}; {expected}")
    check_number(name, "f_max", f_max)
    check_number(name, "rate_hz", rate_hz, high=_MAX_RATE_HZ)
    check_unit(name, unit)
    with _opened(name, policy, stated) as (file, recording):
        parsed, name = recording.read(), file.name
    n_frames, *cells = parsed.forces.shape
    if n_frames == 0:
        raise SourceError(f"{name}: the recording holds no frame")
    timed = (rate_hz, parsed.rate_hz, parsed.stamp_ns) != (None, None, None)
    keeps = policy.raw
    head = Head(tuple(cells), None, parsed.unit, timed)
    shape = _checked_shape(head, file, needs_unit=not (unit or keeps))
    stated_mask, is_whole_numbers = parsed.mask, parsed.forces.dtype.kind in "iu"
    forces = parsed.forces.reshape(n_frames, *shape)
    parsed, treated = treat(replace(parsed, forces=forces), policy)
    if n_frames > MAX_FRAMES:
        raise SourceError(f"{name}: {n_frames} frames; at most {MAX_FRAMES} are allowed")
    check_readings(parsed.forces, name, -MAX_READING if keeps else 0.0, policy.nan != REFUSE)
    if parsed.mask is not None and not parsed.mask.any():
        raise SourceError(f"{name}: no cell of the skin is a taxel, all are masked")
    frames = parsed.forces.astype(np.float32)
    try:
        skin = Skin(
            *shape,
            f_max=_range(frames, f_max if f_max is not None else parsed.f_max, name, keeps),
            unit=_unit(unit, parsed, COUNTS if is_whole_numbers else "raw" if keeps else "N", name),
            pitch_m=parsed.pitch_m,
            mask=None if stated_mask is None or stated_mask.all() else stated_mask,
            points=parsed.points,
            point_rows=None if parsed.points is None else parsed.point_rows,
        )
    except MessageError as error:
        raise SourceError(f"{name}: {error}") from error
    if treated.masked_taxels and parsed.mask is not None:
        skin = skin.without(~parsed.mask)
    stamps, rate_hz = _stamps(parsed, n_frames, rate_hz, name), rate_hz or parsed.rate_hz
    if rate_hz is None and parsed.stamp_ns is not None and stamps[-1]:
        rate_hz = float(f"{(n_frames - 1) * 1e9 / stamps[-1]:.6g}")
    notes = [*parsed.notes, *_assumed("" if unit or parsed.unit or keeps else skin.unit, rate_hz)]
    return RecordedSource(
        Path(name).stem, skin, frames, stamps, rate_hz, policy, treated, tuple(notes)
    )


def treat(parsed: Parsed, policy: Policy) -> tuple[Parsed, Treated]:
    """Return a recording whose invalid readings are treated, and their counts.

    Those of a kind that is refused remain, for `check_readings` to name. Those that are not finite
    become NaN, for `MissingReadings`; a taxel of which all are is masked with `nan` "mask". Cells
    without a taxel are not looked at.
    """
    allowed = policy.nan == policy.negative == REFUSE
    if allowed or not len(parsed.forces):
        return parsed, Treated()
    forces = np.array(parsed.forces, dtype=np.result_type(parsed.forces.dtype, np.float32))
    finite = np.isfinite(forces)
    is_nan = ~finite & (policy.nan != REFUSE)
    is_negative = finite & (forces < 0) & (policy.negative != REFUSE)
    exists = np.ones(forces.shape[1:], np.bool_) if parsed.mask is None else parsed.mask
    gone = np.zeros_like(exists)
    if policy.nan == MASK:
        gone |= is_nan.all(axis=0)
    if policy.negative == MASK:
        gone |= is_negative.any(axis=0)
    forces[is_nan] = np.nan
    forces[:, gone] = 0
    offset = 0.0
    if policy.negative == ZERO:
        forces[is_negative] = 0
    elif policy.negative == OFFSET:
        offset = float(forces.min(initial=0.0, where=np.isfinite(forces)))
        forces[:, exists & ~gone] -= forces.dtype.type(offset)
    mask = exists & ~gone if gone.any() else parsed.mask
    n_bad = (int(np.count_nonzero(is_nan)), int(np.count_nonzero(is_negative)))
    f_max = None if parsed.f_max is None else parsed.f_max - offset
    treated = Treated(*n_bad, int((gone & exists).sum()), offset)
    return replace(parsed, forces=forces, mask=mask, f_max=f_max), treated


def n_taxels(
    path: str,
    unit: str | None = None,
    rate_hz: float | None = None,
    policy: Policy = DEFAULT_POLICY,
    **stated: Any,
) -> int | None:
    """Number of taxels of a recording, from the begin of its file, which a launch checks so; None
    where that does not show it. Arguments and SourceError are those of `open_file`.
    """
    with _opened(path, policy, stated) as (file, recording):
        status = os.fstat(file.file.fileno())
        key = (file.name, status.st_mtime_ns, status.st_size, policy, *stated.items())
        if key not in _HEADS:
            _HEADS.clear()
            _HEADS[key] = recording.head()
        head = _HEADS[key]
    head = head._replace(is_timed=head.is_timed or rate_hz is not None)
    _checked_shape(head, file, not (unit or policy.raw))
    # No taxel: refused as it is read.
    return None if policy.masks else head.n_taxels or None


@contextmanager
def _opened(
    path: str, policy: Policy, stated: Mapping[str, Any]
) -> Iterator[tuple[File, Recording]]:
    """The recording of a file, or an example; of the folder of a bag of ROS 2, of its files."""
    folder, (kind, _, example), parts = Path(path), path.partition(":"), list[str]()
    if kind == "example" and not folder.exists():
        if example not in EXAMPLES:
            raise SourceError(f"{path}: there is no such{nearest_of(example, EXAMPLES)}")
        path = str(Path(__file__).with_name("examples") / f"{example}.npz")
    elif (folder / "metadata.yaml").is_file():
        found = [str(file) for file in folder.iterdir() if file.suffix in (".mcap", ".db3")]
        found.sort(key=lambda name: (len(name), name))  # bag_2 before bag_10
        path, *parts = found or [path]
    with reading(path) as opened:
        file = File(opened, path, tuple(parts), policy=policy, **stated)
        yield file, recording_of(file)


def _checked_shape(head: Head, file: File, needs_unit: bool) -> tuple[int, int]:
    """Rows and columns of a frame; SourceError that asks for all that is missing at once."""
    name, n_cells = file.name, math.prod(head.shape)
    rows, cols = file.n_rows, file.n_cols
    missing: dict[str, str] = {}
    if not 1 <= n_cells <= MAX_ELEMENTS:
        raise SourceError(f"{name}: a frame holds {n_cells} cells; at most {MAX_ELEMENTS}")
    if len(head.shape) == 2:
        check_stated_shape(*head.shape, rows, cols, name)
        rows, cols = head.shape
    elif not (rows or cols):
        missing = {f"shape ({n_cells} = rows x columns)": shape_text(n_cells)}
    else:
        rows = rows or n_cells // (cols or 1)
        cols = cols or n_cells // rows
        if rows * cols != n_cells:
            needed = f"n_rows x n_cols = {rows} x {cols} needs {rows * cols}"
            raise SourceError(f"{name}: a frame holds {n_cells} readings, but {needed}")
    if needs_unit and head.unit is None and Path(name).suffix.lower() == ".csv":
        missing["unit (N, kPa, counts, ...)"] = "unit=N"
    if missing:
        missing |= {} if head.is_timed else {"rate": "rate_hz=100"}
        fault = f"a frame holds {n_cells} readings; the file does not state {', '.join(missing)}"
        raise SourceError(f"{name}: {fault}{ADD}{' '.join(missing.values())}")
    assert rows is not None is not cols
    check_grid(rows, cols, name)
    return rows, cols


def _assumed(unit: str, rate_hz: float | None) -> Iterator[str]:
    """Lines on what the file does not state, and is assumed."""
    if unit == COUNTS:
        yield "whole numbers without a unit: shown as counts; a calibration makes newtons of them"
    elif unit:
        yield f"states no unit: taken as {unit}; set unit where it is another"
    if rate_hz is None:
        yield f"states no rate: {DEFAULT_RATE_HZ:g} Hz; set rate_hz where it is another"


def _range(frames: Floats, stated: float | None, name: str, keeps: bool) -> float:
    peak = float(np.fmax.reduce(frames, axis=None))
    if keeps:
        return max(peak, stated or 1.0)
    if stated is None:
        if peak == 0:
            raise SourceError(f"{name}: all readings are 0, so its range is unknown; state f_max")
        return peak
    # In float32 as the frames are: 0.1 in a float32 recording is above 0.1 in float64.
    if np.float32(peak) > np.float32(stated):
        raise SourceError(f"{name}: f_max = {stated:g} is below the largest reading, {peak:g}")
    return float(stated)


def _unit(stated: str | None, parsed: Parsed, default: str, name: str) -> str:
    found = parsed.unit
    check_unit(name, found)
    if stated is not None and found is not None and stated != found:
        both = f"unit = {shown(stated)} is stated, but the file states {shown(found)}"
        raise SourceError(f"{name}: {both}")
    return stated or found or default


def _stamps(
    parsed: Parsed, n_frames: int, stated_rate_hz: float | None, name: str
) -> tuple[int, ...]:
    rate_hz = stated_rate_hz if stated_rate_hz is not None else parsed.rate_hz
    if stated_rate_hz is None and parsed.stamp_ns is not None:
        stamps = parsed.stamp_ns
    elif rate_hz is None:
        stamps = tuple(k * UNTIMED_PERIOD_NS for k in range(n_frames))
    elif not 1e-9 <= rate_hz <= _MAX_RATE_HZ:
        raise SourceError(f"{name}: rate_hz = {rate_hz:g} is outside 1e-9..{_MAX_RATE_HZ:g}")
    else:
        stamps = tuple(round(k * 1e9 / rate_hz) for k in range(n_frames))
    if stamps[-1] > INT64_MAX:
        raise SourceError(f"{name}: the recording lasts longer than 2**63 ns")
    return stamps
