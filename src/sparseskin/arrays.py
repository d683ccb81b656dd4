"""Compression, reconstruction, scenes, launch files and recordings on arrays."""

import os
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.messages import (
    Contacts,
    Labels,
    Measurements,
    Message,
    Reconstruction,
    Taxels,
    Truth,
)
from sparseskin.messages.frames import Frames, values_alone
from sparseskin.messages.ranges import is_whole
from sparseskin.messages.reasons import first_reason
from sparseskin.messages.skin import Skin
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.phi.base import Phi, phi_fact
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import (
    PhiError,
    SettingsError,
    SolverError,
    SparseskinError,
)
from sparseskin.nodes.monitor.metrics import psnr_db as psnr_of_error
from sparseskin.nodes.numerics.arrays import LARGEST, real_floats
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.faults.watch import solve_watched, watch_of
from sparseskin.nodes.reconstructor.solvers.base import (
    Solver,
    make_rotating_solver,
    newtons,
    solver_fact,
)
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.zero import Zero

Floats = npt.NDArray[np.float32]
Mask = npt.NDArray[np.bool_]

WITHIN = f"numbers within +-{LARGEST:g}"
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
"""Variables by which a user states the number of threads of OpenBLAS."""


@checked(PhiError)
def compress(
    forces: Floats,
    phi: Phi,
    mask: Mask | None = None,
    *,
    rows: str | None = None,
    tare: int | None = None,
    invert: bool = False,
) -> Floats:
    """Measure frames of taxels: y = Phi x.

    A level that nearly all taxels read at first, and readings that fall below rest, are warned of,
    once a call, with the argument that answers it. `phi.reasons` states of each frame why it is not
    to be trusted, "" if it is; what a solver of the same `phi` reconstructs of it is not, either.

    Parameters
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols) or (k, n_rows, n_cols)
        Readings, newtons.
    phi : Phi
        Measurement matrix, for as many taxels as exist.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; by default everywhere.
    rows : str, optional
        "fixed": `phi` measures all frames. "rotating": its row subsets measure them in turn, the
        first one the first frame. By default rotating where they can (phi sbhe or subsample, m in
        n / 64 .. n - 1), as in the nodes. Make the solver with the same `rows`.
    tare, invert
        As of `Stream`: `tare` first frames of the k give the reading at rest; 0: readings are
        forces, whatever the untouched skin reads.

    Returns
    -------
    ndarray of float32, shape (m,) or (k, m)
        Measurements, newtons.

    Raises
    ------
    PhiError
        If forces or mask have another shape or type, a force is not finite, the number of existing
        taxels is not `phi.n`, `phi` measured another grid before, `rows` is neither, the rows of
        `phi` cannot rotate, `phi` chooses them in each frame, or there are fewer frames than those
        of the tare.

    Examples
    --------
    >>> import numpy as np, sparseskin
    >>> phi = sparseskin.make_phi("sbhe", n=256, m=85, seed=0)
    >>> sparseskin.compress(np.ones((16, 16), np.float32), phi).shape
    (85,)
    """
    _check_measurable(forces, phi)
    forces = real_floats(forces, "compress: forces", PhiError)
    if forces.ndim not in (2, 3):
        expected = "expected (n_rows, n_cols) or (k, n_rows, n_cols)"
        raise PhiError(f"compress: forces: shape {forces.shape}; {expected}")
    exists = _exists(forces.shape[-2:], mask)
    n = np.count_nonzero(exists)
    if n != phi.n:
        raise PhiError(
            f"compress: {n} taxels of {exists.shape} exist; {phi} is for {phi.n}"
        )
    # The solver of this phi must reconstruct the same grid.
    _keep_grid(phi, exists.shape)
    # Cells where no taxel exists may hold anything.
    is_wrong = exists & ~(np.abs(forces) <= LARGEST)
    if is_wrong.any():
        place = tuple(np.argwhere(is_wrong)[0].tolist())
        reads = f"forces{list(place)} is {forces[place]:g}"
        raise PhiError(f"compress: {reads}; allowed: {WITHIN}")

    frames = _zeroed(forces.reshape(-1, *exists.shape), exists, phi, tare, invert)
    x = frames.reshape(forces.shape)[..., exists]
    subsets = row_subsets(phi, rows)
    if x.ndim == 1:
        return subsets[0].forward(x)
    y = np.empty((len(x), phi.m), dtype=np.float32)
    for k, subset in enumerate(subsets):
        in_turn = slice(k, None, len(subsets))
        y[in_turn] = subset.forward(x[in_turn])
    return y


