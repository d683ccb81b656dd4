"""The interface of solvers, their registry, and `make_solver`."""

import inspect
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.nodes import extensions
from sparseskin.nodes.compressor.phi.base import Phi, phi_fact
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask, real_floats, shared
from sparseskin.nodes.numerics.compiled import check_fast
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.sensor.noise import NoiseModel

SOLVERS = extensions.Registry(
    extensions.SOLVERS,
    {
        "skin": "sparseskin.nodes.reconstructor.skin.solver:SkinSolver",
        "fista": "sparseskin.nodes.reconstructor.solvers.fista:FistaSolver",
    },
)
"""Class of each solver."""
MAX_ITERATIONS = 1000
_INTERFACE = ("setup", "step", "finish", "solve", "reset", "n_steps", "taxels")


class Solver(ABC):
    """Reconstructs the forces of a patch from measurements, frame after frame.

    `solve` does a frame at once. `setup`, then `step` up to `n_steps` times, then `finish` do the
    same in pieces, so that a caller can stop when a frame's time is over. A solver carries its
    state from frame to frame until `reset`. It owns its work arrays and those of its phi and
    basis: use one solver per thread, each with its own.

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
    noise_sd : float
        Least standard deviation of the noise of a taxel that the skin states, in the unit of the
        forces (`SkinState.least_sd`); 0, the default: none stated. The caller sets it.

    Raises
    ------
    SolverError
        If the mask does not fit the grid, or phi not the number of taxels.
    """

    #: Its registered name, for messages.
    name: str = "solver"
    n_steps: int = 1
    #: Measurements beyond this could overflow float32 inside the solver, newtons.
    y_max: float = 1e30
    #: Numbers of steps, ascending, that the rate of the frames may choose from; none: it may not.
    paces: tuple[int, ...] = ()
    #: True if `use` lets one solver serve all row subsets of rotating rows.
    rotates: bool = False
    #: Row subsets that frames are measured by in turn; none where the rows are fixed.
    subsets: tuple[Phi, ...] = ()
    #: True if it follows a phi that chooses its rows anew in each frame, whatever phi that is.
    follows_choice: bool = False
    #: True if each measurement has to be one taxel.
    reads_taxels: bool = False
    #: False if the basis states the size of the grid alone.
    uses_basis: bool = True
    #: True if lambda_n weighs an l1 norm: it needs a sparse basis, and returns 0 for measurements
    #: below lambda_n.
    is_l1: bool = False
    #: Range of lambda_n, newtons for a range of 2.5 N, in which it stays within 3 dB of its best at
    #: M = N/3; None: not known. Measured by the study `stability`, as the next one.
    lambdas_n: tuple[float, float] | None = None
    #: Least iterations with which the first frames of a sudden contact lose less than 3 dB.
    least_iterations: int = 0
    #: Warning where each measurement is one taxel; "": none.
    warning_of_samples: str = ""
    #: True if small products by the BLAS take most of its time, which threads of it slow down.
    uses_blas: bool = False
    #: True if it subtracts the mean of noise that the range clips at 0.
    subtracts_bias: bool = False
    #: True if it has compiled loops, which are compiled before the first frame.
    has_loops: bool = False
    #: Factor and power of the error that a residual shows, as of `Uncertainty`; None: none.
    calibrated: tuple[float, float] | None = None
    #: Estimated RMS error of a taxel of the last frame, in the unit of the forces; None where the
    #: solver does not estimate it.
    error: float | None = None
    #: Estimated relative error that all forces share, RMS; 0 where the solver does not estimate it.
    common_error: float = 0.0
    #: False if the last frame is not to be trusted: its estimated error is a large part of its
    #: forces.
    trusted: bool = True
    noise_sd: float = 0.0
    #: Why the last frame that `sparseskin.reconstruct` made is not trusted, "" if it is; and why
    #: each frame of its last call.
    reason: str = ""
    reasons: tuple[str, ...] = ()
    #: What looks at the frames of a solver that is used by itself: a `FaultWatch`, or None.
    watch: Any = None
    #: Phi that the caller made, of which `subsets` are the row subsets.
    measured_by: Phi | None = None
    #: Measurements of the next frame that are not to count, bool (m,); None: all count.
    faulty: Mask | None = None
    #: Noise of the readings, as the skin states it; None where it does not.
    noise_model: NoiseModel | None = None

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
        self.taxels: Indices = shared(np.flatnonzero(mask))
        self._inside: Floats = shared(mask.astype(np.float32))
        #: True between `use` and the frame that it is for.
        self._subset_stated = False
        #: Steps still to do in the current frame; `setup` sets it, `finish` clears it.
        self._steps_left = 0
        if phi.n != self.taxels.size:
            raise SolverError(
                f"solver: phi is for n = {phi.n} taxels; "
                f"the grid of {shape[0]} x {shape[1]} has {self.taxels.size}"
            )

    def __repr__(self) -> str:
        rows, cols = self.mask.shape
        rotating = f", {len(self.subsets)} row subsets" if self.subsets else ""
        return (
            f"<{type(self).__name__} {self.name}: {rows} x {cols}, m = {self.phi.m} of "
            f"{self.phi.n} taxels by {self.phi.kind}{rotating}>"
        )

    def solve(self, y: Floats, warm: Floats | None = None) -> Floats:
        """Reconstruct one frame.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements, newtons.
        warm : ndarray of float32, shape (n_rows, n_cols), optional
            Estimate to start from, newtons; None: the state that the last frame left.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Forces, newtons, at least 0; 0 where no taxel exists. The caller's own.

        Raises
        ------
        SolverError
            If y or warm is of another shape or not finite, y is so large that float32 does not
            hold the result, or the rows rotate and `use` has not stated the row subset of y.
        """
        self._check_subset()
        self.setup(y, warm)
        for _ in range(self.n_steps):
            self.step()
        return self.finish()

    def _check_subset(self) -> None:
        """Raise SolverError if rows rotate and `use` has not stated the row subset of the frame."""
        if len(self.subsets) > 1 and not self._subset_stated:
            raise SolverError(
                f"{self.name}: its {len(self.subsets)} row subsets measure frames in turn; that "
                "of y is not stated: call solver.use(solver.subsets[k % len(solver.subsets)]) "
                "before frame k, or sparseskin.reconstruct(frames, solver)"
            )
        self._subset_stated = False

    @abstractmethod
    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        """Begin a frame; parameters and Raises as in `solve`."""

    @abstractmethod
    def step(self) -> None:
        """Do one step of the current frame.

        Raises
        ------
        SolverError
            If the frame has had all its steps, or none was begun.
        """

    @abstractmethod
    def finish(self) -> Floats:
        """End the frame and return its estimate, as `solve` does."""

    @abstractmethod
    def reset(self) -> None:
        """Forget all earlier frames."""

    def use(self, phi: Phi) -> None:
        """Expect measurements of this row subset of rotating rows in the next frame.

        Raises
        ------
        SolverError
            If the solver was made for another matrix, and can use no other.
        """
        if not self.rotates and phi.fingerprint != self.phi.fingerprint:
            raise SolverError(f"solver: was not made for phi {phi.fingerprint}")
        self._subset_stated = True

    def subtract(self, forces: Floats) -> None:  # noqa: B027
        """Note that the next frames are measured without forces, float32 (n_rows, n_cols), that
        those before had. Solvers without a state of measurements do nothing.
        """

    def use_pace(self, n_steps: int) -> None:
        """Do this many steps in each frame from now on; one of `paces`."""
        self.n_steps = n_steps

    def _count_step(self) -> None:
        """Count a step of the current frame; Raises as in `step`."""
        if not self._steps_left:
            raise SolverError(
                f"{self.name}: no step is left of the frame's {self.n_steps}"
            )
        self._steps_left -= 1

    def _final_forces(self, image: Floats) -> Floats:
        """End the frame; return the forces of its last image, in place, or raise SolverError."""
        self._steps_left = 0
        np.maximum(image, 0, out=image)
        np.multiply(image, self._inside, out=image)
        return self._finite(image)

    def _finite(self, forces: Floats) -> Floats:
        """Return forces that are finite; or forget all frames, and raise SolverError."""
        # The sum of squares is finite if all of them are, unless it overflows.
        energy = np.vdot(forces, forces)
        if math.isfinite(energy) or np.isfinite(forces).all():
            return forces
        self.reset()
        raise SolverError(
            f"{self.name}: the iteration diverged, and starts anew with the next frame: is "
            "phi.lipschitz too small?"
        )

    def _checked_y(self, y: Floats) -> Floats:
        """Return y as contiguous float32, or raise SolverError."""
        return checked_measurements(y, self.phi.m, self.y_max)

    def _checked_warm(self, warm: Floats) -> Floats:
        """Return a warm start as contiguous float32, or raise SolverError."""
        warm = real_floats(warm, "solver: warm", SolverError)
        if warm.shape != self.mask.shape:
            raise SolverError(
                f"solver: the warm start has shape {warm.shape}; expected {self.mask.shape}"
            )
        if not np.isfinite(warm).all():
            raise SolverError("solver: the warm start has values that are not finite")
        return warm


