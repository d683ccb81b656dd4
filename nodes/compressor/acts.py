"""Single taxels, others in each frame: a Phi whose rows are chosen as the frame is read."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.calls import Indices
from sparseskin.nodes.compressor.phi import Phi, fingerprint_of
from sparseskin.nodes.compressor.subsample import SubsamplePhi
from sparseskin.nodes.errors import PhiError


class ActsPhi(SubsamplePhi):
    """Phi = Q of this frame: m single taxels that `choose` names, anew for each frame.

    Until then they are those that `SubsamplePhi` reads. The fingerprint says only how many
    taxels there are and how many are read; which ones has to travel with the measurements.

    Raises
    ------
    PhiError
        As in `Phi`.

    Notes
    -----
    Source: Slepyan, Li, Aug, Sankar, Tran, Thakor, "Adaptive Compressive Tactile Subsampling",
    arXiv 2410.13847; which taxels are chosen: `ActsSearch`.
    """

    kind = "acts"

    def __init__(self, n: int, m: int, seed: int, block: int = 32) -> None:
        super().__init__(n, m, seed, block)
        self.fingerprint = fingerprint_of(self.kind, n, m, 1)

    def phases(self) -> list[Phi]:
        """Refuse rotating rows.

        Raises
        ------
        PhiError
            Always.
        """
        raise PhiError('rows: "rotating" is not allowed for phi "acts": it chooses anew each frame')

    def choose(self, taxels: Indices) -> None:
        """Take the taxels of a frame.

        Parameters
        ----------
        taxels : ndarray of intp, shape (m,)
            Numbers of taxels among the existing ones, ascending, each below n.

        Raises
        ------
        PhiError
            If they are not that.
        """
        if taxels.shape != (self.m,):
            raise PhiError(f"acts: {taxels.size} taxels are read; expected m = {self.m}")
        if taxels[0] < 0 or taxels[-1] >= self.n or (taxels[1:] <= taxels[:-1]).any():
            raise PhiError(f"acts: the taxels are not ascending within 0..{self.n - 1}")
        self.rows = taxels


def packed_places(taxels: Indices, n: int) -> npt.NDArray[np.uint8]:
    """A bit for each of n taxels, the highest first, set for those that were read.

    Parameters
    ----------
    taxels : ndarray of intp, shape (m,)
        Numbers of taxels, each below n.
    n : int

    Returns
    -------
    ndarray of uint8, shape (ceil(n / 8),)
    """
    is_read = np.zeros(n, dtype=np.bool_)
    is_read[taxels] = True
    return np.packbits(is_read)


def follow(phi: Phi, places: npt.NDArray[np.uint8] | None) -> None:
    """Tell a phi which taxels a frame's measurements are of, where it is one that asks.

    Parameters
    ----------
    phi : Phi
    places : ndarray of uint8, shape (ceil(n / 8),), or None
        What came with the measurements, as `packed_places` makes it.

    Raises
    ------
    PhiError
        If "acts" is not told, or another one is, or they are not m of n taxels.
    """
    if isinstance(phi, ActsPhi):
        if places is None:
            raise PhiError("acts: the measurements do not say of which taxels they are")
        phi.choose(np.flatnonzero(np.unpackbits(places)))
    elif places is not None:
        raise PhiError(f'{phi.kind}: measurements with places; allowed: phi "acts" alone has them')
