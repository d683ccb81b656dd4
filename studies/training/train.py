"""Study `train`: the gates of solver `oamp`, trained on procedural presses, and their scores."""

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
from sparseskin.nodes.reconstructor.oamp.gates import FILE
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page

from .presses import N_FRAMES, SIDE, masks, presses

RATIOS = (2, 3, 3, 4, 4, 6, 8, 8, 8, 12)
"""Compression ratios N / M, drawn with these frequencies."""
STEPS = (5, 6, 8, 8)
"""Steps of a frame, drawn with these frequencies."""
TILE_NOISE, NOISE = (3e-4, 1.0), (1e-4, 1.0)
"""Deviation of the noise of taxels and of measurements, in the largest force of a press; drawn by
its logarithm."""
CLIPPED, SILENT = 0.5, 0.1
"""Parts of the batches with noise clipped at 0, and of the presses without noise."""
CLIP_BIAS = 0.399
"""Mean of normal noise clipped at 0, in its deviation: 1 / sqrt(2 pi)."""
RATES = (2e-3, 3e-4)
"""First rates of Adam, of both parts of the training; each falls to 0 as a half cosine."""
FLOOR = 1e-3
"""Part of the noise variance below which a squared error counts as none."""
HELD_OUT = 256
"""Presses that are not trained on, and scored at the end."""
EVERY = 100
"""Batches from one row of the table to the next."""


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Train, write weights, page and chart, and return the conclusion; see `command.Study`.

    First tiles alone are denoised, then frames are reconstructed through all steps: three of each
    press, with fixed or rotating rows. One thread: the same seed gives the same weights on one
    machine. `executor` is not used.

    Raises
    ------
    StudyError
        If PyTorch is not installed, or a file cannot be written.
    """
    if find_spec("torch") is None:
        raise StudyError("study train: torch is not installed: pip install 'sparseskin[train]'")
    n_presses, n_tiles, n_frames = (400, 1500, 20) if quick else (16_000, 25_000, 9_000)
    found, rows = _trained(n_presses, n_tiles, n_frames, seed)
    content = BytesIO()
    np.savez(content, **found)
    try:
        (out / FILE).write_bytes(content.getvalue())
    except OSError as error:
        raise StudyError(f"{out / FILE}: {error.strerror}") from error
    fingerprint = hashlib.sha256(content.getvalue()).hexdigest()[:16]
    table = pd.DataFrame(rows)
    page = Page(out, "train", Path(__file__).with_suffix(".md"), quick)
    page.section("", _draw(out, table[table["part"] != "held out"]))
    page.csv("train", table)
    score = table[table["part"] == "held out"].iloc[0]
    lines = [
        f"{FILE} (SHA-256 {fingerprint}): {sum(a.size for a in found.values())} weights, seed "
        f"{seed}, {n_presses} presses, {n_tiles} batches of tiles and {n_frames} of frames.",
        f"{HELD_OUT} other presses, {N_FRAMES} frames each, N/8, rotating rows, noise of 0.01 of "
        f"the peak: error {_db(score['first_db'])} in the first frame, {_db(score['last_db'])} "
        "in the last, relative to the forces.",
    ]
    page.write(lines)
    return lines


def _db(error: float) -> str:
    """Text of an error in dB; weights that were hardly trained amplify it beyond any number."""
    return f"{error:.1f} dB" if math.isfinite(error) else "beyond any number (too few batches)"


def _draw(out: Path, table: pd.DataFrame) -> str:
    caption = (
        "Squared error relative to the squared forces, running mean over batches: frames of a "
        "press that begins, and two frames later."
    )
    with Chart(out, "chart_train", caption, legend_columns=2) as chart:
        (axes,) = chart.panels
        frames = table[table["part"] == "frames"]
        axes.plot(frames["batch"], frames["first_db"], label="first frame")
        axes.plot(frames["batch"], frames["last_db"], "--", label="third frame")
        chart.label("batch", "error in dB")
    return chart.markdown


def _trained(
    n_presses: int, n_tiles: int, n_frames: int, seed: int
) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return weights, and the running means of errors every so many batches."""
    import torch
    from tqdm import trange

    from .network import first_network, weights

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        drawn = _Drawn(seed, presses(n_presses, seed))
        network, rows = first_network(seed), list[dict[str, Any]]()
        for part, count, rate, batch in (
            ("tiles", n_tiles, RATES[0], drawn.tiles),
            ("frames", n_frames, RATES[1], drawn.frames),
        ):
            optimiser = torch.optim.Adam(network.values(), lr=rate)
            means = None
            for k in trange(count, desc=part, leave=False):
                for group in optimiser.param_groups:
                    group["lr"] = rate * 0.5 * (1 + math.cos(math.pi * k / count)) + 1e-6
                loss, first, last = batch(network)
                optimiser.zero_grad()
                loss.backward()
                norm = torch.nn.utils.clip_grad_norm_(list(network.values()), 1.0)
                if math.isfinite(float(norm)):
                    optimiser.step()
                now = np.array([first, last])
                means = now if means is None else means + (now - means) / min(k + 1, 2 * EVERY)
                if (k + 1) % EVERY == 0 or k + 1 == count:
                    figures = {"first_db": means[0], "last_db": means[1]}
                    rows.append({"part": part, "batch": k + 1, **figures})
        held_out = _Drawn(seed + 1, presses(HELD_OUT, seed + 1))
        first, last = held_out.score(network)
        rows.append({"part": "held out", "batch": 0, "first_db": first, "last_db": last})
        return weights(network), rows
    finally:
        torch.set_num_threads(before)


