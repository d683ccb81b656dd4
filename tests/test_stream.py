"""Compression and reconstruction one frame a call, with the defaults of a graph."""

import numpy as np
import pytest
from damaged import refusal
from doubting import DOUBTING

import sparseskin
from sparseskin import Stream
from sparseskin.checks import check_basis, check_phi, check_solver
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.errors import PhiError, SolverError, SparseskinError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N, PAPER_SIGMA_MID_N

FRAMES = np.random.default_rng(0).random((7, 8, 8), dtype=np.float32)


# touched from frame 320 on
@pytest.mark.parametrize(
    ("settings", "chosen"),
    [
        (
            ["sensor.first=310", "reconstructor.iterations=24"],
            {},
        ),
        (
            [
                "compressor.rows=paper",
                "compressor.ratio=4",
                "reconstructor.preset=paper",
            ],
            {"rows": "paper", "ratio": 4, "preset": "paper"},
        ),
        # Lambda is scaled with the range.
        (["reconstructor.preset=paper"], {"preset": "paper", "f_max": 40}),
        (
            [
                "compressor.phi=gaussian",
                "compressor.seed=2",
                "reconstructor.iterations=3",
            ],
            {"phi": "gaussian", "seed": 2, "iterations": 3},
        ),
        (
            [
                f"reconstructor.solver={DOUBTING}",
                "reconstructor.options.period=3",
                "reconstructor.options.n_doubted=2",
                "compressor.rows=fixed",
            ],
            {"solver": DOUBTING, "period": 3, "n_doubted": 2, "rows": "fixed"},
        ),
    ],
)
def test_a_stream_has_the_bits_and_defaults_of_a_graph(settings, chosen, tmp_path):
    if chosen:
        f_max = chosen.get("f_max", 2.5)
        np.save(tmp_path / "log.npy", FRAMES * (f_max / 2.5))
        name = "replay"
        shape = (8, 8)
        sigmas = None
        settings = [
            *settings,
            f"sensor.source=file:{tmp_path}/log.npy",
            "sensor.unit=N",
        ]
        settings += ["sensor.rate_hz=100", f"sensor.f_max={f_max}"]
    else:
        name = "lift_box_40"
        shape = (40, 40)
        sigmas = (PAPER_SIGMA_MID_N, PAPER_SIGMA_END_N)
    stream = Stream(shape, sigmas=sigmas, **chosen)
    for frame in sparseskin.run_launch(name, 30, settings):
        y = stream.compress(frame.taxels)
        np.testing.assert_array_equal(y, frame.measurements)
        np.testing.assert_array_equal(stream.reconstruct(y), frame.forces)
        assert stream.error == frame.error
        assert stream.trusted == frame.trusted
    assert stream.n == shape[0] * shape[1]
    assert stream.m == y.size


def test_a_masked_skin_is_that_of_the_arrays():
    mask = np.ones((8, 8), np.bool_)
    mask[:2, 3:] = False
    stream = Stream((8, 8), mask=mask, m=18, rows="rotating", preset="paper")
    phi = sparseskin.make_phi("sbhe", n=54, m=18, seed=0)
    basis = sparseskin.make_basis("haar", 8, 8)
    solver = sparseskin.make_solver(
        "fista", phi, basis, mask, rows="rotating", iterations=30, lambda_n=0.003125
    )
    y = sparseskin.compress(FRAMES, phi, mask, rows="rotating")
    found = [stream.compress(frame) for frame in FRAMES]
    np.testing.assert_array_equal(found, y)
    expected = sparseskin.reconstruct(y, solver)
    np.testing.assert_array_equal([stream.reconstruct(one) for one in found], expected)
    stream.reset()
    np.testing.assert_array_equal([stream.reconstruct(one) for one in found], expected)
    np.testing.assert_array_equal(stream.compress(FRAMES[0]), y[0])


@pytest.mark.parametrize("preset", ["skin", "paper"])
def test_frames_that_are_lost_do_not_mix_up_row_subsets(preset):
    """An edge and a host, which lose frames 2, 3 and 5."""
    edge = Stream((8, 8), preset=preset)
    host = Stream((8, 8), preset=preset)
    y = [edge.compress(frame) for frame in FRAMES]
    kept = (0, 1, 4, 6)
    phi = sparseskin.make_phi("sbhe", 64, 22, 0)
    basis = sparseskin.make_basis("haar", 8, 8)
    name, stated = {
        "skin": ("skin", {}),
        "paper": ("fista", {"iterations": 30, "lambda_n": 0.003125}),
    }[preset]
    solver = sparseskin.make_solver(name, phi, basis, rows="rotating", **stated)
    for k in kept:
        solver.use(solver.subsets[k % 3])
        np.testing.assert_array_equal(host.reconstruct(y[k], k), solver.solve(y[k]))
    # The number is counted from the stated one on.
    host.reset()
    solver.reset()
    host.reconstruct(y[4], 4)
    again = host.reconstruct(y[5])
    for k in (4, 5):
        solver.use(solver.subsets[k % 3])
        expected = solver.solve(y[k])
    np.testing.assert_array_equal(again, expected)


