"""Compression and reconstruction of a stream of frames, one call a frame."""

import warnings
from functools import cached_property
from inspect import signature
from typing import Any

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import is_whole
from sparseskin.messages.reasons import first_reason
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.messages.state import CLIP_SD
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import phi_class, phi_fact
from sparseskin.nodes.compressor.phi.rotation import RATIO
from sparseskin.nodes.errors import (
    PhiError,
    SettingsError,
    SolverError,
    SparseskinError,
)
from sparseskin.nodes.lookup import suggestion
from sparseskin.nodes.numerics.arrays import LARGEST, real_floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.faults.watch import FaultWatch, Noise, solve_watched
from sparseskin.nodes.reconstructor.limits import options_for_range
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.reconstructor.solvers.base import (
    Solver,
    estimated_error,
    make_rotating_solver,
    newtons,
    solver_class,
    solver_fact,
)
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.zero import Zero

from .arrays import Floats, Mask, warn_of_threads

MOST_RANGES = 10.0
"""Largest reading in parts of f_max, chosen: no noise reaches it, counts of a converter do."""
MOST_WAITING = 1024
"""Most frames of which a stream keeps what it found of their readings, chosen."""
_NAMED = ("solver", "basis", "iterations", "lambda_n", "fast")
"""Settings of the reconstructor that a stream takes; others are options of the solver."""


