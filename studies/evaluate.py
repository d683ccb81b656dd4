"""Evaluation of solvers on frames: measure, reconstruct, compare with the true forces."""

from __future__ import annotations

import inspect
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION, PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.acts import ActsPhi, ActsSearch, force_threshold
from sparseskin.nodes.compressor.phi.adaptive import AdaptiveChoice, AdaptivePhi, layout
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import block_and_rule, row_subsets, rows_and_m
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import find_class
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import SOLVERS, Solver, make_rotating_solver
from sparseskin.nodes.sensor.noise import NoiseModel

#: Solvers of sums of taxels: all but those that need a phi which chooses its taxels in each frame.
SUM_SOLVERS = tuple(
    name
    for name in SOLVERS
    if not getattr(find_class("solver", name, SOLVERS, SolverError), "follows_choice", False)
)


def settings_of(solver: str) -> Mapping[str, inspect.Parameter]:
    """Settings that a solver takes, by name."""
    return inspect.signature(find_class("solver", solver, SOLVERS, SolverError)).parameters


class Solved(NamedTuple):
    """A reconstructed frame.

    Attributes
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols)
        Newtons.
    wall_s, cpu_s : float
        Duration of the solve by the clock, and processor time of its thread.
    n_steps : int
        Iterations.
    """

    forces: Floats
    wall_s: float = 0.0
    cpu_s: float = 0.0
    n_steps: int = 0


class Estimator(Protocol):
    """Estimate of a frame's true forces from what its taxels read."""

    def reconstruct(self, taxels: Floats) -> Solved:
        """Estimate one frame; taxels: float32, shape (n_rows, n_cols), newtons."""


class Reading:
    """Estimator of no method: the taxels as they are read, forces in a dead zone set to 0.

    Parameters
    ----------
    dead_zone_n : float
        Readings below it are set to 0, newtons.
    """

    def __init__(self, dead_zone_n: float = 0.0) -> None:
        self.dead_zone_n = dead_zone_n

    def reconstruct(self, taxels: Floats) -> Solved:
        """Return the readings; see `Estimator`."""
        if not self.dead_zone_n:
            return Solved(taxels)
        return Solved(np.where(taxels < self.dead_zone_n, np.float32(0), taxels))


class Method:
    """Estimator of a measurement matrix and a solver, frame after frame.

    Parameters
    ----------
    solver : Solver
        Made for the first of `phis`; with several of them, one whose `use` takes each.
    phis : sequence of Phi
        Matrices that frames take in turn: one where rows are fixed.
    f_max_n : float
        Upper end of the taxels' range, newtons; only phi "acts" needs it.

    Attributes
    ----------
    n_code_bytes : int
        Size of the last frame's choice of rows; 0 but for phi "adaptive".
    """

    def __init__(self, solver: Solver, phis: Sequence[Phi], f_max_n: float = PAPER_F_MAX_N) -> None:
        self.solver = solver
        self.phis = phis
        self.n_frames = 0
        self.n_code_bytes = 0
        self._search: ActsSearch | None = None
        self._choice: AdaptiveChoice | None = None
        if isinstance(solver.phi, AdaptivePhi):
            self._choice = AdaptiveChoice(solver.phi)
        if isinstance(solver.phi, ActsPhi):
            noise = NoiseModel.for_range(f_max_n)
            threshold = force_threshold(noise.sigma_end, noise.f_max)
            self._search = ActsSearch(solver.mask, solver.phi.m, threshold)

    @property
    def phi(self) -> Phi:
        """Matrix of the next frame."""
        return self.phis[self.n_frames % len(self.phis)]

    def reset(self) -> None:
        """Forget all frames, and begin with the first matrix again."""
        self.solver.reset()
        self.n_frames = 0
        if self._choice is not None and isinstance(self.phi, AdaptivePhi):
            self._choice = AdaptiveChoice(self.phi)

    def measure(self, taxels: Floats) -> Floats:
        """Measurements of the next frame: float32, shape (n_rows, n_cols) to (m,)."""
        x, phi = taxels.reshape(-1)[self.solver.taxels], self.phi
        if self._search is not None and isinstance(phi, ActsPhi):
            phi.choose(self._search.places(x.take))
        if self._choice is not None and isinstance(phi, AdaptivePhi):
            y = self._choice.measure(phi.tree.analysis(x).take)
            self.n_code_bytes = phi.tree.coded(phi.chosen).size
            return y
        return phi.forward(x)

    def solve(self, y: Floats) -> Solved:
        """Reconstruct the next frame from measurements, shape (m,); Raises as `Solver.solve`."""
        phi = self.phi
        self.n_frames += 1
        begin_s, cpu_begin_s = time.perf_counter(), time.thread_time()
        if len(self.phis) > 1:
            self.solver.use(phi)
        forces = self.solver.solve(y)
        cpu_s, wall_s = time.thread_time() - cpu_begin_s, time.perf_counter() - begin_s
        return Solved(forces, wall_s, cpu_s, self.solver.n_steps)

    def reconstruct(self, taxels: Floats) -> Solved:
        """Measure and reconstruct the next frame; see `Estimator`."""
        return self.solve(self.measure(taxels))


