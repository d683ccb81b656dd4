"""Arrays in files of MATLAB and HDF5: which one is taken, in which order, and what is refused."""

import io
import re
import struct
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PATIENCE_S
from damaged import mutated, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.process import isolation
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.plugins.vendors import matlab

h5py = pytest.importorskip("h5py", reason="h5py is not installed")
FRAMES = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
LAST = np.moveaxis(FRAMES, 0, -1)


@pytest.fixture(autouse=True)
def direct(request, monkeypatch):
    """Read in this process, without the start of another, unless a test is of that."""

    def output_of(module, name, most, topic, *, n_bytes, data):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(data)))
        key, array = matlab._chosen(name, int(most), topic or None)
        np.save(out := io.BytesIO(), array)
        return f"{key}\n".encode() + out.getvalue()

    monkeypatch.setattr(isolation, "START_S", PATIENCE_S)
    if "isolated" not in request.keywords:
        monkeypatch.setattr(matlab, "output_of", output_of)


def mat(packed=True, **arrays):
    buffer = io.BytesIO()
    savemat(buffer, arrays, do_compression=packed)
    return buffer.getvalue()


def hdf5(**arrays):
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name, array in arrays.items():
            file[name.replace("__", "/")] = array
    return buffer.getvalue()


def read(folder, name, raw, **stated):
    (folder / name).write_bytes(raw)
    return open_file(folder / name, **stated)


@pytest.mark.parametrize(
    ("name", "raw", "stated"),
    [
        ("a.mat", mat(forces=LAST, a=LAST, text="x", cell=np.array([1, "a"], object)), {}),
        pytest.param(
            *("a.mat", mat(False, a=LAST, b=LAST), {"topic": "b"}), marks=pytest.mark.isolated
        ),
        ("a.mat", mat(log={"rate": 9.0, "left": {"pad": LAST}}), {}),
        ("a.mat", mat(a=LAST + 1, log={"left": {"pad": LAST}}), {"topic": "log.left.pad"}),
        ("a.mat", mat(a=FRAMES), {"n_rows": 3, "n_cols": 4}),
        ("a.mat", mat(a=FRAMES.reshape(2, 12)), {"n_rows": 3}),
        ("a.mat", hdf5(a=LAST.T), {}),
        ("a.h5", hdf5(run__left=FRAMES, run__right=FRAMES), {"topic": "/run/left"}),
        ("a.hdf5", hdf5(run__forces=FRAMES, b=FRAMES), {}),
    ],
)
def test_the_frames_are_found(tmp_path, name, raw, stated):
    source = read(tmp_path, name, raw, **stated)
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert source.skin.unit == "counts"


@pytest.mark.parametrize(
    ("name", "raw", "message"),
    [
        ("a.mat", mat(a=LAST, b=LAST), r"a .3-D., b .3-D.; add topic=a"),
        ("a.mat", mat(a="text"), "holds no arrays of frames"),
        ("a.mat", mat(a=LAST)[:180], "cannot be read"),
        ("a.mat", b"MATLAB" * 40, "cannot be read"),
        ("a.h5", hdf5(a=np.zeros((2, 3, 4), complex)), "dtype 'complex128'"),
        ("a.h5", hdf5(a=FRAMES)[:900], "cannot be read"),
    ],
)
def test_what_holds_no_frames_is_refused(tmp_path, name, raw, message):
    assert re.search(message, refusal(lambda: read(tmp_path, name, raw), SourceError))


def test_links_to_other_files_are_not_followed(tmp_path):
    (tmp_path / "b.h5").write_bytes(hdf5(forces=FRAMES))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["forces"] = h5py.ExternalLink(str(tmp_path / "b.h5"), "forces")
        layout = h5py.VirtualLayout((2, 3, 4), "u2")
        layout[:] = h5py.VirtualSource(str(tmp_path / "b.h5"), "forces", (2, 3, 4))
        file.create_virtual_dataset("virtual", layout)
    for topic in (None, "forces", "virtual"):
        with pytest.raises(SourceError, match="holds no arrays of frames"):
            open_file(tmp_path / "a.h5", topic=topic)


def test_a_reader_that_is_ended_is_named_with_its_signal(tmp_path, monkeypatch):
    (tmp_path / "dying.py").write_text("import os; os.kill(os.getpid(), 11)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(SourceError, match=r"^any\.mat: its reader was ended by SIGSEGV; a damaged"):
        isolation.output_of("dying", "any.mat", n_bytes=1)


@pytest.mark.isolated
def test_bytes_at_which_scipy_may_end_the_process_are_refused_in_one_line(tmp_path):
    raw = bytearray(mat(False, forces=LAST.astype(float)))
    at = raw.index(struct.pack("<II", 9, 8 * LAST.size))  # 9: of float64
    raw[at] = 200
    # What SciPy does with a type that it has no entry for depends on what its memory holds there.
    ends = r"its reader (was ended|failed).*; a damaged"
    with pytest.raises(SourceError, match=rf"^\S+any\.mat: ({ends}|cannot be read \()") as refused:
        read(tmp_path, "any.mat", bytes(raw))
    assert "\n" not in str(refused.value)


@pytest.mark.isolated
@settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    max_examples=settings().max_examples // 5,  # each starts a process
)
@given(data=st.data(), packed=st.booleans())
def test_mutated_files_of_matlab_are_read_or_refused_in_one_line(tmp_path, data, packed):
    raw = mutated(data, mat(packed, forces=LAST))
    refusal(lambda: read(tmp_path, "any.mat", raw), SourceError)
