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
    # Random vectors: what holds for them holds for all, as the products are linear.
    test = _Test(PhiError, f"phi {phi.kind}")
    # Two of each: a batch must give the same bits as its frames alone.
    x = _normal((2, phi.n))
    y = _normal((2, phi.m))

    measured = test.applied("forward", phi.forward, x, (2, phi.m))
    spread = test.applied("adjoint", phi.adjoint, y, (2, phi.n))
    dot = test.dot_error("adjoint", (measured, y), (x, spread))

    # The dense form is the reference for the fast ones.
    dense = phi.dense()
    if dense.shape != (phi.m, phi.n) or dense.dtype != np.float64:
        test.fail(": dense", f"{dense.dtype} {dense.shape}", f"float64 {phi.m, phi.n}")
    test.compare("forward", measured, x @ dense.T, "the product with dense()")
    test.compare("adjoint", spread, y @ dense, "the product with dense()")

    # The largest singular value, squared.
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

    # Orthonormal: each of the two is the transpose and the inverse of the other.
    coefficients = test.applied("analysis", basis.analysis, image, shape)
    spread = test.applied("synthesis", basis.synthesis, theta, shape)
    dot = test.dot_error("synthesis", (coefficients, theta), (image, spread))
    back = basis.synthesis(coefficients)
    again = basis.analysis(spread)
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
    test = _SolverTest(solver)
    results = test.run(test.straight)
    # Later frames must not change earlier results.
    copies = [forces.copy() for forces in results]
    solves = {
        "a second run after reset()": test.straight,
        "setup(), step() and finish()": test.stepped,
        "frames after one that is refused": test.troubled,
    }
    for runs, solve in solves.items():
        if not all(map(np.array_equal, test.run(solve), copies)):
            test.fail("", f"{runs} differ from solve()", "the same bits")
    if not all(map(np.array_equal, results, copies)):
        test.fail("", "a result that a later frame changes", "the caller's own array")

    test.check_nothing()
    solver.reset()
    frame = test.frames[-1]
    error = float(np.linalg.norm(results[-1] - frame))
    size = float(np.linalg.norm(frame))
    return {"error": error / max(size, TINY)}


def _normal(shape: tuple[int, ...], seed: int = 0) -> Floats:
    values = np.random.default_rng(seed).standard_normal(shape)
    return values.astype(np.float32)


