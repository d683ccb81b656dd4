"""Checks of matrices, bases and solvers of one's own: what every part of this package fulfils."""

from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.arguments import checked
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.errors import PhiError, SolverError, SparseskinError
from sparseskin.nodes.numerics.arrays import TINY, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import Basis
from sparseskin.nodes.reconstructor.solvers.base import Solver

ROUNDING = 1e-5
"""Largest error, relative to the lengths of vectors, that float32 arithmetic explains."""
N_FRAMES = 6


@checked(PhiError)
def check_phi(phi: Phi) -> dict[str, float]:
    """Check a measurement matrix by random vectors, its dense form and its eigenvalues.

    Shapes and types of `forward` and `adjoint`, which leave their input as it is and give the same
    bits on two calls, alone and in a batch; <Phi x, y> = <x, Phi^T y> (the dot test); `dense`;
    `lipschitz`, which is at least the largest eigenvalue of Phi Phi^T; `fingerprint`.

    Returns
    -------
    dict
        "dot": error of the dot test, relative; "largest": largest eigenvalue.

    Raises
    ------
    PhiError
        At the first of these that does not hold, with what was found and what is expected.
    """
    if not isinstance(phi, Phi):
        raise PhiError(f"phi: got {phi!r}; expected what make_phi returns")
    test = _Test(PhiError, f"phi {phi.kind}")
    x = _normal((2, phi.n))
    y = _normal((2, phi.m))
    measured = test.applied("forward", phi.forward, x, (2, phi.m))
    spread = test.applied("adjoint", phi.adjoint, y, (2, phi.n))
    dot = test.dot_error("adjoint", (measured, y), (x, spread))
    dense = phi.dense()
    if dense.shape != (phi.m, phi.n) or dense.dtype != np.float64:
        test.fail(": dense", f"{dense.dtype} {dense.shape}", f"float64 {phi.m, phi.n}")
    test.compare("forward", measured, x @ dense.T, "the product with dense()")
    test.compare("adjoint", spread, y @ dense, "the product with dense()")
    largest = float(np.linalg.norm(dense, 2)) ** 2
    if not phi.lipschitz >= largest * (1 - ROUNDING):
        test.fail(": lipschitz", phi.lipschitz, f"at least {largest:.7g}")
    if not (isinstance(phi.fingerprint, str) and len(phi.fingerprint) == 16):
        test.fail(": fingerprint", repr(phi.fingerprint), "16 characters")
    return {"dot": dot, "largest": largest}


@checked(SolverError)
def check_basis(basis: Basis) -> dict[str, float]:
    """Check that a basis is orthonormal, and its shapes, types and bits as in `check_phi`.

    Returns
    -------
    dict
        "dot": error of the dot test, relative.

    Raises
    ------
    SolverError
        At the first property that does not hold.
    """
    if not isinstance(basis, Basis):
        raise SparseskinError(f"basis: got {basis!r}; expected what make_basis returns")
    test = _Test(SolverError, f"basis {type(basis).__name__}")
    shape = (2, basis.n_rows, basis.n_cols)
    image = _normal(shape)
    theta = _normal(shape, 1)
    found = test.applied("analysis", basis.analysis, image, shape)
    made = test.applied("synthesis", basis.synthesis, theta, shape)
    dot = test.dot_error("synthesis", (found, theta), (image, made))
    back = basis.synthesis(found)
    again = basis.analysis(made)
    test.compare("synthesis of analysis", back, image, "the image")
    test.compare("analysis of synthesis", again, theta, "the coefficients")
    return {"dot": dot}


