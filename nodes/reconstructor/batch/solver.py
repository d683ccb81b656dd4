"""The default solver for many equal patches at once, on any array library and device."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.bases.shifted_haar import SHIFTS
from sparseskin.nodes.reconstructor.skin.solver import N_DRAWN, SkinSolver, checked_iterations
from sparseskin.nodes.reconstructor.skin.tuning import TUNING
from sparseskin.nodes.reconstructor.solvers.base import whole_number
from sparseskin.nodes.reconstructor.solvers.projection import MAX_BLOCK

from .backend import Array, Backend
from .finish import RESULT
from .graphs import MODES, EagerFrames, Frames, GraphFrames
from .smooth import SmoothBatch
from .state import NUMBERS, State, first_numbers, first_state
from .tables import Tables


@dataclass(frozen=True)
class BatchFrame:
    """A reconstructed frame of a batch of B patches, on the host.

    Attributes
    ----------
    forces : ndarray of float32, shape (B, n_rows, n_cols)
        Newtons, at least 0; 0 where no taxel exists, and for patches that are not finite.
    error : ndarray of float64, shape (B,)
        Estimated RMS error of a taxel, newtons; inf where the patch is not finite, nan where all
        taxels are measured: there is no estimate.
    trusted : ndarray of bool, shape (B,)
        False if the frame of a patch is not to be trusted.
    finite : ndarray of bool, shape (B,)
        False if the iteration of a patch diverged; it begins anew with the next frame.
    is_smooth : ndarray of bool, shape (B,)
        True where the estimate is that of the smooth model.
    n_steps : ndarray of int64, shape (B,)
        Iterations of the Haar model.
    """

    forces: Floats
    error: Doubles
    trusted: npt.NDArray[np.bool_]
    finite: npt.NDArray[np.bool_]
    is_smooth: npt.NDArray[np.bool_]
    n_steps: npt.NDArray[np.int64]


class BatchSolver:
    """`SkinSolver` for many patches at once: same grid, mask and Phi, each its own past.

    It is written against the Python array API standard and runs on numpy and torch, on a GPU too.
    The steps, constants and random shifts are those of `SkinSolver`, with these differences:

    - Sums of squares and numbers of a patch are float64 (there: float32 sums), so that estimates
      differ by rounding: on simulated presses at N/3 by some 1e-5 N. The smooth model, and far
      fewer measurements, amplify it, and a decision within rounding of its bound may differ; PSNR
      then differs as much as between the two forms of `SkinSolver` (setting `fast`).
    - A patch whose iteration diverges is returned as 0, untrusted, and begins anew; there, an
      error is raised.
    - Phi is "sbhe" with blocks of at most 64, and at least 96 measurements: `SkinSolver` solves
      smaller skins by a smooth model of its own.
    - All patches are measured by the same row subset in a frame. No budget ends a frame early.

    Patches that need the smooth model, or a comparison of both, are handed to it as a smaller batch
    on the same device; those that need more iterations of Haar, likewise.

    Parameters
    ----------
    phis : sequence of Phi
        Row subsets of one "sbhe" in their order; one with fixed rows.
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    n_patches : int
        B, at least 1.
    iterations, max_iterations, seed
        As in `SkinSolver`; all patches draw the same shifts.
    device : str
        As in `Backend`.
    mode : str
        One of `graphs.MODES`; of a GPU alone.

    Raises
    ------
    SolverError
        If a parameter is not allowed, or Phi and mask do not fit.
    SettingsError
        If there is no such device, or its library is not installed.
    """

    def __init__(
        self,
        phis: Sequence[Phi],
        mask: Mask,
        n_patches: int,
        *,
        iterations: int | None = None,
        max_iterations: int = 30,
        seed: int = 0,
        device: str = "numpy",
        mode: str = "fused",
    ) -> None:
        checked = _checked(phis, mask)
        phi = checked[0]
        self.n_patches = whole_number("batch", "n_patches", n_patches, 1, 2**20)
        least, most = checked_iterations("batch", phi.ratio, iterations, max_iterations)
        self.iterations, self.max_iterations = least, most
        whole_number("batch", "seed", seed, 0, 2**32 - 1)
        self.backend = Backend(device)
        shifts = np.random.default_rng(seed).integers(len(SHIFTS), size=N_DRAWN)
        self.tables = Tables(self.backend, checked, mask, shifts)
        smooth = SmoothBatch(self.tables)
        self._frames: Frames = EagerFrames(self.tables, smooth, least, most)
        if mode not in MODES:
            raise SolverError(f"batch: mode = {mode!r} is not allowed; allowed: {', '.join(MODES)}")
        if self.backend.on_gpu and mode != MODES[0]:
            self._frames = GraphFrames(self.tables, smooth, least, most, mode)
        self._numbers = {phi.fingerprint: k for k, phi in enumerate(checked)}
        self._state: State = {}
        self.reset()

    def reset(self, patches: npt.ArrayLike | None = None) -> None:
        """Forget all earlier frames: of some patches, bool (B,), or of all."""
        be, t = self.backend, self.tables
        n_subsets = len(t.subsets)
        if patches is None and self._state:
            patches = np.ones(self.n_patches, dtype=np.bool_)
        if patches is None:
            self._state = first_state(be, self.n_patches, t.n, t.m, n_subsets)
            #: Frames of each patch, as the numbers of the state count them.
            self._n_frames = np.zeros(self.n_patches, dtype=np.int64)
            return
        chosen = be.array(np.asarray(patches, dtype=np.bool_))
        first = be.array(first_numbers(self.n_patches, n_subsets))
        for name, array in self._state.items():
            if name == NUMBERS:
                array[...] = be.xp.where(chosen[None, :], first, array)
            else:
                array[...] = be.choose(chosen, be.xp.zeros_like(array), array)
        self._n_frames[np.asarray(patches)] = 0

    def unfitted(self, phi: Phi | None = None) -> Indices:
        """Return the numbers of the measurements that estimates are not made from, intp."""
        return self.tables.subsets[self._number_of(phi)].measurements

    def solve(
        self, y: Floats, phi: Phi | None = None, active: npt.ArrayLike | None = None
    ) -> BatchFrame:
        """Reconstruct one frame of each patch.

        Parameters
        ----------
        y : ndarray of float32, shape (B, m)
            Measurements, newtons. An array of the backend on its device is used as it is: there,
            a value that is not finite makes its patch untrusted and not finite.
        phi : Phi, optional
            Row subset of the frame; None: the first.
        active : array of bool, shape (B,), optional
            False for patches without a frame: their state stays as it is, and their results mean
            nothing. None: all have one.

        Returns
        -------
        BatchFrame

        Raises
        ------
        SolverError
            If y is of another shape, not finite or above 1e14 N, or phi none of those given.
        """
        return self.advance(y, phi, active)[1]

    def advance(
        self,
        y: Any,
        phi: Phi | None = None,
        active: npt.ArrayLike | None = None,
        with_forces: bool = True,
    ) -> tuple[Array, BatchFrame]:
        """As `solve`; return also the forces on the device, valid until the next frame.

        Without `with_forces` those of the `BatchFrame` are empty: they stay on the device.
        """
        number = self._number_of(phi)
        given = self._checked_active(active)
        y = self._checked_y(y, given)
        some = None if given.all() else given
        with np.errstate(all="ignore"):
            state, result = self._frames.frame(self._state, y, number, self._uses_median(some))
        state = {**state, f"y{number}": y}
        self._keep(state, some)
        wanted = [result["numbers"], *([result["forces"]] if with_forces else [])]
        numbers, *rest = self.backend.fetch(wanted)
        forces = rest[0] if rest else np.zeros((0, *self.tables.shape), dtype=np.float32)
        self._n_frames += given
        found = dict(zip(RESULT, numbers, strict=True))
        finite = found["finite"] > 0
        if not finite[given].all():
            self.reset(~finite & given)
        if not self.tables.tests:
            found["error"] = np.where(finite, np.nan, np.inf)
        return result["forces"], BatchFrame(
            forces=forces,
            error=found["error"],
            trusted=found["trusted"] > 0,
            finite=finite,
            is_smooth=found["is_smooth"] > 0,
            n_steps=found["n_steps"].astype(np.int64),
        )

    def _uses_median(self, active: Mask | None) -> bool:
        frames = (self._n_frames if active is None else self._n_frames[active]) + 1
        return bool(
            np.any((frames <= self.tables.median_first) | (frames % TUNING.median_every == 0))
        )

    def _keep(self, state: State, active: Mask | None) -> None:
        """Make this the state, of patches that had a frame, in place."""
        be = self.backend
        chosen = None if active is None else be.array(active)
        for name, array in state.items():
            if chosen is not None:
                mask = chosen[None, :] if name == NUMBERS else chosen[:, None]
                array = be.xp.where(mask, array, self._state[name])
            self._state[name][...] = array

    def _number_of(self, phi: Phi | None) -> int:
        if phi is None:
            return 0
        if phi.fingerprint not in self._numbers:
            raise SolverError(f"batch: was not made for phi {phi.fingerprint}")
        return self._numbers[phi.fingerprint]

    def _checked_active(self, active: npt.ArrayLike | None) -> Mask:
        """Return the flags of patches that have a frame, bool (B,), or raise SolverError."""
        if active is None:
            return np.ones(self.n_patches, dtype=np.bool_)
        given = np.asarray(active)
        if given.dtype != np.bool_ or given.shape != (self.n_patches,):
            raise SolverError(
                f"batch: active is {given.dtype} of shape {given.shape}; "
                f"expected bool of shape {(self.n_patches,)}"
            )
        return given

    def _checked_y(self, y: Any, active: Mask) -> Array:
        """Return y on the device, float32, or raise SolverError."""
        expected, most = (self.n_patches, self.tables.m), SkinSolver.y_max
        if isinstance(y, list | tuple):
            y = np.asarray(y)
        if tuple(y.shape) != expected:
            raise SolverError(f"batch: y has shape {tuple(y.shape)}; expected {expected}")
        if not isinstance(y, np.ndarray):
            if y.dtype != self.backend.f32:
                raise SolverError(f"batch: y on the device is {y.dtype}; allowed: float32")
            return y
        if y.dtype.kind not in "fiu":
            raise SolverError(f"batch: y is {y.dtype}; allowed: real numbers")
        if not active.all():
            y = np.where(active[:, None], y, 0)
        with np.errstate(over="ignore"):
            y = np.ascontiguousarray(y, dtype=np.float32)
        # Without arrays of its own, which would take longer than the transfer to a GPU.
        if not (y.min() >= -most and y.max() <= most):
            patch, place = np.argwhere(~(np.abs(y) <= most))[0]
            raise SolverError(
                f"batch: measurement {place} of patch {patch} is {y[patch, place]}; "
                f"allowed: finite numbers within +-{most:g}"
            )
        return self.backend.send(y)


def _checked(phis: Sequence[Phi], mask: Mask) -> list[SbhePhi]:
    """Return the row subsets, or raise SolverError."""
    found = [phi for phi in phis if type(phi) is SbhePhi and phi.block <= MAX_BLOCK]
    if not phis or len(found) != len(phis):
        raise SolverError(f'batch: phi: allowed: "sbhe" with blocks of at most {MAX_BLOCK}')
    phi = found[0]
    if mask.dtype != np.bool_ or mask.ndim != 2 or np.count_nonzero(mask) != phi.n:
        raise SolverError(
            f"batch: the mask is {mask.dtype} of shape {mask.shape} with "
            f"{np.count_nonzero(mask)} taxels; expected bool with {phi.n}"
        )
    for other in found[1:]:
        if other.m != phi.m or not np.array_equal(other.permutation, phi.permutation):
            raise SolverError(f"batch: phi {other.fingerprint} is no row subset of the first one")
    if phi.m < TUNING.comparable:
        raise SolverError(
            f"batch: {phi.m} measurements are not allowed; allowed: {TUNING.comparable} or more; "
            'solver "skin" takes fewer'
        )
    return found
