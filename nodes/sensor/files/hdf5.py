"""HDF5: one dataset of frames, read by h5py (the extra `files`) in a process of its own."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SourceError

from .arrays import NPZ_NAMES, checked_shape, forces_name, parsed_arrays
from .isolated import in_child
from .parsed import Head, Parsed, Recording, shown

INSTALL = 'reading HDF5 needs h5py; pip install "sparseskin[files]"'
_MOST_OBJECTS = 1000
"""Groups and datasets that are looked at; chosen, far above those of a recording."""
_FILTERS = {"gzip", "lzf", "szip", None}
MATLAB_CLASS = "MATLAB_class"


class Hdf5Recording(Recording):
    """A dataset `forces`, in any group, or the only one of numbers with three dimensions:
    (frames, rows, columns).

    `stamp_ns`, `rate_hz`, `mask`, `f_max`, `unit` and `pitch_m` are those beside it, or attributes
    of it, as in an .npz. Links to other files and virtual datasets are not followed.

    Raises
    ------
    SourceError
        If h5py is not installed, the file is no HDF5, does not hold one such dataset, or an array
        is larger than allowed or not as in an .npz.
    """

    def __init__(self, file: IO[bytes], name: str) -> None:
        self._name, self._n_bytes = name, file.seek(0, io.SEEK_END)

    def head(self) -> Head:
        found = in_child(f"{__name__}:read_shape", self._name, self._n_bytes)
        _, n_rows, n_cols = checked_shape(tuple(found["shape"].tolist()), self._name)
        return Head(n_rows, n_cols, None if found["has_mask"] else n_rows * n_cols)

    def read(self) -> Parsed:
        arrays = in_child(f"{__name__}:read_arrays", self._name, self._n_bytes)
        return parsed_arrays(arrays, self._name)


def read_shape(name: str, most: int) -> dict[str, npt.NDArray[Any]]:
    """The shape of the frames, and whether there is a mask; runs in a child."""
    with _opened(name) as (file, h5py):
        forces = _forces(file, h5py, name)
        has_mask = "mask" in forces.parent or "mask" in forces.attrs
        return {"shape": np.array(forces.shape), "has_mask": np.array(has_mask)}


def read_arrays(name: str, most: int) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a file, of at most `most` bytes together, and whether MATLAB wrote them, whose
    dimensions stand in reverse order; runs in a child.
    """
    with _opened(name) as (file, h5py):
        return _arrays(_forces(file, h5py, name), h5py, name, most)


def _arrays(forces: Any, h5py: Any, name: str, most: int) -> dict[str, npt.NDArray[Any]]:
    held: dict[str, Any] = {"forces": forces}
    for key in NPZ_NAMES[1:]:
        beside = forces.parent.get(key, getlink=True)
        if isinstance(beside, h5py.HardLink) and isinstance(forces.parent[key], h5py.Dataset):
            held[key] = forces.parent[key]
    size = sum(one.size * one.dtype.itemsize for one in held.values())
    if size > most:
        raise SourceError(f"{name}: its datasets have {size} bytes; at most {most} are allowed")
    arrays = {key: _read(one, h5py, name) for key, one in held.items()}
    for key in NPZ_NAMES[1:]:
        if key not in arrays and key in forces.attrs:
            arrays[key] = _text_or_number(forces.attrs[key])
    return arrays | {MATLAB_CLASS: np.array(MATLAB_CLASS in forces.attrs)}


@contextmanager
def _opened(name: str) -> Iterator[Any]:
    try:
        import h5py
    except ImportError as error:
        raise SourceError(f"{name}: {INSTALL}") from error
    try:
        with h5py.File(name, "r") as file:
            yield file, h5py
    except SourceError:
        raise
    except Exception as error:  # HDF5 has one of many kinds for each fault of a file
        raise SourceError(f"{name}: not a readable HDF5 file ({shown(error, 80)})") from error


def _forces(file: Any, h5py: Any, name: str) -> Any:
    """The dataset of frames."""
    found: dict[str, Any] = {}
    n_seen = 0

    def note(path: str, one: Any) -> None:
        nonlocal n_seen
        n_seen += 1
        if n_seen > _MOST_OBJECTS:
            raise SourceError(f"{name}: holds more than {_MOST_OBJECTS} objects")
        hidden = any(part.startswith("#") for part in path.split("/"))  # of MATLAB's own
        if isinstance(one, h5py.Dataset) and one.dtype.kind in "iufb" and not hidden:
            found[f"/{path}"] = one

    file.visititems(note)  # follows neither soft nor external links
    named = [path for path in found if path.endswith("/forces")]
    if len(named) == 1:
        return found[named[0]]
    key = forces_name({path: one.ndim for path, one in found.items()}, name)
    return found[key]


def _read(dataset: Any, h5py: Any, name: str) -> npt.NDArray[Any]:
    where = f"{name}, dataset {shown(dataset.name)}"
    if dataset.is_virtual or dataset.external:
        raise SourceError(f"{where}: its numbers are in other files")
    if dataset.compression not in _FILTERS:
        raise SourceError(f"{where}: compression {shown(dataset.compression)} is not read")
    if dataset.attrs.get(MATLAB_CLASS) == b"char":
        return np.array("".join(map(chr, dataset[()].ravel())))
    if h5py.check_string_dtype(dataset.dtype) is not None:
        return _text_or_number(dataset[()])
    return np.asarray(dataset[()])


def _text_or_number(value: Any) -> npt.NDArray[Any]:
    if isinstance(value, bytes):
        return np.array(value.decode("utf-8", "replace"))
    return np.asarray(value)
