"""Frames that are not sent because nothing has changed since the last ones that were."""

from typing import TYPE_CHECKING

import numpy as np

from sparseskin.messages import SkinState, Taxels
from sparseskin.nodes.numerics.arrays import Mask

if TYPE_CHECKING:
    from .change import ChangeWatch


class Silence:
    """Decides which patches of each frame are sent; by default all of them.

    Time is that of the stamps, so that a replay decides the same.

    Attributes
    ----------
    n_frames : int
        Number of frames so far that were not sent, of any patch.
    """

    def __init__(self, n_patches: int) -> None:
        self.n_frames = 0
        self._n_patches = n_patches
        self._all = np.ones(n_patches, dtype=np.bool_)
        self._watch: ChangeWatch | None = None
        self._period_ns = 0
        #: The last frame of which something was sent, and the last one of which all was.
        self._sent: Taxels | None = None
        self._whole_ns = 0
        self._cycle = 1
        #: Frames that are still to be sent after a silence, so that all rows are.
        self._n_due = 0
        #: The last frame, if it was not sent.
        self._unsent: Taxels | None = None

    @property
    def n_quiet(self) -> int:
        """Number of patches whose next frame is not sent if it departs by no more than noise."""
        if self._watch is None:
            return 0
        return int(np.count_nonzero(~self._watch.sending))

    def begin(self, skin: SkinState, cycle: int, period_s: float | None) -> None:
        """Send all frames until nothing changes: of a skin that states its noise, with matrices
        that read all rows in a `cycle` of frames. `period_s` is the longest silence, after
        which a cycle is sent; None: there is none.
        """
        self._watch = None
        self._sent = None
        if period_s is not None:
            from .change import ChangeWatch

            self._watch = ChangeWatch(self._n_patches, skin, cycle)
            self._period_ns = round(1e9 * period_s)
            self._cycle = cycle

    def to_send(self, taxels: Taxels) -> Mask | None:
        """Patches of the next frame that are sent, bool (n_patches,); None: none is."""
        self._unsent = None
        if self._watch is None:
            return self._all

        # The watch sees every frame, sent or not: its references are means of frames in a row.
        send = self._watch.to_send(taxels.forces)
        if self._is_due(taxels):
            self._n_due = self._cycle
        if self._n_due:
            self._n_due -= 1
            send = self._all

        if not send.any():
            self.n_frames += 1
            self._unsent = taxels
            return None
        self._sent = taxels
        if send.all():
            self._whole_ns = taxels.stamp_ns
        return send

    def end(self) -> Taxels | None:
        """The last frame, to be sent after all, where it was not."""
        unsent = self._unsent
        self._unsent = None
        if unsent is not None:
            self.n_frames -= 1
        return unsent

    def _is_due(self, taxels: Taxels) -> bool:
        """True if a frame is sent whatever it reads: after the period, or where the sensor states
        something else of its readings than before.
        """
        # The first frame has none before it.
        if self._sent is None or taxels.reason != self._sent.reason:
            return True
        if bits_of(taxels) != bits_of(self._sent):
            return True
        # Stamps go back where a recording is played again.
        return not 0 <= taxels.stamp_ns - self._whole_ns < self._period_ns


def bits_of(taxels: Taxels) -> bytes:
    """Marks of the missing readings of a frame; b"" where none is missing."""
    return b"" if taxels.missing is None else taxels.missing.tobytes()