def test_refused_measurements_count_as_a_frame_and_a_frame_of_another_shape_does_not():
    stream = Stream((8, 8))
    other = Stream((8, 8))
    y = [other.compress(frame) for frame in FRAMES]
    with pytest.raises(
        SparseskinError, match=r"^stream: the frame has shape \(7, 8, 8\); exp"
    ):
        stream.compress(FRAMES)
    spoilt = FRAMES[0].copy()
    spoilt[2, 5] = np.nan
    for counts in (4095, -409):
        line = refusal(
            lambda n=counts: stream.compress(np.full((8, 8), n)), SparseskinError
        )
        assert f"a taxel reads {counts}, far beyond f_max = 2.5; state" in line
    line = refusal(lambda: stream.compress(spoilt), SparseskinError)
    assert line.startswith("stream: taxel (2, 5) reads nan; allowed: finite")
    np.testing.assert_array_equal(stream.compress(FRAMES[0]), y[0])
    with pytest.raises(SolverError, match="measurement 0 is nan"):
        stream.reconstruct(np.full(22, np.nan, np.float32))
    with pytest.raises(SolverError, match=r"y has shape \(21,\)"):
        stream.reconstruct(y[1][1:], 0)
    np.testing.assert_array_equal(stream.reconstruct(y[1]), other.reconstruct(y[1], 1))


@pytest.mark.parametrize("k", [-1, 2.0])
def test_a_number_of_a_frame_that_is_none_is_refused(k):
    with pytest.raises(
        SolverError, match=r"^stream: k = .* is not allowed; allowed: a whole"
    ):
        Stream((8, 8)).reconstruct(np.zeros(22, np.float32), k)


class Choosing(SubsamplePhi):
    """A matrix whose taxels are chosen anew in each frame."""

    choice = "places"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ({"shape": 8}, "stream: shape = 8 is not allowed; allowed: (n_rows, n_cols)"),
        (
            {"shape": (16.0, 16)},
            "stream: shape = (16.0, 16) is not allowed; allowed: (n_rows",
        ),
        (
            {"mask": np.ones((8, 7), np.bool_)},
            "skin: the mask is bool [8, 7], expected bool",
        ),
        ({"phi": f"{__name__}:Choosing"}, ':Choosing" chooses rows by what it reads'),
        ({"ratio": 100}, "ratio: 100 leaves no measurement of 64 taxels"),
        ({"solver": "fist"}, 'solver: solver "fist" is not known (did you mean'),
        ({"max_iteration": 9}, "max_iteration: is not known"),
        (
            {"solver": DOUBTING, "perod": 9},
            "options.perod: is no option of solver doubting:D",
        ),
    ],
)
def test_an_argument_that_is_not_allowed_is_one_line(arguments, line):
    assert line in refusal(
        lambda: Stream(**{"shape": (8, 8), **arguments}), SparseskinError
    )


def changed(made, **methods):
    """The same object, with methods that are wrong: functions of it and what it is given."""
    made.__class__ = type("Own", (made.__class__,), methods)
    return made


def phi(**methods):
    return changed(make_phi("gaussian", 24, 9, seed=0), **methods)


def solver(**methods):
    basis = make_basis("haar", 8, 8)
    measured = make_phi("sbhe", 64, 30, seed=0)
    return changed(make_solver("fista", measured, basis), **methods)


def half(self, y, out):
    out[:] = 0.5 * (self.dense().T @ y)


def growing(self, x, out):
    self.calls = getattr(self, "calls", 0) + 1
    out[:] = self.calls * x.sum()


@pytest.mark.parametrize(
    ("methods", "text"),
    [
        (
            {"_adjoint": half},
            "adjoint: inner products of .*; expected: the transpose, so equal",
        ),
        (
            {"_forward": growing},
            "forward: other bits on a second call; expected: the same bits",
        ),
        (
            {"lipschitz": property(lambda self: 1.0)},
            r"lipschitz: 1.0; expected: at least 2\.\d+",
        ),
        (
            {"dense": lambda self: np.zeros((9, 24))},
            "forward: a relative error of .* dense",
        ),
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
        (
            {"finish": forces(-1)},
            "forces below 0 or not finite; expected: at least 0, finite",
        ),
        (
            {"finish": lambda self: np.zeros((8, 8))},
            r"float64 \(8, 8\); expected: float32",
        ),
        (
            {"finish": forces(1)},
            "a NaN among the measurements is taken|forces for measurements",
        ),
        ({"reset": lambda self: None}, "a second run after reset"),
    ],
)
def test_a_wrong_solver_is_named(methods, text):
    assert check_solver(solver())["error"] < 1
    with pytest.raises(SolverError, match=f"solver fista: (?:{text})"):
        check_solver(solver(**methods))