class Stream:
    """Compression and reconstruction of one patch, frame by frame, as a graph does them.

    Frames are counted, so that each is reconstructed by the matrix that measured it. An edge and a
    host in two programs each make a stream with the same arguments: one calls `compress` alone, the
    other `reconstruct` alone. Use a stream in one thread.

    The solver is made with the first frame that is reconstructed, which takes a minute where
    numba first compiles it. A loop in real time reconstructs a frame of zeros before, and calls
    `reset`.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns of the skin.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; by default everywhere.
    phi, ratio, m, rows, block, seed
        Settings of the compressor node, with its defaults: rows rotate where they can.
    preset : str
        "skin" or "paper": settings of the reconstructor node.
    noise_sd : float
        Standard deviation of the readings of an untouched taxel, as they are compressed, newtons;
        0: not known. Noise that is clipped at 0 has 0.58 of its own. A value that is too large
        hides light touches of single taxels.
    sigmas : (float, float), optional
        In its place: those at mid-range and at both ends, before readings are clipped at 0, as a
        skin states them to a graph. They make the estimated error nearer.
    f_max : float
        Upper end of the range of a taxel, newtons.
    tare : int, optional
        Number of first frames that `compress` gets, of the untouched skin, whose median is the
        reading at rest: it is subtracted, and they are measured as 0. 0: readings are forces,
        whatever the untouched skin reads.
    invert : bool
        Readings fall with force: a force is the reading at rest less the reading.
    **settings
        In place of the preset's: solver, basis, iterations, lambda_n, fast; and options of the
        solver by name.

    Attributes
    ----------
    n, m : int
        Number of taxels that exist, and of measurements of a frame.
    error : float or None
        RMS error of a taxel of the last reconstructed frame as the solver estimates it, newtons,
        where it does; None also for measurements that hold nothing of the skin.
    trusted : bool
        False if the frame is not to be acted on, as `reason` states.
    reason : str
        Word of the `messages.Reason`, such as "error" where that error is a large part of the
        forces, or "frozen"; "" if there is none.
    sensed : str
        Word of the `messages.Reason` for which the readings that were compressed last are not to
        be trusted: "rest" where nearly all read a level at first, and `tare` is not stated, or
        while a tare is taken; "sign" where they fall below rest; "clipped" where more than 1 % are
        outside 0..f_max; "" if there is none. A host in another program hands it to `reconstruct`.
        The first two are also warned of, once each, with the argument that answers them.

    Raises
    ------
    SparseskinError
        If an argument is not allowed, or they do not fit.

    Examples
    --------
    >>> import numpy as np, sparseskin
    >>> edge, host = (sparseskin.Stream((16, 16), ratio=4) for _ in range(2))
    >>> for k in range(3):
    ...     y = edge.compress(np.ones((16, 16), np.float32))
    ...     if k != 1:  # frame 1 is lost
    ...         forces = host.reconstruct(y, k)
    >>> y.shape, forces.shape
    ((64,), (16, 16))
    """

    def __init__(
        self,
        shape: tuple[int, int],
        *,
        mask: Mask | None = None,
        phi: str = "sbhe",
        ratio: float = RATIO,
        m: int | None = None,
        rows: str | None = None,
        block: int | None = None,
        seed: int = 0,
        preset: str = "skin",
        noise_sd: float = 0.0,
        sigmas: tuple[float, float] | None = None,
        f_max: float = PAPER_F_MAX_N,
        tare: int | None = None,
        invert: bool = False,
        **settings: Any,
    ) -> None:
        # The skin, and its reading at rest.
        self._skin = _checked_skin(shape, f_max, mask)
        try:
            self._zero = Zero(self._skin, tare, invert)
        except SettingsError as error:
            raise SparseskinError(f"stream: {error}") from error
        if sigmas is not None and np.shape(sigmas) != (2,):
            allowed = "allowed: standard deviations at mid-range and at the ends"
            raise SparseskinError(
                f"stream: sigmas = {sigmas!r} is not allowed; {allowed}"
            )

        # The edge: the matrices that measure frames in turn.
        edge = CompressorSettings(
            phi=phi, ratio=ratio, m=m, rows=rows, block=block, seed=seed
        )
        edge.check()
        if phi_fact(phi_class(phi), "choice"):
            raise PhiError(
                f'stream: phi "{phi}" chooses rows by what it reads, and measurements alone do not '
                "state which; allowed: other kinds, or a graph"
            )
        self._phis = edge.phis(self._skin)
        self.n = self._phis[0].n
        self.m = self._phis[0].m

        # The host: what it knows of the noise, and its settings.
        self._noise_model = None
        if sigmas is not None:
            self._noise_model = NoiseModel(f_max, *sigmas)
            noise_sd = CLIP_SD * min(sigmas)
        self._noise_sd = newtons("stream", "noise_sd", noise_sd)
        self._host = _host_settings(phi, preset, settings)

        self._n_compressed = 0
        self._n_reconstructed = 0
        # Of frames that wait to be reconstructed.
        self._doubts: dict[int, str] = {}
        self.sensed = ""
        self.error: float | None = None
        self.reason = ""
        self.trusted = True

    def __repr__(self) -> str:
        n_rows, n_cols = self._skin.shape
        phi = f"m = {self.m} of {self.n} taxels by {self._phis[0].kind}"
        if len(self._phis) > 1:
            phi += f", {len(self._phis)} row subsets"
        return f"<Stream {n_rows} x {n_cols}: {phi}; solver {self._host.chosen()['solver']}>"

    @cached_property
    def _solver(self) -> Solver:
        """The solver, made when it is first used: an edge needs none."""
        skin = self._skin
        settings = dict(self._host.chosen())
        name = settings.pop("solver")
        basis = make_basis(settings.pop("basis"), *skin.shape)
        if solver_fact(solver_class(name), "uses_blas"):
            warn_of_threads()
        # Weights are stated for the range of the paper.
        options = options_for_range(name, settings, skin.f_max, self._phis[0])
        options["fast"] = self._host.fast
        solver = make_rotating_solver(name, self._phis, basis, skin.mask, **options)
        solver.noise_sd = self._noise_sd
        solver.noise_model = self._noise_model
        return solver

    @cached_property
    def _watch(self) -> FaultWatch:
        """What looks at each frame, as in a graph."""
        noise = Noise(self._skin.f_max, self._noise_sd)
        return FaultWatch(noise, self._skin.shape)

    def compress(self, frame: Floats) -> Floats:
        """Measure the next frame.

        Parameters
        ----------
        frame : ndarray of float32, shape (n_rows, n_cols)
            Readings, newtons.

        Returns
        -------
        ndarray of float32, shape (m,)
            Measurements, newtons.

        Raises
        ------
        SparseskinError
            If the frame has another shape or type, a reading is not finite, or is beyond 10 f_max,
            as counts are where newtons are expected; it is not counted.
        """
        # A frame that is refused is not counted: all checks come first.
        forces = real_floats(frame, "stream: readings", SparseskinError)
        if forces.shape != self._skin.shape:
            expected = f"expected {self._skin.shape}"
            raise SparseskinError(
                f"stream: the frame has shape {forces.shape}; {expected}"
            )
        # Nothing is filled in here: that is a decision of the caller.
        bad = self._skin.exists & ~np.isfinite(forces)
        if bad.any():
            row, col = np.argwhere(bad)[0]
            reads = f"reads {forces[row, col]}; allowed: finite numbers; fill in what is missing"
            raise SparseskinError(f"stream: taxel ({row}, {col}) {reads}")
        # Raw readings of a tared skin have a range of their own.
        if not self._zero.changes_readings:
            self._check_range(forces)
        forces = self._zero.forces(forces)
        self._note_doubt()

        # Row subsets take turns, by the number of the frame.
        phi = self._phis[self._n_compressed % len(self._phis)]
        self._n_compressed += 1
        return phi.forward(forces[self._skin.exists])

    def _check_range(self, forces: Floats) -> None:
        """Raise SparseskinError if readings are far beyond the range."""
        readings = forces[self._skin.exists]
        largest = float(readings[np.abs(readings).argmax()])
        if abs(largest) > MOST_RANGES * self._skin.f_max:
            text = f"a taxel reads {largest:g}, far beyond f_max = {self._skin.f_max:g}"
            raise SparseskinError(
                f"stream: {text}; state f_max in the unit of the readings"
            )
        if abs(largest) > LARGEST:
            allowed = f"allowed: within +-{LARGEST:g}"
            raise SparseskinError(f"stream: a taxel reads {largest:g}; {allowed}")

    def _note_doubt(self) -> None:
        """Keep what is found of the readings of the next frame for its reconstruction."""
        self.sensed = str(self._zero.reason)
        if self.sensed:
            # A host in another program never asks for them: their number is limited.
            self._doubts[self._n_compressed] = self.sensed
            if len(self._doubts) > MOST_WAITING:
                oldest = next(iter(self._doubts))
                del self._doubts[oldest]
        line = self._zero.take_still() or self._zero.doubt.take_line()
        if line:
            warnings.warn(f"stream: {line}", RuntimeWarning, stacklevel=3)

    def reconstruct(self, y: Floats, k: int | None = None, sensed: str = "") -> Floats:
        """Reconstruct a frame, from what the frames before it left.

        Parameters
        ----------
        y : ndarray of float32, shape (m,)
            Measurements, newtons.
        k : int, optional
            Number of the frame among those compressed, from 0: state it where frames may be lost.
            By default the one after the last frame of this call.
        sensed : str
            That of the stream that compressed the frame, where it is another than this one.

        Returns
        -------
        ndarray of float32, shape (n_rows, n_cols)
            Forces, newtons, 0 or more; 0 where no taxel exists.

        Raises
        ------
        SolverError
            If `k` is not allowed, or the measurements have another shape or are not finite; such
            measurements count as a frame.
        """
        if k is None:
            k = self._n_reconstructed
        if not is_whole(k, 0):
            allowed = "allowed: a whole number, 0 or more"
            raise SolverError(f"stream: k = {k!r} is not allowed; {allowed}")
        self._n_reconstructed = int(k) + 1

        phi = self._phis[k % len(self._phis)]
        if len(self._phis) > 1:
            self._solver.use(phi)
        # As in a graph: faulty measurements are looked for, too.
        verdict = solve_watched(self._solver, self._watch, phi, y)
        self.error = None
        if verdict.is_solved:
            self.error, _ = estimated_error(self._solver)

        # What the edge found of the readings goes on with the frame.
        doubt = self._doubts.pop(int(k), sensed)
        self.reason = str(first_reason(verdict.reason, doubt))
        self.trusted = not self.reason
        return verdict.forces

    def reset(self) -> None:
        """Forget all frames, and the reading at rest: the next one is number 0."""
        self._zero.reset()
        self._doubts.clear()
        self.sensed = ""
        self._n_compressed = 0
        self._n_reconstructed = 0
        self.error = None
        self.reason = ""
        self.trusted = True
        # The solver of an edge was never made.
        if "_solver" in vars(self):
            self._solver.reset()
            self._watch.reset()


