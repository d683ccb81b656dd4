"""The account of a source: each line, message or frame that comes in becomes a frame, or is dropped
by name.
"""

from __future__ import annotations

from collections import Counter

from sparseskin.nodes.errors import SourceError


class Tally:
    """Counts of what a reader took in, and of what became of it.

    `what` names the items of the source in the plural: lines, messages, items of an array.
    """

    def __init__(self, what: str) -> None:
        self.what = what
        self.n_items = 0
        self.n_frames = 0
        #: Items that belong to a frame beside its first one, as the lines of a grid.
        self.n_further = 0
        self.dropped: Counter[str] = Counter()

    def begin(self) -> None:
        """Begin again: the source is read from its begin."""
        self.n_items = 0
        self.n_frames = 0
        self.n_further = 0
        self.dropped.clear()

    def take(self, n_items: int, n_frames: int) -> None:
        """Add items that became so many frames."""
        self.n_items += n_items
        self.n_frames += n_frames
        self.n_further += n_items - n_frames

    def drop(self, name: str, n_items: int = 1) -> None:
        """Add items that are dropped, by a name such as "blank lines"."""
        if n_items:
            self.n_items += n_items
            self.dropped[name] += n_items

    def check(self, where: str, n_expected: int | None = None) -> None:
        """Raise SourceError unless items in are frames out and drops; `n_expected` is the number
        of items that the source states, None where it states none.
        """
        # The law of conservation: whatever comes in becomes a frame, or is dropped by name.
        n_accounted = self.n_frames + self.n_further + self.dropped.total()
        if n_accounted != self.n_items:
            counts = (
                f"{self.n_items} {self.what} were read, {n_accounted} are accounted for"
            )
            raise SourceError(f"{where}: {counts}; the file is not used")
        if n_expected is not None and n_expected != self.n_items:
            counts = f"it states {n_expected} {self.what}, but holds {self.n_items}"
            raise SourceError(f"{where}: {counts}")

    @property
    def text(self) -> str:
        """The account in words: "12 lines: 10 frames, 1 header, 1 blank lines"."""
        parts = [f"{self.n_frames} frames"]
        if self.n_further:
            parts[0] += f" of {self.n_frames + self.n_further} {self.what}"
        parts += [f"{n} {name}" for name, n in self.dropped.items()]
        return f"{self.n_items} {self.what}: {', '.join(parts)}"
