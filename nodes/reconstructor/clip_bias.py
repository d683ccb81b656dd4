"""The bias of readings that are clipped at 0: found in the measurements, and undone."""

from __future__ import annotations

import math

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.projection import Projection

#: Normal noise of deviation sigma, clipped at 0, has mean 0.399 sigma and deviation 0.584 sigma.
#: The mean is thus at most this part of the noise, with room for the error of its estimate.
LARGEST = 0.75
#: That noise is an untouched taxel's, the least the skin has had; it is forgotten by so much a
#: frame. A contact's own would let a whole scene that is restored badly pass for bias.
FORGOTTEN = 1.002
SLOWEST = 0.05
#: Frames at the beginning in which the level of most taxels is looked at, and how often later.
FIRST, EVERY = 8, 32


class ClipBias:
    """What an untouched taxel reads on average, as noise below 0 is cut off.

    The bias is one number b for the whole skin. It is taken off the measurements as
    b Phi 1, so that an untouched taxel is sought at 0, where it is; a touched taxel has no bias,
    and gets b back in the end. For a force between, the readings' mean above b is u, and
    u + b (1 - exp(-u / b)) is the force to within 0.03 b.

    Its estimate follows what the restored frame leaves of the measurements along Phi 1, and, as
    a bias looks like a force on most taxels, their median. A skin without it (one that cuts its
    noise off otherwise) ends at b = 0.

    Parameters
    ----------
    projection : Projection
    n : int
        Number of taxels.

    Attributes
    ----------
    b : float
        The estimate, newtons, at least 0.
    ones : ndarray of float32, shape (n_rows,)
        Phi 1 as a vector of rows, of the phase that is in use.
    """

    def __init__(self, projection: Projection, n: int) -> None:
        self._projection = projection
        self._n = n
        self._known: dict[int, tuple[Floats, float]] = {}
        self.use(0)
        self._b = np.zeros((), dtype=np.float32)
        self._scaled = np.zeros_like(self.ones)
        self.reset()

    def use(self, phase: int) -> None:
        """Take measurements of the phase, known by its number, that the projection is now of."""
        if phase not in self._known:
            rows = np.zeros((1, self._projection.n_rows), dtype=np.float32)
            self._projection.forward(np.ones((1, self._n), dtype=np.float32), rows)
            self._known[phase] = rows[0], float(np.dot(rows[0], rows[0]))
        self.ones, self._energy = self._known[phase]

    def reset(self) -> None:
        """Forget all frames."""
        self.b = 0.0
        self._n_frames = 0
        self._least_s2 = math.inf

    def take_off(self, y_rows: Floats) -> None:
        """Subtract the bias from measurements in place, a vector of rows."""
        if self.b:
            self._b[()] = self.b
            np.multiply(self.ones, self._b, self._scaled)
            np.subtract(y_rows, self._scaled, y_rows)

    def update(self, left: float, x: Floats, s2: float) -> None:
        """Take in a restored frame.

        Parameters
        ----------
        left : float
            Product of Phi 1 with what the frame leaves of the measurements.
        x : ndarray of float32, shape (n,)
            The frame, without the bias, newtons.
        s2 : float
            Variance of the noise on a measurement.
        """
        self._n_frames += 1
        more = left / self._energy if self._energy else 0.0
        if self._n_frames <= FIRST or self._n_frames % EVERY == 0:
            more += float(np.median(x))
        self._least_s2 = min(FORGOTTEN * self._least_s2, s2)
        noise = math.sqrt(self._least_s2)
        more = min(max(more, -noise / 2), noise / 2)
        rate = max(SLOWEST, 1 / (self._n_frames + 1))
        self.b = min(max(self.b + rate * more, 0.0), LARGEST * noise)

    def give_back(self, forces: Floats) -> None:
        """Turn means above b into forces, in place, float32 of any shape."""
        if self.b:
            share = forces * np.float32(-1 / self.b)
            np.exp(share, share)
            np.subtract(np.float32(1), share, share)
            np.multiply(share, np.float32(self.b), share)
            np.add(forces, share, forces)
