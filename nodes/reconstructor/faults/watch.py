"""Faulty measurements and taxels: found, excluded from the frames, and logged."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.nodes.compressor.phi.acts import ActsPhi
from sparseskin.nodes.compressor.phi.adaptive import AdaptivePhi
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.sensor.noise import NoiseModel

from .frame import FrameWatch, FrozenWatch
from .rows import RowWatch
from .taxels import TaxelWatch, listed


class FaultWatch:
    """Detects faulty measurements and taxels, and excludes them from the frames.

    Of a Phi that chooses its taxels or rows anew in each frame there are no rows to follow.

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
        self._rows: dict[str, RowWatch] = {}
        self._rows_text = ""
        self._taxels: TaxelWatch | None = None
        self._noisy = self._chosen = False
        self._frozen = FrozenWatch(0.0)
        self._frame: FrameWatch | None = None
        self._expected: tuple[str, Floats] | None = None
        self._constant = self._outlying = False

    @property
    def frozen(self) -> bool:
        """True while all measurements repeat exactly, as those of a board that hangs."""
        return self._frozen.frozen

    @property
    def text(self) -> str:
        """What is excluded from the measurements now, and whether all repeat; "" if nothing is."""
        frozen = "all measurements repeat exactly" if self.frozen else ""
        offset = 0.0 if self._frame is None else self._frame.offset
        common = f"offset of all measurements subtracted: {offset:.2g}" if offset else ""
        taxels = "" if self._taxels is None else self._taxels.text
        return "; ".join(filter(None, (frozen, common, self._rows_text, taxels)))

    @property
    def taxels(self) -> list[int]:
        """Flat cells of the taxels excluded now, as in `TaxelWatch`."""
        return [] if self._taxels is None else self._taxels.cells

    @property
    def swamped(self) -> bool:
        """True if so many measurements disagree that excluding them would be no remedy."""
        contradicted = self._frame is not None and self._frame.contradicted
        return contradicted or any(watch.swamped for watch in self._rows.values())

    @property
    def doubts_taxels(self) -> bool:
        """True while a row, column or square of taxels may be stuck; as in `TaxelWatch`."""
        return self._taxels is not None and self._taxels.doubts

    def set_up(self, subsets: dict[str, Phi], state: SkinState, mask: Mask) -> None:
        """Watch these row subsets, by fingerprint, and the skin with existing taxels `mask`."""
        # On a skin that does not state its noise, constant readings may be right.
        self._noisy = state.sigma_mid > 0
        self._chosen = any(isinstance(phi, ActsPhi | AdaptivePhi) for phi in subsets.values())
        self._frozen = FrozenWatch(state.least_sd)
        self._frame = FrameWatch(state, mask) if self._noisy else None
        self._expected = None
        self._mask = mask
        self._rows = {
            fingerprint: self._rows.get(fingerprint) or RowWatch(phi)
            for fingerprint, phi in subsets.items()
        }
        self._describe_rows()
        self._taxels = None
        if self._watch_taxels and self._noisy:
            noise = NoiseModel(state.f_max, state.sigma_mid, state.sigma_end)
            self._taxels = TaxelWatch(mask, noise, self._log)

    def watch_repeats(self, phi: Phi, y: Floats) -> None:
        """Process measurements as they were received, float32 (m,)."""
        if isinstance(phi, AdaptivePhi):
            y = y[: phi.tree.n_tiles]  # the rows that all frames have
        if self._frozen.update(phi.fingerprint, y):
            if self.frozen:
                self._log(
                    "all measurements repeat exactly, on a skin with noise: not trusted until they "
                    "change; does the board hang?"
                )
            else:
                self._log("measurements change again")

    def is_constant(self, y: Floats) -> bool:
        """True if measurements as they were received, float32 (m,), hold nothing: all are equal."""
        constant = self._frame is not None and self._frame.is_constant(y)
        if constant and not self._constant:
            self._log(
                f"all measurements of a frame are {float(y[0]):.3g}, on a skin with noise: such "
                "frames are left out, and not trusted; does the converter or the link drop out?"
            )
        self._constant |= constant
        return constant

    def expect(self, phi: Phi, measured: Floats) -> None:
        """Take Phi times the last frame, float32 (m,), for what the next frame is compared with."""
        if not self._chosen:
            self._expected = phi.fingerprint, measured

    def cleaned(self, phi: Phi, y: Floats, last: Floats | None) -> tuple[Floats, Floats]:
        """Return y without the readings of stuck taxels and the offset of all measurements; and
        with Phi `last` for faulty measurements, too.

        y and both results are float32 (m,); `last` is the last frame as the solver reconstructed
        it, float32 (n_rows, n_cols), or None.
        """
        given = y if self._taxels is None else self._taxels.cleaned(phi, y)
        if not (self._watch_rows and self._noisy) or isinstance(phi, ActsPhi):
            return given, given
        assert self._frame is not None
        known, self._expected = self._expected, None
        if last is None:
            expected = np.zeros(phi.m, dtype=np.float32)
        elif known is not None and known[0] == phi.fingerprint:
            expected = known[1]
        else:
            expected = phi.forward(last[self._mask])
        was_off = bool(self._frame.offset)
        if isinstance(phi, AdaptivePhi):
            given = believed = self._frame.cleaned_of_choice(phi, y, expected)
        else:
            watch = self._rows[phi.fingerprint]
            given, believed = self._frame.cleaned(watch.rows, given, expected)
            if watch.n_out:
                believed = np.where(watch.left_out, expected, believed).astype(np.float32)
        self._log_frame(was_off)
        return given, believed

    def _log_frame(self, was_off: bool) -> None:
        """Log the first outliers, and an offset that begins or ends."""
        assert self._frame is not None
        if self._frame.n_outlying and not self._outlying:
            self._outlying = True
            self._log(
                "measurements of a frame contradict the others and the frame before: such "
                "measurements are left out of their frame"
            )
        offset = self._frame.offset
        if offset and not was_off:
            self._log(f"all measurements share an offset of {offset:.2g}, which is subtracted")
        elif was_off and not offset:
            self._log("all measurements have no offset any more")

    def checked(self, forces: Floats, left: Doubles, error: float) -> tuple[Floats, str]:
        """Return the frame with faulty taxels filled in and forces within the range, and why they
        cannot be right; arguments as in `FrameWatch.checked`.
        """
        if self._taxels is not None:
            forces = self._taxels.filled(forces)
        return (forces, "") if self._frame is None else self._frame.checked(forces, left, error)

    def update(
        self, phi: Phi, given: Floats, believed: Floats, forces: Floats, fitted: Floats
    ) -> bool:
        """Process a frame as the solver reconstructed it.

        `given` and `believed` are as `cleaned` returned them, `fitted` is Phi times the forces.
        Return True if a faulty measurement was found that the estimate has used so far.
        """
        if self._taxels is not None and isinstance(phi, AdaptivePhi):
            self._taxels.search(forces)
        if self._chosen or not self._noisy:
            return False
        residual = believed - fitted
        if self._taxels is not None:
            self._taxels.update(phi, forces, residual)
        if not self._watch_rows:
            return False
        left = residual if given is believed else given - fitted
        return self._update_rows(self._rows[phi.fingerprint], given, left)

    def _update_rows(self, watch: RowWatch, y: Floats, residual: Floats) -> bool:
        before, was_swamped = watch.left_out, watch.swamped
        if watch.update(y, residual):
            self._describe_rows()
            new, healed = watch.left_out & ~before, before & ~watch.left_out
            for rows, what in ((new, "left out, faulty"), (healed, "used again")):
                if rows.any():
                    self._log(f"measurements {what}: {listed(np.flatnonzero(rows).tolist())}")
            return bool(new.any())
        if watch.swamped and not was_swamped:
            self._log(
                "a quarter of all measurements and more do not fit each other: none more is left "
                "out; is the skin's mask right?"
            )
        return False

    def _describe_rows(self) -> None:
        several = len(self._rows) > 1
        parts = []
        for subset, watch in enumerate(self._rows.values()):
            if out := np.flatnonzero(watch.left_out).tolist():
                where = f" of row subset {subset}" if several else ""
                parts.append(f"{len(out)} of {watch.left_out.size}{where} ({listed(out)})")
        self._rows_text = f"faulty measurements left out: {'; '.join(parts)}" if parts else ""
