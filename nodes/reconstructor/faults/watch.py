"""Faulty measurements and taxels: found, excluded from the frames, and logged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask

from .rows import RowWatch
from .taxels import TaxelWatch

#: Most numbers that a line names; of more it states the count.
MOST_NAMED = 8


class FaultWatch:
    """Detects faulty measurements and taxels, and excludes them from the frames.

    Frames of a Phi that chooses its taxels anew in each frame have no rows to watch: omit them.

    Parameters
    ----------
    watch_rows, watch_taxels : bool
        Search for faulty measurements; for faulty taxels.
    log : callable
        Receives one line of text.
    """

    def __init__(self, watch_rows: bool, watch_taxels: bool, log: Callable[[str], None]) -> None:
        self._watch_rows, self._watch_taxels = watch_rows, watch_taxels
        self._log = log
        self._rows = FaultyRows(log)
        self._taxels: TaxelWatch | None = None
        self._noisy = False

    @property
    def text(self) -> str:
        """The measurements and taxels excluded now; "" if there are none."""
        taxels = "" if self._taxels is None else self._taxels.text
        return "; ".join(filter(None, (self._rows.text, taxels)))

    @property
    def swamped(self) -> bool:
        """As in `FaultyRows`."""
        return self._rows.swamped

    def set_up(self, subsets: dict[str, Phi], state: SkinState, mask: Mask) -> None:
        """Watch these row subsets, by fingerprint, and the skin with existing taxels `mask`."""
        # On a skin that does not state its noise, constant readings may be right.
        self._noisy = state.sigma_mid > 0
        self._mask = mask
        self._rows.keep(subsets)
        self._taxels = None
        if self._watch_taxels and self._noisy:
            sigmas = state.sigma_mid, state.sigma_end
            self._taxels = TaxelWatch(mask, state.f_max, *sigmas, self._log)

    def cleaned(self, phi: Phi, y: Floats, last: Floats | None) -> tuple[Floats, Floats]:
        """Return y without the readings of stuck taxels; and with Phi `last` for faulty rows, too.

        y and both results are float32 (m,); `last` is the last frame as the solver reconstructed
        it, float32 (n_rows, n_cols), or None.
        """
        given = y if self._taxels is None else self._taxels.cleaned(phi, y)
        if not self._looks_at_rows or not self._rows.text:
            return given, given
        forces = None if last is None else last[self._mask]
        return given, self._rows.cleaned(phi, given, forces)

    def filled(self, forces: Floats) -> Floats:
        """Return the frame with faulty taxels filled in; as in `TaxelWatch`."""
        return forces if self._taxels is None else self._taxels.filled(forces)

    def update(
        self, phi: Phi, given: Floats, believed: Floats, forces: Floats, fitted: Floats
    ) -> bool:
        """Process a frame as the solver reconstructed it; return as `FaultyRows.update`.

        `given` and `believed` are as `cleaned` returned them, `fitted` is Phi times the forces.
        """
        if self._taxels is not None:
            self._taxels.update(phi, forces, believed - fitted)
        return self._looks_at_rows and self._rows.update(phi, given, fitted)

    @property
    def _looks_at_rows(self) -> bool:
        return self._watch_rows and self._noisy


class FaultyRows:
    """A `RowWatch` for each row subset, and a log of the faulty measurements they find.

    `text` names the measurements excluded now; "" if there are none.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._watches: dict[str, RowWatch] = {}
        self.text = ""

    @property
    def swamped(self) -> bool:
        """True if so many measurements disagree that excluding them would be no remedy."""
        return any(watch.swamped for watch in self._watches.values())

    def keep(self, subsets: dict[str, Phi]) -> None:
        """Watch these, by fingerprint, and forget all others."""
        self._watches = {
            fingerprint: self._watches.get(fingerprint) or RowWatch(phi)
            for fingerprint, phi in subsets.items()
        }
        self._describe()

    def cleaned(self, phi: Phi, y: Floats, last: Floats | None) -> Floats:
        """As in `RowWatch`."""
        return self._watches[phi.fingerprint].cleaned(y, last)

    def update(self, phi: Phi, y: Floats, fitted: Floats) -> bool:
        """Process a reconstructed frame; parameters as in `RowWatch`.

        Return True if a faulty measurement was found that the estimate has used so far.
        """
        watch = self._watches[phi.fingerprint]
        before, was_swamped = watch.left_out.copy(), watch.swamped
        if watch.update(y, fitted):
            self._describe()
            new, healed = watch.left_out & ~before, before & ~watch.left_out
            if new.any():
                self._log(f"measurements left out, faulty: {_numbers(np.flatnonzero(new))}")
            if healed.any():
                self._log(f"measurements used again: {_numbers(np.flatnonzero(healed))}")
            return bool(new.any())
        if watch.swamped and not was_swamped:
            self._log(
                "a quarter of all measurements and more do not fit each other: none more is left "
                "out; is the skin's mask right?"
            )
        return False

    def _describe(self) -> None:
        several = len(self._watches) > 1
        parts = []
        for subset, watch in enumerate(self._watches.values()):
            out = np.flatnonzero(watch.left_out)
            if out.size:
                where = f" of row subset {subset}" if several else ""
                parts.append(f"{out.size} of {watch.left_out.size}{where} ({_numbers(out)})")
        self.text = f"faulty measurements left out: {'; '.join(parts)}" if parts else ""


def _numbers(rows: Indices) -> str:
    named = ", ".join(str(row) for row in rows[:MOST_NAMED])
    return named if rows.size <= MOST_NAMED else f"{named} and {rows.size - MOST_NAMED} more"