def _check_measurable(forces: Floats, phi: Phi) -> None:
    """Raise PhiError if phi is no matrix for frames alone, or forces are counts."""
    if not hasattr(phi, "forward"):
        raise PhiError(f"phi: got {type(phi).__name__}; expected what make_phi returns")
    if phi_fact(phi, "choice"):
        raise PhiError(
            f'compress: phi "{phi.kind}" chooses rows by what it reads, and measurements alone do '
            "not state which; allowed: other kinds, or a graph"
        )
    if np.issubdtype(getattr(forces, "dtype", float), np.integer):
        newton = "newtons, as of float32"
        allowed = f"{newton} (counts become newtons by sparseskin calibrate)"
        raise PhiError(f"compress: forces: type {forces.dtype}; allowed: {allowed}")


def _exists(shape: tuple[int, ...], mask: Mask | None) -> Mask:
    """True where a taxel exists, by a mask that is checked."""
    if mask is None:
        return np.ones(shape, dtype=np.bool_)
    exists = np.asarray(mask)
    if exists.shape != shape or exists.dtype != np.bool_:
        got = f"{exists.dtype} of shape {exists.shape}"
        raise PhiError(f"compress: the mask is {got}; expected bool of shape {shape}")
    return exists


def _zeroed(
    frames: Floats, exists: Mask, phi: Phi, tare: int | None, invert: bool
) -> Floats:
    """Forces of readings, float32 (k, n_rows, n_cols), by tare and sign; warn of what is found of
    them, and note on `phi` what is found of each.
    """
    if len(frames) < (tare or 0):
        raise PhiError(f"compress: tare = {tare}: there are {len(frames)} frames")
    readings = frames[:, exists]
    # The range is not stated: the largest reading stands for it.
    f_max = float(np.abs(readings).max(initial=0.0)) or 1.0
    n_rows, n_cols = exists.shape
    skin = Skin(n_rows, n_cols, f_max, mask=None if exists.all() else exists)
    try:
        zero = Zero(skin, tare, invert)
    except SettingsError as error:
        raise PhiError(f"compress: {error}") from error

    forces = frames.copy() if zero.changes_readings else frames
    can_fall = zero.changes_readings or bool((readings < 0).any())
    # Once nothing more can be found out, frames are forces as they are.
    reasons = [""] * len(frames)
    for k, frame in enumerate(frames):
        if zero.doubt.is_settled and not can_fall:
            break
        forces[k] = zero.forces(frame)
        reasons[k] = str(zero.reason)
    phi.reasons = tuple(reasons)

    lines = [zero.take_still()]
    # A frame alone may show a level, but not whether it stays.
    if len(frames) > 1:
        lines.append(zero.doubt.line)
    for line in filter(None, lines):
        warnings.warn(f"compress: {line}", RuntimeWarning, stacklevel=4)
    return forces


def _keep_grid(phi: Phi, shape: tuple[int, ...]) -> None:
    """Note the grid that a phi measures, or raise PhiError if it is another than before."""
    grid = getattr(phi, "grid", None) or shape
    if grid != shape:
        raise PhiError(
            f"{phi} measures frames of {grid}, not of {shape}; make one for each grid"
        )
    phi.grid = (shape[0], shape[1])


@checked(SolverError)
def make_solver(
    name: str,
    phi: Phi,
    basis: Basis,
    mask: Mask | None = None,
    *,
    fast: str = "auto",
    rows: str | None = None,
    **settings: Any,
) -> Solver:
    """Make a solver by name.

    Parameters
    ----------
    name : str
        "skin", "fista", "interpolation"; or "module:Class" for your own, as `Solver`.
    phi, basis, mask
        As in `Solver`.
    fast : str
        Use of compiled loops: "auto" (where numba is installed), "on" or "off".
    rows : str, optional
        As in `compress`, with the same default.
    **settings
        The solver's own, e.g. iterations=20 for "fista".

    Raises
    ------
    SolverError, SettingsError, PhiError
        If the name or a setting is unknown or not allowed, phi, basis and mask do not fit, a class
        of your own is not a solver; fast is "on" without numba; rows of phi cannot rotate.
    """
    subsets = row_subsets(phi, rows)
    solver = make_rotating_solver(name, subsets, basis, mask, fast=fast, **settings)
    _keep_grid(phi, (basis.n_rows, basis.n_cols))
    solver.measured_by = phi
    return solver


