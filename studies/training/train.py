"""Study `train`: the gates of solver `skin`, trained on procedural presses, and their scores."""

from __future__ import annotations

import hashlib
import math
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.skin.gates import FILE
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page

from .presses import N_FRAMES, SIDE, masks, presses

NOISE = (3e-4, 1.0)
"""Deviation of the noise, in the largest force of a press; drawn by its logarithm."""
RATE = 2e-3
"""First rate of Adam, which falls to 0 as a half cosine."""
BATCH = 96
"""Presses of a batch, each with all its tiles."""
FLOOR = 1e-3
"""Part of the noise variance below which a squared error counts as none."""
HELD_OUT, SCORED = 256, (0.001, 0.01, 0.03, 0.1, 0.3, 1.0)
"""Presses that are not trained on, and the noise at which they are scored."""
EVERY = 100
"""Batches from one row of the table to the next."""


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Train, write weights, page and chart, and return the conclusion; see `command.Study`.

    Tiles of presses with normal noise of a known deviation are denoised. One thread: the same seed
    gives the same weights on one machine. `executor` is not used. Raises StudyError if PyTorch is
    not installed, or a file cannot be written.
    """
    if find_spec("torch") is None:
        raise StudyError("study train: torch is not installed: pip install 'sparseskin[train]'")
    n_presses, n_batches = (400, 1500) if quick else (24_000, 42_000)
    found, rows, scores = _trained(n_presses, n_batches, seed)
    content = BytesIO()
    halves: dict[str, Any] = {name: value.astype(np.float16) for name, value in found.items()}
    np.savez(content, **halves)
    try:
        (out / FILE).write_bytes(content.getvalue())
    except OSError as error:
        raise StudyError(f"{out / FILE}: {error.strerror}") from error
    fingerprint = hashlib.sha256(content.getvalue()).hexdigest()[:16]
    page = Page(out, "train", Path(__file__).with_suffix(".md"), quick)
    page.section("", _draw(out, pd.DataFrame(rows)), scores)
    page.csv("train", pd.DataFrame(rows))
    line = (
        f"{FILE} (SHA-256 {fingerprint}): {sum(a.size for a in found.values())} weights, seed "
        f"{seed}, {n_presses} presses, {n_batches} batches of {BATCH}."
    )
    page.write([line])
    return [line]


def _draw(out: Path, table: pd.DataFrame) -> str:
    caption = "Squared error of a taxel in noise variances: running geometric mean over batches."
    with Chart(out, "chart_train", caption) as chart:
        (axes,) = chart.panels
        axes.plot(table["batch"], table["error_db"])
        chart.label("batch", "error in dB")
    return chart.markdown


def _trained(
    n_presses: int, n_batches: int, seed: int
) -> tuple[dict[str, Floats], list[dict[str, Any]], pd.DataFrame]:
    """Return weights, the running mean of errors every so many batches, and scores by noise."""
    import torch
    from tqdm import trange

    from .network import first_network, weights

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        drawn, network = _Drawn(seed, presses(n_presses, seed)), first_network(seed)
        optimiser = torch.optim.Adam(network.values(), lr=RATE)
        rows, mean = list[dict[str, Any]](), 0.0
        for k in trange(n_batches, desc="tiles", leave=False):
            for group in optimiser.param_groups:
                group["lr"] = RATE * 0.5 * (1 + math.cos(math.pi * k / n_batches)) + 1e-6
            loss, error_db = drawn.loss(network)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(list(network.values()), 1.0)
            optimiser.step()
            mean += (error_db - mean) / min(k + 1, 2 * EVERY)
            if (k + 1) % EVERY == 0 or k + 1 == n_batches:
                rows.append({"batch": k + 1, "error_db": mean})
        return weights(network), rows, _Drawn(seed + 1, presses(HELD_OUT, seed + 1)).score(network)
    finally:
        torch.set_num_threads(before)


class _Drawn:
    """Batches of presses with noise and masks; losses of a network on them."""

    def __init__(self, seed: int, pool: Floats) -> None:
        import torch

        self._torch = torch
        self._pool = torch.tensor(pool)
        self._rng = np.random.default_rng(seed)
        self._generator = torch.Generator().manual_seed(seed)

    def _batch(self, size: int) -> tuple[Any, Any]:
        """Presses (size, N_FRAMES, SIDE, SIDE), mirrored or transposed, and their masks."""
        torch = self._torch
        chosen = self._pool[torch.randint(len(self._pool), (size,), generator=self._generator)]
        turn = int(self._rng.integers(8))
        if turn & 1:
            chosen = chosen.flip(-1)
        if turn & 2:
            chosen = chosen.flip(-2)
        if turn & 4:
            chosen = chosen.transpose(-1, -2)
        mask = torch.tensor(masks(self._rng, size))
        return chosen * mask[:, None], mask

    def _noise(self, size: int, low: float, high: float) -> Any:
        exponent = self._torch.rand(size, generator=self._generator)
        return low * (high / low) ** exponent

    def loss(self, network: Any) -> tuple[Any, float]:
        """Loss on frames with normal noise of a known deviation, and the mean error in dB."""
        presses, mask = self._batch(BATCH)
        x = presses[:, int(self._rng.integers(N_FRAMES))]
        s = self._noise(len(x), *NOISE)
        e, error = self._errors(network, x, s, mask)
        loss = (e + FLOOR).log().mean() + 0.3 * (error.log() + e.detach() / error).mean()
        return loss, 10 * float((e.detach() + FLOOR).log10().mean())

    def score(self, network: Any) -> pd.DataFrame:
        """Squared and expected error of all presses by noise, in noise variances."""
        torch, rows = self._torch, []
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
        from .network import denoise

        u = x + s[:, None, None] * self._torch.randn(x.shape, generator=self._generator)
        estimate, error = denoise(network, u, s, mask, int(self._rng.integers(64)))
        return (estimate - x).square().sum((1, 2)) / mask.sum((1, 2)) / s**2, error
