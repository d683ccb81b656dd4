"""Formats of recordings: the interface, those of the core, and those of plug-ins."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import FILES, failures, loaded

from .arrays import ArrayRecording
from .bag import BagRecording, is_bag
from .recording import File, Recording, shown
from .table import TableRecording

HEAD_BYTES = 1 << 16
"""Bytes from the begin of a file by which its format is found, where several have its suffix."""


@dataclass(frozen=True)
class Format:
    """A format of recordings."""

    #: Suffixes of its files, in small letters with the dot, and what such a file holds, in few
    #: words.
    suffixes: Mapping[str, str]
    open: Callable[[File], Recording]  # raises SourceError
    #: True if a file that begins with these bytes (at most `HEAD_BYTES`) is one of this format;
    #: None: every file with one of its suffixes that no other format recognises.
    recognises: Callable[[bytes], bool] | None = None


_NPZ = "array 'forces' with stamp_ns, rate_hz, mask, f_max, unit, pitch_m as wanted"
OWN = (
    Format({".csv": "table with one frame a line"}, TableRecording),
    Format({".npy": "array (frames, rows, columns)", ".npz": _NPZ}, ArrayRecording),
    Format({".mcap": "recording of sparseskin"}, BagRecording, is_bag),
)
"""Formats of the core."""


@cache
def suffixes() -> dict[str, str]:
    """The suffixes of recordings that can be read, and what files of each hold."""
    found: dict[str, list[str]] = {}
    for one in (*OWN, *loaded(FILES).values()):
        for suffix, about in one.suffixes.items():
            found.setdefault(suffix, []).append(about)
    return {suffix: " or ".join(abouts) for suffix, abouts in found.items()}


def recording_of(file: File) -> Recording:
    """The recording of an open file, by its suffix, and where several formats have it, by its
    begin. Raises SourceError if no format has it.
    """
    suffix = Path(file.name).suffix.lower()
    fitting = [one for one in OWN if suffix in one.suffixes]
    # Plug-ins, which may have it too, are imported for these.
    if suffix in (".csv", ".mcap") or not fitting:
        begin = file.file.read(HEAD_BYTES)
        file.file.seek(0)
        if suffix == ".csv" and b"\0" in begin:
            raise SourceError(f"{file.name}: not a text table in UTF-8: holds bytes of value 0")
        fitting = [one for one in (*fitting, *loaded(FILES).values()) if suffix in one.suffixes]
        sure = [one for one in fitting if one.recognises is not None and one.recognises(begin)]
        fitting = sure or [one for one in fitting if one.recognises is None] or fitting
    if not fitting:
        allowed = f"allowed are {', '.join(suffixes())}{failures(FILES)}"
        unknown = f"suffix {shown(Path(file.name).suffix)} is not known"
        raise SourceError(f"{file.name}: {unknown}; {allowed}")
    return fitting[0].open(file)
