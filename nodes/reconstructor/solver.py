"""What every solver is, and how one is made by name."""

from __future__ import annotations

import inspect
import math
from abc import ABC, abstractmethod
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.compressor.acts import ActsPhi
from sparseskin.nodes.compressor.calls import Floats, Indices
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.fast import check_fast
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.reconstructor.basis import Basis

Mask: TypeAlias = npt.NDArray[np.bool_]

SOLVERS = {
    "skin": "sparseskin.nodes.reconstructor.skin:SkinSolver",
    "fista": "sparseskin.nodes.reconstructor.fista:FistaSolver",
    "fista_nonneg": "sparseskin.nodes.reconstructor.fista_nonneg:FistaNonnegSolver",
    "reweighted": "sparseskin.nodes.reconstructor.reweighted:ReweightedSolver",
    "tv": "sparseskin.nodes.reconstructor.tv:TvSolver",
    "oamp": "sparseskin.nodes.reconstructor.oamp:OampSolver",
    "ista": "sparseskin.nodes.reconstructor.ista:IstaSolver",
    "omp": "sparseskin.nodes.reconstructor.omp:OmpSolver",
    "interpolation": "sparseskin.nodes.reconstructor.interpolation:InterpolationSolver",
}
_INTERFACE = ("setup", "step", "finish", "solve", "reset", "n_steps", "taxels")


class Solver(ABC):
    """Restores the forces of a patch from measurements, frame after frame.

    `solve` does a frame at once. `setup`, then `step` up to `n_steps` times, then `finish` do
    it in pieces, so that a caller can stop where a frame's time is over. A solver carries what
    it knows from frame to frame until `reset`. It owns its work arrays and those of the phi and
    the basis it is given: use one solver per thread, each with its own.

    Parameters
    ----------
    phi : Phi
        Measurement matrix; acts on the existing taxels in row-major order.
    basis : Basis
        Basis on the whole grid.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists. None: everywhere.

    Attributes
    ----------
    n_steps : int
        Number of steps of the current frame.
    taxels : ndarray of intp, shape (n,)
        Place in the flat grid of each existing taxel, ascending.

    Raises
    ------
    SolverError
        If the mask does not fit the grid, or phi not the number of taxels.
    """

    n_steps: int = 1
    #: Measurements beyond this could overflow float32 inside the solver.
    y_max: float = 1e30
    #: Whether `use` makes one solver serve all phases of rotating rows.
    rotates: bool = False
    #: Whether it follows a phi that chooses its taxels anew each frame.
    follows_choice: bool = False

    def __init__(self, phi: Phi, basis: Basis, mask: Mask | None = None) -> None:
        shape = (basis.n_rows, basis.n_cols)
        if mask is None:
            mask = np.ones(shape, dtype=np.bool_)
        mask = np.asarray(mask)
        if mask.shape != shape or mask.dtype != np.bool_:
            raise SolverError(
                f"solver: the mask is {mask.dtype} of shape {mask.shape}; "
                f"expected bool of shape {shape}"
            )
        self.phi = phi
        self.basis = basis
        self.mask: Mask = mask.copy()
        self.taxels: Indices = np.flatnonzero(mask)
        if phi.n != self.taxels.size:
            raise SolverError(
                f"solver: phi is for n = {phi.n} taxels; "
                f"the grid of {shape[0]} x {shape[1]} has {self.taxels.size}"
            )

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        """Restore one frame.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements, newtons.
        warm : ndarray of float32, shape (n_rows, n_cols), optional
            Estimate to begin from, newtons; None: what the last frame left.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Forces, newtons, at least 0; 0 where no taxel exists. The caller's own.

        Raises
        ------
        SolverError
            If y or warm is of another shape or not finite, or y so large that float32 does
            not hold the result.
        """
        self.setup(y, warm)
        for _ in range(self.n_steps):
            self.step()
        return self.finish()

    @abstractmethod
    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""

    @abstractmethod
    def step(self) -> None:
        """Do one iteration of the frame that was begun."""

    @abstractmethod
    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""

    @abstractmethod
    def reset(self) -> None:
        """Forget all earlier frames."""

    def use(self, phi: Phi) -> None:
        """Take measurements of this phase of rotating rows from the next frame on.

        Raises
        ------
        SolverError
            If the solver was made for another matrix, and can use no other.
        """
        if phi.fingerprint != self.phi.fingerprint:
            raise SolverError(f"solver: was not made for phi {phi.fingerprint}")

    def _checked_y(self, y: Floats) -> Floats:
        """Return y as contiguous float32, or raise SolverError."""
        y = np.ascontiguousarray(y, dtype=np.float32)
        if y.shape != (self.phi.m,):
            raise SolverError(
                f"solver: y has shape {y.shape}; expected ({self.phi.m},): m = {self.phi.m}"
            )
        # The squares' sum is found far sooner than the extremes, and is hardly ever as large.
        with np.errstate(over="ignore", invalid="ignore"):
            power = float(np.dot(y, y))
        if power < min(self.y_max**2, math.inf):
            return y
        if not np.isfinite(y).all():
            bad = int(np.flatnonzero(~np.isfinite(y))[0])
            raise SolverError(f"solver: measurement {bad} is {y[bad]}; allowed: finite numbers")
        if max(float(y.max()), -float(y.min())) > self.y_max:
            raise SolverError(
                f"solver: a measurement is beyond +-{self.y_max:g}: too large for float32"
            )
        return y

    def _checked_warm(self, warm: Floats) -> Floats:
        """Return a warm start as contiguous float32, or raise SolverError."""
        warm = np.ascontiguousarray(warm, dtype=np.float32)
        if warm.shape != self.mask.shape:
            raise SolverError(
                f"solver: the warm start has shape {warm.shape}; expected {self.mask.shape}"
            )
        if not np.isfinite(warm).all():
            raise SolverError("solver: the warm start has values that are not finite")
        return warm


