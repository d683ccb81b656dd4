"""The time that PyLops takes for the measurements of study `targets`, in the same run."""

from __future__ import annotations

import time

import numpy as np

from sparseskin.nodes.reconstructor.presets import PRESETS

from .scene_frames import Floats
from .speed_peers import PyLopsFista, missing_peers
from .speed_problem import Bpdn

#: The paper's method on the project's own operators.
PAPER = PRESETS["paper"]
#: It is timed in one frame of so many: it takes the time of many.
EVERY = 25


class PeerClock:
    """Times FISTA of PyLops on some of the frames that other methods restore.

    Parameters
    ----------
    shape : (n_rows, n_cols)
    ratio : int
        N / M.
    seed : int
        Of Phi.
    """

    def __init__(self, shape: tuple[int, int], ratio: int, seed: int) -> None:
        self._seconds: list[float] = []
        self._n_frames = 0
        self._peer: PyLopsFista | None = None
        if "PyLops FISTA" not in missing_peers():
            problem = Bpdn(shape, ratio, seed, PAPER["lambda_n"])
            self._peer = PyLopsFista(problem, np.zeros(problem.n, dtype=np.float32))

    def restore(self, taxels: Floats) -> None:
        """Let it restore this frame, where its turn has come."""
        if self._peer is not None and self._n_frames % EVERY == 0:
            y = self._peer.problem.phi.forward(taxels.reshape(-1))
            begin = time.perf_counter()
            self._peer.solve(y, PAPER["iterations"])
            self._seconds.append(time.perf_counter() - begin)
        self._n_frames += 1

    @property
    def p50_ms(self) -> float | None:
        """Median time of a frame, ms; None where PyLops is not installed or had no frame."""
        return float(np.median(self._seconds) * 1e3) if self._seconds else None
