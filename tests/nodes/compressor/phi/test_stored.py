"""A sparse matrix from a file, and one that is wired: operators, and what is refused."""

import numpy as np
import pytest
import scipy.sparse
from damaged import launch_faults, refusal

from sparseskin import Stream, psnr_db, run_launch
from sparseskin.checks import check_phi
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi import stored
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_rotating_solver


def matrix_of(m, n, seed=0):
    rng = np.random.default_rng(seed)
    dense = rng.standard_normal((m, n)) * (rng.random((m, n)) < 0.2)
    dense[np.arange(m), rng.integers(0, n, m)] = 1.0
    return scipy.sparse.csr_matrix(dense.astype(np.float32))


@pytest.mark.parametrize(("m", "n"), [(1, 7), (30, 64)])
def test_operators_are_adjoint_and_are_those_of_the_file(m, n, tmp_path):
    path = tmp_path / "phi.npz"
    matrix = matrix_of(m, n)
    scipy.sparse.save_npz(path, matrix)
    phi = make_phi(f"file:{path}", n, m, 0)
    check_phi(phi)
    np.testing.assert_allclose(phi.dense(), matrix.toarray())
    largest = np.linalg.eigvalsh(phi.dense() @ phi.dense().T)[-1]
    assert phi.lipschitz <= 1.1 * largest * (1 + 1e-6)
    assert CompressorSettings(phi=phi.kind).rows_and_m(n) == ("fixed", m)
    scipy.sparse.save_npz(path, 2 * matrix)
    assert make_phi(f"file:{path}", n, m, 0).fingerprint != phi.fingerprint


def parts():
    matrix = matrix_of(4, 6)
    return {
        "indices": matrix.indices,
        "indptr": matrix.indptr,
        "data": matrix.data,
        "shape": np.array([4, 6]),
        "format": np.array(b"csr"),
    }


def changed(name, change):
    arrays = parts()
    arrays[name] = change(arrays[name].copy())
    return arrays


def alone(shape):
    return {"arr_0": np.ones(shape)}


HALF_EMPTY = np.stack([np.ones((4, 6)), np.zeros((4, 6))])


def first(value):
    def change(array):
        array[0] = value
        return array

    return change


@pytest.mark.parametrize(
    ("arrays", "line"),
    [
        ({k: v for k, v in parts().items() if k != "data"}, "has no array data"),
        (changed("format", lambda a: np.array(b"coo")), 'format: expected "csr"'),
        (changed("shape", lambda a: np.array([4, 6, 1])), "shape: 3 numbers"),
        (changed("shape", lambda a: np.array([6, 4])), "shape: 6 x 4; allowed"),
        (
            changed("shape", lambda a: np.array([4.0, 6.0])),
            "shape: expected a list of whole",
        ),
        (
            changed("indptr", first(1)),
            "no matrix of 4 x 6 in format csr: index pointer",
        ),
        (
            changed("indptr", lambda a: np.array([0, 0, 1, 2, a[-1]])),
            "data: a row holds zeros al",
        ),
        (changed("indices", first(6)), "no matrix of 4 x 6 in format csr: "),
        (
            changed("data", lambda a: a.astype(np.complex64)),
            "data: expected a list of numbers",
        ),
        (changed("data", first(np.nan)), "data: expected finite numbers"),
        (changed("data", first(1e7)), "data: expected finite numbers of at most 1e+06"),
        (
            alone((4, 6)),
            "one array, float64 of 2 dimensions; expected numbers of 3, (k, m, n)",
        ),
        (alone((0, 4, 6)), "0 matrices of 4 x 6; allowed: 1..64 of 1 <= m <= n"),
        (alone((65, 1, 1)), "65 matrices of 1 x 1; allowed: 1..64"),
        ({"arr_0": HALF_EMPTY}, "matrix 1: data: a row holds zeros alone"),
        (alone((2, 4, 7)), "is 4 x 7; expected m x n = 4 x 6"),
    ],
)
def test_a_file_that_is_no_such_matrix_is_refused_with_its_name(arrays, line, tmp_path):
    path = tmp_path / "phi.npz"
    np.savez(path, **arrays)
    found = refusal(lambda: make_phi(f"file:{path}", 6, 4, 0), PhiError)
    assert found.startswith(f"{path}: {line}")


