"""Measurement matrices: the fast forms agree with the dense matrices; fingerprints differ."""

import numpy as np
import pytest

from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.identity import FullPhi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError

KINDS = ["sbhe", "full", "subsample", "gaussian"]


class Unnamed(FullPhi):
    fingerprint = property(lambda self: "", lambda self, value: None)


def normal(shape, seed=5):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@pytest.mark.parametrize("kind", [*KINDS, "local:3", "local:100", "row_local"])
@pytest.mark.parametrize(("n", "m"), [(1, 1), (33, 1), (95, 31), (95, 95)])
def test_adjoint_passes_the_dot_test_both_are_the_dense_matrix_and_rows_are_orthonormal(
    kind, n, m
):
    m = n if kind == "full" else m
    phi = make_phi(kind, n, m, seed=3)
    phi.lay_out(np.ones((5, 19) if n == 95 else (1, n), np.bool_))
    check_phi(phi)
    if kind not in ("gaussian", "row_local"):
        matrix = phi.dense()
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(m), atol=1e-12)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (64, 21), (400, 400)])
def test_lipschitz_bounds_a_gaussian_from_above_and_closely(n, m):
    phi = make_phi("gaussian", n, m, seed=7)
    largest = np.linalg.svd(phi.dense(), compute_uv=False)[0] ** 2
    assert largest <= phi.lipschitz <= largest + 2e-6


def test_sbhe_rows_are_signs_on_one_block_of_32_taxels():
    phi = SbhePhi(n=784, m=200, seed=1, block=32)
    for row in phi.dense():
        values = np.abs(row[row != 0])
        size = values.size
        assert size in (32, 16)  # 784 = 24 x 32 + 16
        np.testing.assert_allclose(values, 1 / np.sqrt(size), rtol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_a_batch_gives_the_bits_of_its_frames_and_leaves_the_input_alone(kind):
    phi = make_phi(kind, 100, 100 if kind == "full" else 33, seed=2)
    for apply, given_to in (
        (phi.forward, normal((5, phi.n))),
        (phi.adjoint, normal((5, phi.m))),
    ):
        before = given_to.copy()
        np.testing.assert_array_equal(apply(given_to), [apply(one) for one in given_to])
        np.testing.assert_array_equal(given_to, before)


def test_wrong_shapes_and_types_are_named():
    phi = make_phi("sbhe", 64, 20, seed=2)
    with pytest.raises(PhiError, match=r"x has shape \(63,\); expected \(64,\)"):
        phi.forward(normal(63))
    with pytest.raises(PhiError, match=r"y has shape \(64,\); expected \(20,\)"):
        phi.adjoint(normal(64))

    with pytest.raises(PhiError, match=r"x has shape \(2, 3, 64\)"):
        phi.forward(normal((2, 3, 64)))


def test_fingerprints_are_of_the_matrix():
    asked = [
        ("sbhe", 784, 261, 0, 32),
        ("sbhe", 784, 261, 1, 32),
        ("sbhe", 784, 261, 0, 16),
        ("sbhe", 783, 261, 0, 32),
        ("subsample", 784, 261, 0, 32),
        ("subsample", 784, 784, 0, 32),
        ("gaussian", 784, 261, 0, 32),
        ("full", 784, 784, 0, 32),
    ]
    prints = [make_phi(*one).fingerprint for one in asked]
    assert len(set(prints)) == len(asked)
    assert prints == [make_phi(*one).fingerprint for one in asked]
    assert all(len(p) == 16 and int(p, 16) >= 0 for p in prints)
    # Every seed gives the same matrix.
    for kind, n in (("full", 9), ("sbhe", 1)):
        assert len({make_phi(kind, n, n, seed).fingerprint for seed in range(3)}) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_describe_is_enough_to_make_it_again(kind):
    phi = make_phi(kind, 100, 100 if kind == "full" else 30, seed=11, block=16)
    described = {"kind": kind, "n": 100, "m": phi.m, "seed": 11, "block": 16, "rule": 3}
    assert phi.describe() == described
    assert make_phi(**phi.describe()).fingerprint == phi.fingerprint
    assert phi.ratio == 100 / phi.m


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sbeh", 64, 20, 0), 'phi "sbeh" is not known.*sbhe'),
        (("sbhe", 64, 65, 0), r"m = 65 is not allowed; allowed: 1\.\.64"),
        (("sbhe", 64, 20, -1), "seed = -1 is not allowed"),
        (("sbhe", 64, 20, 0, 0), "block = 0 is not allowed"),
        (("sbhe", 64, 20.0, 0), "m = 20.0 is not allowed; allowed: a whole number"),
        (("sbhe", 64, 20, 0, 32, 2), "phi: rule = 2 is not allowed; allowed: 1, 3"),
        (("full", 64, 20, 0), "m = 20 is not allowed; allowed: 64"),
        (("gaussian", 4097, 20, 0), r"n = 4097 is not allowed; allowed: 1\.\.4096"),
        (("no_such_module:Phi", 64, 20, 0), "no_such_module"),
        (
            ("collections:OrderedDict", 64, 20, 0),
            "no measurement matrix: it lacks kind",
        ),
        (("decimal:Decimal", 64, 20, 0), "does not take n, m, seed, block"),
        (
            (f"{__name__}:Unnamed", 64, 64, 0),
            "fingerprint = ''; expected 16 hexadecimal digits",
        ),
        (("local:", 64, 8, 0), 'phi "local:": expected local:SIDE'),
        (("local:0", 64, 8, 0), "1..4096"),
        (("local", 64, 8, 0), "is not known"),
    ],
)
def test_what_cannot_be_made_is_named(arguments, message):
    with pytest.raises(PhiError, match=message):
        make_phi(*arguments)
