"""False rows of measurements and stuck taxels: found, left out of the frames, and told."""

from __future__ import annotations

from collections.abc import Callable

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi

from .faulty_rows import FaultyRows
from .solver import Mask
from .taxel_watch import TaxelWatch


class FaultWatch:
    """Watches what measurements and restored frames say of the rows and taxels behind them.

    A Phi that chooses its taxels anew in each frame has no rows to watch: leave such frames out.

    Parameters
    ----------
    watch_rows, watch_taxels : bool
        What is looked for.
    log : callable
        Takes one line of text.
    """

    def __init__(self, watch_rows: bool, watch_taxels: bool, log: Callable[[str], None]) -> None:
        self._watch_rows, self._watch_taxels = watch_rows, watch_taxels
        self._log = log
        self._rows = FaultyRows(log)
        self._taxels: TaxelWatch | None = None
        self._noisy = False

    @property
    def text(self) -> str:
        """What is left out now; "" where nothing is."""
        taxels = "" if self._taxels is None else self._taxels.text
        return "; ".join(filter(None, (self._rows.text, taxels)))

    @property
    def swamped(self) -> bool:
        """As in `FaultyRows`."""
        return self._rows.swamped

    def set_up(self, phases: dict[str, Phi], state: SkinState, mask: Mask) -> None:
        """Watch these phases, by fingerprint, and this skin, whose existing taxels are `mask`."""
        # On a skin that does not state its noise, what is still or exact could be taken for false.
        self._noisy = state.sigma_mid > 0
        self._mask = mask
        self._rows.keep(phases)
        self._taxels = None
        if self._watch_taxels and self._noisy:
            sigmas = state.sigma_mid, state.sigma_end
            self._taxels = TaxelWatch(mask, state.f_max, *sigmas, self._log)

    def cleaned(self, phi: Phi, y: Floats, last: Floats | None) -> tuple[Floats, Floats]:
        """Take out of measurements what is known to be false.

        Parameters
        ----------
        phi : Phi
        y : ndarray of float32, shape (m,)
        last : ndarray of float32, shape (n_rows, n_cols), or None
            The last frame as the solver restored it.

        Returns
        -------
        given, believed : ndarray of float32, shape (m,)
            y without what stuck taxels read; and its false rows replaced by what `last` says.
        """
        given = y if self._taxels is None else self._taxels.cleaned(phi, y)
        if not self._looks_at_rows or not self._rows.text:
            return given, given
        forces = None if last is None else last[self._mask]
        return given, self._rows.cleaned(phi, given, forces)

    def filled(self, forces: Floats) -> Floats:
        """The frame with stuck taxels filled in from their neighbours; as in `TaxelWatch`."""
        return forces if self._taxels is None else self._taxels.filled(forces)

    def update(
        self, phi: Phi, given: Floats, believed: Floats, forces: Floats, fitted: Floats
    ) -> bool:
        """Take in a restored frame.

        Parameters
        ----------
        phi : Phi
        given, believed : ndarray of float32, shape (m,)
            As `cleaned` gave them.
        forces : ndarray of float32, shape (n_rows, n_cols)
            As the solver restored them.
        fitted : ndarray of float32, shape (m,)
            Phi times these.

        Returns
        -------
        bool
            Whether a row was found that the estimate has believed so far.
        """
        if self._taxels is not None:
            self._taxels.update(phi, forces, believed - fitted)
        return self._looks_at_rows and self._rows.update(phi, given, fitted)

    @property
    def _looks_at_rows(self) -> bool:
        return self._watch_rows and self._noisy
