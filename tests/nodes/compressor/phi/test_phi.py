"""Measurement matrices: the fast forms agree with the dense matrices; fingerprints differ."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matrices import assert_operators

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import PhiError

SIZES = [1, 3, 33, 95, 784]


def measurements_for(kind: str, n: int) -> list[int]:
    return [n] if kind == "full" else sorted({1, max(1, n // 3), n})


CASES = [
    (kind, n, m)
    for kind in ("sbhe", "full", "subsample", "gaussian")
    for n in SIZES
    for m in measurements_for(kind, n)
    if not (kind == "gaussian" and m == n == 784)  # the same code as smaller ones, and slow
]


def normal(shape: int | tuple[int, ...], seed: int = 5) -> npt.NDArray[np.float32]:
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


@given(n=st.integers(1, 200), data=st.data(), block=st.sampled_from([1, 2, 4, 8, 32, 64, 256]))
@settings(max_examples=60, deadline=None)
def test_sbhe_of_any_size_and_block_is_its_dense_matrix(
    n: int, data: st.DataObject, block: int
) -> None:
    m = data.draw(st.integers(1, n))
    assert_operators(make_phi("sbhe", n, m, seed=data.draw(st.integers(0, 2**32)), block=block))


@pytest.mark.parametrize(("kind", "n", "m"), CASES)
def test_adjoint_passes_the_dot_test_both_are_the_dense_matrix_and_rows_are_orthonormal(
    kind: str, n: int, m: int
) -> None:
    phi = make_phi(kind, n, m, seed=3)
    assert_operators(phi)
    if kind != "gaussian":
        matrix = phi.dense()
        np.testing.assert_allclose(matrix @ matrix.T, np.eye(m), atol=1e-12)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 2), (64, 21), (400, 400)])
def test_lipschitz_bounds_a_gaussian_from_above_and_closely(n: int, m: int) -> None:
    phi = make_phi("gaussian", n, m, seed=7)
    largest = np.linalg.svd(phi.dense(), compute_uv=False)[0] ** 2
    assert largest <= phi.lipschitz <= largest + 2e-6


def test_sbhe_rows_are_signs_on_one_block_of_32_taxels() -> None:
    phi = SbhePhi(n=784, m=200, seed=1, block=32)
    for row in phi.dense():
        values = np.abs(row[row != 0])
        size = values.size
        assert size in (32, 16)  # 784 = 24 x 32 + 16
        np.testing.assert_allclose(values, 1 / np.sqrt(size), rtol=1e-12)


@pytest.mark.parametrize("kind", ["sbhe", "full", "subsample", "gaussian"])
@pytest.mark.parametrize("n", [1, 33, 784])
def test_a_batch_gives_the_bits_of_its_frames_in_out_and_leaves_the_input_alone(
    kind: str, n: int
) -> None:
    phi = make_phi(kind, n, n if kind == "full" else max(1, n // 3), seed=2)
    for apply, given_to, size in (
        (phi.forward, normal((5, phi.n)), phi.m),
        (phi.adjoint, normal((5, phi.m)), phi.n),
    ):
        before, out = given_to.copy(), np.full((5, size), 9, np.float32)
        assert apply(given_to, out) is out
        np.testing.assert_array_equal(out, [apply(one) for one in given_to])
        np.testing.assert_array_equal(given_to, before)


def test_wrong_shapes_and_types_are_named() -> None:
    phi = make_phi("sbhe", 64, 20, seed=2)
    with pytest.raises(PhiError, match=r"x has shape \(63,\); expected \(64,\)"):
        phi.forward(normal(63))
    with pytest.raises(PhiError, match=r"y has shape \(64,\); expected \(20,\)"):
        phi.adjoint(normal(64))
    with pytest.raises(PhiError, match=r"out is float64 .*expected contiguous float32"):
        phi.forward(normal(64), np.empty(20))  # type: ignore[arg-type]
    with pytest.raises(PhiError, match=r"shape \(19,\)"):
        phi.forward(normal(64), np.empty(19, dtype=np.float32))
    with pytest.raises(PhiError, match="expected contiguous float32"):
        phi.forward(normal(64), np.empty(40, dtype=np.float32)[::2])
    with pytest.raises(PhiError, match=r"x has shape \(2, 3, 64\)"):
        phi.forward(normal((2, 3, 64)))


def test_fingerprints_are_of_the_matrix() -> None:
    asked = [
        ("sbhe", 784, 261, 0, 32),
        ("sbhe", 784, 261, 1, 32),
        ("sbhe", 784, 260, 0, 32),
        ("sbhe", 784, 261, 0, 16),
        ("sbhe", 783, 261, 0, 32),
        ("subsample", 784, 261, 0, 32),
        ("subsample", 784, 261, 1, 32),
        ("subsample", 784, 784, 0, 32),
        ("gaussian", 784, 261, 0, 32),
        ("gaussian", 784, 261, 1, 32),
        ("full", 784, 784, 0, 32),
        ("full", 783, 783, 0, 32),
    ]
    prints = [make_phi(*one).fingerprint for one in asked]
    assert len(set(prints)) == len(asked)
    assert prints == [make_phi(*one).fingerprint for one in asked]
    assert all(len(p) == 16 and int(p, 16) >= 0 for p in prints)
    # Every seed gives the same matrix.
    for kind, n in (("full", 9), ("sbhe", 1)):
        assert len({make_phi(kind, n, n, seed).fingerprint for seed in range(3)}) == 1


@pytest.mark.parametrize("kind", ["sbhe", "full", "subsample", "gaussian"])
def test_describe_is_enough_to_make_it_again(kind: str) -> None:
    phi = make_phi(kind, 100, 100 if kind == "full" else 30, seed=11, block=16)
    described = {"kind": kind, "n": 100, "m": phi.m, "seed": 11, "block": 16, "rule": 2}
    assert phi.describe() == described
    assert make_phi(**phi.describe()).fingerprint == phi.fingerprint
    assert phi.ratio == 100 / phi.m


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("sbeh", 64, 20, 0), 'phi "sbeh" is not known.*sbhe'),
        (("sbhe", 64, 0, 0), r"m = 0 is not allowed; allowed: 1\.\.64"),
        (("sbhe", 64, 65, 0), r"m = 65 is not allowed; allowed: 1\.\.64"),
        (("sbhe", 0, 0, 0), "n = 0 is not allowed; allowed: at least 1"),
        (("sbhe", 64, 20, -1), "seed = -1 is not allowed"),
        (("sbhe", 64, 20, 0, 24), "block = 24 is not allowed; allowed: a power of two"),
        (("sbhe", 64, 20, 0, 0), "block = 0 is not allowed"),
        (("sbhe", 64, 20.0, 0), "m = 20.0 is not allowed; allowed: an integer"),
        (("sbhe", True, True, 0), "n = True is not allowed"),
        (("sbhe", 64, 20, 0, 32, 0), "phi: rule = 0 is not allowed; allowed: 1, 2"),
        (("sbhe", 64, 20, 0, 32, 3), "phi: rule = 3 is not allowed; allowed: 1, 2"),
        (("full", 64, 20, 0), "m = 20 is not allowed; allowed: 64"),
        (("gaussian", 4097, 20, 0), r"n = 4097 is not allowed; allowed: 1\.\.4096"),
        (("no_such_module:Phi", 64, 20, 0), "no_such_module"),
        (("sparseskin.nodes.compressor.phi.sbhe:SbhePhy", 64, 20, 0), "SbhePh"),
        (("collections:OrderedDict", 64, 20, 0), "no measurement matrix: it lacks kind"),
        (("decimal:Decimal", 64, 20, 0), "does not take n, m, seed, block"),
    ],
)
def test_what_cannot_be_made_is_named(arguments: tuple[object, ...], message: str) -> None:
    with pytest.raises(PhiError, match=message):
        make_phi(*arguments)  # type: ignore[arg-type]


def run_python(code: str, **environment: str) -> str:
    return subprocess.run(
        [sys.executable, "-c", code],
        env={**os.environ, **environment},
        check=True,
        capture_output=True,
        text=True,
    ).stdout


def test_the_edge_loads_no_scipy_and_no_wavelets() -> None:
    code = (
        "import sys; from sparseskin.nodes.compressor.phi.base import make_phi, KINDS;"
        "[make_phi(k, 64, 64, seed=0) for k in KINDS];"
        "print([m for m in sys.modules if m.split('.')[0] in ('scipy', 'pywt')])"
    )
    assert run_python(code).strip() == "[]"


def test_measurements_are_the_same_bits_with_any_number_of_blas_threads() -> None:
    code = (
        "import numpy as np, hashlib; from sparseskin.nodes.compressor.phi.base import make_phi;"
        "x = np.random.default_rng(0).random(1600, dtype=np.float32);"
        "phis = [make_phi(kind, 1600, 533, seed=0) for kind in ('sbhe', 'gaussian')];"
        "bits = [p.forward(x).tobytes() + p.adjoint(p.forward(x)).tobytes() for p in phis];"
        "print([hashlib.sha256(b).hexdigest() for b in bits])"
    )
    one = run_python(code, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1")
    assert one == run_python(code, OPENBLAS_NUM_THREADS="2", OMP_NUM_THREADS="2")
