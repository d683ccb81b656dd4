"""The names that `import sparseskin` gives, on arrays and without processes."""

import doctest
import importlib
import warnings

import bags
import numpy as np
import pytest
from damaged import refusal

import sparseskin
from sparseskin import arrays, compress, make_basis, make_phi, make_solver, reconstruct
from sparseskin.messages.state import CLIP_SD
from sparseskin.nodes.compressor.phi.identity import SubsamplePhi
from sparseskin.nodes.errors import SolverError, SparseskinError
from sparseskin.nodes.sensor.noise import PAPER_SIGMA_END_N


def test_every_name_is_there_and_listed():
    for name in sparseskin.__all__:
        assert getattr(sparseskin, name)
    assert set(sparseskin.__all__) <= set(dir(sparseskin))
    with pytest.raises(AttributeError, match="no attribute 'make_phy'"):
        sparseskin.make_phy  # noqa: B018


@pytest.mark.parametrize("module", ["arrays", "stream"])
def test_examples_in_docstrings_give_what_they_state(module):
    found = doctest.testmod(importlib.import_module(f"sparseskin.{module}"))
    assert found.attempted > 0
    assert found.failed == 0


def test_compress_measures_existing_taxels_alone():
    mask = np.ones((4, 4), np.bool_)
    mask[0, :2] = False
    phi = make_phi("subsample", n=14, m=14, seed=0)
    frames = np.arange(32, dtype=np.float32).reshape(2, 4, 4)
    np.testing.assert_array_equal(compress(frames, phi, mask), frames[:, mask])


def test_reconstruct_warns_once_of_threads_that_slow_it_down(monkeypatch):
    config = {"Build Dependencies": {"blas": {"name": "scipy-openblas"}}}
    monkeypatch.setattr(np, "show_config", lambda mode: config)
    monkeypatch.setattr("os.cpu_count", lambda: 2)
    monkeypatch.setenv("SPARSESKIN_FAST", "off")
    threads = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS")
    phi = make_phi("sbhe", n=64, m=32, seed=0)
    basis = make_basis("haar", 8, 8)
    y = np.zeros(32, np.float32)
    for solver_name, stated, expected in (
        ("skin", 0, 1),
        ("skin", 1, 0),
        ("fista", 0, 0),
    ):
        for name in threads:
            monkeypatch.delenv(name, raising=False)
        if stated:
            monkeypatch.setenv(threads[0], "1")
        arrays.warn_of_threads.cache_clear()
        solver = make_solver(solver_name, phi, basis, rows="fixed")
        with warnings.catch_warnings(record=True) as found:
            warnings.simplefilter("always")
            for _ in range(2):
                reconstruct(y, solver)
        assert ["OPENBLAS_NUM_THREADS=1" in str(one.message) for one in found] == [
            True
        ] * expected


def test_row_subsets_measure_frames_in_turn():
    frames = np.random.default_rng(0).random((7, 8, 8), dtype=np.float32)
    phi = make_phi("sbhe", n=64, m=22, seed=0)
    subsets = phi.row_subsets()
    y = compress(frames, phi)
    np.testing.assert_array_equal(compress(frames, phi, rows="rotating"), y)
    for k, frame in enumerate(frames):
        np.testing.assert_array_equal(y[k], subsets[k % 3].forward(frame.reshape(-1)))
    np.testing.assert_array_equal(compress(frames[0], phi, rows="rotating"), y[0])
    assert np.array_equal(
        compress(frames, phi, rows="fixed"), phi.forward(frames.reshape(7, 64))
    )
    assert compress(frames[:0], phi, rows="rotating").shape == (0, 22)


@pytest.mark.parametrize("solver", ["skin", "fista"])
def test_arrays_give_the_bits_of_the_nodes_by_default(solver):
    stated = {"skin": "iterations=24", "fista": "preset=paper"}[solver]
    # touched from frame 320 on
    settings = [
        "sensor.first=310",
        f"reconstructor.{stated}",
    ]
    launch = sparseskin.load_launch("lift_box_40", settings)
    frames = list(sparseskin.run_launch(launch, 30))
    assert frames[0].patch == "skin"
    assert frames[0].truth.shape == (40, 40)
    taxels = np.stack([frame.taxels for frame in frames])
    phi = make_phi("sbhe", n=1600, m=534, seed=0)
    y = compress(taxels, phi)
    np.testing.assert_array_equal(y, np.stack([frame.measurements for frame in frames]))
    made = make_solver(solver, phi, make_basis("haar", 40, 40))
    made.noise_sd = PAPER_SIGMA_END_N * CLIP_SD  # as the scene states
    forces = reconstruct(y, made)
    np.testing.assert_array_equal(forces, np.stack([frame.forces for frame in frames]))
    made.reset()
    np.testing.assert_array_equal(reconstruct(y[:20], made), forces[:20])
    assert reconstruct(y[:0], made).shape == (0, 40, 40)