class CountsTiles(Solver):
    """A solver whose frames take as many steps as fit into a time, which is counted in tiles of the
    skin in which something presses: the same number on any host.
    """

    #: Number of tiles of the skin.
    most_tiles: int
    #: Steps of the last frame.
    n_done: int = 0
    #: Tiles that counted in all steps of the last frame.
    n_tiles: int = 0
    #: Arguments of `use_times`.
    times: tuple[int, int] = (0, 0)

    @abstractmethod
    def use_times(self, frame_tiles: int, step_tiles: int) -> None:
        """Choose the steps of each frame from now on, one to `n_steps`, by their time and by that
        of a step without any tile, both counted in that of a tile in a step. 0: all are done.
        """

    @abstractmethod
    def steps_for(self, n_tiles: int) -> tuple[int, int]:
        """Numbers of steps by the formula and of others, in a frame of so many tiles."""


class RotatingSolver(Solver):
    """One solver of any kind for each row subset; each starts from the estimate of the last frame.

    `solvers` are by the fingerprint of their phi; phi is the first row subset.
    """

    rotates = True

    def __init__(
        self,
        solvers: dict[str, Solver],
        phi: Phi,
        basis: Basis,
        mask: Mask | None = None,
    ) -> None:
        super().__init__(phi, basis, mask)
        self._solvers = solvers
        self.name = solvers[phi.fingerprint].name
        self._chosen = solvers[phi.fingerprint]
        self._last: Floats | None = None
        self.n_steps = self._chosen.n_steps

    def use(self, phi: Phi) -> None:
        if phi.fingerprint not in self._solvers:
            raise SolverError(f"solver: was not made for phi {phi.fingerprint}")
        super().use(phi)
        self.phi = phi
        self._chosen = self._solvers[phi.fingerprint]

    def setup(self, y: Floats, warm: Floats | None = None) -> None:
        self._chosen.setup(y, self._last if warm is None else warm)
        self.n_steps = self._chosen.n_steps

    def step(self) -> None:
        self._chosen.step()

    def finish(self) -> Floats:
        # One that raises has diverged: the next frame does not start from an earlier one.
        self._last = None
        forces = self._chosen.finish()
        self._last = forces.copy()
        self.error, self.trusted = estimated_error(self._chosen)
        return forces

    def reset(self) -> None:
        self._last = None
        self.error = None
        self.trusted = True
        self.watch = None
        for solver in self._solvers.values():
            solver.reset()


