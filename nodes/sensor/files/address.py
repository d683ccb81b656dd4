"""Addresses of recordings: file:PATH."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from sparseskin.messages.text import printable
from sparseskin.nodes.sensor.source import Address, Listing, Source

from .file_source import n_taxels, open_file
from .format import suffixes
from .recording import KEEP, REFUSE, Policy

MAX_LISTED = 20
"""Most recordings of the current folder that are listed; chosen."""


class FileAddress(Address):
    """A recording.

    A .csv of numbers takes its shape from the file of the skin, where one is stated. Readings below
    0 are kept where a calibration converts them.
    """

    form = "file:PATH"

    def check(self) -> None:
        unit = "raw" if self.unit is None and self.described is not None else self.unit
        n_taxels(self.rest, *self._shape, unit, self._policy)

    def n_taxels(self) -> int | None:
        return n_taxels(self.rest, *self._shape, self.unit, self._policy)

    def open(self) -> Source:
        n_rows, n_cols = self._shape
        return open_file(
            self.rest,
            n_rows=n_rows,
            n_cols=n_cols,
            unit=self.unit,
            f_max=self.f_max,
            policy=self._policy,
        )

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        """Recordings in the current folder by their suffixes, the newest first."""
        about = suffixes()
        found = (p for p in Path().iterdir() if p.suffix.lower() in about and p.is_file())
        newest = sorted(found, key=lambda p: -p.stat().st_mtime_ns)[:MAX_LISTED]
        entries = [
            {"source": f"file:{printable(p.name)}", "about": about[p.suffix.lower()]}
            for p in newest
        ]
        return (Listing("files", "recordings in this folder", entries),)

    @property
    def _shape(self) -> tuple[int | None, int | None]:
        found = self.described
        if found is None or found.placement is not None or not self.rest.endswith(".csv"):
            return self.n_rows, self.n_cols
        return self.n_rows or found.rows, self.n_cols or found.cols

    @property
    def _policy(self) -> Policy:
        keeps = self.raw and self.policy.negative == REFUSE
        return replace(self.policy, negative=KEEP) if keeps else self.policy