class Alone:
    """Estimator of a method that forgets all earlier frames before each one.

    Parameters
    ----------
    method : Method
    """

    def __init__(self, method: Method) -> None:
        self.method = method

    def reconstruct(self, taxels: Floats) -> Solved:
        """Measure and reconstruct a frame as if it were the first; see `Estimator`."""
        self.method.reset()
        return self.method.reconstruct(taxels)


def phis_at(n: int, ratio: float, rows: str, seed: int, kind: str = "sbhe") -> list[Phi]:
    """Matrices that frames take in turn at a ratio N / M.

    M is rounded down where rows are fixed, and up where they rotate, so that all row subsets
    together hold every row. `rows` "paper" are the paper's, fixed.
    """
    kept, m = rows_and_m(kind, n, rows=rows, ratio=ratio)
    phi = make_phi(kind, n=n, m=m, seed=seed, **block_and_rule(rows, None))
    return row_subsets(phi, kept)


def make_method(
    chosen: Mapping[str, Any],
    shape: tuple[int, int],
    ratio: float,
    seed: int,
    *,
    rows: str,
    phi: str = "sbhe",
    mask: Mask | None = None,
    f_max_n: float = PAPER_F_MAX_N,
    sigma_end: float = 0.0,
) -> Method:
    """Make a method by the names of its parts.

    Parameters
    ----------
    chosen : mapping
        solver, basis ("haar" where absent) and the solver's settings, as in `PRESETS`.
    shape : tuple of int
        Rows and columns of the skin.
    ratio : float
        N / M.
    seed : int
        Of Phi.
    rows, phi : str
        "fixed" or "rotating" rows; kind of Phi.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists. None: everywhere.
    f_max_n : float
        Upper end of the taxels' range, newtons. Settings are used as stated, whatever the range.
    sigma_end : float
        Standard deviation of an untouched taxel's noise, newtons, as the skin states it to phi
        "adaptive"; 0 if it is not known.

    Raises
    ------
    PhiError, SolverError
        If a name or setting is unknown or not allowed, or the parts do not fit.
    """
    settings = {key: value for key, value in chosen.items() if key not in ("solver", "basis")}
    n = shape[0] * shape[1] if mask is None else int(np.count_nonzero(mask))
    phis = phis_at(n, ratio, rows, seed, phi)
    layout(phis[0], np.ones(shape, dtype=np.bool_) if mask is None else mask, sigma_end, f_max_n)
    basis = make_basis(chosen.get("basis", "haar"), *shape)
    solver = make_rotating_solver(chosen["solver"], phis, basis, mask, **settings)
    return Method(solver, phis, f_max_n)