def test_a_single_frame_of_rotating_rows_is_refused_unless_its_row_subset_is_stated():
    phi = make_phi("sbhe", 64, 22, 0)
    basis = make_basis("haar", 8, 8)
    y = compress(np.ones((4, 8, 8), np.float32), phi, rows="rotating")
    solver = make_solver("skin", phi, basis)
    with pytest.raises(SolverError, match=r"call solver\.use\(solver\.subsets\[k % "):
        reconstruct(y[1], solver)
    found = []
    for k, one in enumerate(y):
        solver.use(solver.subsets[k % len(solver.subsets)])
        found.append(reconstruct(one, solver))
    solver.reset()
    np.testing.assert_array_equal(found, reconstruct(y, solver))


def test_psnr_of_frames_is_that_of_each():
    truth, taxels = sparseskin.simulate("lift_box_40", 4, seed=1)
    assert truth.shape == taxels.shape == (4, 40, 40)
    truth = np.zeros((2, 3, 3), np.float32)
    found = sparseskin.psnr_db(
        truth + np.float32([[[0.1]], [[0.025]]]), truth, f_max=1.0
    )
    assert found == pytest.approx([20.0, 20 * np.log10(40)], abs=1e-4)
    counts = np.full((2, 2), 4000, np.uint16)
    with pytest.raises(
        SparseskinError, match=r"reaches 4000, above f_max = 2.5; state f_max"
    ):
        sparseskin.psnr_db(counts, counts)
    assert sparseskin.psnr_db(
        counts - np.uint16(40), counts, f_max=4000
    ) == pytest.approx(40)


def test_a_plot_has_a_map_of_each_frame_on_one_scale():
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    rng = np.random.default_rng()
    k, n_rows, n_cols = rng.integers(1, (9, 12, 12))
    frames = rng.random((k, n_rows, n_cols), np.float32)
    mask = rng.random((n_rows, n_cols)) < 0.5
    mask.flat[rng.integers(mask.size)] = True

    titles = [f"frame {number}" for number in range(k)]
    panels = sparseskin.plot_forces(frames, titles, "counts", mask)
    assert [panel.get_title() for panel in panels] == titles
    for panel, frame in zip(panels, frames, strict=True):
        (image,) = panel.images
        assert image.get_clim() == (0, frames[:, mask].max())
        np.testing.assert_array_equal(image.get_array().mask, ~mask)
        np.testing.assert_array_equal(image.get_array()[mask], frame[mask])
    *_, bar = panels[0].figure.axes
    assert bar.get_ylabel() == "force in counts"
    matplotlib.pyplot.close(panels[0].figure)


def test_a_bag_is_read_into_arrays(tmp_path):
    path = tmp_path / "run.mcap"
    bags.make_bag(path, bags.frames(5))
    recording = sparseskin.read_recording(path)
    shape = (5, bags.N_ROWS, bags.N_COLS)
    assert recording["forces"].shape == recording["reconstruction"].shape == shape
    assert recording["measurements"].shape == (5, bags.M)
    assert np.diff(recording["stamp_ns"]).tolist() == [bags.PERIOD_NS] * 4
    np.testing.assert_array_equal(recording["mask"], bags.MASK)
    with pytest.raises(SparseskinError, match="has no patch 'palm'"):
        sparseskin.read_recording(path, patch="palm")


