"""Addresses of recordings: file:PATH, and example:NAME of those of this package."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sparseskin.messages.text import printable
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.source import Address, Listing, Source

from .file_source import EXAMPLES, n_taxels, open_file
from .format import TABLE_SUFFIXES, TEXT_SUFFIXES, suffixes
from .survey import Needs

MAX_LISTED = 20
"""Most recordings of the current folder that are listed; chosen."""


class FileAddress(Address):
    """A recording.

    A table takes its shape from the file of the skin, where one is stated. Readings below 0 are
    kept where a calibration converts them.
    """

    delivers = "taxels"
    form = "file:PATH"

    @property
    def path(self) -> str:
        """The file."""
        return self.rest

    def check(self) -> None:
        self.n_taxels()

    def n_taxels(self) -> int | None:
        return n_taxels(self.path, self._layout, self.raw)

    def open(self) -> Source:
        # The file of a calibrated skin states the range of the forces, whatever the readings are.
        needs = Needs(range=self.described is None, widens=not self.raw)
        return open_file(self.path, self._layout, self.raw, needs)

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        """Recordings in the current folder, and bags of ROS 2, the newest first."""
        # A .txt or .log is a recording now and then; those that are listed are mostly recordings.
        by_suffix = {
            s: words for s, words in suffixes().items() if s not in TEXT_SUFFIXES
        }
        recordings: dict[Path, str] = {}
        for path in Path().iterdir():
            words = by_suffix.get(path.suffix.lower(), "")
            if words and path.is_file():
                recordings[path] = words
        for path in Path().glob("*/metadata.yaml"):
            recordings[path.parent] = "bag of ROS 2"

        newest = sorted(recordings, key=lambda path: -path.stat().st_mtime_ns)[
            :MAX_LISTED
        ]
        entries = [
            {"source": f"file:{printable(path.name)}", "about": recordings[path]}
            for path in newest
        ]
        return (Listing("files", "recordings in this folder", entries),)

    @property
    def _layout(self) -> Layout:
        """What is stated; a table takes its shape from the file of the skin, where there is one."""
        # Numbers in a line have no shape of their own, and the skin is known.
        described = self.described
        layout = self.layout
        is_table = Path(self.path).suffix.lower() in TABLE_SUFFIXES
        if described is None or described.placement is not None or not is_table:
            return layout
        shape = {
            "n_rows": layout.n_rows or described.n_rows,
            "n_cols": layout.n_cols or described.n_cols,
        }
        return layout.stating(shape)


class ExampleAddress(FileAddress):
    """A recording that comes with this package, so that there is one to begin with."""

    form = "example:NAME"

    @property
    def path(self) -> str:
        return self.source

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        entries = [
            {"source": f"example:{name}", "about": about}
            for name, about in EXAMPLES.items()
        ]
        return (Listing("examples", "recordings of this package", entries),)