def in_contact(truth: Floats, f_max_n: float) -> bool:
    """True if some taxel bears more than 0.4 % of the range, 0.01 N of 2.5 N."""
    return bool(truth.max() > CONTACT_FRACTION * f_max_n)


class Scores:
    """Error and solve time of each frame of one estimator.

    Parameters
    ----------
    f_max_n : float
        Upper end of the range, peak of the PSNR, newtons.

    Attributes
    ----------
    psnr_db : list of float
        Of each frame.
    contact : list of bool
        True where the frame is in contact.
    touched : list of (float, int)
        Of each contact frame: mean squared error over the touched taxels (above 0.4 % of the
        range) in newtons squared, and their number.
    wall_s, cpu_s, n_steps : list
        Of each frame, as in `Solved`.
    """

    def __init__(self, f_max_n: float = PAPER_F_MAX_N) -> None:
        self.f_max_n = f_max_n
        self.psnr_db: list[float] = []
        self.contact: list[bool] = []
        self.touched: list[tuple[float, int]] = []
        self.wall_s: list[float] = []
        self.cpu_s: list[float] = []
        self.n_steps: list[int] = []

    def add(self, solved: Solved, truth: Floats) -> None:
        """Count one frame; truth: float32, shape (n_rows, n_cols), newtons."""
        error = solved.forces - truth
        self.psnr_db.append(psnr_db(error, self.f_max_n))
        self.contact.append(in_contact(truth, self.f_max_n))
        self.wall_s.append(solved.wall_s)
        self.cpu_s.append(solved.cpu_s)
        self.n_steps.append(solved.n_steps)
        if self.contact[-1]:
            on_touched = error[truth > CONTACT_FRACTION * self.f_max_n]
            squared = float(np.mean(np.square(on_touched, dtype=np.float64)))
            self.touched.append((squared, on_touched.size))

    @property
    def contact_db(self) -> list[float]:
        """PSNR of each contact frame, dB."""
        return [psnr for psnr, touches in zip(self.psnr_db, self.contact, strict=True) if touches]

    @property
    def mean_db(self) -> float:
        """Mean PSNR over the contact frames, dB."""
        return float(np.mean(self.contact_db))

    @property
    def min_db(self) -> float:
        """Least PSNR of a contact frame, dB."""
        return float(np.min(self.contact_db))

    def wall_ms(self, percent: float) -> float:
        """Percentile of the solve times by the clock, ms."""
        return float(np.percentile(self.wall_s, percent)) * 1e3

    def cpu_ms(self, percent: float) -> float:
        """Percentile of the processor times of the solves, ms."""
        return float(np.percentile(self.cpu_s, percent)) * 1e3


def evaluate(
    estimators: Mapping[str, Estimator],
    frames: Iterable[tuple[Floats, Floats]],
    f_max_n: float = PAPER_F_MAX_N,
) -> dict[str, Scores]:
    """Run estimators side by side over the same frames.

    Parameters
    ----------
    estimators : mapping of str to Estimator
        By name; those that carry something from frame to frame go on from what they have.
    frames : iterable of (truth, taxels)
        float32, shape (n_rows, n_cols), newtons; each read once.
    f_max_n : float
        Upper end of the range, newtons.

    Returns
    -------
    dict of str to Scores
        By the same names.
    """
    scores = {name: Scores(f_max_n) for name in estimators}
    for truth, taxels in frames:
        for name, estimator in estimators.items():
            scores[name].add(estimator.reconstruct(taxels), truth)
    return scores


def evaluate_one(
    estimator: Estimator, frames: Iterable[tuple[Floats, Floats]], f_max_n: float = PAPER_F_MAX_N
) -> Scores:
    """Run one estimator over frames; see `evaluate`."""
    return evaluate({"": estimator}, frames, f_max_n)[""]
