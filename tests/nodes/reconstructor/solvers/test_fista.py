"""FISTA: the article's iteration, the optimum of basis pursuit denoising, and what is refused."""

import os
import subprocess
import sys

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver


def sliding_box(shape, n_frames, seed=0):
    """A box with a rim, sliding by one taxel a frame after an untouched one; noisy, newtons."""
    rows, cols = shape
    noise = np.random.default_rng(seed).normal(0, 0.03, (n_frames, rows, cols))
    frames = np.zeros((n_frames, rows, cols))
    for t in range(1, n_frames):
        top = rows // 4
        left = cols // 4 + t
        frames[t, top : top + rows // 3, left : left + cols // 3] = 1.2
        frames[t, top, left : left + cols // 3] = 1.8
        frames[t, -3, 2] = 0.4
    return np.clip(frames + noise, 0, 2.5).astype(np.float32)


def matrix_of(basis):
    """Psi, column by column."""
    n = basis.n_rows * basis.n_cols
    units = np.eye(n, dtype=np.float32).reshape(n, basis.n_rows, basis.n_cols)
    return np.stack([basis.synthesis(u).ravel() for u in units], axis=1).astype(
        np.float64
    )


def dense_fista(A, y, lam, L, iterations, start):
    """FISTA with constant step size, line by line from Beck and Teboulle (2009), section 4."""
    x_last = start
    y_k = start
    t_k = 1.0
    for _ in range(iterations):
        v = y_k - A.T @ (A @ y_k - y) / L
        x_k = np.sign(v) * np.maximum(np.abs(v) - lam / L, 0)
        t_next = (1 + np.sqrt(1 + 4 * t_k**2)) / 2
        y_k = x_k + (t_k - 1) / t_next * (x_k - x_last)
        x_last = x_k
        t_k = t_next
    return x_last


def ring_mask(shape):
    """A grid whose corners and one dead taxel are missing."""
    mask = np.ones(shape, dtype=np.bool_)
    mask[:2, :3] = mask[-2:, -4:] = False
    mask[shape[0] // 2, shape[1] // 2] = False
    return mask


@pytest.mark.parametrize("fast", ["off", "auto"])
@pytest.mark.parametrize(
    ("kind", "basis", "shape", "block"),
    [
        *[("sbhe", "haar", (13, 11), 8), ("sbhe", "haar", (12, 32), 128)],
        *[("subsample", "haar", (13, 11), 32), ("gaussian", "identity", (13, 11), 32)],
    ],
)
def test_it_is_the_articles_iteration_however_started(kind, basis, shape, block, fast):
    """Every frame of a sequence, within 1e-4 N; missing taxels are left out."""
    if fast == "auto" and (kind, basis) != ("sbhe", "haar"):
        pytest.skip("the same code")
    mask = ring_mask(shape)
    n = int(mask.sum())
    phi = make_phi(kind, n, n if kind == "full" else n // 2, seed=1, block=block)
    solver = FistaSolver(phi, make_basis(basis, *shape), mask, iterations=20, fast=fast)
    psi = matrix_of(solver.basis)
    A = phi.dense() @ psi[mask.ravel()]
    theta = np.zeros(psi.shape[1])
    frames = sliding_box(shape, 4) * mask
    for frame, warm in zip(frames, (None, None, None, frames[1]), strict=True):
        y = phi.forward(frame[mask])
        if warm is not None:
            theta = psi.T @ warm.ravel().astype(np.float64)
        theta = dense_fista(
            A, y.astype(np.float64), solver.lambda_n, phi.lipschitz, 20, theta
        )
        expected = np.where(mask, np.maximum(psi @ theta, 0).reshape(shape), 0)
        estimate = solver.solve(y, warm)
        assert estimate.dtype == np.float32
        np.testing.assert_allclose(estimate, expected, atol=1e-4)
    solver.reset()
    np.testing.assert_array_equal(solver.theta, 0)


class CountedSteps(FistaSolver):
    """A step of the user's own."""

    n_done = 0

    def step(self):
        self.n_done += 1
        super().step()


def test_solve_makes_the_steps_of_a_class_of_ones_own():
    phi = make_phi("sbhe", 256, 100, seed=2)
    own, plain = (
        cls(phi, HaarBasis(16, 16), iterations=7) for cls in (CountedSteps, FistaSolver)
    )
    for frame in sliding_box((16, 16), 3):
        y = phi.forward(frame.ravel())
        np.testing.assert_array_equal(
            own.solve(y, warm=frame), plain.solve(y, warm=frame)
        )
    assert own.n_done == 3 * 7


@pytest.mark.parametrize("fast", ["off", "auto"])
def test_many_iterations_reach_the_optimality_conditions(fast):
    """g = Psi^T Phi^T (y - Phi Psi theta): |g| <= lambda, = lambda sign(theta) where not 0."""
    phi = make_phi("sbhe", 256, 100, seed=2)
    lambda_n = 0.02
    basis = HaarBasis(16, 16)
    solver = FistaSolver(phi, basis, iterations=1000, lambda_n=lambda_n, fast=fast)
    y = phi.forward(sliding_box((16, 16), 3)[2].ravel())
    solver.solve(y)
    solver.solve(y)
    theta = solver.theta.astype(np.float64).ravel()
    A = phi.dense() @ matrix_of(basis)
    g = A.T @ (y - A @ theta)
    active = np.abs(theta) > 1e-3
    assert 10 < active.sum() < 100
    assert np.abs(g).max() <= lambda_n + 2e-5
    np.testing.assert_allclose(g[active], lambda_n * np.sign(theta[active]), atol=2e-5)


def test_preset_paper_is_the_papers_method():
    """Its lambda of 0.1 on rows of +1 and -1 is 0.1 / 32 on orthonormal ones: the same theta."""
    preset = dict(PRESETS["paper"])
    assert preset == {
        "solver": "fista",
        "basis": "haar",
        "iterations": 30,
        "lambda_n": 0.1 / 32,
    }
    phi = make_phi("sbhe", 256, 85, seed=2)
    basis = make_basis(preset.pop("basis"), 16, 16)
    solver = make_solver(preset.pop("solver"), phi, basis, **preset)
    y = phi.forward(sliding_box((16, 16), 3)[2].ravel())
    psi = matrix_of(solver.basis)
    signs = phi.dense() * np.sqrt(32) @ psi
    theta = dense_fista(signs, y * np.sqrt(32), 0.1, 32.0, 30, np.zeros(256))
    expected = np.maximum(psi @ theta, 0).reshape(16, 16)
    np.testing.assert_allclose(solver.solve(y), expected, atol=1e-4)


@pytest.mark.slow
def test_the_same_bits_with_any_number_of_blas_threads():
    code = (
        "import numpy as np, hashlib;"
        "from sparseskin.nodes.compressor.phi.base import make_phi;"
        "from sparseskin.nodes.reconstructor.bases.base import make_basis;"
        "from sparseskin.nodes.reconstructor.solvers.base import make_solver;"
        "phis = [make_phi(kind, 576, 192, seed=0) for kind in ('sbhe', 'gaussian')];"
        "x = np.random.default_rng(0).random(576, dtype=np.float32);"
        "basis = make_basis('haar', 24, 24);"
        "bits = [make_solver('fista', p, basis).solve(p.forward(x)).tobytes() for p in phis];"
        "print([hashlib.sha256(b).hexdigest() for b in bits])"
    )
    one, two = (
        subprocess.run(
            [sys.executable, "-c", code],
            env={
                **os.environ,
                "OPENBLAS_NUM_THREADS": threads,
                "OMP_NUM_THREADS": threads,
            },
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for threads in "12"
    )
    assert one == two


@pytest.mark.parametrize(
    ("y", "warm", "said"),
    [
        (np.zeros(99), None, r"y has shape \(99,\); expected \(100,\)"),
        (np.full(100, 1e31), None, "too large"),
        (
            np.zeros(100),
            np.zeros(256),
            r"warm start has shape \(256,\); expected \(16, 16\)",
        ),
        (
            np.zeros(100),
            np.full((16, 16), np.nan),
            "warm start has values that are not finite",
        ),
    ],
)
def test_measurements_and_warm_starts_of_the_wrong_kind_are_named(y, warm, said):
    solver = FistaSolver(make_phi("sbhe", 256, 100, seed=2), HaarBasis(16, 16))
    with pytest.raises(SolverError, match=said):
        solver.solve(
            y.astype(np.float32), None if warm is None else warm.astype(np.float32)
        )


class TooShortLipschitz(HaarBasis):
    """A basis that is not orthonormal, so that the step 1/L is too long."""

    def _synthesis(self, coefficients, out):
        super()._synthesis(100 * coefficients, out)

    def _analysis(self, image, out):
        super()._analysis(100 * image, out)


@pytest.mark.filterwarnings("ignore:.*encountered:RuntimeWarning")
def test_an_iteration_that_diverges_is_an_error_and_forgotten():
    phi = make_phi("sbhe", 256, 100, seed=2)
    solver = FistaSolver(phi, TooShortLipschitz(16, 16))
    y = phi.forward(sliding_box((16, 16), 3)[2].ravel())
    with pytest.raises(SolverError, match="diverged"):
        solver.solve(y)
    np.testing.assert_array_equal(solver.theta, 0)


@pytest.mark.parametrize(
    ("name", "settings", "said"),
    [
        ("fista", {"iterations": 2.5}, "iterations = 2.5"),
        ("fista", {"lambda_n": float("inf")}, "lambda_n = inf"),
        (
            "fista",
            {"mask": np.ones((4, 64), np.bool_)},
            r"shape \(4, 64\); expected .* \(16, 16\)",
        ),
        (
            "fista",
            {"mask": ring_mask((16, 16))},
            "n = 256 taxels; the grid of 16 x 16 has",
        ),
        ("fist", {}, 'solver "fist" is not known.*fista'),
        ("no_such_module:Solver", {}, "no_such_module"),
        ("collections:Counter", {}, "no solver: it lacks setup"),
    ],
)
def test_what_cannot_be_made_is_named(name, settings, said):
    phi = make_phi("sbhe", 256, 100, seed=2)
    with pytest.raises(SolverError, match=said):
        make_solver(name, phi, HaarBasis(16, 16), **settings)
