"""Recordings as a sensor source: a file is read whole and checked, then yields its frames."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats

from .arrays import parse_npy, parse_npz, parse_plain_csv
from .emed import parse_emed
from .hdf5 import parse_hdf5
from .invalid import Treated, treat
from .matlab import parse_mat
from .novel_asc import parse_novel_asc
from .own_csv import is_own_csv, parse_own_csv
from .parsed import (
    DEFAULT_POLICY,
    KEEP,
    MAX_READING,
    NO_UNIT,
    Parsed,
    Policy,
    check_grid,
    check_number,
    check_readings,
    check_stated_shape,
    check_unit,
    read_bytes,
    shown,
)
from .tekscan import is_tekscan, parse_tekscan
from .xsensor import is_xsensor, parse_xsensor

SUFFIXES = {
    ".lst": "Novel emed text export",
    ".asf": "Tekscan ASCII movie export",
    ".asc": "Novel pliance text export",
    ".csv": "Tekscan ASCII movie, XSENSOR or bag export, or numbers with one frame a line",
    ".npy": "array (frames, rows, columns)",
    ".npz": "array 'forces' with stamp_ns, rate_hz, mask, f_max, unit, pitch_m as wanted",
    ".mat": "MATLAB variable 'forces', or the only one of three dimensions; n_rows, n_cols stated",
    ".h5": "HDF5 dataset 'forces', or the only one of three dimensions (frames, rows, columns)",
    ".hdf5": "as .h5",
}
"""The file formats that can be read, by suffix."""
MAX_FRAMES = 1 << 24
"""Most frames of a recording, chosen: four hours at 1 kHz; each has a stamp, a Python integer."""
UNTIMED_PERIOD_NS = 10_000_000
"""Time between frames where neither file nor caller states one, chosen: stamps must rise."""
_MAX_RATE_HZ = 1e9


@dataclass(eq=False)
class RecordedSource:
    """The frames of a recording, in memory and checked; may be iterated any number of times.

    Its attributes are those of a `Source`; its name is that of the file without suffix, its skin
    the patch after the crop. `treated` counts the readings that were not valid, and were treated by
    `policy`.
    """

    name: str
    skin: Skin
    frames: Floats
    stamp_ns: Sequence[int]
    rate_hz: float | None = None
    delivers: Literal["truth", "taxels"] = "taxels"
    policy: Policy = DEFAULT_POLICY
    treated: Treated = field(default_factory=Treated)
    n_frames: int | None = field(init=False)

    def __post_init__(self) -> None:
        self.n_frames = len(self.frames)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces): nanoseconds since the first frame, and a new float32 array
        of shape (n_rows, n_cols) in [0, f_max], 0 in masked cells.
        """
        for stamp, frame in zip(self.stamp_ns, self.frames, strict=True):
            yield stamp, frame.copy()


