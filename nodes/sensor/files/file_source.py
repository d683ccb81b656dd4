"""Recordings as a sensor source: a file is read whole and checked, then yields its frames.

Before a graph starts, the begin of the file is read alone.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.source import Source

from .format import File, recording_of
from .invalid import Treated, treat
from .recording import (
    DEFAULT_POLICY,
    KEEP,
    MAX_READING,
    NO_UNIT,
    REFUSE,
    Parsed,
    Policy,
    check_grid,
    check_number,
    check_readings,
    check_stated_shape,
    check_unit,
    reading,
    shown,
)

MAX_FRAMES = 1 << 24
"""Most frames of a recording, chosen: four hours at 1 kHz; each has a stamp, a Python integer."""
UNTIMED_PERIOD_NS = 10_000_000
"""Time between frames where neither file nor caller states one, chosen: stamps must rise."""
_MAX_RATE_HZ = 1e9


@dataclass(eq=False)
class RecordedSource(Source):
    """The frames of a recording, in memory and checked; may be iterated any number of times.

    Its attributes are those of a `Source`; its name is that of the file without suffix. `treated`
    counts the readings that were not valid, and were treated by
    `policy`.
    """

    name: str
    skin: Skin
    frames: Floats
    stamp_ns: Sequence[int]
    rate_hz: float | None = None
    policy: Policy = DEFAULT_POLICY
    treated: Treated = field(default_factory=Treated)
    n_frames: int | None = field(init=False)
    _is_new: bool = field(default=True, init=False)

    def __post_init__(self) -> None:
        self.n_frames = len(self.frames)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces): nanoseconds since the first frame, and a new float32 array
        of shape (n_rows, n_cols) in [0, f_max], 0 in masked cells; NaN as in `open_file`.
        """
        for stamp, frame in zip(self.stamp_ns, self.frames, strict=True):
            yield stamp, frame.copy()

    def take_lines(self) -> list[str]:
        lines = list(self.treated.lines(self.policy, self.skin.unit)) if self._is_new else []
        self._is_new = False
        return lines

    def report(self) -> dict[str, Any]:
        invalid = self.treated.counts()
        return {"invalid": invalid} if invalid else {}


def open_file(
    path: str | os.PathLike[str],
    *,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
    rate_hz: float | None = None,
    policy: Policy = DEFAULT_POLICY,
) -> RecordedSource:
    """Open a recording; its format follows from the suffix, and for .csv from the content.

    Parameters
    ----------
    path : str or path
        A file with one of the suffixes in `format.suffixes()`.
    n_rows, n_cols : int, optional
        Shape of a frame. Required for a plain .csv (one of them is enough); any other file
        states its shape, which must agree.
    unit : str, optional
        Unit of the readings. Required for a plain .csv; "N" where an array states none; must
        agree with a unit that the file states.
    f_max : float, optional
        Upper end of the range, in `unit`; by default that of the file, or else the largest
        reading of the recording.
    rate_hz : float, optional
        Frame rate, 1e-9..1e9, in place of the file's own rate and stamps.
    policy : Policy
        What to do with readings that are not finite or below 0, in arrays and plain .csv; refused
        by default.

    Returns
    -------
    RecordedSource
        Frames float32 of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells; NaN where a
        reading is not finite and `policy` allows it: `MissingReadings` fills it in. Stamps are the
        file's, or follow from the rate, or are 10 ms apart where there is neither.

    Raises
    ------
    SourceError
        If the file is missing, empty or of no known format, anything in it is malformed, a
        reading is negative or not finite, a setting contradicts the file, `f_max` is below the
        largest reading, or all readings are 0 and no `f_max` is stated.
    """
    name = str(path)
    for what, side in (("n_rows", n_rows), ("n_cols", n_cols)):
        if side is not None and not is_whole(side, 1, MAX_SIDE):
            raise SourceError(
                f"{name}: {what} = {shown(side)}; expected a whole number in 1..{MAX_SIDE}"
            )
    check_number(name, "f_max", f_max)
    check_number(name, "rate_hz", rate_hz, high=_MAX_RATE_HZ)
    check_unit(name, unit)
    with reading(name) as file:
        parsed = recording_of(File(file, name, n_rows, n_cols, policy)).read()
    stated_mask = parsed.mask
    parsed, treated = treat(parsed, policy)
    n_frames, rows, cols = parsed.forces.shape
    if n_frames == 0:
        raise SourceError(f"{name}: the recording holds no frame")
    if n_frames > MAX_FRAMES:
        raise SourceError(f"{name}: {n_frames} frames; at most {MAX_FRAMES} are allowed")
    check_grid(rows, cols, name)
    check_stated_shape(rows, cols, n_rows, n_cols, name)
    keeps = policy.negative == KEEP
    check_readings(parsed.forces, name, -MAX_READING if keeps else 0.0, policy.nan != REFUSE)
    if parsed.mask is not None and not parsed.mask.any():
        raise SourceError(f"{name}: no cell of the skin is a taxel, all are masked")
    frames = parsed.forces.astype(np.float32)
    try:
        skin = Skin(
            n_rows=rows,
            n_cols=cols,
            f_max=_range(frames, f_max if f_max is not None else parsed.f_max, name, keeps),
            unit=_unit(unit or ("raw" if keeps and parsed.unit is None else None), parsed, name),
            pitch_m=parsed.pitch_m,
            mask=None if stated_mask is None or stated_mask.all() else stated_mask,
            points=parsed.points,
            point_rows=None if parsed.points is None else parsed.point_rows,
        )
    except MessageError as error:
        raise SourceError(f"{name}: {error}") from error
    if treated.masked_taxels and parsed.mask is not None:
        skin = skin.without(~parsed.mask)
    return RecordedSource(
        Path(name).stem,
        skin,
        frames,
        _stamps(parsed, n_frames, rate_hz, name),
        rate_hz=rate_hz if rate_hz is not None else parsed.rate_hz,
        policy=policy,
        treated=treated,
    )


def n_taxels(
    path: str,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    policy: Policy = DEFAULT_POLICY,
) -> int | None:
    """Number of taxels of a recording, from the begin of its file: what a launch checks.

    Parameters
    ----------
    path, n_rows, n_cols, unit, policy
        As in `open_file`.

    Returns
    -------
    int or None
        Number of cells that exist; None where the begin of the file does not show it.

    Raises
    ------
    SourceError
        If the file cannot be read, its begin is malformed, its shape is not allowed or not the
        one that is stated, or it is a .csv with no unit, stated or its own.
    """
    with reading(path) as file:
        head = recording_of(File(file, path, n_rows, n_cols, policy)).head()
    check_grid(head.n_rows, head.n_cols, path)
    check_stated_shape(head.n_rows, head.n_cols, n_rows, n_cols, path)
    if unit is None and head.unit is None and Path(path).suffix.lower() == ".csv":
        raise SourceError(path + NO_UNIT)
    # No taxel: refused as it is read.
    return None if policy.masks else head.n_taxels or None


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


def _unit(stated: str | None, parsed: Parsed, name: str) -> str:
    found = parsed.unit
    if found is not None and not (found.strip() and found.isprintable() and len(found) <= 32):
        raise SourceError(f"{name}: unit {shown(found)}; expected 1 to 32 printable characters")
    if stated is not None and found is not None and stated != found:
        raise SourceError(
            f"{name}: unit = {shown(stated)} is stated, but the file states {shown(found)}"
        )
    unit = stated or found
    if unit is None and Path(name).suffix.lower() == ".csv":
        raise SourceError(name + NO_UNIT)
    return unit or "N"


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
