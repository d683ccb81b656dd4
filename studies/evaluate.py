"""Evaluation of estimators on frames: measure, reconstruct, compare with the true forces."""

from __future__ import annotations

import inspect
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION, PAPER_F_MAX_N, Skin
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.errors import PhiError, SparseskinError
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.estimates.uncertainty import Spread
from sparseskin.nodes.reconstructor.solvers.base import (
    Solver,
    estimated_error,
    make_rotating_solver,
    solver_class,
)
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.touch import in_contact

VARIATION = "sparseskin.studies.baselines.total_variation:TvSolver"
"""Name for `make_solver` of total variation."""
SUM_SOLVERS = {
    "skin": "skin",
    "fista": "fista",
    "tv": VARIATION,
}
"""Name for `make_solver` of each solver of sums of taxels, by its label."""


def settings_of(solver: str) -> Mapping[str, inspect.Parameter]:
    """Settings that a solver takes, by name."""
    return inspect.signature(solver_class(solver)).parameters


VALUE_BYTES = 2
"""Bytes of a value that is sent, measurement or reading. Chosen: sensors have 8 to 16 bits."""
LOADED = 0.1
UNTOUCHED = 0.01
GHOST = 0.05
"""Parts of the 95th percentiles of a recording. A frame is loaded whose norm is above the first
part of that of norms; below it a relative error is one of the sensor's offset and noise. A frame is
untouched whose total is below the second part of that of totals, and a reconstruction of it above
the third is a ghost. Chosen."""
VANISHED = 0.9
WRONG = 0.5
POOR = 0.25
RIGHT = 0.1
"""Relative errors: from the first on a contact has vanished (1 is that of an estimate of 0); above
the second a frame should be marked as not to be trusted, above the third it may be, below the last
it should not. Chosen."""
CLOSE = 1.5
"""Factor of the true error within which an estimate is close. Chosen."""
BAND = 1.645
"""Half width of the band that holds 90 % of normal errors, in their deviations. Derived."""


class Solved(NamedTuple):
    """A reconstructed frame: forces, float32, shape (n_rows, n_cols), newtons; duration of the
    solve by the clock, and processor time of its thread; iterations; bytes that the edge sends; and
    where the solver estimates them, the RMS error of a taxel in newtons, True if the frame is not
    to be trusted, and the relative error that all forces share.
    """

    forces: Floats
    wall_s: float = 0.0
    cpu_s: float = 0.0
    n_steps: int = 0
    n_bytes: float = 0.0
    error: float | None = None
    flagged: bool | None = None
    common_error: float = 0.0


class Estimator(Protocol):
    """Estimate of a frame's true forces from what its taxels read."""

    def reconstruct(self, taxels: Floats) -> Solved:
        """Estimate one frame; taxels: float32, shape (n_rows, n_cols), newtons."""


class Reading:
    """Estimator of no method: the taxels as they are read, those below a dead zone set to 0."""

    def __init__(self, dead_zone_n: float = 0.0) -> None:
        self.dead_zone_n = dead_zone_n

    def reconstruct(self, taxels: Floats) -> Solved:
        """Return the readings; see `Estimator`."""
        return Solved(np.where(taxels < self.dead_zone_n, np.float32(0), taxels))


class Method:
    """Estimator of a measurement matrix and a solver, frame after frame. `phis`: matrices that
    frames take in turn, for the first of which the solver was made. `bits`: those of a measurement;
    None: float32.
    """

    def __init__(self, solver: Solver, phis: Sequence[Phi]) -> None:
        self.solver = solver
        self.phis = phis
        self.bits: int | None = None
        self.n_frames = 0
        self._n_code_bytes = 0
        self.reset()

    @property
    def phi(self) -> Phi:
        """Matrix of the next frame."""
        return self.phis[self.n_frames % len(self.phis)]

    def reset(self) -> None:
        """Forget all frames, and begin with the first matrix again."""
        self.solver.reset()
        self.n_frames = 0
        self.phi.forget()

    def measure(self, taxels: Floats) -> Floats:
        """Measurements of the next frame: float32, shape (n_rows, n_cols) to (m,)."""
        x = taxels.reshape(-1)[self.solver.taxels]
        phi = self.phi
        y, code = phi.measure(x)
        self._n_code_bytes = 0 if code is None else code.size
        return y

    def solve(self, y: Floats) -> Solved:
        """Reconstruct the next frame from measurements, shape (m,); Raises as `Solver.solve`."""
        phi = self.phi
        self.n_frames += 1
        begin_s = time.perf_counter()
        cpu_begin_s = time.thread_time()
        if len(self.phis) > 1:
            self.solver.use(phi)
        forces = self.solver.solve(y)
        cpu_s = time.thread_time() - cpu_begin_s
        wall_s = time.perf_counter() - begin_s
        error, trusted = estimated_error(self.solver)
        return Solved(
            forces,
            wall_s,
            cpu_s,
            self.solver.n_steps,
            n_bytes=VALUE_BYTES * phi.m + self._n_code_bytes,
            error=error,
            # A solver without an estimate states nothing of trusted frames.
            flagged=None if error is None and trusted else not trusted,
            common_error=self.solver.common_error,
        )

    def reconstruct(self, taxels: Floats) -> Solved:
        """Measure and reconstruct the next frame, rounded to `bits`; see `Estimator`."""
        y = self.measure(taxels)
        if self.bits is not None:
            y = np.asarray(quantised(y, self.bits))
        return self.solve(y)