def _checked_skin(shape: tuple[int, int], f_max: float, mask: Mask | None) -> Skin:
    is_pair = np.shape(shape) == (2,)
    if not is_pair or not all(is_whole(side, 1, MAX_SIDE) for side in shape):
        allowed = f"allowed: (n_rows, n_cols), whole numbers 1..{MAX_SIDE}"
        raise SparseskinError(f"stream: shape = {shape!r} is not allowed; {allowed}")
    if mask is not None:
        # The caller's own may change.
        mask = np.array(mask)
    try:
        return Skin(*shape, f_max, mask=mask)
    except MessageError as error:
        raise SparseskinError(f"stream: {error}") from error


def _host_settings(
    phi: str, preset: str, settings: dict[str, Any]
) -> ReconstructorSettings:
    """Settings of the reconstructor: those named here, and options of the solver."""
    # Other names are options of the solver.
    stated = {name: value for name, value in settings.items() if name in _NAMED}
    options = {name: value for name, value in settings.items() if name not in _NAMED}
    # What a user's own solver takes is not known here.
    if ":" not in str(stated.get("solver")):
        # A misspelled argument would pass for an option of the solver.
        known_names = [*_NAMED, *signature(Stream).parameters]
        known_names.remove("settings")
        for name in options:
            hint = suggestion(name, known_names)
            if hint:
                raise SparseskinError(f"stream: {name}: is not known{hint}")
    host = ReconstructorSettings(phi=phi, preset=preset, options=options, **stated)
    host.check()
    host.check_phi(phi)
    return host