def make_solver(
    name: str,
    phi: Phi,
    basis: Basis,
    mask: Mask | None = None,
    *,
    fast: str = "auto",
    **settings: Any,
) -> Solver:
    """Make a solver by name.

    Parameters
    ----------
    name : str
        One of `SOLVERS`, or "module:Class" for your own: called with phi, basis, mask and the
        settings as keywords, it must offer what `Solver` does.
    phi, basis, mask
        As in `Solver`.
    fast : str
        Whether compiled loops are used by solvers that have them: "auto", "on" or "off", as
        `sparseskin.nodes.fast` tells.
    **settings
        The solver's own, e.g. iterations=20 for "fista".

    Raises
    ------
    SolverError
        If the name or a setting is unknown, a setting is not allowed, phi, basis and mask do
        not fit, or a class of your own is not a solver.
    SettingsError
        If fast is none of these, or "on" without numba.
    """
    cls = find_class("solver", name, SOLVERS, SolverError)
    if isinstance(phi, ActsPhi) and not getattr(cls, "follows_choice", False):
        raise SolverError(
            f'solver "{name}": phi "acts" reads other taxels each frame; allowed: interpolation'
        )
    parameters = inspect.signature(cls).parameters
    known = [p for p in parameters if p not in ("phi", "basis", "mask", "fast")]
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    for setting in settings:
        if setting not in known and not takes_any:
            raise SolverError(
                f'solver "{name}": setting "{setting}" is not known{did_you_mean(setting, known)}'
            )
    check_fast(fast)  # refused here, whether or not the solver has compiled loops
    if "fast" in parameters:
        settings["fast"] = fast
    try:
        made = cls(phi=phi, basis=basis, mask=mask, **settings)
    except TypeError as cause:
        raise SolverError(f'solver "{name}" cannot be made: {cause}') from cause
    missing = [attribute for attribute in _INTERFACE if not hasattr(made, attribute)]
    if missing:
        raise SolverError(f'solver "{name}" is no solver: it lacks {", ".join(missing)}')
    solver: Solver = made
    return solver
