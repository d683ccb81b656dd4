"""The file formats of recordings: which suffix is read by which parser."""

from __future__ import annotations

from pathlib import Path

from sparseskin.nodes.errors import SourceError

from .arrays import parse_npy, parse_npz, parse_plain_csv
from .emed import parse_emed
from .parsed import Parsed, read_bytes, shown
from .tekscan import is_tekscan, parse_tekscan

SUFFIXES = {
    ".lst": "Novel emed text export",
    ".asf": "Tekscan ASCII movie export",
    ".csv": "Tekscan ASCII movie export, or numbers with one frame a line",
    ".npy": "array (frames, rows, columns)",
    ".npz": "array 'forces' with stamp_ns, rate_hz, mask, f_max, unit, pitch_m as wanted",
}
"""The file formats that can be read, by suffix."""


def parse_file(name: str, n_rows: int | None, n_cols: int | None) -> Parsed:
    """Read a recording; its suffix, and for .csv its content, tells the format.

    Parameters
    ----------
    name : str
        Path of the file, also its name in errors.
    n_rows, n_cols : int or None
        Shape of a frame, for a .csv of numbers; no other format looks at it.

    Raises
    ------
    SourceError
        If the suffix is not known, or the file cannot be read or is malformed.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in SUFFIXES:
        raise SourceError(
            f"{name}: suffix {shown(suffix)} is not known; allowed are {', '.join(SUFFIXES)}"
        )
    raw = read_bytes(name)
    if suffix == ".csv" and not is_tekscan(raw):
        return parse_plain_csv(raw, name, n_rows, n_cols)
    parsers = {
        ".lst": parse_emed,
        ".asf": parse_tekscan,
        ".csv": parse_tekscan,
        ".npy": parse_npy,
        ".npz": parse_npz,
    }
    return parsers[suffix](raw, name)
