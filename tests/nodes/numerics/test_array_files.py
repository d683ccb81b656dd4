"""Arrays of files from elsewhere: read as NumPy wrote them, or refused before memory is used."""

import contextlib
import io
import tracemalloc
import zipfile

import numpy as np
import pytest

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics import array_files
from sparseskin.nodes.numerics.array_files import read_npy, read_npz
from sparseskin.nodes.sensor.files.file_source import open_file

MB = 1_000_000


def npy(array):
    made = io.BytesIO()
    np.save(made, array)
    return made.getvalue()


def npz(**arrays):
    made = io.BytesIO()
    np.savez_compressed(made, **arrays)
    return made.getvalue()


@contextlib.contextmanager
def peak_below(n_bytes):
    """No more memory than that is allocated within."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < n_bytes
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("dtype", ["u1", ">f4", "?", "<U3"])
@pytest.mark.parametrize("shape", [(), (2, 3, 4), (0, 4, 4)])
def test_arrays_are_read_as_numpy_wrote_them(shape, dtype):
    array = np.arange(np.prod(shape, dtype=int)).astype(dtype).reshape(shape)
    for written in (array, np.asfortranarray(array)):
        np.testing.assert_array_equal(read_npy(npy(written)), written)
        found = read_npz(npz(a=written, b=written), lambda names: ["b"])
        assert list(found) == ["b"]
        np.testing.assert_array_equal(found["b"], written)


def test_an_archive_that_would_grow_too_far_is_not_unpacked(tmp_path, monkeypatch):
    monkeypatch.setattr(array_files, "MAX_GROWN_BYTES", MB)
    path = tmp_path / "bomb.npz"
    path.write_bytes(npz(forces=np.zeros((40_000, 32, 32), np.uint8)))
    assert path.stat().st_size < MB / 10
    with peak_below(MB), pytest.raises(SourceError, match=r"bomb\.npz: its arrays would have 409"):
        open_file(path)


def test_a_header_in_an_archive_is_not_believed(tmp_path):
    head = npy(np.zeros((1, 4, 4)))[:128].replace(b"(1, 4, 4)", b"(1000000, 400, 4)")[:128]
    path = tmp_path / "lies.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("forces.npy", head + bytes(64))
    with peak_below(MB), pytest.raises(SourceError, match=r"array 'forces': its header states 10"):
        open_file(path)


def test_a_shape_of_truth_values_is_no_shape(tmp_path):
    path = tmp_path / "true.npy"
    path.write_bytes(npy(np.ones((1, 8, 8))).replace(b"(1, 8, 8), }   ", b"(True, 8, 8), }"))
    with pytest.raises(SourceError, match=r"true\.npy: not a readable NumPy file"):
        open_file(path)


def test_a_recording_of_bytes_takes_the_memory_of_its_frames_and_no_more(tmp_path):
    path = tmp_path / "bytes.npy"
    np.save(path, np.ones((4000, 32, 32), np.uint8))
    # The file, its frames in float32, and a part that is checked.
    with peak_below(path.stat().st_size * (1 + 4) + 12 * MB):
        assert open_file(path).n_frames == 4000