def test_objects_bombs_and_folders_are_refused(tmp_path, monkeypatch):
    path = tmp_path / "phi.npz"
    np.savez(
        path,
        **{**parts(), "data": np.array([print] * 4, dtype=object)},
        allow_pickle=True,
    )
    with pytest.raises(PhiError, match="Python objects"):
        make_phi(f"file:{path}", 6, 4, 0)
    np.savez(path, **parts())
    monkeypatch.setattr(stored, "MAX_ARRAY_BYTES", 100)
    with pytest.raises(PhiError, match="its arrays would have"):
        make_phi(f"file:{path}", 6, 4, 0)
    with pytest.raises(PhiError, match="is no file"):
        make_phi(f"file:{tmp_path}", 6, 4, 0)
    with pytest.raises(PhiError, match="cannot be read: No such file"):
        make_phi("file:none.npz", 6, 4, 0)


def stack_of(k, m, n):
    return np.stack([(1 + one) * matrix_of(m, n, one).toarray() for one in range(k)])


def saved(path, stack):
    """The file of a stack, in the form that its name states."""
    if path.suffix == ".npz":
        np.savez_compressed(path, stack)
    else:
        np.save(path, stack)
    return path


@pytest.mark.parametrize("name", ["phi.npz", "phi.npy"])
def test_the_matrices_of_a_stack_measure_frames_in_turn(name, tmp_path):
    stack = stack_of(3, 5, 13)
    path = saved(tmp_path / name, stack)
    kind = f"file:{path}"
    assert CompressorSettings(phi=kind).rows_and_m(13) == ("rotating", 5)
    assert CompressorSettings(phi=kind, rows="fixed").rows_and_m(13) == ("fixed", 5)
    phi = make_phi(kind, 13, 5, 0)
    subsets = row_subsets(phi, "rotating")
    for one, matrix in zip(subsets, stack, strict=True):
        check_phi(one)
        np.testing.assert_array_equal(one.dense(), matrix)
        largest = np.linalg.eigvalsh(matrix.astype(float) @ matrix.T)[-1]
        assert one.lipschitz == subsets[0].lipschitz >= largest
    assert len({one.fingerprint for one in subsets}) == 3
    assert phi.fingerprint == subsets[0].fingerprint
    single = tmp_path / "single.npz"
    scipy.sparse.save_npz(single, scipy.sparse.csr_matrix(stack[1]))
    assert make_phi(f"file:{single}", 13, 5, 0).fingerprint == subsets[1].fingerprint
    saved(path, stack[:1])
    assert CompressorSettings(phi=kind).rows_and_m(13) == ("fixed", 5)
    with pytest.raises(PhiError, match='"rotating" is not allowed for phi'):
        row_subsets(make_phi(kind, 13, 5, 0), "rotating")


def test_another_size_is_refused_before_the_start(tmp_path):
    path = tmp_path / "phi.npz"
    scipy.sparse.save_npz(path, matrix_of(4, 6))
    with pytest.raises(PhiError, match="is 4 x 6; expected m x n = 4 x 7"):
        make_phi(f"file:{path}", 7, 4, 0)
    phis = [f"{node}.phi=file:{path}" for node in ("compressor", "reconstructor")]
    assert "is 4 x 6; expected m x n = 4 x 1600" in "".join(
        launch_faults("path_40", phis)
    )


def test_a_graph_and_a_stream_measure_by_a_stack_in_turn(tmp_path):
    source = row_subsets(make_phi("sbhe", 1600, 534, 0, block=32), "rotating")
    stack = np.stack([one.dense().astype(np.float32) for one in source])
    kind = f"file:{saved(tmp_path / 'phi.npz', stack)}"
    press = np.zeros((9, 40, 40), np.float32)
    press[:, 10:18, 12:24] = 0.8
    np.save(tmp_path / "press.npy", press)
    chosen = [f"{node}.phi={kind}" for node in ("compressor", "reconstructor")]
    chosen += [
        f"sensor.source=file:{tmp_path}/press.npy",
        "sensor.unit=N",
        "sensor.rate_hz=100",
    ]
    chosen += ["sensor.f_max=2.5"]
    chosen += ["reconstructor.iterations=8"]
    frames = run_launch("replay", 9, chosen)
    stream = Stream((40, 40), phi=kind, iterations=8)
    for k, frame in enumerate(frames):
        y = stack[k % 3] @ frame.taxels.reshape(-1)
        np.testing.assert_allclose(frame.measurements, y, atol=1e-5)
        found = stream.reconstruct(stream.compress(frame.taxels))
        np.testing.assert_array_equal(found, frame.forces)
    assert psnr_db(found, press[-1]) > 40


