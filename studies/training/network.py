"""The gates of solver `skin` in PyTorch, as `Gates`, on batches of frames, and their training.

Cells without a taxel are 0.
"""

from __future__ import annotations

import math
from typing import Any, TypeAlias

import numpy as np
import pandas as pd
import torch
from torch.nn import functional
from tqdm import trange

from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.skin.gates import N_FILTERS, N_HIDDEN, stored_gates
from sparseskin.nodes.reconstructor.skin.tiles import SHIFTS, TILE, WINDOW, inner

from .presses import N_FRAMES, SIDE, masks, presses

MARGIN = (WINDOW - TILE) // 2
NOISE = (3e-4, 1.0)
"""Deviation of the noise, in the largest force of a press; drawn by its logarithm."""
RATE = 2e-3
"""First rate of Adam, which falls to 0 as a half cosine."""
BATCH = 96
"""Presses of a batch, each with all its tiles."""
FLOOR = 1e-3
"""Part of the noise variance below which a squared error counts as none."""
HELD_OUT = 256
SCORED = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Presses that are not trained on, and the noise at which they are scored."""
EVERY = 100
"""Batches from one row of the table to the next."""

Tensor: TypeAlias = Any
"""A tensor of PyTorch, which is not installed where types are checked."""
Network: TypeAlias = dict[str, Any]
"""The arrays of `Gates` by name, as tensors."""


def first_network(seed: int) -> Network:
    """Return random weights near Haar shrinkage: half of the filters are Haar's, half cosines."""
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape: int, scale: float) -> Tensor:
        return scale * torch.randn(*shape, generator=generator)

    # Haar's filters see the tile alone, and their synthesis is the transpose.
    units = np.eye(TILE * TILE, dtype=np.float32).reshape(-1, TILE, TILE)
    analysis = HaarBasis(TILE, TILE).analysis(units).reshape(len(units), -1)
    haar = np.zeros((TILE * TILE, WINDOW, WINDOW))
    tiles = haar[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    tiles[:] = analysis.T.reshape(tiles.shape)
    n_cosines = N_FILTERS - TILE * TILE
    haar_rows = haar.reshape(len(haar), -1)
    rows = np.concatenate([haar_rows, cosines(WINDOW)[:n_cosines]])
    filters = torch.tensor(rows, dtype=torch.float32)
    tile = torch.tensor(analysis, dtype=torch.float32)
    # The scale of a layer is that of its number of inputs: outputs are about 1.
    network = {
        "filters": filters + draw(N_FILTERS, WINDOW**2, scale=0.01),
        "hidden": draw(N_HIDDEN, 2 * N_FILTERS, scale=(2 * N_FILTERS) ** -0.5),
        "hidden_0": torch.zeros(N_HIDDEN),
        "gates": draw(N_FILTERS + 1, N_HIDDEN, scale=0.5 * N_HIDDEN**-0.5),
        "gates_0": torch.full((N_FILTERS + 1,), 0.4),
        "synthesis": torch.cat([tile, draw(TILE * TILE, n_cosines, scale=0.01)], dim=1),
        "error": draw(1, N_HIDDEN, scale=0.1 * N_HIDDEN**-0.5),
        "error_0": torch.full((1,), -2.0),
    }
    return {name: value.requires_grad_() for name, value in network.items()}


def cosines(side: int) -> Doubles:
    """Return two-dimensional cosines by frequency, float64 (side^2, side^2), orthonormal rows."""
    k = np.arange(side)
    phases = np.pi * (k + 0.5) * k[:, None] / side
    one_way = np.sqrt(2 / side) * np.cos(phases)
    one_way[0] /= math.sqrt(2)
    frequencies = np.add.outer(k, k).reshape(-1)
    order = np.argsort(frequencies, kind="stable")
    products: Doubles = np.kron(one_way, one_way)[order]
    return products


def weights(network: Network) -> dict[str, Floats]:
    """Return the arrays of `Gates`, float32."""
    return {name: value.detach().numpy().copy() for name, value in network.items()}


def gated(network: Network, windows: Tensor) -> tuple[Tensor, Tensor]:
    """As `Gates.gated`, in PyTorch: windows of unit noise, (t, 144), to tiles and their errors."""
    a = windows @ network["filters"].T
    size = 4 * ((1 + a.abs()).sqrt().sqrt() - 1)
    levels = torch.cat([torch.copysign(size, a), size], dim=-1)
    h = levels @ network["hidden"].T + network["hidden_0"]
    h = h.clip(0, None)
    g = h @ network["gates"].T + network["gates_0"]
    g = g.clip(0, 1)

    # The last gate passes the tile as it is.
    passed = g[:, -1:]
    gains = g[:, :-1] - passed
    filtered = (a * gains) @ network["synthesis"].T
    tiles = passed * inner(windows) + filtered
    log_error = h @ network["error"][0] + network["error_0"]
    return tiles.clip(0, None), log_error.clip(-12, 0).exp()


def denoise(
    network: Network, u: Tensor, s: Tensor, mask: Tensor, shift: int
) -> tuple[Tensor, Tensor]:
    """Denoise frames (k, SIDE, SIDE) of noise deviation s (k,), with the tiles at a shift.

    Return them, 0 where the mask is, and the expected squared error of a taxel, in s^2: (k,).
    """
    row, col = SHIFTS[shift % len(SHIFTS)]
    sides = (col, TILE - col, row, TILE - row)
    outer = tuple(side + MARGIN for side in sides)
    # In units of the noise, with a margin that windows at the edges see as 0.
    of_unit_noise = u / s[:, None, None] * mask
    canvas = functional.pad(of_unit_noise, outer)
    windows = canvas.unfold(1, WINDOW, TILE)
    windows = windows.unfold(2, WINDOW, TILE)
    k, down = windows.shape[:2]
    windows = windows.reshape(-1, WINDOW * WINDOW)
    tiles, error = gated(network, windows)

    # Rows of taxels run across tiles that are next to each other.
    x = tiles.reshape(k, down, -1, TILE, TILE)
    x = x.transpose(2, 3).reshape(k, down * TILE, -1)
    x = x[:, row : row + SIDE, col : col + SIDE]

    # A tile counts by the part of it that exists.
    padded = functional.pad(mask, sides)[:, None]
    share = functional.avg_pool2d(padded, TILE).reshape(k, -1)
    mean_error = (error.reshape(k, -1) * share).sum(1) / share.sum(1)
    return x * mask * s[:, None, None], mean_error


class Drawn:
    """Batches of presses with noise and masks; losses of a network on them."""

    def __init__(self, seed: int, pool: Floats) -> None:
        self._pool = torch.tensor(pool)
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)

    def _batch(self, size: int) -> tuple[Any, Any]:
        """Presses (size, N_FRAMES, SIDE, SIDE), mirrored or transposed, and their masks."""
        places = torch.randint(len(self._pool), (size,), generator=self._generator)
        drawn = self._pool[places]
        # One of the eight symmetries of a square.
        turn = int(self._rng.integers(8))
        if turn & 1:
            drawn = drawn.flip(-1)
        if turn & 2:
            drawn = drawn.flip(-2)
        if turn & 4:
            drawn = drawn.transpose(-1, -2)
        mask = torch.tensor(masks(self._rng, size))
        return drawn * mask[:, None], mask

    def _noise(self, size: int, low: float, high: float) -> Any:
        exponent = torch.rand(size, generator=self._generator)
        return low * (high / low) ** exponent

    def loss(self, network: Any) -> tuple[Any, float]:
        """Loss on frames with normal noise of a known deviation, and the mean error in dB."""
        presses, mask = self._batch(BATCH)
        x = presses[:, int(self._rng.integers(N_FRAMES))]
        s = self._noise(len(x), *NOISE)
        e, error = self._errors(network, x, s, mask)
        # The second part is least where the expected error is the mean of the true one.
        of_error = (error.log() + e.detach() / error).mean()
        loss = (e + FLOOR).log().mean() + 0.3 * of_error
        return loss, 10 * float((e.detach() + FLOOR).log10().mean())

    def score(self, network: Any) -> pd.DataFrame:
        """Squared and expected error of all presses by noise, in noise variances."""
        rows = []
        mask = torch.ones(len(self._pool), SIDE, SIDE)
        for sd in SCORED:
            with torch.no_grad():
                x = self._pool[:, 0]
                e, error = self._errors(network, x, torch.full((len(x),), sd), mask)
            row = {"noise / peak": f"{sd:g}", "error": f"{float(e.mean()):.3f}"}
            rows.append(row | {"expected": f"{float(error.mean()):.3f}"})
        return pd.DataFrame(rows)

    def _errors(self, network: Any, x: Any, s: Any, mask: Any) -> tuple[Any, Any]:
        """Squared error of a taxel of each frame, and the expected one, in s^2."""
        noise = s[:, None, None] * torch.randn(x.shape, generator=self._generator)
        shift = int(self._rng.integers(64))
        estimate, error = denoise(network, x + noise, s, mask, shift)
        squares = (estimate - x).square().sum((1, 2))
        return squares / mask.sum((1, 2)) / s**2, error


