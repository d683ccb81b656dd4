"""False rows of measurements under all phases of a Phi: kept out of the frames, and told."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.row_watch import RowWatch

#: Numbers that a line names; of more it says how many.
MOST_NAMED = 8


class FaultyRows:
    """Watches the rows of every Phi that frames come from, and tells a log what it finds.

    Under rotating rows each phase has a watch of its own, which sees a frame in P.

    Parameters
    ----------
    log : callable
        Takes one line of text: rows that are left out, and those that are believed again.

    Attributes
    ----------
    text : str
        Which rows are left out now; "" where none is.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._watches: dict[str, RowWatch] = {}
        self.text = ""

    @property
    def swamped(self) -> bool:
        """Whether so many rows disagree that leaving them out would mend nothing."""
        return any(watch.swamped for watch in self._watches.values())

    def keep(self, phases: dict[str, Phi]) -> None:
        """Watch these and forget all others; `phases` by fingerprint."""
        self._watches = {
            fingerprint: self._watches.get(fingerprint) or RowWatch(phi)
            for fingerprint, phi in phases.items()
        }
        self._tell()

    def cleaned(self, phi: Phi, y: Floats, last: Floats | None) -> Floats:
        """As in `RowWatch`."""
        return self._watches[phi.fingerprint].cleaned(y, last)

    def update(self, phi: Phi, y: Floats, fitted: Floats) -> bool:
        """Take in a restored frame; parameters as in `RowWatch`.

        Returns
        -------
        bool
            Whether a row was found that the estimate has believed so far.
        """
        watch = self._watches[phi.fingerprint]
        before, was_swamped = watch.left_out.copy(), watch.swamped
        if watch.update(y, fitted):
            self._tell()
            new, healed = watch.left_out & ~before, before & ~watch.left_out
            if new.any():
                self._log(f"measurements left out, false: {_numbers(np.flatnonzero(new))}")
            if healed.any():
                self._log(f"measurements believed again: {_numbers(np.flatnonzero(healed))}")
            return bool(new.any())
        if watch.swamped and not was_swamped:
            self._log(
                "a quarter of all measurements and more do not fit each other: none more is left "
                "out; is the skin's mask right?"
            )
        return False

    def _tell(self) -> None:
        several = len(self._watches) > 1
        parts = []
        for turn, watch in enumerate(self._watches.values()):
            out = np.flatnonzero(watch.left_out)
            if out.size:
                where = f" of turn {turn}" if several else ""
                parts.append(f"{out.size} of {watch.left_out.size}{where} ({_numbers(out)})")
        self.text = f"false measurements left out: {'; '.join(parts)}" if parts else ""


def _numbers(rows: Indices) -> str:
    named = ", ".join(str(row) for row in rows[:MOST_NAMED])
    return named if rows.size <= MOST_NAMED else f"{named} and {rows.size - MOST_NAMED} more"