@checked(SolverError)
def reconstruct(measurements: Floats, solver: Solver) -> Floats:
    """Reconstruct frames one after the other, each with what the solver kept of the last.

    Parameters
    ----------
    measurements : ndarray of float32, shape (m,) or (k, m)
        Measurements of one frame or of k frames in order, newtons.
    solver : Solver
        It starts from what its last frame left; `solver.reset()` makes it start anew. If its rows
        rotate, the first of k frames is one of the first row subset; before a single frame,
        `solver.use` states that of the frame. `Stream` does so by itself.

    Returns
    -------
    ndarray of float32, shape (n_rows, n_cols) or (k, n_rows, n_cols)
        Forces, newtons, 0 or more; 0 where no taxel exists. `solver.reasons` states of each frame
        why it is not to be trusted, "" if it is, as in a graph, by what the last `compress` with
        the same phi found of its readings, too; `solver.reason` is that of the last frame.
        `solver.noise_sd` and `solver.noise_model`, a `NoiseModel`, help it to see; set them before
        the first frame.

    Raises
    ------
    SolverError
        If the measurements have another shape, are not finite, or are a single frame of rotating
        rows whose row subset is not stated.

    Examples
    --------
    >>> import sparseskin
    >>> truth, taxels = sparseskin.simulate("path_40", 330)
    >>> phi = sparseskin.make_phi("sbhe", n=1600, m=533, seed=0)
    >>> basis = sparseskin.make_basis("haar", 40, 40)
    >>> solver = sparseskin.make_solver("skin", phi, basis)
    >>> forces = sparseskin.reconstruct(sparseskin.compress(taxels, phi), solver)
    >>> forces.shape
    (330, 40, 40)
    >>> bool(sparseskin.psnr_db(forces, truth).min() > 30)
    True
    """
    if solver_fact(solver, "uses_blas"):
        warn_of_threads()
    _check_solver(solver)
    y = real_floats(measurements, "measurements", SolverError)
    if y.ndim not in (1, 2):
        raise SolverError(f"measurements have shape {y.shape}; expected (m,) or (k, m)")
    sensed = _sensed(solver, 1 if y.ndim == 1 else len(y))
    if y.ndim == 1:
        # A single frame may be any of a stream: its row subset is stated.
        forces = _reconstructed(y, solver, sensed[0])
        solver.reasons = (solver.reason,)
        return forces

    # Frames in order begin with the first row subset, as `compress` does.
    subsets = getattr(solver, "subsets", ())
    frames = np.zeros((len(y), *solver.mask.shape), dtype=np.float32)
    reasons: list[str] = []
    for k, of_frame in enumerate(y):
        if subsets:
            solver.use(subsets[k % len(subsets)])
        frames[k] = _reconstructed(of_frame, solver, sensed[k])
        reasons.append(solver.reason)
    solver.reasons = tuple(reasons)
    return frames


def _check_solver(solver: Solver) -> None:
    """Raise SolverError if this is no solver, or what was set of its noise is not allowed."""
    if not hasattr(solver, "solve"):
        raise SolverError(
            f"solver: got {type(solver).__name__}; expected what make_solver returns"
        )
    newtons("solver", "noise_sd", getattr(solver, "noise_sd", 0.0))
    model = getattr(solver, "noise_model", None)
    if model is not None and not isinstance(model, NoiseModel):
        allowed = "allowed: a NoiseModel"
        raise SolverError(
            f"solver: noise_model = {model!r:.60} is not allowed; {allowed}"
        )


def _sensed(solver: Solver, n: int) -> Sequence[str]:
    """What the last `compress` found of the readings of n frames; of other frames than these, what
    it found of its last one.
    """
    reasons = getattr(getattr(solver, "measured_by", None), "reasons", ())
    if len(reasons) == n:
        return reasons
    return [*reasons[-1:], ""][:1] * n


def _reconstructed(y: Floats, solver: Solver, sensed: str) -> Floats:
    """Forces of one frame; the solver notes why they are not to be trusted, by what the edge found
    of the readings, too.
    """
    verdict = solve_watched(solver, watch_of(solver), solver.phi, y)
    solver.reason = str(first_reason(verdict.reason, sensed))
    solver.trusted = not solver.reason
    return verdict.forces


@cache
def warn_of_threads() -> None:
    """Warn, once, where threads of OpenBLAS slow down the small products of the solver."""
    # Which library numpy was built with is known from this alone.
    config: Any = np.show_config(mode="dicts")
    # Other libraries do not make small products wait.
    is_openblas = "openblas" in config["Build Dependencies"]["blas"]["name"]
    is_stated = not os.environ.keys().isdisjoint(THREADS)
    if not is_openblas or is_stated or (os.cpu_count() or 1) == 1:
        return
    warnings.warn(
        "solver skin: threads of OpenBLAS wait for each other; set OPENBLAS_NUM_THREADS=1 "
        "before Python starts",
        RuntimeWarning,
        stacklevel=3,
    )


