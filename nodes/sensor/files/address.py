"""Addresses of recordings: file:PATH, and example:NAME of those of this package."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from sparseskin.messages.text import printable
from sparseskin.nodes.sensor.source import Address, Listing, Source

from .file_source import EXAMPLES, n_taxels, open_file
from .format import suffixes

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
        return n_taxels(self.path, **self._stated)

    def open(self) -> Source:
        return open_file(self.path, f_max=self.f_max, **self._stated)

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        """Recordings in the current folder, and bags of ROS 2, the newest first."""
        about = suffixes()
        found = {p: about.get(p.suffix.lower(), "") for p in Path().iterdir() if p.is_file()}
        found |= {p.parent: "bag of ROS 2" for p in Path().glob("*/metadata.yaml")}
        newest = sorted(filter(found.get, found), key=lambda p: -p.stat().st_mtime_ns)[:MAX_LISTED]
        entries = [{"source": f"file:{printable(p.name)}", "about": found[p]} for p in newest]
        return (Listing("files", "recordings in this folder", entries),)

    @property
    def _stated(self) -> dict[str, Any]:
        found, n_rows, n_cols = self.described, self.n_rows, self.n_cols
        if found and found.placement is None and self.path.endswith(".csv"):
            n_rows, n_cols = n_rows or found.rows, n_cols or found.cols
        return {
            "n_rows": n_rows,
            "n_cols": n_cols,
            "unit": self.unit,
            "rate_hz": self.rate_hz,
            "columns": self.columns or None,
            "topic": self.topic or None,
            "policy": replace(self.policy, raw=self.raw),
        }


class ExampleAddress(FileAddress):
    """A recording that comes with this package, so that there is one to begin with."""

    form = "example:NAME"

    @property
    def path(self) -> str:
        return self.source

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        entries = [
            {"source": f"example:{name}", "about": about} for name, about in EXAMPLES.items()
        ]
        return (Listing("examples", "recordings of this package", entries),)