def _disc(shape: tuple[int, ...]) -> Floats:
    """Frames of a disc of force 1 that slides along the middle row, (N_FRAMES, n_rows, n_cols)."""
    n_rows, n_cols = shape
    rows, cols = np.mgrid[:n_rows, :n_cols]
    radius = max(1.0, min(shape) / 6)
    # Half a taxel a frame: solvers that start from the last one are followed.
    middle = n_cols / 4 + 0.5 * np.arange(N_FRAMES)[:, None, None]
    inside: Mask = np.hypot(rows - n_rows // 2, cols - middle) < radius
    return inside.astype(np.float32)


class _Test:
    """The test of one part, whose failures are errors of a kind that name it."""

    def __init__(self, kind: type[SparseskinError], name: str) -> None:
        self._kind = kind
        self._name = name

    def fail(self, place: str, result: object, expected: str) -> NoReturn:
        raise self._kind(f"{self._name}{place}: {result}; expected: {expected}")

    def applied(
        self,
        name: str,
        apply: Callable[[Floats], Floats],
        batch: Floats,
        shape: tuple[int, ...],
    ) -> Floats:
        """Apply to a batch of two frames, with checks of shape, type, values and bits."""
        place = f": {name}"
        copy = batch.copy()
        result = apply(batch)
        if result.shape != shape or result.dtype != np.float32:
            kind = f"{result.dtype} of shape {result.shape}"
            self.fail(place, kind, f"float32 of shape {shape}")
        if not np.isfinite(result).all():
            self.fail(place, "not finite", "finite numbers")
        if not np.array_equal(batch, copy):
            self.fail(place, "its input is changed", "an input that is left as it is")

        # The same bits, alone and in a batch, twice.
        frame_by_frame = np.stack([apply(frame) for frame in batch])
        if not np.array_equal(frame_by_frame, result):
            expected = "the same bits, alone and in a batch"
            self.fail(place, "other bits on a second call", expected)
        return result

    def dot_error(
        self,
        name: str,
        factors: tuple[Floats, Floats],
        transposed: tuple[Floats, Floats],
    ) -> float:
        """Relative difference of two inner products of the first frames, as they are equal."""
        product, length = _inner_product(*factors)
        expected, expected_length = _inner_product(*transposed)
        error = abs(product - expected) / max(length, expected_length, TINY)
        if not error <= ROUNDING:
            products = f"inner products of {product:.6g} and {expected:.6g}"
            self.fail(f": {name}", products, "the transpose, so equal")
        return error

    def compare(
        self, name: str, found: Floats, expected: npt.NDArray[Any], by: str
    ) -> None:
        largest = float(np.abs(found - expected).max())
        error = largest / max(float(np.linalg.norm(expected)), TINY)
        if not error <= ROUNDING:
            self.fail(f": {name}", f"a relative error of {error:.2g}", by)


def _inner_product(a: Floats, b: Floats) -> tuple[float, float]:
    """Inner product of two first frames, and the product of their lengths, in float64."""
    u = a[0].astype(np.float64)
    v = b[0].astype(np.float64)
    product = float(np.vdot(u, v))
    length = float(np.linalg.norm(u) * np.linalg.norm(v))
    return product, length


class _SolverTest(_Test):
    """The test of a solver by frames of a disc."""

    def __init__(self, solver: Solver) -> None:
        super().__init__(SolverError, f"solver {solver.name}")
        mask = solver.mask
        # Rows that rotate measure each frame by another matrix.
        subsets = solver.subsets or (solver.phi,)
        self.solver = solver
        self.frames = _disc(mask.shape) * mask
        self.phis = [subsets[k % len(subsets)] for k in range(N_FRAMES)]
        self.measurements = []
        for phi, frame in zip(self.phis, self.frames, strict=True):
            self.measurements.append(phi.forward(frame[mask]))

    def run(self, solve: Callable[[Phi, Floats], Floats]) -> list[Floats]:
        """Forces of all frames, checked, after a reset."""
        self.solver.reset()
        results: list[Floats] = []
        for phi, y in zip(self.phis, self.measurements, strict=True):
            self.solver.use(phi)
            copy = y.copy()
            forces = solve(phi, y)
            self._check_forces(forces)
            # The caller may use its measurements again.
            if not np.array_equal(y, copy):
                self.fail("", "other measurements than were given", "y unchanged")
            results.append(forces)
        return results

    def _check_forces(self, forces: Floats) -> None:
        mask = self.solver.mask
        if forces.shape != mask.shape or forces.dtype != np.float32:
            self.fail("", f"{forces.dtype} {forces.shape}", f"float32 {mask.shape}")
        lowest = float(forces.min(initial=0))
        if not (np.isfinite(forces).all() and lowest >= 0):
            self.fail("", "forces below 0 or not finite", "at least 0, finite")
        if forces[~mask].any():
            self.fail("", "forces outside the mask", "0 there")

    def straight(self, phi: Phi, y: Floats) -> Floats:
        """By `solve`."""
        return self.solver.solve(y)

    def stepped(self, phi: Phi, y: Floats) -> Floats:
        """Step by step."""
        self.solver.setup(y)
        for _ in range(self.solver.n_steps):
            self.solver.step()
        return self.solver.finish()

    def troubled(self, phi: Phi, y: Floats) -> Floats:
        """After measurements that are refused."""
        # A refused frame must leave no trace in the next one.
        broken = y.copy()
        broken[y.size // 2] = np.nan
        try:
            self.solver.solve(broken)
        except SolverError:
            # A refused frame may count as one of rotating rows.
            self.solver.use(phi)
            return self.solver.solve(y)
        self.fail("", "a NaN among the measurements is taken", "SolverError")

    def check_nothing(self) -> None:
        """Measurements of 0 give forces of 0."""
        zeros = np.zeros(self.solver.phi.m, np.float32)
        self.solver.reset()
        self.solver.use(self.phis[0])
        forces = self.solver.solve(zeros)
        if forces.any():
            self.fail("", "forces for measurements of 0", "0")