def solver_class(name: str) -> Callable[..., Any]:
    """The class of a solver by name, or "module:Class". Raises SolverError if there is none."""
    return find_class("solver", name, SOLVERS, SolverError)


def solver_fact(solver: object, name: str) -> Any:
    """An attribute of a solver or its class; that of `Solver` for a user's own without it."""
    return getattr(solver, name, getattr(Solver, name))


def make_solver(
    name: str,
    phi: Phi,
    basis: Basis,
    mask: Mask | None = None,
    *,
    fast: str = "auto",
    **settings: Any,
) -> Solver:
    """Make a solver by name, of fixed rows.

    Parameters and Raises as in `sparseskin.arrays.make_solver`. A class of the user's own is called
    with phi, basis, mask and the settings as keywords.
    """
    for kind, argument, method in (
        ("phi", phi, "forward"),
        ("basis", basis, "synthesis"),
    ):
        if not hasattr(argument, method):
            raise SolverError(
                f"{kind}: got {type(argument).__name__}; expected what make_{kind} returns"
            )
    cls = solver_class(name)
    check_reads(name, cls, phi.kind, type(phi))
    of_phi = phi_fact(phi, "solvers").get(name)
    if of_phi is not None:
        cls = solver_class(of_phi)
    parameters = inspect.signature(cls).parameters
    _check_settings(name, settings, parameters)
    # A wrong word is refused by each solver, one without compiled loops too.
    check_fast(fast)
    if "fast" in parameters:
        settings["fast"] = fast
    try:
        instance = cls(phi=phi, basis=basis, mask=mask, **settings)
    except TypeError as cause:
        raise SolverError(f'solver "{name}" cannot be made: {cause}') from cause
    missing = [member for member in _INTERFACE if not hasattr(instance, member)]
    if missing:
        lacks = ", ".join(missing)
        raise SolverError(f'solver "{name}" is no solver: it lacks {lacks}')
    solver: Solver = instance
    return solver


def _check_settings(
    name: str, settings: Iterable[str], parameters: Mapping[str, inspect.Parameter]
) -> None:
    """Raise SolverError for a setting that the constructor of a solver does not take."""
    takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
    if takes_any:
        return
    # The others are stated by who makes it.
    options = [p for p in parameters if p not in ("phi", "basis", "mask", "fast")]
    for setting in settings:
        if setting not in options:
            fault = f'setting "{setting}" is not known'
            guess = did_you_mean(setting, options)
            raise SolverError(f'solver "{name}": {fault}{guess}')


