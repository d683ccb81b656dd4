"""A reconstructor node that watches for faults: what tests of it share."""

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
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings

DESK_SHAPE, N = (40, 40), 1600
FAST = "on" if importlib.util.find_spec("numba") else "off"


class Desk:
    """A reconstructor that knows its skin, and what it said."""

    def __init__(
        self,
        phi: Phi,
        *,
        rows: str = FIXED,
        states_noise: bool = True,
        **settings: object,
    ) -> None:
        self.lines: list[str] = []
        context = Context("reconstructor", ManualClock(0), self.lines.append)
        self.node = Reconstructor(
            ReconstructorSettings(**{"fast": FAST, **settings}), context
        )
        self.subsets = row_subsets(phi, rows)
        self._stamps = itertools.count(1)
        sigmas = (0.0628, 0.0141) if states_noise else (0.0, 0.0)
        grid = {
            "n_rows": DESK_SHAPE[0],
            "n_cols": DESK_SHAPE[1],
            "mask": None,
            "rate_hz": 0.0,
        }
        skin = skin_state(
            **grid, sigma_mid=sigmas[0], sigma_end=sigmas[1], has_truth=False
        )
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

    def reconstructions(
        self, y: Iterable[Floats | Quantised]
    ) -> Iterator[Reconstruction]:
        """Reconstructions of the measurements y, frame by frame."""
        return (m for m in self._published(y) if isinstance(m, Reconstruction))

    def _published(self, y: Iterable[Floats | Quantised]) -> Iterator[Message]:
        for k, one in enumerate(y):
            phi = self.subsets[k % len(self.subsets)]
            sent = one.copy()
            head = {
                "stamp_ns": next(self._stamps),
                "patch": "skin",
                "phi": phi.fingerprint,
            }
            yield from self.node.step(Measurements(y=sent, **head))
            sent.fill(0)  # a sender may write to its array again

    def restore(self, y: Iterable[Floats | Quantised]) -> Floats:
        """Forces of the frames of measurements y."""
        return np.array([m.forces[0] for m in self.reconstructions(y)])
