"""Wires, crossings and conversions of a strategy on a skin."""

from __future__ import annotations

import functools
import math
from dataclasses import replace
from typing import cast

import numpy as np

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.local import WIRED_BLOCK, LocalSbhePhi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.plugins.design.spec import Design
from sparseskin.plugins.design.strategies import ANALOG, DIGITAL, Strategy
from sparseskin.plugins.wiring.model import Wiring, array_wiring, sbhe_wiring

MOST_STAR = 4096
"""Most taxels for which crossings of single wires are counted: the time grows with the square."""


def wires_of(strategy: Strategy, design: Design) -> Wiring:
    """Return the wires of a strategy. A row-column array has a line a row and column
    (`array_wiring`), analog sums of SBHE a wire a taxel (`star_wiring`). Of points, the array is
    the smallest near square, with as many crossings; its length depends on the surface and is not
    known.
    """
    n = design.n_taxels
    m = strategy.m(n, design.n_rows)
    sums = design.sums if strategy.phi == "sbhe" else strategy.sums
    conversions = n if sums == DIGITAL or strategy.phi == "full" else m
    if sums == ANALOG and strategy.phi != "row_local":
        if design.n_rows is None or design.n_cols is None or n > MOST_STAR:
            return Wiring(n, None, None, conversions)
        return replace(_star(strategy.phi, design.n_rows, design.n_cols), conversions=conversions)
    if design.n_rows is None or design.n_cols is None:
        side = math.isqrt(n - 1) + 1
        return Wiring(side + -(-n // side), n, None, conversions)
    return array_wiring(design.n_rows, design.n_cols, conversions)


@functools.cache
def _star(kind: str, n_rows: int, n_cols: int) -> Wiring:
    """Wires of a kind of SBHE; they do not depend on M."""
    n = n_rows * n_cols
    phi = cast(SbhePhi, make_phi(kind, n, n, 0, WIRED_BLOCK))
    exists = np.ones((n_rows, n_cols), dtype=np.bool_)
    if isinstance(phi, LocalSbhePhi):
        phi.lay_out(exists)
    return sbhe_wiring(phi, exists)
