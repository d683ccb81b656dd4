"""Arrays in files of HDF5: which one is taken, in which order, and what is refused."""

import io
import re

import numpy as np
import pytest
from damaged import mutated, refusal
from drawn_arrays import arrays, check
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files import recording
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.plugins.vendors import hdf5

h5py = pytest.importorskip("h5py", reason="h5py is not installed")
AXES = "frames,rows,cols"
FRAMES = np.arange(40, dtype=np.uint16).reshape(5, 2, 4)
TIMES = np.array([0.0, 0.02, 0.04, 0.5, 0.52])
CASES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Blocks of a few frames."""
    monkeypatch.setattr(recording, "BLOCK_NUMBERS", 40)


def written(write):
    """The bytes of a file, written by a function of an open one."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        write(file)
    return buffer.getvalue()


def read(folder, raw, name="a.h5", **stated):
    (folder / name).write_bytes(raw)
    return open_file(folder / name, Layout(**stated))


def put(file, **content):
    for name, array in content.items():
        file[name.replace("__", "/")] = array


@CASES
@given(array=arrays(), data=st.data(), is_matlab=st.booleans())
def test_a_drawn_array_whose_axes_are_stated_is_read_as_it_was_written(
    tmp_path, array, data, is_matlab
):
    stored = array.stored.transpose() if is_matlab else array.stored
    chunks = data.draw(
        st.none() | st.tuples(*(st.integers(1, side) for side in stored.shape))
    )

    def write(file):
        packing = data.draw(st.sampled_from([None, "gzip", "lzf"])) if chunks else None
        file.create_dataset("run/pad", data=stored, chunks=chunks, compression=packing)
        if array.time_name:
            file[f"run/{array.time_name}"] = (
                array.times[None] if is_matlab else array.times
            )

    name = "a.mat" if is_matlab else "a.hdf5"
    check(
        read(tmp_path, written(write), name, **array.axes_stated), array, has_times=True
    )


@CASES
@given(array=arrays(), is_scale=st.booleans())
def test_labels_of_the_axes_are_followed(tmp_path, array, is_scale):
    def write(file):
        pad = file.create_dataset("pad", data=array.stored)
        for at, name in enumerate(array.axes):
            if name == "-":
                continue
            if is_scale:
                file[f"axes/{at}/{name}"] = np.arange(array.stored.shape[at])
                file[f"axes/{at}/{name}"].make_scale(name)
                pad.dims[at].attach_scale(file[f"axes/{at}/{name}"])
            else:
                pad.dims[at].label = name

    check(read(tmp_path, written(write)), array, has_times=False)


@pytest.mark.parametrize(
    ("content", "stated"),
    [
        (
            {"run__left": FRAMES, "run__right": FRAMES},
            {"topic": "/run/left", "axes": AXES},
        ),
        ({"run__left": FRAMES, "run__right": FRAMES}, {"topic": "right", "axes": AXES}),
        ({"run__forces": FRAMES, "b": FRAMES}, {}),
        (
            {"a": FRAMES, "names": ["x", "y"], "poses": np.ones((5, 7))},
            {"axes": AXES},
        ),
        ({"a": FRAMES, "image": np.ones((5, 8, 8, 3))}, {"n_rows": 2, "n_cols": 4}),
    ],
)
def test_the_frames_are_found(tmp_path, content, stated):
    source = read(tmp_path, written(lambda file: put(file, **content)), **stated)
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert source.skin.unit == "counts"


def test_times_are_those_of_the_nearest_group(tmp_path):
    raw = written(
        lambda file: put(
            file,
            left__pad=FRAMES,
            left__time=TIMES,
            right__pad=FRAMES,
            right__time=TIMES + 2,
        )
    )
    for topic in ("left/pad", "right/pad"):
        source = read(tmp_path, raw, topic=topic)
        np.testing.assert_allclose(source.stamp_ns / 1e9, TIMES, atol=1e-6)
        assert any(f"times: {topic[:-4]}/time" in note for note in source.notes)


def test_attributes_state_unit_rate_range_and_pitch(tmp_path):
    def write(file):
        put(file, run__pad=FRAMES, run__t=1000 * TIMES)
        file["run/pad"].attrs.update(units="kPa", long_name="left palm", f_max=99.5)
        file["run/t"].attrs["units"] = "milliseconds since 2026-01-01"
        file["run"].attrs["sampling_rate"] = 40
        file.attrs.update(pitch_m=0.004, units="V")

    raw = written(write)
    source = read(tmp_path, raw)
    assert source.skin.unit == "kPa"
    assert source.skin.f_max == 99.5
    assert source.rate_hz == 40
    assert source.skin.pitch_m == 0.004
    np.testing.assert_allclose(source.stamp_ns / 1e9, TIMES, atol=1e-6)
    assert "long name: left palm" in source.notes
    even = read(tmp_path, raw, time="none", axes=AXES)
    np.testing.assert_allclose(even.stamp_ns / 1e9, np.arange(5) / 40, atol=1e-6)


