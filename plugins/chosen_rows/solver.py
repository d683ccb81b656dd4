"""The default solver for rows that are chosen anew in each frame: held rows, then filtered."""

import math
from dataclasses import replace

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.skin.solver import SkinSolver
from sparseskin.nodes.reconstructor.skin.tuning import SkinTuning
from sparseskin.nodes.reconstructor.solvers.base import Solver
from sparseskin.nodes.sensor.noise import NoiseModel

from .adaptive import AdaptivePhi, HeldRows

MEMORY = 0.7
"""Weight of the past in the running means of squared prediction errors. Chosen."""
CLEARLY = 0.8
"""Quotient of prediction errors below which the held rows are used as they are. Fitted on moving
presses, where it is above, and on a recording (xsensor_L) where the filter lags."""
SATURATED = 4.0
"""Frames of drift after which a node is expected to change no more. Fitted on five recordings of
real skins: without it the estimated error of a dense bed is three times the true one."""
UNTOUCHED = 0.5
"""Mean squared force, in noise variances, up to which nothing touches the skin: rows of few taxels
hold the noise of a single reading. Chosen."""
KEPT = 0.25
"""Part of the noise variance of touched taxels that is left at least. Chosen on presses with the
noise of the paper."""


class AdaptiveSkinSolver(Solver):
    """Reconstructs frames whose rows were chosen at the edge.

    1. Each row of W keeps its last measurement (`HeldRows`): together they are an estimate of all
       taxels, p.
    2. `SkinSolver` filters p over time and space, as if all taxels had been measured.
    3. Where p of the last frame predicted the rows that are read now clearly better than the
       filtered estimate did, p itself is the result: the filter lags behind.
    4. The error of a taxel is the expected change of the nodes since they were read, much as at the
       edge, times the quotient of true and expected change of those that are read now; or the
       noise that the filter keeps, if that is more.

    Each frame is complete by itself: after lost ones, the rows that they had are older.

    Parameters
    ----------
    phi : AdaptivePhi
        Laid out on the grid of the mask; if it is not laid out at all, it is now.
    basis, mask
        As in `Solver`.
    **settings
        Of `SkinSolver`.

    Raises
    ------
    SolverError
        If phi is of another kind or grid; and as in `SkinSolver`.
    """

    name = "skin"
    uses_basis = False
    subtracts_bias = SkinSolver.subtracts_bias
    uses_blas = True
    least_iterations = SkinSolver.least_iterations
    paces = SkinSolver.paces
    y_max = SkinSolver.y_max

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int = 24,
        fast: str = "auto",
    ) -> None:
        super().__init__(phi, basis, mask)
        if not isinstance(phi, AdaptivePhi):
            raise SolverError(f'solver "skin": phi "{phi.kind}" does not choose rows')
        if phi.exists is None:
            phi.lay_out(self.mask)
        elif not np.array_equal(phi.exists, self.mask):
            raise SolverError(
                'solver "skin": phi "adaptive" is laid out on another grid'
            )
        self._rows_of: AdaptivePhi = phi

        # All taxels, as if they had been measured.
        self._whole = SbhePhi(
            n=phi.n,
            m=phi.n,
            seed=0,
        )
        self._filter = SkinSolver(
            self._whole, basis, self.mask, iterations=iterations, fast=fast
        )
        self.n_steps = self.iterations = self._filter.iterations
        self._held = HeldRows(phi)
        self.reset()

    def reset(self) -> None:
        self._filter.reset()
        self._held.reset()
        self.watch = None
        self._predicted: tuple[Doubles, Doubles] | None = None
        self._errors = [0.0, 0.0]
        self._changed = 1.0
        self.error = None
        self.trusted = True

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._checked_y(y)
        rows = self._rows_of.rows
        if self._predicted is not None:
            # How well held rows and filter predicted this frame.
            for k, predicted in enumerate(self._predicted):
                residual = y - predicted[rows]
                error2 = float(np.mean(np.square(residual)))
                self._errors[k] = MEMORY * self._errors[k] + (1 - MEMORY) * error2

        self._held.age += 1
        expected = self._expected()
        last_details = self._held.now.copy()
        self._held.begin()
        self._held.read(rows, y)
        self._x = np.maximum(self._held.update(), 0).astype(np.float32)
        self._learn(expected, last_details)
        self._held.end()

        # Rows that are not read again show no noise.
        self._filter.noise_sd = max(self.noise_sd, math.sqrt(self._rows_of.variance))
        self._filter.noise_model = self._noise_of_touched
        self._filter.setup(self._whole.forward(self._x), warm)
        self._steps_left = self.n_steps

    def use_pace(self, n_steps: int) -> None:
        super().use_pace(n_steps)
        self._filter.use_pace(n_steps)

    def step(self) -> None:
        self._count_step()
        self._filter.step()

    def finish(self) -> Floats:
        self._steps_left = 0
        forces = self._filter.finish()

        tree = self._rows_of.tree
        filtered = tree.analysis(forces.reshape(-1)[self.taxels])
        self._predicted = (tree.analysis(self._x), filtered)
        # The filter lags behind where the held rows predict clearly better.
        if self._errors[0] < CLEARLY * self._errors[1]:
            forces = np.zeros(self.mask.size, dtype=np.float32)
            forces[self.taxels] = self._x
            forces = forces.reshape(self.mask.shape)

        self._judge(forces.reshape(-1)[self.taxels])
        return forces

    def _expected(self) -> Doubles:
        """Expected squared change of each node's details since they were read."""
        drifted = self._held.drift * np.minimum(self._held.age, SATURATED)
        expected = self._held.changed2() + drifted
        # Forces are not negative: of an untouched node all are known.
        expected[self._held.sums <= self._rows_of.untouched] = 0
        return expected

    @property
    def _noise_of_touched(self) -> NoiseModel | None:
        if self.noise_model is None:
            return None
        return replace(self.noise_model, of_touched=True)

    def _learn(self, expected: Doubles, last_details: Doubles) -> None:
        """Compare the expected changes of the nodes that are read with the ones they had."""
        nodes = self._rows_of.chosen
        expected = np.maximum(expected, self._expected())[nodes]
        change2 = self._held.learn(nodes, last_details[nodes])
        total = float(expected.sum())
        if total > 0:
            quotient = min(float(change2.sum()) / total, 1.0)
            self._changed = MEMORY * self._changed + (1 - MEMORY) * quotient

    def _judge(self, x: Floats) -> None:
        """Set the error of the estimate, and whether it is trusted."""
        n = self._rows_of.n
        if self._rows_of.m == n:
            self.error = None
            self.trusted = True
            return

        missed2 = self._changed * float(self._expected().sum()) / n
        assert self._filter.error is not None
        # Frames after each other hold the same noise where they hold the same reading.
        noise = self._noise_of_touched
        kept2 = 0.0
        if noise is not None:
            kept2 = KEPT * float(noise.variance(x).sum()) / n
        error2 = max(missed2, self._filter.error**2, kept2)

        power = float(np.dot(x, x)) / n
        self.error = math.sqrt(error2)
        noise2 = max(self._filter.noise2, self._rows_of.variance)
        untouched = max(power, missed2) <= UNTOUCHED * noise2
        self.trusted = bool(untouched or error2 <= SkinTuning.trusted**2 * power + TINY)
