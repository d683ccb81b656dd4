"""The fastest implementation of projection and descent for a phi and a basis."""

from __future__ import annotations

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.numerics.arrays import Indices
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis

from .descent import Descent, PlainDescent, SbheHaarDescent
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


def make_descent(phi: Phi, basis: Basis, taxels: Indices, compiled: bool = False) -> Descent:
    """Return the fastest iterations of FISTA; those of compiled loops only if `compiled`."""
    if not is_sbhe(phi) or type(basis) is not HaarBasis:
        return PlainDescent(phi, basis, taxels)
    if compiled:
        from .fast import CompiledDescent

        return CompiledDescent(phi, basis, taxels)
    return SbheHaarDescent(phi, basis, taxels)
