"""The gates of solver `skin` in PyTorch: the same as `Gates`, on batches of whole frames.

Cells without a taxel are 0.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import torch
from torch.nn import functional

from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.skin.backend import ManyPatches
from sparseskin.nodes.reconstructor.skin.gates import (
    N_FILTERS,
    N_HIDDEN,
    SHIFTS,
    TILE,
    WINDOW,
    Gates,
)

from .presses import SIDE

MARGIN = (WINDOW - TILE) // 2

Tensor: TypeAlias = Any
"""A tensor of PyTorch, which is not installed where types are checked."""
Network: TypeAlias = dict[str, Any]
"""The arrays of `Gates` by name, as tensors."""


def first_network(seed: int) -> Network:
    """Return random weights near Haar shrinkage: half of the filters are Haar's, half cosines."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    inside = np.zeros((WINDOW, WINDOW), dtype=np.bool_)
    inside[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    haar = np.zeros((TILE * TILE, WINDOW * WINDOW))
    units = np.eye(TILE * TILE, dtype=np.float32).reshape(-1, TILE, TILE)
    haar[:, inside.reshape(-1)] = HaarBasis(TILE, TILE).analysis(units).reshape(len(units), -1).T
    n_more = N_FILTERS - TILE * TILE
    filters = torch.tensor(np.concatenate([haar, cosines(WINDOW)[:n_more]]), dtype=torch.float32)
    tile = torch.tensor(haar[:, inside.reshape(-1)].T, dtype=torch.float32)
    network = {
        "filters": filters + draw(N_FILTERS, WINDOW**2, scale=0.01),
        "hidden": draw(N_HIDDEN, 2 * N_FILTERS, scale=(2 * N_FILTERS) ** -0.5),
        "hidden_0": torch.zeros(N_HIDDEN),
        "gates": draw(N_FILTERS + 1, N_HIDDEN, scale=0.5 * N_HIDDEN**-0.5),
        "gates_0": torch.full((N_FILTERS + 1,), 0.4),
        "synthesis": torch.cat([tile, draw(TILE * TILE, n_more, scale=0.01)], dim=1),
        "error": draw(1, N_HIDDEN, scale=0.1 * N_HIDDEN**-0.5),
        "error_0": torch.full((1,), -2.0),
    }
    return {name: value.requires_grad_() for name, value in network.items()}


def cosines(side: int) -> Doubles:
    """Return two-dimensional cosines by frequency, float64 (side^2, side^2), orthonormal rows."""
    k = np.arange(side)
    one = np.sqrt(2 / side) * np.cos(np.pi * (k + 0.5) * k[:, None] / side)
    one[0] /= math.sqrt(2)
    order = np.argsort(np.add.outer(k, k).reshape(-1), kind="stable")
    made: Doubles = np.kron(one, one)[order]
    return made


def weights(network: Network) -> dict[str, Floats]:
    """Return the arrays of `Gates`, float32."""
    return {name: value.detach().numpy().copy() for name, value in network.items()}


def denoise(
    network: Network, u: Tensor, s: Tensor, mask: Tensor, shift: int
) -> tuple[Tensor, Tensor]:
    """Denoise frames (k, SIDE, SIDE) of noise deviation s (k,), with the tiles at a shift.

    Return them, 0 where the mask is, and the expected squared error of a taxel, in s^2: (k,).
    """
    row, col = SHIFTS[shift % len(SHIFTS)]
    sides = (col, TILE - col, row, TILE - row)
    outer = tuple(side + MARGIN for side in sides)
    canvas = functional.pad(u / s[:, None, None] * mask, outer)
    windows = canvas.unfold(1, WINDOW, TILE).unfold(2, WINDOW, TILE)
    k, down = windows.shape[:2]
    windows = windows.reshape(-1, WINDOW * WINDOW)
    tiles, error = Gates(**network).gated(windows, ManyPatches(1, "cpu"))
    x = tiles.reshape(k, down, -1, TILE, TILE).transpose(2, 3).reshape(k, down * TILE, -1)
    x = x[:, row : row + SIDE, col : col + SIDE] * mask * s[:, None, None]
    share = functional.avg_pool2d(functional.pad(mask, sides)[:, None], TILE).reshape(k, -1)
    return x, (error.reshape(k, -1) * share).sum(1) / share.sum(1)
