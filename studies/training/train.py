"""Study `train`: the gates of solver `skin`, trained on procedural presses, and their scores."""

from __future__ import annotations

import hashlib
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from sparseskin.nodes.errors import not_installed
from sparseskin.nodes.reconstructor.skin.gates import FILE
from sparseskin.studies.points import StudyError
from sparseskin.studies.report import Chart, Page


def run(out: Path, quick: bool, seed: int, executor: str) -> list[str]:
    """Train, write weights, page and chart, and return the conclusion; see `command.Study`.

    Tiles of presses with normal noise of a known deviation are denoised. One thread: the same seed
    gives the same weights on one machine. `executor` is not used. Raises StudyError if PyTorch is
    not installed, or a file cannot be written.
    """
    if find_spec("torch") is None:
        raise StudyError(f"study train: {not_installed('torch', 'train')}")
    n_presses, n_batches = (400, 1500) if quick else (24_000, 42_000)
    # Imported here: without torch the line above is to be printed.
    from .network import BATCH, trained

    network, rows, scores = trained(n_presses, n_batches, seed)
    halves: dict[str, Any] = {
        name: value.astype(np.float16) for name, value in network.items()
    }
    file = BytesIO()
    np.savez(file, **halves)
    content = file.getvalue()
    try:
        (out / FILE).write_bytes(content)
    except OSError as error:
        raise StudyError(f"{out / FILE}: {error.strerror}") from error
    fingerprint = hashlib.sha256(content).hexdigest()[:16]
    page = Page(out, "train", Path(__file__).with_suffix(".md"), quick)
    page.section("", _draw(out, pd.DataFrame(rows)), scores)
    page.csv("train", pd.DataFrame(rows))
    line = (
        f"{FILE} (SHA-256 {fingerprint}): {sum(a.size for a in network.values())} weights, seed "
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