class _Drawn:
    """Batches of presses with noise, masks and rows; losses of a network on them."""

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

    def tiles(self, network: Any) -> tuple[Any, float, float]:
        """Loss on frames with normal noise of a known deviation, and the mean errors in dB."""
        from .network import denoise

        presses, mask = self._batch(96)
        x = presses[:, int(self._rng.integers(N_FRAMES))]
        s = self._noise(len(x), *TILE_NOISE)
        u = x + s[:, None, None] * self._torch.randn(x.shape, generator=self._generator)
        estimate, error = denoise(network, u, s, mask, int(self._rng.integers(64)))
        e = (estimate - x).square().sum((1, 2)) / mask.sum((1, 2)) / s**2
        loss = (e + FLOOR).log().mean() + 0.3 * (error.log() + e.detach() / error).mean()
        mean_db = 10 * float((e.detach() + FLOOR).log10().mean())
        return loss, mean_db, mean_db

    def frames(self, network: Any) -> tuple[Any, float, float]:
        """Loss on successive frames from measurements, and the mean errors of first and last."""
        from .network import Rows, solve

        torch, rng = self._torch, self._rng
        truth, mask = self._batch(48)
        rows = Rows.draw(self._generator, int(rng.choice(RATIOS)), bool(rng.random() < 0.5))
        sd = self._noise(len(truth), *NOISE)
        sd = sd * (torch.rand(len(sd), generator=self._generator) > SILENT) + 1e-6
        readings, wanted = self._read(truth, sd[:, None, None, None], bool(rng.random() < CLIPPED))
        found = solve(
            network,
            rows,
            list((readings * mask[:, None]).unbind(1)),
            mask,
            sd**2,
            int(rng.choice(STEPS)),
            int(rng.integers(64)),
        )
        n, floor = mask.sum((1, 2)), 1e-9 + FLOOR * sd**2
        loss, errors = torch.zeros(()), []
        for k, (estimate, steps) in enumerate(found):
            x = wanted[:, k]
            e = (estimate - x).square().sum((1, 2)) / n
            loss = loss + (1.0 if k == 0 else 0.7) * (e + floor).log().mean()
            for one, s, error in steps:
                off = ((one - x).square().sum((1, 2)) / n / s**2).detach().clamp(max=20)
                loss = loss + 0.1 * (error.log() + off / error).mean()
            power = truth[:, k].square().sum((1, 2)) / n
            errors.append(10 * float(((e.detach() + floor) / (power + floor)).log10().mean()))
        return loss, errors[0], errors[-1]

    def _read(self, truth: Any, sd: Any, clipped: bool) -> tuple[Any, Any]:
        """Readings less their bias, and what they read in the mean."""
        torch = self._torch
        readings = truth + sd * torch.randn(truth.shape, generator=self._generator)
        if not clipped:
            return readings, truth
        bias, z = CLIP_BIAS * sd, truth / sd
        mean = truth * torch.special.ndtr(z) + bias * (-z.square() / 2).exp()
        return readings.clamp(min=0) - bias, mean - bias

    def score(self, network: Any) -> tuple[float, float]:
        """Errors in dB of the first and the last frame, N/8, rotating rows, noise of 0.01."""
        from .network import Rows, solve

        torch, x = self._torch, self._pool
        rows = Rows.draw(self._generator, 8, fixed=False)
        sd = torch.full((len(x),), 0.01)
        noise = 0.01 * torch.randn(x.shape, generator=self._generator)
        mask = torch.ones(len(x), SIDE, SIDE)
        with torch.no_grad():
            found = solve(network, rows, list((x + noise).unbind(1)), mask, sd**2, 8, 0)
        db = [
            10 * float(((e - x[:, k]).square().sum() / x[:, k].square().sum()).log10())
            for k, (e, _) in enumerate(found)
        ]
        return db[0], db[-1]