class Alone:
    """Estimator of a method that forgets all earlier frames before each one."""

    def __init__(self, method: Method) -> None:
        self.method = method

    def reconstruct(self, taxels: Floats) -> Solved:
        """Measure and reconstruct a frame as if it were the first; see `Estimator`."""
        self.method.reset()
        return self.method.reconstruct(taxels)


def make_method(
    chosen: Mapping[str, Any],
    shape: tuple[int, int],
    ratio: float,
    seed: int,
    *,
    mask: Mask | None = None,
    f_max_n: float = PAPER_F_MAX_N,
    sigma_end: float = 0.0,
    **how: Any,
) -> Method:
    """Make a method by the names of its parts.

    `chosen`: solver, basis ("haar" where absent) and the solver's settings, as in `PRESETS`;
    `mask`: True where a taxel exists (None: everywhere); `ratio`, `seed`, `how`: settings of a
    compressor. `f_max_n`, the upper end of the range, and `sigma_end`, the standard deviation of an
    untouched taxel's noise (0: not known), newtons, are for phi "adaptive" and the estimated error:
    settings are used as stated. Raises SettingsError, PhiError or SolverError if a name or setting
    is unknown or not allowed, or the parts do not fit.
    """
    settings = dict(chosen)
    name = settings.pop("solver")
    basis = make_basis(settings.pop("basis", "haar"), *shape)
    skin = Skin(*shape, f_max_n, mask=mask)
    phis = CompressorSettings(
        ratio=ratio,
        seed=seed,
        **how,
    ).phis(skin, sigma_end)
    solver = make_rotating_solver(name, phis, basis, mask, **settings)
    # The noise at mid-range, as it is to that at the ends in the paper.
    if sigma_end:
        paper = NoiseModel()
        sigma_mid = min(f_max_n, sigma_end * paper.sigma_mid / paper.sigma_end)
        solver.noise_model = NoiseModel(f_max_n, sigma_mid, sigma_end)
    return Method(solver, phis)


def values_that_fit(kind: str, mask: Mask, m: int) -> int:
    """Number of measurements by a kind of Phi that fit, with the longest code of their rows, into
    the bytes of m values; at least 1. Raises PhiError as `make_phi`.
    """
    n = int(np.count_nonzero(mask))
    for k in range(m, 1, -1):
        try:
            phi = make_phi(kind, n, k, seed=0)
        except PhiError:
            # This kind needs more measurements.
            break
        phi.lay_out(mask)
        if VALUE_BYTES * k + phi.most_code_bytes <= VALUE_BYTES * m:
            return k
    return 1