@checked(SparseskinError)
def psnr_db(forces: Floats, truth: Floats, f_max: float = 2.5) -> Any:
    """Peak signal-to-noise ratio of each frame, 20 log10(f_max / RMSE), capped at 100 dB (paper,
    section V-C).

    Parameters
    ----------
    forces, truth : ndarray of float32, shape (n_rows, n_cols) or (k, n_rows, n_cols)
        Estimate and reference, newtons; or both in the unit of f_max.
    f_max : float
        Upper end of the range of the reference; by default 2.5 N.

    Returns
    -------
    float, or ndarray of float64, shape (k,)
        Decibels.

    Raises
    ------
    SparseskinError
        If the shapes differ or are no frames, or the reference exceeds the range.
    """
    _check_numbers("forces", forces)
    _check_numbers("truth", truth)
    if not f_max > 0:
        raise SparseskinError(
            f"psnr_db: f_max = {f_max:g} is not allowed; allowed: above 0"
        )
    forces = np.asarray(forces)
    truth = np.asarray(truth)
    if forces.shape != truth.shape or forces.ndim not in (2, 3):
        raise SparseskinError(
            f"psnr_db: shapes {forces.shape} and {truth.shape}; "
            "expected the same, (n_rows, n_cols) or (k, n_rows, n_cols)"
        )
    # A reference beyond the range would give a PSNR that is too low.
    peak = float(truth.max()) if truth.size else 0.0
    if peak > f_max:
        text = f"the reference reaches {peak:g}, above f_max = {f_max:g}"
        raise SparseskinError(
            f"psnr_db: {text}; state f_max, the upper end of its range"
        )

    dtype = np.result_type(forces, truth, np.float32)
    # Not in their own type, which may be unsigned.
    error = np.subtract(forces, truth, dtype=dtype)
    if error.ndim == 2:
        return psnr_of_error(error, f_max)
    return np.array([psnr_of_error(frame, f_max) for frame in error])


def _check_numbers(name: str, frames: Floats) -> None:
    """Raise SparseskinError at the first force that is not finite, or beyond any range."""
    values = real_floats(frames, f"psnr_db: {name}", SparseskinError)
    is_number = np.abs(values) <= LARGEST
    if not is_number.all():
        place = tuple(np.argwhere(~is_number)[0].tolist())
        reads = f"{name}{list(place)} is {np.asarray(frames)[place]:g}"
        raise SparseskinError(f"psnr_db: {reads}; allowed: {WITHIN}")


