"""The gates of solver `oamp` in PyTorch, and the steps of a frame that gradients pass through.

The same as `nodes.reconstructor.oamp`, on batches of frames whose taxels all exist or are 0.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from torch.nn import functional

from sparseskin.nodes.compressor.phi.hadamard import hadamard_matrix
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.reconstructor.bases.haar import haar_matrix
from sparseskin.nodes.reconstructor.oamp.gates import N_FILTERS, N_HIDDEN, SHIFTS, TILE, WINDOW
from sparseskin.nodes.reconstructor.oamp.solver import OampTuning

from .presses import SIDE

BLOCK = 256
"""Size of the Hadamard blocks, the default of Phi."""
LOG_LEAST = -12.0
"""Least logarithm of an expected error."""
FIRST_PRIOR = (4.0, 1.0)
"""c and d of the prior that training begins with: with errors that do not repeat, 1 and 0."""
TUNING = OampTuning()
MARGIN = (WINDOW - TILE) // 2

Tensor: TypeAlias = Any
"""A tensor of PyTorch, which is not installed where types are checked."""
Network: TypeAlias = dict[str, Any]
"""The arrays of `Gates` by name, as tensors; `prior` as its logarithm."""


def first_network(seed: int) -> Network:
    """Return random weights near Haar shrinkage: half of the filters are Haar's, half cosines."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    inside = np.zeros((WINDOW, WINDOW), dtype=np.bool_)
    inside[MARGIN:-MARGIN, MARGIN:-MARGIN] = True
    haar = np.zeros((TILE * TILE, WINDOW * WINDOW))
    haar[:, inside.reshape(-1)] = haar_matrix((TILE, TILE))
    n_more = N_FILTERS - TILE * TILE
    filters = torch.tensor(np.concatenate([haar, cosines(WINDOW)[:n_more]]), dtype=torch.float32)
    tile = torch.tensor(haar[:, inside.reshape(-1)].T, dtype=torch.float32)
    network = {
        "filters": filters + draw(N_FILTERS, WINDOW**2, scale=0.01),
        "hidden": draw(N_HIDDEN, N_FILTERS, scale=N_FILTERS**-0.5),
        "hidden_0": torch.zeros(N_HIDDEN),
        "gates": draw(N_FILTERS, N_HIDDEN, scale=0.5 * N_HIDDEN**-0.5),
        "gates_0": torch.full((N_FILTERS,), 0.4),
        "synthesis": torch.cat([tile, draw(TILE * TILE, n_more, scale=0.01)], dim=1),
        "error": draw(1, N_HIDDEN, scale=0.1 * N_HIDDEN**-0.5),
        "error_0": torch.full((1,), -2.0),
        "prior": torch.tensor(FIRST_PRIOR).log(),
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
    found = {name: value.detach().numpy().copy() for name, value in network.items()}
    return {**found, "prior": np.exp(found["prior"])}


def denoise_windows(network: Network, windows: Tensor) -> tuple[Tensor, Tensor]:
    """As `Gates.gated`, with the logarithm of the error: (k, 144) to (k, 64) and (k,)."""
    a = windows @ network["filters"].T
    level = torch.sign(a) * torch.log1p(a.abs())
    h = torch.relu(level @ network["hidden"].T + network["hidden_0"])
    g = (h @ network["gates"].T + network["gates_0"]).clamp(0, 1)
    tiles = torch.relu((a * g) @ network["synthesis"].T)
    return tiles, (h @ network["error"][0] + network["error_0"]).clamp(LOG_LEAST, 0)


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
    tiles, log_error = denoise_windows(network, windows.reshape(-1, WINDOW * WINDOW))
    x = tiles.reshape(k, down, -1, TILE, TILE).transpose(2, 3).reshape(k, down * TILE, -1)
    x = x[:, row : row + SIDE, col : col + SIDE] * mask * s[:, None, None]
    share = functional.avg_pool2d(functional.pad(mask, sides)[:, None], TILE).reshape(k, -1)
    error = (log_error.exp().reshape(k, -1) * share).sum(1) / share.sum(1)
    return x, error


@dataclass(frozen=True)
class Rows:
    """All rows of a scrambled block Hadamard ensemble; `read` (n,) is 1 for those of a frame."""

    order: Tensor
    hadamard: Tensor
    subsets: list[Tensor]

    @classmethod
    def draw(cls, generator: Any, ratio: int, fixed: bool) -> Rows:
        """Draw the order of the taxels, and row subsets that hold 1 / ratio of each block.

        Fixed rows are one subset, with the sum of each block.
        """
        n, per = SIDE * SIDE, BLOCK // ratio
        blocks = range(n // BLOCK)
        orders = torch.stack([torch.randperm(BLOCK, generator=generator) for _ in blocks])
        if fixed:
            orders = torch.stack([torch.cat([o[o == 0], o[o != 0]]) for o in orders])
        subsets = []
        for k in range(1 if fixed else ratio):
            read = torch.zeros(len(blocks), BLOCK)
            read.scatter_(1, torch.roll(orders, -k * per, 1)[:, :per], 1.0)
            subsets.append(read.reshape(-1))
        block = torch.tensor(hadamard_matrix(BLOCK) / math.sqrt(BLOCK), dtype=torch.float32)
        return cls(torch.randperm(n, generator=generator), block, subsets)

    def forward(self, x: Tensor) -> Tensor:
        """Return W x: (k, SIDE, SIDE) to (k, n)."""
        taxels = x.reshape(len(x), -1)[:, self.order].reshape(len(x), -1, BLOCK)
        return (taxels @ self.hadamard).reshape(len(x), -1)

    def adjoint(self, rows: Tensor) -> Tensor:
        """Return W^T rows: (k, n) to (k, SIDE, SIDE)."""
        taxels = (rows.reshape(len(rows), -1, BLOCK) @ self.hadamard.T).reshape(len(rows), -1)
        return torch.empty_like(taxels).index_copy(1, self.order, taxels).reshape(-1, SIDE, SIDE)


def solve(
    network: Network,
    rows: Rows,
    frames: list[Tensor],
    mask: Tensor,
    noise: Tensor,
    n_steps: int,
    first_shift: int,
) -> list[tuple[Tensor, list[tuple[Tensor, Tensor, Tensor]]]]:
    """Reconstruct successive frames of readings (k, SIDE, SIDE), as `OampSolver` does.

    The noise variance (k,) is known, and a frame is predicted to be the last one. Each frame gives
    its estimate, and of the last steps x, s and the expected squared error in s^2.
    """
    found, z, tiny = [], torch.zeros_like(frames[0]), 1e-14
    for k, readings in enumerate(frames):
        read = rows.subsets[k % len(rows.subsets)]
        whole = rows.forward(z)
        innovation = rows.forward(readings) - whole
        e2 = (innovation.square() * read).sum(1) / read.sum()
        predicted = (e2 - noise).clamp(min=0) + 1e-3 * noise + tiny
        gain = predicted / (predicted + noise) if k else torch.ones_like(noise)
        c, d = network["prior"].exp()
        prior = c * predicted * (1 + d * predicted / (noise + tiny))
        precision = read / (gain * noise + tiny)[:, None]
        if k:
            precision = precision + 1 / prior[:, None]
        target = whole + read * gain[:, None] * innovation
        steps = []
        for step in range(n_steps):
            r = target - rows.forward(z)
            rho = (r.square() * read).sum(1) / read.sum()
            tau = torch.maximum(rho - gain * noise, TUNING.least_tau * rho) + tiny
            weight = tau[:, None] * precision / (tau[:, None] * precision + 1)
            mean = weight.mean(1)
            s = torch.sqrt(tau * (1 - mean) / mean + tiny)
            u = z + rows.adjoint(weight * r) / mean[:, None, None]
            x, error = denoise(network, u, s, mask, first_shift + k * n_steps + step)
            alpha = error.clamp(max=TUNING.most_alpha)[:, None, None]
            z = z + TUNING.damping * ((x - alpha * u) / (1 - alpha) - z)
            steps.append((x, s, error))
        last = steps[-TUNING.averaged :]
        z = torch.stack([x for x, _, _ in last]).mean(0)
        found.append((z, last))
    return found
