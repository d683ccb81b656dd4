"""Compiled loops: used where numba is installed, else refused in one line; compiled once."""

import importlib.util
import os
import subprocess
import sys
import tempfile

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.numerics import compiled as fast
from sparseskin.nodes.numerics.compiled import ready, use_compiled
from sparseskin.nodes.numerics.warm_up import (
    USUAL_MODULES,
    compile_loops,
    store_bytecode,
)
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.studies.presses import press_frames

HAS_NUMBA = importlib.util.find_spec("numba") is not None
needs_numba = pytest.mark.skipif(
    not HAS_NUMBA, reason="numba is not installed (extra fast)"
)


@pytest.fixture(autouse=True)
def _no_environment(monkeypatch):
    monkeypatch.delenv(fast.ENVIRONMENT, raising=False)


@pytest.fixture
def no_numba(monkeypatch):
    monkeypatch.setattr(fast, "find_spec", lambda name: None)


@pytest.mark.usefixtures("no_numba")
def test_without_numba_auto_is_numpy_and_both_lines_name_what_to_install(monkeypatch):
    assert not use_compiled("auto")
    with pytest.raises(
        SettingsError,
        match=r"fast: 'on': numba is not installed: pip install .*\[fast\]",
    ):
        use_compiled("on")
    lines = []
    compile_loops("auto", lines.append)
    (line,) = lines
    assert line.endswith("pip install 'sparseskin[fast]'")
    compile_loops("off", pytest.fail)
    monkeypatch.setenv(fast.ENVIRONMENT, "off")
    compile_loops("auto", pytest.fail)


def test_a_numba_that_cannot_be_imported_is_not_used_and_refused_when_stated(
    monkeypatch,
):
    def fail(name):
        raise ImportError("Numba needs NumPy 2.3 or less. Got NumPy 2.9.")

    monkeypatch.setattr(fast, "find_spec", lambda name: name)
    monkeypatch.setattr(fast, "import_module", fail)
    lines = []
    compile_loops("auto", lines.append)
    assert lines == ["compiled loops: numba cannot be imported; numpy is used"]
    with pytest.raises(
        SettingsError, match=r"fast: importing numba failed: .*Got NumPy 2\.9"
    ):
        use_compiled("on")


@needs_numba
def test_the_environment_replaces_auto(monkeypatch):
    assert use_compiled("auto")
    monkeypatch.setenv(fast.ENVIRONMENT, "off")
    assert not use_compiled("auto")
    assert use_compiled("on")
    assert not use_compiled("off")
    with pytest.raises(
        SettingsError, match=r"fast: 'onn' is not known.*allowed: auto, on, off"
    ):
        use_compiled("onn")
    monkeypatch.setenv(fast.ENVIRONMENT, "of")
    with pytest.raises(
        SettingsError, match=r"SPARSESKIN_FAST: 'of' is not known.*'off'"
    ):
        use_compiled("auto")


@needs_numba
def test_compiling_is_logged_before_it_begins_and_when_it_is_done(tmp_path):
    loop = _module_of(tmp_path).double
    lines = []

    def log(line):
        lines.append((line, list(loop.signatures)))

    ready(loop, log=log)
    (first, before), (last, after) = lines
    assert "compiling" in first
    assert "ready after" in last
    assert len(before) == 0
    assert len(after) == 1
    # From the disk it is read without a word.
    ready(_module_of(tmp_path).double, log=pytest.fail)


@needs_numba
def test_all_loops_are_compiled_for_their_types_at_once_and_take_no_others():
    import numpy as np

    from sparseskin.nodes.numerics import kernels as fast_kernels

    compile_loops("on", print)
    assert all(len(loop.signatures) == 1 for loop in fast_kernels.LOOPS)
    wrong = np.zeros(4)  # float64
    with pytest.raises(TypeError, match="No matching definition"):
        fast_kernels.orthonormal(wrong, np.zeros((1, 3), np.int64), wrong)


def _run(code):
    """What a program of its own prints."""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


@needs_numba
def test_loops_that_call_blas_are_read_without_its_package_which_still_imports():
    lines = _run("""if True:
        import sys
        from sparseskin.nodes.numerics.warm_up import compile_loops
        compile_loops("on", print)
        print("scipy.linalg" in sys.modules)
        import scipy.linalg.cython_blas
        from scipy.linalg import blas, cython_blas, inv
        print(inv([[2.0]])[0, 0], cython_blas.__name__)
    """)
    assert lines == ["False", "0.5", "scipy.linalg.cython_blas"]