@checked(SparseskinError)
def simulate(scene: str, n_frames: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Simulate the first frames of a scene.

    Parameters
    ----------
    scene : str
        Name of a scene: "lift_box_40", "lift_wrench_40", "drag_wrench_40", "path_40",
        "lift_box_64", "drag_wrench_64".
    n_frames : int
        Number of frames, 1 or more; a scene ends after its last frame, and delivers fewer then.
    seed : int
        Seed of the noise, and of what the scene draws at random.

    Returns
    -------
    truth, taxels : ndarray of float32, shape (k, n_rows, n_cols), k at most n_frames
        Forces that act, and what noisy taxels read, newtons, in [0, 2.5].

    Raises
    ------
    SparseskinError
        If there is no such scene, or `n_frames` or `seed` is not allowed.
    """
    # Imported here: other functions of this module need no scene.
    from sparseskin.nodes.sensor.node import Sensor

    _check_frames("simulate", n_frames)
    settings = Sensor.Settings(source=f"scene:{scene}", seed=seed)
    # The same node as in a graph, so that frames have the same bits.
    bus = Bus({"sensor": (Sensor, settings)})
    truth = []
    taxels = []
    for messages in bus.frames(n_frames):
        truth += [each.forces[0] for each in messages if isinstance(each, Truth)]
        taxels += [each.forces[0] for each in messages if isinstance(each, Taxels)]
    bus.check()
    return np.stack(truth), np.stack(taxels)


def _check_frames(function: str, n_frames: object) -> None:
    if not is_whole(n_frames, 1):
        allowed = "allowed: a whole number, 1 or more"
        raise SparseskinError(
            f"{function}: n_frames = {n_frames!r} is not allowed; {allowed}"
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of one patch, as it passed through the nodes; None where no node makes a part."""

    patch: str
    stamp_ns: int
    """Time of acquisition, nanoseconds."""
    truth: Floats | None = None
    """Forces that act, newtons, float32 (n_rows, n_cols), where a simulation knows them."""
    taxels: Floats | None = None
    """Readings, newtons, float32 (n_rows, n_cols)."""
    measurements: Floats | None = None
    """What the edge sent, newtons, float32 (m,)."""
    forces: Floats | None = None
    """Reconstructed forces, newtons, float32 (n_rows, n_cols)."""
    error: float | None = None
    """RMS error of a taxel of `forces` as the solver estimates it, newtons, where it does."""
    trusted: bool = True
    """False if the frame is not to be acted on, as `reason` states."""
    reason: str = ""
    """Word of the `messages.Reason` for that; "" if there is none."""
    contacts: Contacts | None = None
    """Contacts of `forces`, arrays with an entry each, with `reconstructor.contacts=true`."""
    label: Labels | None = None
    """What presses: label, share, age; with a node recogniser."""
    missing: Mask | None = None
    """Taxels whose reading is missing, and filled in, (n_rows, n_cols); None: there are none."""


@checked(SparseskinError)
def run_launch(
    launch: LaunchFile | str, n_frames: int | None = None, settings: Sequence[str] = ()
) -> Iterator[Frame]:
    """Run the nodes of a launch file in this program, frame by frame, as fast as they go.

    The results have the same bits as those of the processes that `sparseskin launch` starts.

    Parameters
    ----------
    launch : LaunchFile or str
        What `load_launch` returned, or the name or path of a launch file.
    n_frames : int, optional
        Number of frames, 1 or more; by default until the source ends.
    settings : sequence of str
        "NODE.KEY=VALUE" each; only with a name or path.

    Yields
    ------
    Frame
        For each patch of the graph and each of its frames.

    Raises
    ------
    SparseskinError
        If the launch file is refused (LaunchError), a node fails, or refuses a message; or
        `n_frames` is not allowed.

    Examples
    --------
    >>> import sparseskin
    >>> for frame in sparseskin.run_launch("path_40", 2, ["compressor.ratio=4"]):
    ...     print(frame.patch, frame.taxels.shape, frame.measurements.shape, frame.forces.shape)
    skin (40, 40) (400,) (40, 40)
    skin (40, 40) (400,) (40, 40)
    """
    if n_frames is not None:
        _check_frames("run_launch", n_frames)
    if isinstance(launch, str):
        launch = load(launch, settings)
    elif settings:
        raise SparseskinError(
            "run_launch: settings go to load_launch where the file is loaded"
        )
    nodes = launch.nodes.values()
    bus = Bus({node.name: (node.cls, node.settings) for node in nodes})
    last_forces: dict[str, Floats] = {}
    try:
        for messages in bus.frames(n_frames):
            bus.check()
            yield from _frames_of(messages, last_forces)
    finally:
        bus.close()
    bus.check()


_PARTS: dict[type[Frames], str] = {
    Truth: "truth",
    Taxels: "taxels",
    Measurements: "measurements",
    Reconstruction: "forces",
}


def _frames_of(
    messages: Sequence[Message], last_forces: dict[str, Floats]
) -> Iterator[Frame]:
    """Frames of messages that came together; `last_forces` as of `Frames.split`."""
    # Messages of one frame share patch and stamp.
    frames: dict[tuple[str, int], dict[str, Any]] = {}
    for message in messages:
        if isinstance(message, Labels):
            frames.setdefault((message.patch, message.stamp_ns), {})["label"] = message
        if not isinstance(message, Frames):
            continue
        for of_patch in message.split(last_forces):
            parts = frames.setdefault((of_patch.patch, of_patch.stamp_ns), {})
            parts |= _parts_of(of_patch)
    for (patch, stamp_ns), parts in frames.items():
        yield Frame(patch, stamp_ns, **parts)


def _parts_of(message: Frames) -> dict[str, Any]:
    """Fields of `Frame` that a message of one patch gives."""
    if isinstance(message, Contacts):
        return {"contacts": message}
    values = values_alone(message)
    parts = {_PARTS[type(message)]: values.get("y", values.get("forces"))}
    if isinstance(message, Taxels | Reconstruction):
        parts["missing"] = message.missing_cells(message.forces.shape[1:])
    for name in ("error", "trusted", "reason"):
        if name in values:
            parts[name] = values[name]
    return parts
