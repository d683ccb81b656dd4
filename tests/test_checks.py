"""Checks of a user's own matrix, basis and solver: what is wrong is found and named."""

import numpy as np
import pytest

from sparseskin.checks import check_basis, check_phi, check_solver
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import PhiError, SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver


def changed(made, **methods):
    """The same object, with methods that are wrong: functions of it and what it is given."""
    made.__class__ = type("Own", (made.__class__,), methods)
    return made


def phi(**methods):
    return changed(make_phi("gaussian", 24, 9, seed=0), **methods)


def solver(**methods):
    basis, measured = make_basis("haar", 8, 8), make_phi("sbhe", 64, 30, seed=0)
    return changed(make_solver("fista", measured, basis), **methods)


def half(self, y, out):
    out[:] = 0.5 * (self.dense().T @ y)


def growing(self, x, out):
    self.calls = getattr(self, "calls", 0) + 1
    out[:] = self.calls * x.sum()


@pytest.mark.parametrize(
    ("methods", "text"),
    [
        ({"_adjoint": half}, "adjoint: inner products of .*; expected: the transpose, so equal"),
        ({"_forward": growing}, "forward: other bits on a second call; expected: the same bits"),
        ({"lipschitz": property(lambda self: 1.0)}, r"lipschitz: 1.0; expected: at least 2\.\d+"),
        ({"dense": lambda self: np.zeros((9, 24))}, "forward: a relative error of .* dense"),
    ],
)
def test_a_wrong_matrix_is_named(methods, text):
    assert check_phi(phi())["dot"] < 1e-6
    if "_adjoint" in methods:  # the dense form is that of `_adjoint` else
        matrix = phi().dense()
        methods = {**methods, "dense": lambda self: matrix}
    with pytest.raises(PhiError, match=f"phi gaussian: {text}"):
        check_phi(phi(**methods))


def test_a_basis_that_is_not_orthonormal_is_named():
    def twice(self, image, out):
        out[:] = 2 * image

    basis = changed(make_basis("identity", 5, 7), _analysis=twice)
    with pytest.raises(SolverError, match="basis Own: synthesis: inner products of"):
        check_basis(basis)


def forces(value):
    return lambda self: np.full((8, 8), value, np.float32)


@pytest.mark.parametrize(
    ("methods", "text"),
    [
        ({"finish": forces(-1)}, "forces below 0 or not finite; expected: at least 0, finite"),
        ({"finish": lambda self: np.zeros((8, 8))}, r"float64 \(8, 8\); expected: float32"),
        ({"finish": forces(1)}, "a NaN among the measurements is taken|forces for measurements"),
        ({"reset": lambda self: None}, "a second run after reset"),
    ],
)
def test_a_wrong_solver_is_named(methods, text):
    assert check_solver(solver())["error"] < 1
    with pytest.raises(SolverError, match=f"solver fista: (?:{text})"):
        check_solver(solver(**methods))
