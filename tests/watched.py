"""A reconstructor and a skin under the watch for faults: what their tests share."""

import importlib.util
import itertools
from collections.abc import Iterable, Iterator

import numpy as np
from bags import skin_state

from sparseskin.messages import Measurements, Message, PhiState, Reconstruction
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.rotation import FIXED, row_subsets
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.faults.taxels import TaxelWatch
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel

DESK_SHAPE, N = (40, 40), 1600
FAST = "on" if importlib.util.find_spec("numba") else "off"
SKIN_SHAPE = (28, 28)
NOISE = NoiseModel()


class Desk:
    """A reconstructor that knows its skin, and what it said."""

    def __init__(
        self, phi: Phi, *, rows: str = FIXED, states_noise: bool = True, **settings: object
    ) -> None:
        self.lines: list[str] = []
        context = Context("reconstructor", ManualClock(0), self.lines.append)
        self.node = Reconstructor(ReconstructorSettings(**{"fast": FAST, **settings}), context)
        self.subsets = row_subsets(phi, rows)
        self._stamps = itertools.count(1)
        sigmas = (0.0628, 0.0141) if states_noise else (0.0, 0.0)
        grid = {"n_rows": DESK_SHAPE[0], "n_cols": DESK_SHAPE[1], "mask": None, "rate_hz": 0.0}
        skin = skin_state(**grid, sigma_mid=sigmas[0], sigma_end=sigmas[1], has_truth=False)
        told = PhiState(
            stamp_ns=0,
            patch="skin",
            fingerprint=self.subsets[0].fingerprint,
            rows=rows,
            **phi.describe(),
        )
        for message in (skin, told):
            list(self.node.step(message))

    def messages(self, y: Iterable[Floats | Quantised]) -> list[Message]:
        """What is published for the measurements y, the first of them of the first row subset."""
        return list(self._published(y))

    def reconstructions(self, y: Iterable[Floats | Quantised]) -> Iterator[Reconstruction]:
        """Reconstructions of the measurements y, frame by frame."""
        return (m for m in self._published(y) if isinstance(m, Reconstruction))

    def _published(self, y: Iterable[Floats | Quantised]) -> Iterator[Message]:
        for k, one in enumerate(y):
            phi = self.subsets[k % len(self.subsets)]
            sent = one.copy()
            head = {"stamp_ns": next(self._stamps), "patch": "skin", "phi": phi.fingerprint}
            yield from self.node.step(Measurements(y=sent, **head))
            sent.fill(0)  # a sender may write to its array again

    def restore(self, y: Iterable[Floats | Quantised]) -> Floats:
        """Forces of the frames of measurements y."""
        return np.array([m.forces[0] for m in self.reconstructions(y)])


class Skin:
    """A skin that is restored frame by frame under the watch, and what was said of it."""

    def __init__(self, phi: Phi, noise: NoiseModel = NOISE) -> None:
        self.lines: list[str] = []
        self.phi, self.noise = phi, noise
        mask = np.ones(SKIN_SHAPE, np.bool_)
        self.watch = TaxelWatch(mask, NOISE, self.lines.append)
        self.solver = make_solver("skin", phi, make_basis("haar", *SKIN_SHAPE), mask, fast=FAST)
        self.rng = np.random.default_rng(0)

    def read(self, truth: Floats, reads: dict[tuple[int, int], float] | None = None) -> Floats:
        """The reconstruction published for a frame; `reads` are the readings of faulty taxels."""
        taxels = self.noise.apply(truth, self.rng)
        for cell, value in (reads or {}).items():
            taxels[cell] = value
        y = self.watch.cleaned(self.phi, self.phi.forward(taxels.reshape(-1)))
        forces = self.solver.solve(y)
        self.watch.update(self.phi, forces, y - self.phi.forward(forces.reshape(-1)))
        return self.watch.filled(forces)


def pad(*cells: tuple[slice, slice], force: float = 1.0) -> Floats:
    frame = np.zeros(SKIN_SHAPE, np.float32)
    for cell in cells:
        frame[cell] = force
    return frame