@checked(SolverError)
def check_solver(solver: Solver) -> dict[str, float]:
    """Check a solver by frames of a disc that slides over its skin; it is reset before and after.

    Forces are float32 of the grid's shape, finite, at least 0, 0 where no taxel exists, and the
    caller's own; measurements are left as they are; `setup`, `step` and `finish` are `solve`;
    `reset` forgets; nothing gives nothing; what is not finite is refused and leaves no trace.

    Returns
    -------
    dict
        "error": of the last frame, relative to its forces.

    Raises
    ------
    SolverError
        At the first property that does not hold.
    """
    if not isinstance(solver, Solver):
        raise SolverError(f"solver: got {solver!r}; expected what make_solver returns")
    test = _Test(SolverError, f"solver {solver.name}")
    shape = solver.mask.shape
    frames = _disc(shape) * solver.mask
    subsets = solver.subsets or (solver.phi,)
    phis = [subsets[k % len(subsets)] for k in range(N_FRAMES)]
    given = [phi.forward(f[solver.mask]) for phi, f in zip(phis, frames, strict=True)]

    def solved(how: Callable[[Phi, Floats], Floats]) -> list[Floats]:
        solver.reset()
        found: list[Floats] = []
        for phi, y in zip(phis, given, strict=True):
            solver.use(phi)
            kept = y.copy()
            forces = how(phi, y)
            if forces.shape != shape or forces.dtype != np.float32:
                test.fail("", f"{forces.dtype} {forces.shape}", f"float32 {shape}")
            if not (np.isfinite(forces).all() and float(forces.min(initial=0)) >= 0):
                test.fail("", "forces below 0 or not finite", "at least 0, finite")
            if forces[~solver.mask].any():
                test.fail("", "forces outside the mask", "0 there")
            if not np.array_equal(y, kept):
                test.fail("", "other measurements than were given", "y unchanged")
            found.append(forces)
        return found

    def straight(phi: Phi, y: Floats) -> Floats:
        return solver.solve(y)

    def stepped(phi: Phi, y: Floats) -> Floats:
        solver.setup(y)
        for _ in range(solver.n_steps):
            solver.step()
        return solver.finish()

    def troubled(phi: Phi, y: Floats) -> Floats:
        try:
            solver.solve(np.where(np.arange(y.size) == y.size // 2, np.float32(np.nan), y))
        except SolverError:
            solver.use(phi)
            return solver.solve(y)
        test.fail("", "a NaN among the measurements is taken", "SolverError")

    first = solved(straight)
    copies = [one.copy() for one in first]
    for what, how in (
        ("a second run after reset()", straight),
        ("setup(), step() and finish()", stepped),
        ("frames after one that is refused", troubled),
    ):
        if not all(map(np.array_equal, solved(how), copies)):
            test.fail("", f"{what} differ from solve()", "the same bits")
    if not all(map(np.array_equal, first, copies)):
        test.fail("", "a result that a later frame changes", "the caller's own array")
    solver.reset()
    solver.use(phis[0])
    if solver.solve(np.zeros(solver.phi.m, np.float32)).any():
        test.fail("", "forces for measurements of 0", "0")
    solver.reset()
    off = float(np.linalg.norm(first[-1] - frames[-1]))
    return {"error": off / max(float(np.linalg.norm(frames[-1])), TINY)}


def _normal(shape: tuple[int, ...], seed: int = 0) -> Floats:
    made: Floats = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    return made


def _disc(shape: tuple[int, ...]) -> Floats:
    """Frames of a disc of force 1 that slides along the middle row, (N_FRAMES, n_rows, n_cols)."""
    rows, cols = np.mgrid[: shape[0], : shape[1]]
    radius = max(1.0, min(shape) / 6)
    at = shape[1] / 4 + 0.5 * np.arange(N_FRAMES)[:, None, None]
    inside: Mask = np.hypot(rows - shape[0] // 2, cols - at) < radius
    return inside.astype(np.float32)


class _Test:
    """The test of one part, whose failures are errors of a kind that name it."""

    def __init__(self, kind: type[SparseskinError], name: str) -> None:
        self._kind = kind
        self._name = name

    def fail(self, what: str, found: object, expected: str) -> NoReturn:
        raise self._kind(f"{self._name}{what}: {found}; expected: {expected}")

    def applied(
        self, name: str, apply: Callable[[Floats], Floats], given: Floats, shape: tuple[int, ...]
    ) -> Floats:
        """Apply to a batch of two frames, with checks of shape, type, values and bits."""
        what = f": {name}"
        kept = given.copy()
        found = apply(given)
        if found.shape != shape or found.dtype != np.float32:
            self.fail(what, f"{found.dtype} of shape {found.shape}", f"float32 of shape {shape}")
        if not np.isfinite(found).all():
            self.fail(what, "not finite", "finite numbers")
        if not np.array_equal(given, kept):
            self.fail(what, "its input is changed", "an input that is left as it is")
        again = np.stack([apply(one) for one in given])
        if not np.array_equal(again, found):
            self.fail(what, "other bits on a second call", "the same bits, alone and in a batch")
        return found

    def dot_error(self, name: str, left: tuple[Floats, ...], right: tuple[Floats, ...]) -> float:
        """Relative difference of two inner products of the first frames, as they are equal."""
        pairs = [[part[0].astype(np.float64) for part in parts] for parts in (left, right)]
        one, other = (float(np.vdot(a, b)) for a, b in pairs)
        length = max(float(np.linalg.norm(a) * np.linalg.norm(b)) for a, b in pairs)
        error = abs(one - other) / max(length, TINY)
        if not error <= ROUNDING:
            found = f"inner products of {one:.6g} and {other:.6g}"
            self.fail(f": {name}", found, "the transpose, so equal")
        return error

    def compare(self, name: str, found: Floats, expected: npt.NDArray[Any], by: str) -> None:
        error = float(np.abs(found - expected).max()) / max(float(np.linalg.norm(expected)), TINY)
        if not error <= ROUNDING:
            self.fail(f": {name}", f"a relative error of {error:.2g}", by)
