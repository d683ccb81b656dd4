"""The default solver for several patches at once: its readable form, also on a device of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import MAX_ITERATIONS, Solver, whole_number

from .backend import Array, ManyPatches
from .estimator import CONVERGED, N_FORMULA, SkinEstimator
from .gates import SHIFTS, Gates, TilesOfDevice, gates_of, tiles_of
from .rows import HadamardRows
from .solver import SkinSolver
from .tuning import SkinTuning
from .vectors import FrameVectors

N_EAGER = 3
"""Frames of a row subset before its operations are recorded: libraries set themselves up."""


class SkinBatch:
    """Reconstructs the frames of equal patches at once, each as a `SkinSolver` of its own would,
    but for rounding.

    A patch without a frame keeps its state. On CUDA the operations of a frame are recorded once
    for each row subset and replayed.

    Parameters
    ----------
    subsets : sequence of Phi
        Row subsets of phi "sbhe", fixed or rotating.
    basis, mask, iterations, gates
        As in `SkinSolver`.
    n_patches : int
    device : str
        As in `ManyPatches`.

    Attributes
    ----------
    patches : tuple of PatchOfBatch
        A solver for each patch.

    Raises
    ------
    SolverError
        If phi is of another kind; and as in `SkinSolver`.
    SettingsError
        As in `ManyPatches`.
    """

    def __init__(
        self,
        subsets: Sequence[Phi],
        basis: Basis,
        mask: Mask | None,
        n_patches: int,
        device: str,
        *,
        iterations: int = 8,
        gates: Gates | str | None = None,
    ) -> None:
        phi, tuning, weights = subsets[0], SkinTuning(), gates_of(gates)
        if not is_sbhe(phi):
            raise SolverError(f'device: phi "{phi.kind}" is not available there; allowed: sbhe')
        self._o = o = ManyPatches(n_patches, device)
        self.patches = tuple(
            PatchOfBatch(self, k, phi, basis, mask, iterations) for k in range(n_patches)
        )
        one = self.patches[0]
        self._rows = HadamardRows(phi, o)
        cells = one.taxels[self._rows.taxel]
        self._tiles = TilesOfDevice(tiles_of(one.mask.shape, cells), o)
        of_device = self._tiles, weights and weights.on(o), tuning, o
        self._vectors = FrameVectors(self._rows, *of_device)
        self._estimator = SkinEstimator(self._rows, self._vectors, tuning, o)
        self._cells, self._image = o.array(cells), o.zeros(one.mask.size)
        self._fresh = self._state
        self._keep([o.copy(array) for array in self._fresh])
        self._y, self._active = np.zeros((n_patches, phi.m), np.float32), np.zeros(n_patches, bool)
        #: What a frame reads, where it is read.
        self._inputs = o.zeros(phi.m), o.copy(o.false), o.copy(o.zero)
        self._first_shift = 0
        self._subset = phi.fingerprint
        self._n_frames: dict[tuple[str, int], int] = {}
        self._recorded: dict[tuple[str, int], tuple[Any, tuple[Array, Array]]] = {}

    @property
    def _state(self) -> list[Array]:
        """All that a frame leaves to the next one, but for what is kept of each row subset."""
        v, e = self._vectors, self._estimator
        return [*(getattr(v, name) for name in v.STATE), *(getattr(e, name) for name in e.STATE)]

    def _keep(self, state: Sequence[Array]) -> None:
        v, e = self._vectors, self._estimator
        owners = [(v, name) for name in v.STATE] + [(e, name) for name in e.STATE]
        for (owner, name), array in zip(owners, state, strict=True):
            setattr(owner, name, array)

    def use(self, phi: Phi) -> None:
        """Expect measurements of another row subset of all patches."""
        self._rows.use(phi)
        self._subset = phi.fingerprint

    def stage(self, k: int, y: Floats, warm: Floats | None) -> None:
        """Take the measurements of patch k, float32 (m,), and where it starts, (n_rows, n_cols)."""
        self._y[k], self._active[k] = y, True
        if warm is not None:
            v = self._vectors
            v.x[k] = self._o.array(np.maximum(warm, 0).reshape(-1))[self._cells]
            v._whole[k] = self._rows.forward(v.x)[k]

    def forget(self, k: int) -> None:
        """Forget all earlier frames of patch k."""
        self._active[k] = False
        for array, fresh in zip(self._state, self._fresh, strict=True):
            array[k] = fresh[k]
        for *_, known in self._estimator.last.values():
            known[k] = False

    def solve(self, n: int, n_formula: int) -> None:
        """Reconstruct the frames of all patches that have one, in steps as of `SkinEstimator`."""
        if not self._active.any():
            return
        self._estimator.noise_model = self.patches[0].noise_model
        sd = np.array([[patch.noise_sd] for patch in self.patches])
        given = self._y, self._active[:, None], sd
        for here, numbers in zip(self._inputs, given, strict=True):
            here[...] = self._o.array(numbers)
        self._tiles.load(self._first_shift, n_formula + n)
        self._first_shift = (self._first_shift + n_formula + n) % len(SHIFTS)
        self._forces, self._found = map(self._o.host, self._run(n, n_formula))
        self._active[:] = False

    def result(self, k: int) -> tuple[Floats, Sequence[float]]:
        """Forces of patch k, float32 (n_rows, n_cols); error, trusted, noise variance and bias."""
        forces: Floats = self._forces[k].reshape(self.patches[k].mask.shape)
        return forces.copy(), self._found[k].tolist()

    def _run(self, n: int, n_formula: int) -> tuple[Array, Array]:
        """Run a frame, or replay one."""
        key = self._subset, n
        n_before = self._n_frames[key] = self._n_frames.get(key, -1) + 1
        if "cuda" not in self._o.device or n_before < N_EAGER:
            return self._frame(n, n_formula)
        if key not in self._recorded:
            cuda = self._o.xp.cuda
            graph = cuda.CUDAGraph()
            with cuda.graph(graph):
                results = self._frame(n, n_formula)
            self._recorded[key] = graph, results
        graph, results = self._recorded[key]
        graph.replay()
        return results

    def _frame(self, n: int, n_formula: int) -> tuple[Array, Array]:
        """Reconstruct a frame of all patches; those that are active take over its state."""
        o, e, subset = self._o, self._estimator, self._subset
        y, active, e.noise_sd = self._inputs
        if subset not in e.last:
            e.last[subset] = o.copy(y), o.copy(y), o.copy(o.false)
        state, last = self._state, e.last[subset]
        e.n_shifts = 0
        e.begin(subset, y)
        forces = e.finish(n, n_formula)
        for before, after in zip((*state, *last), (*self._state, *e.last[subset]), strict=True):
            before[...] = o.where(active, after, before)
        self._keep(state)
        e.last[subset] = last
        image = self._image * 1
        image[:, self._cells] = forces
        found = [o.f64(one) for one in (e.stated_error, e.trusted, e.noise, e.bias)]
        return image, o.xp.concatenate(found, axis=-1)


class PatchOfBatch(Solver):
    """One patch of a `SkinBatch`: `setup` of all patches comes before `finish` of the first one."""

    name = "skin"
    rotates = True
    paces = SkinSolver.paces
    y_max = SkinSolver.y_max

    def __init__(
        self,
        batch: SkinBatch,
        k: int,
        phi: Phi,
        basis: Basis,
        mask: Mask | None,
        iterations: int,
    ) -> None:
        super().__init__(phi, basis, mask)
        self.batch, self._k = batch, k
        whole_number(self.name, "iterations", iterations, 1, MAX_ITERATIONS)
        self.n_steps = self.iterations = iterations
        self.noise2 = self.bias = 0.0

    def reset(self) -> None:
        self.batch.forget(self._k)
        self._steps_left, self.error, self.trusted = 0, None, True

    def use(self, phi: Phi) -> None:
        super().use(phi)
        self.phi = phi
        self.batch.use(phi)

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        y = self._checked_y(y)
        self.batch.stage(self._k, y, None if warm is None else self._checked_warm(warm))
        self._steps_left = self.n_steps

    def step(self) -> None:
        self._count_step()

    def finish(self) -> Floats:
        n, self._steps_left = self.n_steps - self._steps_left, 0
        self.batch.solve(n, N_FORMULA if self.n_steps < CONVERGED else 0)
        forces, (self.error, trusted, self.noise2, self.bias) = self.batch.result(self._k)
        self.trusted = bool(trusted)
        return self._finite(forces)