def checked_measurements(y: Floats, m: int, y_max: float) -> Floats:
    """Return m measurements y as contiguous float32; raise SolverError where one is not finite or
    beyond +-y_max.
    """
    y = real_floats(y, "solver: y", SolverError)
    if y.shape != (m,):
        raise SolverError(f"solver: y has shape {y.shape}; expected ({m},): m = {m}")
    # The sum of squares is found far sooner than the extremes, and is hardly ever as large.
    if np.vdot(y, y) < y_max:
        return y
    is_finite = np.isfinite(y)
    if not is_finite.all():
        bad = int(is_finite.argmin())
        raise SolverError(
            f"solver: measurement {bad} is {y[bad]}; allowed: finite numbers"
        )
    if float(np.abs(y).max()) > y_max:
        raise SolverError(
            f"solver: a measurement is beyond +-{y_max:g}: too large for float32"
        )
    return y


def estimated_error(solver: Solver) -> tuple[float | None, bool]:
    """Return `error` and `trusted` of a solver; None and True for one without these attributes.

    Raises
    ------
    SolverError
        If one of them is no such value.
    """
    error = getattr(solver, "error", None)
    trusted = getattr(solver, "trusted", True)
    if error is not None and not is_real(error, 0.0):
        raise SolverError(
            f"{solver.name}: error = {error!r} is not allowed; allowed: a finite "
            "number, 0 or more; or None"
        )
    if not isinstance(trusted, bool | np.bool_):
        raise SolverError(
            f"{solver.name}: trusted = {trusted!r} is not allowed; allowed: True, False"
        )
    if error is not None:
        error = float(error)
    return error, bool(trusted)


def measured(solver: Solver, forces: Floats, phi: Phi) -> Floats:
    """Return what phi measures of a frame of forces, float32 (n_rows, n_cols): (m,).

    A solver that has a faster way states it as its method `measured`.
    """
    faster_way = getattr(solver, "measured", None)
    if faster_way is None:
        return phi.forward(forces.reshape(-1)[solver.taxels])
    y: Floats = faster_way(forces, phi)[0]
    return y


def check_reads(name: str, solver: object, kind: str, phi: type) -> None:
    """Raise SolverError if a solver cannot use a class of phi."""
    of_phi = phi_fact(phi, "solvers")
    follows = name in of_phi or solver_fact(solver, "follows_choice")
    if phi_fact(phi, "choice") and not follows:
        fault = f'phi "{kind}" reads other rows each frame'
        raise SolverError(f'solver "{name}": {fault}; allowed: {", ".join(of_phi)}')
    if solver_fact(solver, "reads_taxels") and not phi_fact(phi, "samples"):
        allowed = "a phi that reads single taxels, as subsample"
        raise SolverError(
            f'solver "{name}": phi "{kind}" mixes taxels; allowed: {allowed}'
        )


def make_rotating_solver(
    name: str,
    subsets: Sequence[Phi],
    basis: Basis,
    mask: Mask | None = None,
    **settings: Any,
) -> Solver:
    """Make a solver by name for one Phi of fixed rows, or the row subsets of rotating ones.

    Other parameters and Raises as in `make_solver`. `use` of the solver chooses the row subset of
    the next frame; the first one is chosen.
    """
    solver = make_solver(name, subsets[0], basis, mask, **settings)
    if len(subsets) == 1:
        return solver
    # One that does not rotate by itself is made anew for each row subset.
    if not getattr(solver, "rotates", False):
        solvers = {subsets[0].fingerprint: solver}
        for phi in subsets[1:]:
            solvers[phi.fingerprint] = make_solver(name, phi, basis, mask, **settings)
        solver = RotatingSolver(solvers, subsets[0], basis, mask)
    solver.subsets = tuple(subsets)
    return solver


def whole_number(solver: str, name: str, value: Any, low: int, high: int) -> int:
    """Return an integer in low..high, or raise SolverError."""
    if not is_whole(value, low, high):
        raise SolverError(
            f"{solver}: {name} = {value!r} is not allowed; allowed: an integer {low}..{high}"
        )
    return int(value)


def newtons(solver: str, name: str, value: Any) -> float:
    """Return a finite number of newtons, 0 or more, or raise SolverError."""
    if not is_real(value, 0.0):
        raise SolverError(
            f"{solver}: {name} = {value!r} is not allowed; allowed: a finite number of newtons, "
            "0 or more"
        )
    return float(value)