@pytest.mark.parametrize("fill_name", ["_FillValue", "missing_value"])
def test_numbers_are_unpacked_as_their_attributes_state(tmp_path, fill_name):
    numbers = np.arange(60).reshape(5, 4, 3)

    def write(file):
        put(file, run__pad=numbers.astype("i2"))
        file["run/pad"].attrs.update(scale_factor=0.5, add_offset=3.0)
        file["run/pad"].attrs[fill_name] = np.int16(7)

    source = read(tmp_path, written(write), missing="none", axes=AXES)
    expected = np.where(numbers == 7, np.nan, 0.5 * numbers + 3.0)
    np.testing.assert_array_equal(source.frames, expected)
    assert any("read with scale_factor = 0.5" in note for note in source.notes)


def test_times_of_an_unknown_unit_are_refused(tmp_path):
    def write(file):
        put(file, pad=FRAMES, time=TIMES)
        file["time"].attrs["units"] = "weeks since 2026-01-01"

    raw = written(write)
    with pytest.raises(
        SourceError, match="array 'time': its unit is 'weeks', none of ns, us, ms, s"
    ):
        read(tmp_path, raw)
    stamps = read(tmp_path, raw, time_unit="s").stamp_ns
    np.testing.assert_allclose(stamps / 1e9, TIMES, atol=1e-6)


def test_texts_of_a_mat_are_no_numbers(tmp_path):
    def write(file):
        put(file, log__pad=FRAMES.T, log__name=np.array([[72, 105, 33]], "u2"))
        file["log/name"].attrs["MATLAB_class"] = np.bytes_("char")
        put(file, log__valid=np.ones((4, 2, 5), "u1"), **{"#refs#__a": FRAMES.T})
        file["log/valid"].attrs["MATLAB_class"] = np.bytes_("logical")

    source = read(tmp_path, written(write), "a.mat", axes="frames,rows,cols")
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert any("array log.pad, 5 x 2 x 4" in note for note in source.notes)


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        (
            written(lambda file: put(file, a=np.zeros((5, 3, 4), complex))),
            "dtype complex128",
        ),
        (written(lambda file: put(file, a=FRAMES))[:900], "cannot be read"),
        (
            written(lambda file: put(file, a=FRAMES, b=FRAMES)),
            "a .5 x 2 x 4., b .*; state topic",
        ),
        (
            written(lambda file: put(file, a=h5py.Empty("f4"))),
            "holds no arrays of frames",
        ),
        (
            written(
                lambda file: file.create_dataset(
                    "a", (1 << 30, 16, 16), "f4", chunks=True
                )
            ),
            "array 'a': 1099511627776 bytes; at most",
        ),
    ],
)
def test_what_holds_no_frames_is_refused(tmp_path, raw, message):
    assert re.search(message, refusal(lambda: read(tmp_path, raw), SourceError))


def test_chunks_that_need_too_much_memory_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5, "MAX_CHUNK_BYTES", 1 << 10)
    frames = np.ones((512, 2, 2), "u1")
    raw = written(
        lambda file: file.create_dataset("a", data=frames, chunks=(512, 1, 1))
    )
    with pytest.raises(
        SourceError,
        match="array 'a': chunks of 512 entries of axis 1 need 2048 bytes; at most 1024",
    ):
        read(tmp_path, raw)


def test_links_to_other_files_are_not_followed(tmp_path):
    (tmp_path / "b.h5").write_bytes(written(lambda file: put(file, forces=FRAMES)))
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["forces"] = h5py.ExternalLink(str(tmp_path / "b.h5"), "forces")
        layout = h5py.VirtualLayout(FRAMES.shape, "u2")
        layout[:] = h5py.VirtualSource(str(tmp_path / "b.h5"), "forces", FRAMES.shape)
        file.create_virtual_dataset("virtual", layout)
    for topic in ("", "forces", "virtual"):
        with pytest.raises(SourceError, match=r"holds no (arrays|topic)"):
            open_file(tmp_path / "a.h5", Layout(topic=topic))


@CASES
@given(data=st.data())
def test_mutated_files_are_read_or_refused_in_one_line(tmp_path, data):
    raw = mutated(data, written(lambda file: put(file, pad=FRAMES, t=TIMES)))
    refusal(lambda: read(tmp_path, raw), SourceError)
