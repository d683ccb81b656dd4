"""The measurement matrices that a reconstructor inverts: announced by the edge, or stated."""

from __future__ import annotations

from sparseskin.messages import PhiState
from sparseskin.nodes.compressor.phi import KINDS, Phi, make_phi
from sparseskin.nodes.compressor.rotation import phases_of
from sparseskin.nodes.errors import PhiError, RefusedError

from .settings import ANNOUNCED, ReconstructorSettings


def make_phases(settings: ReconstructorSettings, n: int, announced: PhiState) -> list[Phi]:
    """Return Phi, or where its rows rotate the several of it; the first is what is announced.

    Parameters
    ----------
    settings : ReconstructorSettings
        Says whether a Phi of the user's own is stated in place of what is announced.
    n : int
        Number of taxels of the skin.
    announced : PhiState

    Raises
    ------
    RefusedError
        If what is announced is not built in, is of another skin, cannot be made, or comes out
        as another matrix here.
    PhiError
        If a stated Phi cannot be made.
    """
    s = settings
    if s.phi != ANNOUNCED:
        m = s.phi_m or max(1, n // 3)
        stated = make_phi(s.phi, n=n, m=m, seed=s.phi_seed, block=s.phi_block)
        return phases_of(stated, s.phi_rows)
    # What comes over the wire is never imported: a Phi of the user's own has to be stated.
    if announced.kind not in KINDS:
        raise RefusedError(
            f"{announced.topic}: phi '{announced.kind}' is not built in; "
            "state it as the reconstructor's phi"
        )
    if announced.n != n:
        raise RefusedError(f"{announced.topic}: for {announced.n} taxels; the skin has {n}")
    try:
        phi = make_phi(
            announced.kind, n=n, m=announced.m, seed=announced.seed, block=announced.block
        )
        phases = phases_of(phi, announced.rows)
    except PhiError as error:
        raise RefusedError(f"{announced.topic}: {error}") from error
    if phi.fingerprint != announced.fingerprint:
        raise RefusedError(
            f"{announced.topic}: seed {announced.seed} gives Phi {phi.fingerprint} here, "
            f"not {announced.fingerprint}: the random generators differ"
        )
    return phases