def test_nodes_without_a_solver_import_neither_scipy_nor_numba():
    assert _run("""if True:
        import sys
        from sparseskin.nodes.process import runner
        from sparseskin.nodes.registry import NODE_TYPES, node_class
        for name in NODE_TYPES:
            if name != "reconstructor":
                node_class(name)
        print(len({"scipy", "numba", "pywt"} & set(sys.modules)))
    """) == ["0"]


@needs_numba
def test_code_that_can_be_stored_nowhere_else_is_stored_in_a_private_temporary_folder(
    tmp_path, monkeypatch
):
    import numba
    from numba.core import caching

    temporary = tmp_path / "tmp"
    temporary.mkdir()
    monkeypatch.setattr(numba.config, "CACHE_DIR", "")
    monkeypatch.setattr(tempfile, "gettempdir", lambda: str(temporary))
    locators = vars(caching).items()
    stated_alone = [
        cls for name, cls in locators if name.endswith("UserProvidedCacheLocator")
    ]
    monkeypatch.setattr(
        caching.CompileResultCacheImpl, "_locator_classes", stated_alone
    )
    lines = []
    ready(_module_of(tmp_path).double, log=lines.append)
    assert len(lines) == 2
    ready(_module_of(tmp_path).double, log=pytest.fail)

    (folder,) = temporary.iterdir()
    assert folder.stat().st_mode & 0o777 == 0o700
    folder.chmod(0o755)  # another user could put code there
    numba.config.CACHE_DIR = ""
    ready(_module_of(tmp_path).double, log=lines.append)
    assert len(lines) == 4


@needs_numba
def test_loops_that_are_compiled_are_counted(tmp_path):
    counts = []
    loop = _module_of(tmp_path).double
    ready(loop, log=id, count=lambda *numbers: counts.append(numbers))
    assert counts == [(0, 1), (1, 1)]
    again = _module_of(tmp_path).double
    ready(again, log=id, count=lambda *numbers: counts.append(numbers))
    assert len(counts) == 2


LOOP = """
from sparseskin.nodes.numerics.compiled import compiled
@compiled("int64(int64)")
def double(k):
    return 2 * k
"""


def _module_of(folder):
    path = folder / "loops.py"
    path.write_text(LOOP)
    spec = importlib.util.spec_from_file_location("loops", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_bytecode_is_stored_where_python_stores_none(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    source = tmp_path / "drawn_module.py"
    source.write_text("VALUE = 1\n")
    stored = importlib.util.cache_from_source(str(source))
    spec = importlib.util.spec_from_file_location("drawn_module", source)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    assert not os.path.exists(stored)
    store_bytecode([module, sys])  # one without a file
    assert os.path.exists(stored)
    # A folder without a place for it is none of its errors.
    source.unlink()
    store_bytecode([module])


def test_the_modules_whose_bytecode_is_stored_exist():
    for name in USUAL_MODULES:
        assert importlib.util.find_spec(name) is not None


NOISE_SD = 0.01
"""Noise of untouched taxels, N."""


@needs_numba
@pytest.mark.parametrize("kind", ["full", "sbhe"])
def test_what_fades_on_an_untouched_skin_becomes_0_and_no_subnormal_number(kind):
    n = 32 * 32
    phi = make_phi(kind, n, n if kind == "full" else n // 3, seed=0)
    solver = make_solver("skin", phi, make_basis("haar", 32, 32), fast="on")
    solver.noise_sd = NOISE_SD
    press = [f for f, _ in press_frames("peg", (32, 32), 30, seed=0, course="sudden")]
    rng = np.random.default_rng(0)
    noise = rng.normal(0, NOISE_SD, (60, 32, 32)).astype(np.float32)
    smallest = np.finfo(np.float32).tiny
    for forces in (*press, *noise):
        solver.solve(phi.forward(forces.reshape(-1)))
        vectors = solver._estimator.vectors
        # Of fixed rows most are never read: what their filters say of them has no weight.
        for kept in (vectors.x, vectors._targets.value):
            size = np.abs(kept)
            assert not np.any((size > 0) & (size < smallest))
