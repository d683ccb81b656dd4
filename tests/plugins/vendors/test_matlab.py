"""Arrays in files of MATLAB: those that SciPy writes are read back, and what is refused."""

import io
import re
import struct

import numpy as np
import pytest
from damaged import mutated, refusal
from drawn_arrays import arrays, check
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.io import savemat
from scipy.sparse import csc_matrix

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics import array_files
from sparseskin.nodes.sensor.files import recording
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.plugins.vendors import matlab

FRAMES = np.arange(24, dtype=np.uint16).reshape(2, 3, 4)
LAST = np.moveaxis(FRAMES, 0, -1)
SHAPE = {"n_rows": 3, "n_cols": 4}
CASES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Blocks of a few frames."""
    monkeypatch.setattr(recording, "BLOCK_NUMBERS", 40)


def mat(packed=True, **content):
    buffer = io.BytesIO()
    savemat(buffer, content, do_compression=packed)
    return buffer.getvalue()


def read(folder, raw, **stated):
    (folder / "a.mat").write_bytes(raw)
    return open_file(folder / "a.mat", Layout(**stated))


def saved(array, packed, in_struct):
    """A drawn array, and its times, as the bytes of a file."""
    content = {"pressure": array.stored.astype(array.stored.dtype.newbyteorder("="))}
    if content["pressure"].dtype == np.float16:
        content["pressure"] = content["pressure"].astype(np.float32)
    if array.time_name:
        content[array.time_name] = array.times
    if in_struct:
        content = {"log": {"run": content, "name": "grasp"}, "fs": 50.0}
    return mat(packed, note="left alone", **content)


@CASES
@given(array=arrays(), packed=st.booleans(), in_struct=st.booleans())
def test_a_drawn_array_whose_axes_are_stated_is_read_as_it_was_written(
    tmp_path, array, packed, in_struct
):
    source = read(
        tmp_path, saved(array, packed, in_struct), **array.axes_stated, rate_hz=None
    )
    if array.time_name or not in_struct:
        check(source, array, has_times=True)
    else:
        assert source.rate_hz == 50.0
        np.testing.assert_array_equal(source.frames, array.frames)


@CASES
@given(array=arrays(), packed=st.booleans(), knows_shape=st.booleans())
def test_without_its_axes_it_is_read_right_or_the_ways_are_named(
    tmp_path, array, packed, knows_shape
):
    stated = array.shape_stated if knows_shape else {}
    sources = []
    raw = saved(array, packed, in_struct=False)
    text = refusal(lambda: sources.append(read(tmp_path, raw, **stated)), SourceError)
    if sources:
        assert knows_shape or array.time_name
        if array.is_plain:
            check(sources[0], array, has_times=True)
    else:
        assert "axes=" in text


@pytest.mark.parametrize(
    ("content", "stated"),
    [
        (
            {
                "forces": LAST,
                "a": LAST,
                "text": "x",
                "cell": np.array([1, "a"], object),
            },
            SHAPE,
        ),
        ({"a": LAST, "b": LAST}, {"topic": "b", **SHAPE}),
        ({"log": {"rate": 9.0, "left": {"pad": LAST}}}, SHAPE),
        (
            {"a": LAST + 1, "log": {"left": {"pad": LAST}}},
            {"topic": "log.left.pad", **SHAPE},
        ),
        ({"a": LAST + 1, "log": {"left": {"pad": LAST}}}, {"topic": "pad", **SHAPE}),
        ({"a": FRAMES}, SHAPE),
        ({"a": FRAMES.reshape(2, 12)}, SHAPE),
        (
            {
                "a": LAST,
                "sparse": csc_matrix(np.eye(5)),
                "complex": LAST * 1j,
                "none": [],
            },
            SHAPE,
        ),
        ({"a": LAST, "many": np.array([(1,), (2,)], [("x", object)])}, SHAPE),
    ],
)
@pytest.mark.parametrize("packed", [False, True])
def test_the_frames_are_found(tmp_path, content, stated, packed):
    source = read(tmp_path, mat(packed, **content), **stated)
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert source.skin.unit == "counts"


def element(order, kind, raw):
    """An element of the format, padded."""
    return struct.pack(f"{order}II", kind, len(raw)) + raw + bytes(-len(raw) % 8)


@pytest.mark.parametrize("order", ["<", ">"])
def test_whole_float64_numbers_are_stored_as_bytes_in_either_order(tmp_path, order):
    flags = element(order, 6, struct.pack(f"{order}II", 6, 0))  # 6: of float64
    sides = element(order, 5, struct.pack(f"{order}3i", *LAST.shape))
    # A short name stands in its tag.
    name = struct.pack(f"{order}I", 1 << 16 | 1) + b"a\0\0\0"
    numbers = element(order, 2, LAST.astype("u1").tobytes("F"))
    array = element(order, 14, flags + sides + name + numbers)
    head = (
        b"MATLAB 5.0".ljust(124)
        + struct.pack(f"{order}H", 0x100)
        + b"MI"[:: 1 if order == ">" else -1]
    )
    source = read(tmp_path, head + array, **SHAPE)
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert source.skin.unit == "N"  # as float64 has no other


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (
            mat(a=LAST),
            "state axes=frames,rows,cols or .*axes=rows,cols,frames",
        ),
        (mat(a=LAST, b=LAST), r"a .3 x 4 x 2., b .3 x 4 x 2.; state topic"),
        (mat(a="text"), "holds no arrays of frames"),
        (mat(a=LAST)[:180], "cannot be read: the file ends within an array"),
        (mat(False, a=LAST)[:-9], "cannot be read: the file ends within an array"),
        (b"MATLAB" * 40, "cannot be read: no MATLAB file of version 5 or later"),
    ],
)
def test_what_holds_no_frames_is_refused(tmp_path, raw, message):
    assert re.search(message, refusal(lambda: read(tmp_path, raw), SourceError))


def test_numbers_of_an_unknown_type_or_of_another_size_are_refused(tmp_path):
    raw = mat(False, forces=LAST.astype(float))
    at = raw.index(struct.pack("<II", 9, 8 * LAST.size))  # 9: of float64
    for kind, n_bytes, what in (
        (200, 8 * LAST.size, "unknown type"),
        (7, 8 * LAST.size, "states"),
    ):
        damaged = raw[:at] + struct.pack("<II", kind, n_bytes) + raw[at + 8 :]
        with pytest.raises(SourceError, match=what):
            read(tmp_path, damaged, **SHAPE)


def test_arrays_far_larger_than_the_file_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(matlab, "MAX_GROWN_BYTES", 1 << 10)
    raw = mat(forces=np.zeros((16, 16, 1 << 10), "u1"))
    with pytest.raises(SourceError, match=r"an array would have \d+ bytes; at most"):
        read(tmp_path, raw)
    assert array_files.MAX_GROWTH * len(raw) < 16 * 16 << 10


@CASES
@given(data=st.data(), packed=st.booleans())
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path, data, packed):
    raw = mutated(data, mat(packed, log={"forces": LAST, "t": np.array([0.0, 0.1])}))
    refusal(lambda: read(tmp_path, raw, **SHAPE), SourceError)