def test_a_node_that_fails_or_refuses_ends_a_run_with_its_error(tmp_path, monkeypatch):
    file = tmp_path / "log.npy"
    np.save(file, np.ones((3, 8, 8), np.float32))
    source = f"sensor.source=file:{file}"
    failing = [source, "sensor.rate_hz=100", "sensor.unit=N", "compressor.ratio=5000"]
    line = r"^--set compressor.ratio=5000: 5000 leaves no measurement of 64 taxels"
    # before the run: the file states its shape
    with pytest.raises(SparseskinError, match=line):
        list(sparseskin.run_launch("replay", 3, failing))
    (tmp_path / "own_driver.py").write_text(
        "def frames():\n    yield 0, [[0.5] * 8] * 8\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    failing[0] = "sensor.source=own_driver:frames"
    with pytest.raises(
        SparseskinError, match=r"^compressor: .*leaves no measurement of 64 taxels"
    ):
        list(sparseskin.run_launch("replay", 3, failing))
    (tmp_path / "own_raising.py").write_text(
        "from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver\n"
        "class Raising(FistaSolver):\n"
        "    def setup(self, *arguments): raise ZeroDivisionError('of its own')\n"
    )
    raising = ["reconstructor.solver=own_raising:Raising"]
    with pytest.raises(
        SparseskinError, match=r"^reconstructor: .*ZeroDivisionError: of its own"
    ):
        list(sparseskin.run_launch("path_40", 3, raising))


@pytest.mark.parametrize("n_frames", [0, 2.0])
def test_arguments_of_a_run_are_named(n_frames):
    with pytest.raises(
        SparseskinError, match=r"^simulate: n_frames = .* is not allowed"
    ):
        sparseskin.simulate("lift_box_40", n_frames)
    with pytest.raises(
        SparseskinError, match=r"^run_launch: n_frames = .* is not allowed"
    ):
        next(sparseskin.run_launch("path_40", n_frames))
    with pytest.raises(
        SparseskinError, match=r"^settings: expected a list, .* not a text$"
    ):
        next(sparseskin.run_launch("path_40", 3, "compressor.ratio=4"))


PHI = make_phi("sbhe", 64, 22, 0)
BASIS = make_basis("haar", 8, 8)
OTHER = make_phi("gaussian", 64, 22, 0)


class Choosing(SubsamplePhi):
    """One whose taxels are chosen anew in each frame."""

    kind = "choosing"
    choice = "places"


CHOOSING = Choosing(64, 22, 0)
X = np.ones((2, 8, 8), np.float32)
# From its first frames on a matrix measures those of their grid, whichever test comes first.
compress(X, PHI, tare=0)
Y = np.ones((2, 22), np.float32)


MASKED = np.ma.array(X, mask=X > 0)


def solver():
    return make_solver("fista", PHI, BASIS)


def psnr(**given):
    return sparseskin.psnr_db(**{"forces": X, "truth": X, **given})


def noisy(**stated):
    noisy_solver = solver()
    vars(noisy_solver).update(stated)
    return reconstruct(Y, noisy_solver)


MISTAKES = {
    "the mask is bool of shape (4, 16); expected bool of shape (8, 8)": lambda: (
        compress(X, PHI, np.ones((4, 16), np.bool_))
    ),
    "the mask is int64 of shape": lambda: compress(X, PHI, X[0].astype(int)),
    "compress: forces[1, 0, 3] is nan; allowed: numbers within": lambda: compress(
        np.where(np.arange(128).reshape(2, 8, 8) == 67, np.nan, X), PHI
    ),
    "compress: forces: type int64; allowed: newtons": lambda: compress(
        np.ones((8, 8), int), PHI
    ),
    "compress: forces: type complex": lambda: compress(X * 1j, PHI),
    "compress: forces: type object": lambda: compress(X.astype(object), PHI),
    "compress: forces: shape (64,)": lambda: compress(X[0].reshape(-1), PHI),
    "compress: 256 taxels of (16, 16) exist": lambda: compress(np.ones((16, 16)), PHI),
    '"rotating" is not allowed for phi "gaussian"': lambda: compress(
        X, OTHER, rows="rotating"
    ),
    'compress: phi "choosing" chooses rows by what it': lambda: compress(X, CHOOSING),
    "rows: 'turning' is not allowed": lambda: make_solver(
        "skin", PHI, BASIS, rows="turning"
    ),
    "phi: got ndarray": lambda: compress(PHI, X),
    "measures frames of (8, 8), not of (4, 16)": lambda: make_solver(
        "fista", PHI, make_basis("haar", 4, 16)
    ),
    "phi: got HaarBasis; expected what": lambda: make_solver("fista", BASIS, PHI),
    "basis: got str; expected what": lambda: make_solver("fista", PHI, "haar"),
    "make_basis: n_rows = '8' is not allowed": lambda: make_basis("haar", "8", 8),
    "basis: 0 x 8 is no grid; allowed: whole numbers 1..4096": lambda: make_basis(
        "haar", 0, 8
    ),
    "y has shape (21,); expected (22,)": lambda: reconstruct(Y[:, :21], solver()),
    "measurements: type complex": lambda: reconstruct(Y * 1j, solver()),
    "solver: got ndarray": lambda: reconstruct(solver(), Y),
    "the frame has shape (2, 32); expected (8, 8)": lambda: sparseskin.Stream(
        (8, 8)
    ).compress(X[0].reshape(2, 32)),
    "stream: readings: type complex": lambda: sparseskin.Stream((8, 8)).compress(
        X[0] * 1j
    ),
    "psnr_db: forces: type complex": lambda: sparseskin.psnr_db(X * 1j, X),
    "find_contacts: forces of shape (2, 8, 8)": lambda: sparseskin.find_contacts(
        X, 0.1
    ),
    "find_contacts: error = None is not allowed": lambda: sparseskin.find_contacts(
        X[0], None
    ),
    "find_contacts: skin: the mask is float32 [8": lambda: sparseskin.find_contacts(
        X[0], 0.1, mask=X[0]
    ),
    "find_contacts: sd of shape (8, 7); allowed: 0": lambda: sparseskin.find_contacts(
        X[0], 0.1, sd=X[0, :, 1:]
    ),
    "psnr_db: f_max = 'a' is not allowed; allowed: a finite n": lambda: psnr(f_max="a"),
    "psnr_db: f_max = 0 is not allowed; allowed: above 0": lambda: psnr(f_max=0),
    "psnr_db: truth[0, 0, 0] is nan; allowed: numbers": lambda: psnr(truth=X * np.nan),
    "psnr_db: forces[0, 0, 0] is 3e+38; allowed: num": lambda: psnr(forces=X * 3e38),
    "compress: forces[0, 0, 0] is 3e+38; allowed: num": lambda: compress(X * 3e38, PHI),
    "compress: forces = a masked array is not allowed; allowed: an": lambda: compress(
        MASKED, PHI
    ),
    "stream: readings: entries are masked; allowed: an": lambda: sparseskin.Stream(
        (8, 8)
    ).compress(MASKED[0]),
    "plot_forces: forces of shape (25, 8, 8); allowed: shape (n_rows, n_cols), or": lambda: (
        sparseskin.plot_forces(np.ones((25, 8, 8), np.float32))
    ),
    "plot_forces: forces of shape (2, 8, 8); allowed": lambda: sparseskin.plot_forces(
        X * np.nan
    ),
    "plot_forces: 1 titles; expected one for each of 2": lambda: sparseskin.plot_forces(
        X, "two"
    ),
    "plot_forces: skin: the mask is float32 [8, 8]": lambda: sparseskin.plot_forces(
        X, mask=X[0]
    ),
    "make_phi: missing a required argument: 'n'; expected: make_phi(kind, n, m, s": lambda: (
        make_phi("sbhe")
    ),
    "make_phi: kind = 3 is not allowed; allowed: a text": lambda: make_phi(
        3, 64, 22, 0
    ),
    "phi: n = 1000000000000 is not allowed; allowed: 1..16777216": lambda: make_phi(
        "sbhe", 10**12, 22, 0
    ),
    "make_basis: name = 3 is not allowed; allowed: a text": lambda: make_basis(3, 8, 8),
    "run_launch: launch = None is not allowed; allowed: a LaunchFile or a text": lambda: (
        sparseskin.run_launch(None)
    ),
    "run_launch: settings = [3] is not allowed; allowed: a list of": lambda: (
        sparseskin.run_launch("path_40", 1, [3])
    ),
    "load: name = None is not allowed; allowed: a text": lambda: sparseskin.load_launch(
        None
    ),
    "read_recording: path = 3 is not allowed; allowed: a text or a path": lambda: (
        sparseskin.read_recording(3)
    ),
    "solver: noise_model = 0.1 is not allowed; allowed: a NoiseModel": lambda: noisy(
        noise_model=0.1
    ),
    "solver: noise_sd = nan is not allowed": lambda: noisy(noise_sd=np.nan),
    "solver: got None; expected what make_solver": lambda: sparseskin.check_solver(
        None
    ),
}


@pytest.mark.parametrize("line", MISTAKES)
def test_a_natural_mistake_is_answered_in_one_line(line):
    assert line in refusal(lambda: MISTAKES[line](), SparseskinError)


def test_missing_readings_of_a_file_are_treated_as_stated(tmp_path):
    frames = np.ones((3, 4, 4), np.float32)
    frames[1, 2, 2] = np.nan
    np.save(tmp_path / "log.npy", frames)
    found = sparseskin.read_recording(tmp_path / "log.npy", nan="hold")
    np.testing.assert_array_equal(found["forces"], np.ones((3, 4, 4)))
    with pytest.raises(SparseskinError, match=r"nan: 'hodl' .*did you mean 'hold'"):
        sparseskin.read_recording(tmp_path / "log.npy", nan="hodl")
    with pytest.raises(
        SparseskinError, match=r"nann: unknown argument .*did you mean 'nan'"
    ):
        sparseskin.read_recording(tmp_path / "log.npy", nann="hold")
