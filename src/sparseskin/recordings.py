"""Recordings as arrays."""

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages.state import described
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, PART_SUFFIX
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.format import HEAD_BYTES, is_bag
from sparseskin.nodes.sensor.files.survey import Needs
from sparseskin.nodes.sensor.layout.layout import KEYS, Layout


@checked(SparseskinError)
def read_recording(
    path: str | os.PathLike[str], patch: str | None = None, **stated: Any
) -> dict[str, Any]:
    """Read a recording into arrays, under the names that `recording export --to npz` uses.

    Parameters
    ----------
    path : str or path
        A recording of sparseskin (.mcap, .mcap.part), or any file that the sensor reads; or
        "example:fingers", which comes with the package.
    patch : str, optional
        Patch to read; needed where a bag has several.
    **stated
        What a file does not state: the keys of `Layout`, as the settings of the sensor (n_rows,
        n_cols, unit, time, missing, ...). Not for recordings of sparseskin.

    Returns
    -------
    dict
        `forces` (readings), `truth`, `reconstruction`: float32 (k, n_rows, n_cols), NaN where a
        reading is missing;
        `measurements`: float32 (k, M), NaN behind the last one where M changes; `stamp_ns` (of
        `forces`), `truth_stamp_ns`, `reconstruction_stamp_ns`, `measurements_stamp_ns`: int64
        (k,), nanoseconds; `f_max` (float) and `unit` (str), `mask` (bool, shape (n_rows,
        n_cols)), `pitch_m` (metres), `rate_hz`, as far as known; `notes` (tuple of str): how a
        file was read, what was assumed, what was dropped. All forces in `unit`.

    Raises
    ------
    SparseskinError
        If the file is missing, malformed, or has no such frames.

    Examples
    --------
    >>> import numpy as np, sparseskin, tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.save(f"{folder}/log.npy", np.ones((5, 4, 4), np.float32))
    ...     recording = sparseskin.read_recording(f"{folder}/log.npy", rate_hz=100)
    >>> recording["forces"].shape, recording["stamp_ns"][:2].tolist(), recording["unit"]
    ((5, 4, 4), [0, 10000000], 'N')
    """
    if _is_bag(path):
        if stated:
            raise SparseskinError(
                f"{path}: a recording states {', '.join(stated)} itself"
            )
        return _read_bag(path, patch)
    # A recording of another program: the layout states what it does not.
    for word in stated:
        if word not in KEYS:
            raise SparseskinError(f"{word}: unknown argument{nearest_of(word, KEYS)}")
    source = open_file(path, Layout(**stated), needs=Needs(in_memory=True))
    stamp_ns, forces = source.take_all()
    return {
        "forces": forces,
        "stamp_ns": stamp_ns,
        **described(source.skin, source.rate_hz),
        "notes": tuple(source.take_lines()),
    }


def _is_bag(path: str | os.PathLike[str]) -> bool:
    """True for a recording of sparseskin; other programs write .mcap, too."""
    # An incomplete recording has a name that no other program uses.
    name = Path(path).name
    if name.endswith(FILE_SUFFIX + PART_SUFFIX):
        return True
    if not name.endswith(FILE_SUFFIX):
        return False
    if not Path(path).is_file():
        # The reader reports that it is missing.
        return True
    with Path(path).open("rb") as file:
        return is_bag(file.read(HEAD_BYTES))


def _read_bag(path: str | os.PathLike[str], patch: str | None) -> dict[str, Any]:
    # Most recordings are of other programs: these need none of it.
    from sparseskin.nodes.recorder.bag.frames import array_names, patch_topics, skin_of
    from sparseskin.nodes.recorder.bag.patches import split_bag
    from sparseskin.nodes.recorder.bag.reader import BagReader
    from sparseskin.nodes.recorder.convert.npz import export_npz

    with (
        BagReader(path) as whole,
        tempfile.TemporaryDirectory(prefix="sparseskin-") as folder,
    ):
        # Patches that were recorded in batches are read one by one.
        bag = split_bag(whole)
        patch, topics = patch_topics(bag, patch)
        # By way of the export, so that names and arrays are the same.
        (written,) = export_npz(bag, Path(folder) / "frames.npz", topics)
        skin = skin_of(bag, patch)
        names: list[str] = []
        for topic in topics:
            names += array_names(bag.topics[topic].schema)
        with np.load(written) as file:
            arrays: dict[str, Any] = {name: file[name] for name in names}
    if skin is not None:
        arrays |= described(skin, skin.rate_hz)
    return arrays