@dataclass
class Scores:
    """Error and solve time of each frame of one estimator.

    `f_max_n`: upper end of the range, peak of the PSNR, newtons; `mask`: True where a taxel exists
    (None: everywhere); `norm`, `total`: 95th percentiles of the norms and totals of a recording's
    frames (0: a frame is loaded where it is in contact, and none is untouched). `refused`: reason
    for which the estimator was ended, or "".
    """

    f_max_n: float = PAPER_F_MAX_N
    mask: Mask | None = None
    norm: float = 0.0
    total: float = 0.0
    # Of each frame: PSNR, dB; True where it is in contact, or loaded (`LOADED`).
    psnr_db: list[float] = field(default_factory=list)
    contact: list[bool] = field(default_factory=list)
    # Of each contact frame: mean squared error over the touched taxels (above 0.4 % of the range),
    # newtons squared, and their number; error over the norm of the truth; estimated over true RMS
    # error, where there is an estimate.
    touched: list[tuple[float, int]] = field(default_factory=list)
    relative: list[float] = field(default_factory=list)
    estimates: list[float] = field(default_factory=list)
    # Of each of these: part of the touched taxels whose true force is within its band of 90 %, and
    # within that of the true RMS error in place of the estimated one.
    in_band: list[float] = field(default_factory=list)
    in_true_band: list[float] = field(default_factory=list)
    # Of each untouched frame: True if its reconstruction is a ghost (`GHOST`).
    ghosts: list[bool] = field(default_factory=list)
    # Of each frame with an estimate: True if it is marked; its relative error, NaN without contact.
    flags: list[tuple[bool, float]] = field(default_factory=list)
    # Of each frame, as in `Solved`.
    wall_s: list[float] = field(default_factory=list)
    cpu_s: list[float] = field(default_factory=list)
    n_steps: list[int] = field(default_factory=list)
    n_bytes: list[float] = field(default_factory=list)
    refused: str = ""

    def add(self, solved: Solved, truth: Floats) -> None:
        """Count one frame; truth: float32, shape (n_rows, n_cols), newtons."""
        error = solved.forces - truth
        off, norm = (float(np.linalg.norm(self._taxels(x))) for x in (error, truth))
        contact = in_contact(truth, self.f_max_n)
        # In a recording the offset of the sensor may pass for a contact.
        if self.norm:
            contact = norm > LOADED * self.norm
        self.psnr_db.append(psnr_db(error, self.f_max_n))
        self.contact.append(contact)
        self.wall_s.append(solved.wall_s)
        self.cpu_s.append(solved.cpu_s)
        self.n_steps.append(solved.n_steps)
        self.n_bytes.append(solved.n_bytes)
        if solved.flagged is not None:
            self.flags.append((solved.flagged, off / norm if contact else math.nan))
        if contact:
            is_touched = truth > CONTACT_FRACTION * self.f_max_n
            on_touched = error[is_touched].astype(np.float64)
            if on_touched.size:
                self.touched.append((float(np.mean(on_touched**2)), on_touched.size))
            self.relative.append(off / norm)
            if solved.error is not None and off:
                n = truth.size if self.mask is None else np.count_nonzero(self.mask)
                rms = off / math.sqrt(n)
                self.estimates.append(solved.error / rms)
                self.in_band += self._in_band(solved.forces, solved.error, truth)
                self.in_true_band += self._in_band(solved.forces, rms, truth)
        if self.total and float(self._taxels(truth).sum()) <= UNTOUCHED * self.total:
            total = float(self._taxels(solved.forces).sum())
            self.ghosts.append(total > GHOST * self.total)

    def _in_band(self, forces: Floats, error: float, truth: Floats) -> list[float]:
        """Part of the touched taxels whose true force is within the band of an RMS error; none if
        nothing touches.
        """
        is_touched = truth > CONTACT_FRACTION * self.f_max_n
        if not is_touched.any():
            return []
        exists = (
            np.ones(truth.shape, dtype=np.bool_) if self.mask is None else self.mask
        )
        is_held = np.abs(forces - truth) <= BAND * Spread(exists).deviations(
            forces, error
        )
        return [float(np.mean(is_held, where=is_touched))]

    def _taxels(self, image: Floats) -> Doubles:
        """Values of the taxels that exist."""
        if self.mask is not None:
            image = image[self.mask]
        values: Doubles = image.astype(np.float64)
        return values

    @property
    def contact_db(self) -> list[float]:
        """PSNR of each contact frame, dB."""
        pairs = zip(self.psnr_db, self.contact, strict=True)
        return [psnr for psnr, touches in pairs if touches]


def evaluate(
    estimators: Mapping[str, Estimator],
    frames: Iterable[tuple[Floats, Floats]],
    scores: Mapping[str, Scores] | None = None,
    unscored: int = 0,
) -> Mapping[str, Scores]:
    """Run estimators side by side over the same frames, and return scores by the same names.

    `frames` are (truth, taxels): float32, shape (n_rows, n_cols), newtons; each is read once, the
    first `unscored` are not counted. Estimators go on from what they have; one that raises a
    SparseskinError is ended, and its scores state the reason. `scores` are continued.
    """
    scores = scores if scores is not None else {name: Scores() for name in estimators}
    for k, (truth, taxels) in enumerate(frames):
        for name, estimator in estimators.items():
            if scores[name].refused:
                continue
            try:
                solved = estimator.reconstruct(taxels)
            except SparseskinError as error:
                scores[name].refused = str(error)
                continue
            if k >= unscored:
                scores[name].add(solved, truth)
    return scores