def trained(
    n_presses: int, n_batches: int, seed: int
) -> tuple[dict[str, Floats], list[dict[str, Any]], pd.DataFrame]:
    """Weights, as of `weights`, the running mean of errors every `EVERY` batches, and scores by
    noise, of a training.
    """
    n_threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        drawn = Drawn(seed, presses(n_presses, seed))
        network = first_network(seed)
        optimiser = torch.optim.Adam(network.values(), lr=RATE)
        rows = list[dict[str, Any]]()
        mean = 0.0
        for k in trange(n_batches, desc="tiles", leave=False):
            fall = 1 + math.cos(math.pi * k / n_batches)
            for group in optimiser.param_groups:
                group["lr"] = RATE * 0.5 * fall + 1e-6
            loss, error_db = drawn.loss(network)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(list(network.values()), 1.0)
            optimiser.step()
            mean += (error_db - mean) / min(k + 1, 2 * EVERY)
            if (k + 1) % EVERY == 0 or k + 1 == n_batches:
                rows.append({"batch": k + 1, "error_db": mean})
        held_out = presses(HELD_OUT, seed + 1)
        scores = Drawn(seed + 1, held_out).score(network)
        gates = stored_gates()
        if gates is not None:
            # A new `Drawn` of the same seed: both are scored on the same noise.
            shipped = {name: torch.tensor(getattr(gates, name)) for name in network}
            of_shipped = Drawn(seed + 1, held_out).score(shipped)
            scores["error, shipped weights"] = of_shipped["error"]
        return weights(network), rows, scores
    finally:
        torch.set_num_threads(n_threads)
