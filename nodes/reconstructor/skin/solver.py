"""Orthogonal approximate message passing with learned gates, filtered over time."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.compressor.phi.base import (
    Phi,
    block_layout,
    phi_fact,
)
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Mask, shared
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import (
    MAX_ITERATIONS,
    CountsTiles,
    whole_number,
)

from .estimator import SkinEstimator
from .frame_vectors import FrameVectors
from .gates import Gates, gates_of
from .rows import CompiledRows, HadamardRows, rows_of
from .tiles import tiles_of
from .trust import explains_samples
from .tuning import SkinTuning
from .vectors import CONVERGED, N_FORMULA, StepPlan, StepTimes, Vectors, steps_for

STEPS = 24
"""Steps of a frame by default."""
STEPS_OF_ALL = 4
"""The same where all rows are read: nothing is left to converge. On 30 drawn loads, 12 to 24 taxels
a side, the mean error is 4.57 % with 4 steps, and 4.50 % with 24."""
MOST_TILES = 1 << 40
"""Bound of the times that are stated in tiles: no frame takes as long."""


class SkinSolver(CountsTiles):
    """Reconstructs frames by `SkinEstimator`, in a constant number of steps, with their errors.

    One solver serves all row subsets of rotating rows. Any Phi will do: its rows are made
    orthonormal first, whatever their length. Of a Phi that reads single taxels the error is not
    known. Each frame takes the same number of steps, or a number counted by its tiles.

    Parameters
    ----------
    phi, mask
        As in `Solver`.
    basis : Basis
        Gives the size of the grid; the gates are learned.
    iterations : int, optional
        Steps of a frame, 1..1000; by default 24, or 4 where M = N. Fewer than 8 follow `N_FORMULA`
        steps by a formula, each a few X
        begins, unless all rows are read.
    frame_tiles, step_tiles : int
        Time of the steps of a frame, and of a step without any tile, counted in that of a tile in a
        step. Where they are not 0, each frame takes as many steps as fit into this time with the
        tiles that stand out of the noise in its first step: one at least, `iterations` at most.
    fast : str
        Use of compiled loops, for "sbhe" and single taxels: "auto" (where numba is installed), "on"
        or "off".
    gates : Gates or str, optional
        Weights of the denoiser, or the path of their .npz file; "formula": none, all steps are
        those of `shrink`. None: the weights of the package.
    tuning : SkinTuning
        The constants of the method; another one is an ablation.

    Raises
    ------
    SolverError
        If a parameter is not allowed; and as in `Solver`.
    """

    name = "skin"
    uses_basis = False
    least_iterations = 5
    warning_of_samples = (
        "phi = subsample: solver skin does not know its error between the taxels that are read; "
        "advised: solver interpolation, or phi sbhe"
    )
    subtracts_bias = True
    has_loops = True
    uses_blas = True
    calibrated = (1.33, 0.4)
    rotates = True
    paces = (1, 3, 5, 8, 12, 16, 24)
    #: The sum of squares of larger ones could overflow float32.
    y_max = 1e14

    def __init__(
        self,
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
        *,
        iterations: int | None = None,
        frame_tiles: int = 0,
        step_tiles: int = 0,
        fast: str = "auto",
        gates: Gates | str | None = None,
        tuning: SkinTuning | None = None,
    ) -> None:
        super().__init__(phi, basis, mask)
        if iterations is None:
            iterations = STEPS_OF_ALL if phi.m == phi.n else STEPS
        self.iterations = whole_number(
            self.name, "iterations", iterations, 1, MAX_ITERATIONS
        )
        self.n_steps = self.iterations
        if tuning is None:
            tuning = SkinTuning()
        elif not isinstance(tuning, SkinTuning):
            allowed = "allowed: SkinTuning, from Python only"
            raise SolverError(
                f"{self.name}: tuning = {tuning!r} is not allowed; {allowed}"
            )

        compiled = use_compiled(fast) and block_layout(phi) is not None
        self._rows = rows_of(phi, compiled)
        self._cells = shared(self.taxels[self._rows.taxel])
        place = np.zeros(self.mask.shape, dtype=np.intp)
        place.flat[self._cells] = np.arange(phi.n)
        self._place = shared(place)  # of each taxel, as in `Rows.taxel`
        self._ones: dict[str, Floats] = {}  # Phi 1, by row subset
        self._holes = None if phi.n == self.mask.size else ~self.mask

        self._tuning = tuning
        vectors = self._make_vectors(gates_of(gates), tuning)
        self._estimator = SkinEstimator(self._rows, vectors, tuning)
        self.use_times(
            whole_number(self.name, "frame_tiles", frame_tiles, 0, MOST_TILES),
            whole_number(self.name, "step_tiles", step_tiles, 0, MOST_TILES),
        )
        self.reset()

    def _make_vectors(self, gates: Gates | None, tuning: SkinTuning) -> Vectors:
        tiles = tiles_of(self.mask.shape, self._cells)
        self.most_tiles = tiles.most
        if isinstance(self._rows, CompiledRows):
            from .compiled_vectors import CompiledVectors  # needs numba

            return CompiledVectors(self._rows, tiles, gates, tuning)
        return FrameVectors(self._rows, tiles, gates, tuning)

    def reset(self) -> None:
        self._estimator.forget()
        self._steps_left = 0
        self.watch = None
        self.error = None
        self.common_error = 0.0
        self.trusted = True

    def use(self, phi: Phi) -> None:
        if (phi.n, phi.m) != (self.phi.n, self.phi.m):
            raise SolverError(
                f"{self.name}: phi {phi.fingerprint} is {phi.m} x {phi.n}; "
                f"allowed: {self.phi.m} x {self.phi.n}"
            )
        super().use(phi)
        self.phi = phi
        if not self._rows.use(phi):
            self._estimator.vectors.forget_rows()

    @property
    def bias(self) -> float:
        """Mean reading of an untouched taxel whose noise is clipped at 0, as known so far."""
        return self._estimator.bias.value

    @property
    def noise2(self) -> float:
        """Noise variance of a measurement, as known so far."""
        return self._estimator.noise_level.variance

    @property
    def _compares(self) -> bool:
        """True if measurements are sums of blocks."""
        return self._rows.blocks is not None

    @property
    def doubt(self) -> Floats | None:
        """Part of each measurement that no force explains, float32 (m,), 0 to 1; after `setup`.
        None where measurements are no sums of blocks, within which they could be compared.
        """
        if not self._compares:
            return None
        assert isinstance(self._rows, HadamardRows)
        return self._rows.in_order(self._estimator.vectors.doubt, self.phi)

    def expected(self, phi: Phi) -> Floats:
        """Return what a phi measures of the last estimate and the bias, float32 (m,)."""
        vectors = self._estimator.vectors
        measured = self._rows.measured_of(vectors.x, vectors.x_rows, phi)
        if self.bias:
            if phi.fingerprint not in self._ones:
                all_ones = np.ones(phi.n, dtype=np.float32)
                self._ones[phi.fingerprint] = shared(phi.forward(all_ones))
            measured = measured + np.float32(self.bias) * self._ones[phi.fingerprint]
        return measured

    @property
    def residual(self) -> Floats:
        """Values of the rows read less those of the estimate, float32 (n_read,); after `finish`."""
        return self._estimator.vectors.residual

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._checked_y(y)
        estimator = self._estimator
        if warm is not None:
            forces = self._checked_warm(warm).reshape(-1)[self._cells]
            estimator.vectors.start_from(np.maximum(forces, 0))
        estimator.noise_sd = self.noise_sd
        estimator.noise_model = self.noise_model
        faulty = None
        if self.faulty is not None and self._compares:
            faulty = self._rows.values(self.faulty.astype(np.float32))
        estimator.begin(self.phi.fingerprint, y, faulty)
        self._steps_left = self.n_steps

    def measured(self, forces: Floats, *phis: Phi) -> list[Floats]:
        """As the function `measured`, by one transform."""
        return self._rows.measured(forces.take(self._cells, mode="clip"), *phis)

    def use_times(self, frame_tiles: int, step_tiles: int) -> None:
        self._estimator.times = StepTimes(frame_tiles, max(step_tiles, 1))
        self.times = frame_tiles, step_tiles

    def steps_for(self, n_tiles: int) -> tuple[int, int]:
        # What is 0 does not matter: there is no frame.
        plan = StepPlan(
            n_formula=N_FORMULA,
            n=1,
            first_shift=0,
            frame_tiles=self._estimator.times.frame,
            step_tiles=self._estimator.times.step,
            most=self.n_steps,
            target_variance=0.0,
            floor=0.0,
        )
        plan = steps_for(plan, n_tiles)
        return plan.n_formula, plan.n

    def step(self) -> None:
        self._count_step()  # `finish` does all of them in one call

    def finish(self) -> Floats:
        n_steps = self.n_steps - self._steps_left
        self._steps_left = 0
        n_formula = N_FORMULA if self.n_steps < CONVERGED else 0
        forces = self._estimator.finish(n_steps, n_formula)
        steps = self._estimator.steps
        self.n_done = steps.n if n_steps else 0
        self.n_tiles = steps.n_tiles

        if phi_fact(self.phi, "samples"):
            # The residuals of single taxels show no error between them.
            self.error = None
            self.common_error = 0.0
            self.trusted = explains_samples(
                self.residual, forces, self.noise2, self._tuning
            )
        else:
            self.error = self._estimator.stated_error.value
            self.common_error = self._estimator.common_error.value
            self.trusted = self._estimator.trust.holds

        image = forces.take(self._place, mode="clip")
        if self._holes is not None:
            image[self._holes] = 0
        return self._finite(image)