SHAPES = [(8, 8), (5, 7), (1, 9)]


def laid_out(kind, shape, m, seed=0):
    phi = make_phi(kind, shape[0] * shape[1], m, seed)
    phi.lay_out(np.ones(shape, dtype=np.bool_))
    return phi


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("kind", ["local:4", "row_local"])
def test_row_subsets_together_measure_all_rows(kind, shape):
    n = shape[0] * shape[1]
    phi = laid_out(kind, shape, max(n // 3, shape[0] + 1))
    subsets = row_subsets(phi, "rotating")
    assert len({one.fingerprint for one in subsets}) == len(subsets) >= 2
    for one in subsets:
        assert one.m == phi.m
        check_phi(one)
    assert np.linalg.matrix_rank(np.concatenate([one.dense() for one in subsets])) == n


@pytest.mark.parametrize("side", [4, 16])
def test_a_block_sums_taxels_of_its_neighbourhood_alone(side):
    blocks = laid_out(f"local:{side}", (32, 48), 512).permutation.reshape(-1, 32)
    rows, cols = np.divmod(blocks, 48)
    # A block of 32 fills two neighbourhoods of 4 x 4, and lies within larger ones.
    n_neighbourhoods = [
        len(set(zip(r // side, c // side, strict=True)))
        for r, c in zip(rows, cols, strict=True)
    ]
    assert set(n_neighbourhoods) == {max(1, 32 // side**2)}
    assert np.sort(blocks.ravel()).tolist() == list(range(32 * 48))


def test_a_mask_is_laid_out_by_its_existing_taxels():
    exists = np.ones((8, 8), dtype=np.bool_)
    exists[2:5, 3:6] = False
    phi = make_phi("local:4", 55, 20, 0)
    phi.lay_out(exists)
    check_phi(phi)
    for kind in ("local:4", "row_local", "sbhe"):
        with pytest.raises(PhiError, match="n = 55, but 64 taxels exist"):
            make_phi(kind, 55, 20, 0).lay_out(np.ones((8, 8), dtype=np.bool_))
    with pytest.raises(PhiError, match="without gaps"):
        make_phi("row_local", 55, 20, 0).lay_out(exists)


def test_driven_sums_give_the_signs_of_a_pattern():
    """y_t = 2 s_t - s_0 of the driven sums s is what the matrix states, times sqrt(n_cols)."""
    phi = laid_out("row_local", (4, 8), 4 * 8)
    x = np.random.default_rng(0).random((4, 8)).astype(np.float32)
    driven = (phi.patterns > 0).astype(np.float64) @ x.T
    y = np.concatenate([driven[:1], 2 * driven[1:] - driven[0]]) / np.sqrt(8)
    np.testing.assert_allclose(phi.forward(x.ravel()), y.ravel(), rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("kind", ["local:8", "row_local"])
def test_a_static_press_is_reconstructed_from_rotating_rows(kind):
    shape = (16, 16)
    press = np.zeros(shape, np.float32)
    press[4:9, 6:11] = 1.0
    subsets = row_subsets(laid_out(kind, shape, 96), "rotating")
    solver = make_rotating_solver("skin", subsets, make_basis("haar", *shape), None)
    for k in range(30):
        phi = subsets[k % len(subsets)]
        solver.use(phi)
        forces = solver.solve(phi.forward(press.ravel()))
    assert np.abs(forces - press).max() < 0.05


def test_a_pattern_needs_all_rows_and_one_alone_has_nothing_to_rotate():
    with pytest.raises(PhiError, match="m = 7 is not allowed; allowed: 8 or more"):
        laid_out("row_local", (8, 8), 7)
    phi = laid_out("row_local", (8, 8), 8)
    assert row_subsets(phi, None) == [phi]