def open_file(
    path: str | os.PathLike[str],
    *,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
    rate_hz: float | None = None,
    crop: Sequence[int] | None = None,
    delivers: Literal["truth", "taxels"] = "taxels",
    policy: Policy = DEFAULT_POLICY,
) -> RecordedSource:
    """Open a recording; its format follows from the suffix, and for .csv from the content.

    Parameters
    ----------
    path : str or path
        A file with one of the suffixes in `SUFFIXES`.
    n_rows, n_cols : int, optional
        Shape of a frame. Required for a plain .csv (one of them is enough); any other file
        states its shape, which must agree.
    unit : str, optional
        Unit of the readings. Required for a plain .csv; "N" where an array states none; must
        agree with a unit that the file states.
    f_max : float, optional
        Upper end of the range, in `unit`; by default that of the file, or else the largest
        reading of the (cropped) recording.
    rate_hz : float, optional
        Frame rate, 1e-9..1e9, in place of the file's own rate and stamps.
    crop : sequence of four int, optional
        (row_start, row_stop, col_start, col_stop), from 0, stops excluded: the part of each
        frame that is kept.
    delivers : "truth" or "taxels"
        "truth" for noise-free frames, e.g. of a simulation.
    policy : Policy
        What to do with readings that are not finite or below 0, in arrays and plain .csv; refused
        by default.

    Returns
    -------
    RecordedSource
        Frames float32 of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells. Stamps are
        the file's, or follow from the rate, or are 10 ms apart where there is neither.

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
    if delivers not in ("truth", "taxels"):
        raise SourceError(f"{name}: delivers = {shown(delivers)}; allowed are truth, taxels")
    policy.check(name)
    parsed, treated = treat(_parse(name, n_rows, n_cols, policy), policy)
    n_frames, rows, cols = parsed.forces.shape
    if n_frames == 0:
        raise SourceError(f"{name}: the recording holds no frame")
    if n_frames > MAX_FRAMES:
        raise SourceError(f"{name}: {n_frames} frames; at most {MAX_FRAMES} are allowed")
    check_grid(rows, cols, name)
    check_stated_shape(rows, cols, n_rows, n_cols, name)
    keeps = policy.negative == KEEP
    check_readings(parsed.forces, name, -MAX_READING if keeps else 0.0)
    forces, mask, points, rows_of = parsed.forces, parsed.mask, parsed.points, parsed.point_rows
    if crop is not None:
        window = _window(crop, rows, cols, name)
        forces = forces[:, *window]
        mask = None if mask is None else mask[window].copy()
        points = None if points is None else points[window]
        rows_of = None if rows_of is None else rows_of[window]
    if mask is not None and not mask.any():
        raise SourceError(f"{name}: no cell of the skin is a taxel, all are masked")
    frames = forces.astype(np.float32)
    if mask is not None and mask.all():
        mask = None
    skin = Skin(
        n_rows=frames.shape[1],
        n_cols=frames.shape[2],
        f_max=_range(frames, f_max if f_max is not None else parsed.f_max, name, keeps),
        unit=_unit(unit or ("raw" if keeps and parsed.unit is None else None), parsed, name),
        pitch_m=parsed.pitch_m,
        mask=mask,
    )
    if points is not None:
        try:
            point_rows = None if rows_of is None else rows_of[skin.exists]
            skin = replace(skin, points=points[skin.exists], point_rows=point_rows)
        except MessageError as error:
            raise SourceError(f"{name}, array 'points': {error}") from error
    return RecordedSource(
        Path(name).stem,
        skin,
        frames,
        _stamps(parsed, n_frames, rate_hz, name),
        rate_hz=rate_hz if rate_hz is not None else parsed.rate_hz,
        delivers=delivers,
        policy=policy,
        treated=treated,
    )


def unknown_suffix(suffix: str) -> str:
    """Error text for a file of a suffix that is none of `SUFFIXES`."""
    hint = "; sparseskin play FILE publishes a bag" if suffix.lower() == ".mcap" else ""
    return f"suffix {shown(suffix)} is not known; allowed are {', '.join(SUFFIXES)}{hint}"


def _parse(name: str, n_rows: int | None, n_cols: int | None, policy: Policy) -> Parsed:
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise SourceError(f"{name}: {unknown_suffix(suffix)}")
    raw = read_bytes(name)
    if suffix == ".csv" and not is_tekscan(raw):
        if is_xsensor(raw):
            return parse_xsensor(raw, name)
        if is_own_csv(raw):
            return parse_own_csv(raw, name, policy)
        return parse_plain_csv(raw, name, n_rows, n_cols, policy)
    if suffix == ".mat":
        return parse_mat(raw, name, n_rows, n_cols)
    parsers = {
        ".lst": parse_emed,
        ".npy": parse_npy,
        ".npz": parse_npz,
        ".asc": parse_novel_asc,
        ".h5": parse_hdf5,
        ".hdf5": parse_hdf5,
    }
    return parsers.get(suffix, parse_tekscan)(raw, name)


def _window(crop: Sequence[int], rows: int, cols: int, name: str) -> tuple[slice, slice]:
    wanted = "expected (row_start, row_stop, col_start, col_stop)"
    whole = not isinstance(crop, str) and all(type(edge) is int for edge in crop)
    if not whole or len(crop) != 4:
        raise SourceError(f"{name}: crop = {shown(crop)}; {wanted}, four whole numbers")
    row_start, row_stop, col_start, col_stop = crop
    if not (0 <= row_start < row_stop <= rows and 0 <= col_start < col_stop <= cols):
        raise SourceError(
            f"{name}: crop = {list(crop)}; {wanted} within {rows} rows x {cols} columns"
        )
    return slice(row_start, row_stop), slice(col_start, col_stop)


def _range(frames: Floats, stated: float | None, name: str, keeps: bool) -> float:
    peak = float(frames.max())
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
