"""The fastest implementation of a projection for a phi."""

from __future__ import annotations

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe

from .projection import PlainProjection, Projection, SbheProjection

# A subclass may have changed what the operators do: it is then applied by them. Compiled loops are
# imported where they are chosen: they need numba.


def make_projection(phi: Phi, compiled: bool = False) -> Projection:
    """Return the fastest projection of a phi; one of compiled loops only if `compiled`."""
    if compiled and is_sbhe(phi):
        from .fast import CompiledProjection

        return CompiledProjection(phi)
    if is_sbhe(phi):
        return SbheProjection(phi)
    return PlainProjection(phi)
