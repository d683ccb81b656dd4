"""The number of taxels of a recording, from the begin of its file; of arrays, their readings are
checked.
"""

from __future__ import annotations

from functools import lru_cache
from io import SEEK_END
from pathlib import Path
from typing import IO

from sparseskin.messages.fields import MAX_ELEMENTS
from sparseskin.nodes.errors import SourceError

from .arrays import check_npy, check_npz, npy_file_shape, npz_file_shape, parse_plain_csv
from .emed import emed_shape
from .hdf5 import hdf5_shape
from .matlab import mat_shape
from .novel_asc import novel_asc_shape
from .own_csv import is_own_csv, own_csv_shape
from .parsed import (
    DEFAULT_POLICY,
    NO_UNIT,
    Policy,
    check_grid,
    check_stated_shape,
    text_lines,
)
from .tekscan import is_tekscan, tekscan_shape
from .xsensor import is_xsensor, xsensor_shape

HEAD_BYTES = 1 << 16
"""Begin of a text file that states its shape, bytes: the header, or a line of numbers."""
FRAME_BYTES = 16 * MAX_ELEMENTS
"""Most that is read of a frame in text, bytes; 16 a cell at its largest shape."""


def n_taxels(
    path: str,
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    policy: Policy = DEFAULT_POLICY,
) -> int | None:
    """Number of taxels of a recording.

    Parameters
    ----------
    path : str
        A file with a suffix that `open_file` knows.
    n_rows, n_cols, unit, policy
        As in `open_file`.

    Returns
    -------
    int or None
        Number of cells that exist; None where the begin of the file does not show it.

    Raises
    ------
    SourceError
        If the file cannot be read, its begin is malformed, its shape is not allowed or not the
        one that is stated, it is a .csv of numbers with neither a stated shape nor unit, or
        `policy` refuses a reading of an .npy or .npz.
    """
    try:
        found = Path(path).stat()
        if not found.st_size:
            raise SourceError(f"{path}: the file is empty")
        policy.check(path)
        of = (found.st_mtime_ns, found.st_size)
        n = _n_taxels(path, n_rows, n_cols, unit, policy, of)
        return None if policy.masks else n
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error.strerror}") from error


@lru_cache(maxsize=8)
def _n_taxels(
    path: str,
    n_rows: int | None,
    n_cols: int | None,
    unit: str | None,
    policy: Policy,
    _of: tuple[int, int],
) -> int | None:
    """As above, of one form of the file."""
    suffix = Path(path).suffix.lower()
    masked: int | None = None
    with open(path, "rb") as file:
        if suffix == ".npy":
            shape = npy_file_shape(file, path)
        elif suffix == ".npz":
            shape, masked = npz_file_shape(file, path)
        elif suffix == ".mat":
            shape = mat_shape(file, path, n_rows, n_cols)
        elif suffix in (".h5", ".hdf5"):
            shape, has_mask = hdf5_shape(path, file.seek(0, SEEK_END))
            shape = () if has_mask else shape
        else:
            shape, masked = _of_text(file, suffix, path, n_rows, n_cols, unit, policy)
    if not shape:
        return None
    rows, cols = shape[-2:]
    check_grid(rows, cols, path)
    check_stated_shape(rows, cols, n_rows, n_cols, path)
    with open(path, "rb") as file:
        if suffix == ".npy":
            check_npy(file, path, Path(path).stat().st_size, policy)
        elif suffix == ".npz":
            check_npz(file, path, policy)
    return rows * cols if masked is None else masked or None  # no taxel: refused as it is read


def _of_text(
    file: IO[bytes],
    suffix: str,
    path: str,
    n_rows: int | None,
    n_cols: int | None,
    unit: str | None,
    policy: Policy,
) -> tuple[tuple[int, ...], int | None]:
    """Shape of a recording or its frames, () where it is not known, and the number of taxels where
    some cells are none.
    """
    head = file.read(HEAD_BYTES)
    if suffix == ".asc":  # its grid stands at the end of the file
        rows, cols, n_exist = novel_asc_shape(head + file.read(), path)
        return (rows, cols), n_exist
    if suffix == ".lst":
        shape = emed_shape(head, path)
        if shape is None and len(head) < HEAD_BYTES:
            raise SourceError(f"{path}: no line 'Matrix: COLUMNSxROWS'; not an emed text export")
        return shape or (), None
    if suffix == ".asf" or is_tekscan(head):
        rows, cols, masked = tekscan_shape(head + file.read(FRAME_BYTES - len(head)), path)
        return ((), None) if masked is None else ((rows, cols), masked)
    if is_xsensor(head):
        begin = head + file.read(FRAME_BYTES - len(head))
        if len(begin) == FRAME_BYTES:  # its first frame may be cut
            return (), None
        rows, cols, masked = xsensor_shape(begin, path)
        return ((), None) if masked is None else ((rows, cols), masked)
    if is_own_csv(head):
        begin = head + file.read(FRAME_BYTES - len(head))
        n_rows, n_cols, masked = own_csv_shape(begin, path)
        return (n_rows, n_cols), masked
    lines = text_lines(head + file.readline(FRAME_BYTES))  # the last line of the head may be cut
    first = next((k for k, line in enumerate(lines) if _holds_frame(line)), len(lines))
    line = "\n".join(lines[: first + 1]).encode("latin-1")
    shape = parse_plain_csv(line, path, n_rows, n_cols, policy).forces.shape
    if unit is None:
        raise SourceError(path + NO_UNIT)
    return shape, None


def _holds_frame(line: str) -> bool:
    """True if a line of a plain .csv is neither blank nor a comment."""
    return bool(line.strip()) and not line.lstrip().startswith("#")
