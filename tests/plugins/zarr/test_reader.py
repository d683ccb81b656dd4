"""Folders of Zarr: those that its library writes are read back, and what is refused."""

import json

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
from sparseskin.plugins.zarr import reader

zarr = pytest.importorskip("zarr", minversion="3", reason="zarr is not installed")
numcodecs = pytest.importorskip("numcodecs")
CODECS = [
    None,
    numcodecs.Blosc(),
    numcodecs.Blosc("zstd", shuffle=numcodecs.Blosc.BITSHUFFLE),
    numcodecs.Zstd(),
    numcodecs.LZ4(),
    numcodecs.Zlib(),
    numcodecs.GZip(),
    numcodecs.BZ2(),
    numcodecs.LZMA(),
]
AXES = "frames,rows,cols"
FRAMES = 1 + np.arange(84, dtype=np.float32).reshape(7, 4, 3)
TIMES = 1.7e9 + np.array([0, 0.02, 0.04, 0.5, 0, 0.02, 0.5])
CASES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Blocks of a few frames."""
    monkeypatch.setattr(recording, "BLOCK_NUMBERS", 40)


def put(group, name, array, **options):
    """Write an array into a group."""
    options = {"chunks": array.shape, "compressors": None, **options}
    entry = group.create_array(name, shape=array.shape, dtype=array.dtype, **options)
    entry[...] = array
    return entry


def buffer(folder, ends=(4, 7), **content):
    """A folder of arrays as tactile datasets have them."""
    root = zarr.open_group(str(folder), mode="w", zarr_format=2)
    data = root.create_group("data")
    for name, array in {"timestamps": TIMES, **content}.items():
        put(data, name, array)
    put(root.create_group("meta"), "episode_ends", np.array(ends))
    return folder


def read(folder, **stated):
    return open_file(folder, Layout(**stated))


@CASES
@given(array=arrays(), data=st.data())
def test_a_drawn_array_whose_axes_are_stated_is_read_as_it_was_written(
    tmp_path, array, data
):
    sides = array.stored.shape
    options = {
        "chunks": data.draw(st.tuples(*(st.integers(1, side + 2) for side in sides))),
        "compressors": data.draw(st.sampled_from(CODECS)),
        "order": data.draw(st.sampled_from("CF")),
        "chunk_key_encoding": {
            "name": "v2",
            "separator": data.draw(st.sampled_from("./")),
        },
    }
    root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    put(root, "pad", array.stored, **options)
    if array.time_name:
        put(root, array.time_name, array.times, chunks=(2,))
    check(read(tmp_path / "a.zarr", **array.axes_stated), array, has_times=True)


def test_places_without_a_chunk_hold_the_stated_number(tmp_path):
    root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    entry = root.create_array(
        "pad", shape=(9, 4, 3), dtype="f4", chunks=(2, 2, 2), fill_value=5
    )
    entry[3:5] = 7
    frames = read(tmp_path / "a.zarr", axes=AXES).frames
    assert (frames[3:5] == 7).all()
    assert (np.delete(frames, (3, 4), axis=0) == 5).all()


def test_labels_and_attributes_are_followed(tmp_path):
    root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    root.attrs["sampling_rate"] = 50
    entry = put(root, "pad", np.moveaxis(FRAMES, 0, -1))
    entry.attrs.update(
        {"_ARRAY_DIMENSIONS": ["y", "x", "time"], "units": "kPa", "f_max": 99}
    )
    source = read(tmp_path / "a.zarr")
    np.testing.assert_array_equal(source.frames, FRAMES)
    assert source.skin.unit == "kPa"
    assert source.skin.f_max == 99
    assert source.rate_hz == 50


class TestEpisodes:
    def test_one_of_several_is_stated(self, tmp_path):
        camera = np.zeros((7, 8, 8, 3), "u1")
        folder = buffer(
            tmp_path / "a.zarr",
            right_tactile_data_palm=FRAMES[:, None],
            camera_ego_rgb=camera,
            right_wrist_pose=np.zeros((7, 6)),
        )
        with pytest.raises(
            SourceError, match=r"2 episodes, .* state topic=NAME:0 \.\. topic=NAME:1"
        ):
            read(folder)
        for number, span in enumerate((slice(0, 4), slice(4, 7))):
            for name in ("data/right_tactile_data_palm", "right_tactile_data_palm"):
                source = read(folder, topic=f"{name}:{number}")
                np.testing.assert_array_equal(source.frames, FRAMES[span])
                seconds = TIMES[span] - TIMES[span][0]
                np.testing.assert_allclose(source.stamp_ns / 1e9, seconds, atol=1e-6)
            assert f"episode {number} of 2" in source.notes
        with pytest.raises(SourceError, match="no episode 2; it holds 2"):
            read(folder, topic="right_tactile_data_palm:2")

    def test_a_single_one_needs_no_word(self, tmp_path):
        content = {
            "timestamps": np.arange(7) / 50,
            "right_tactile_data_palm": FRAMES[:, None],
        }
        source = read(buffer(tmp_path / "a.zarr", ends=(7,), **content))
        np.testing.assert_array_equal(source.frames, FRAMES)

    def test_of_several_sensors_one_is_stated(self, tmp_path):
        pads = np.stack([FRAMES, FRAMES + 100], axis=1)
        folder = buffer(tmp_path / "a.zarr", left_tactile_data_fingers=pads)
        topic = {"topic": "left_tactile_data_fingers:1"}
        with pytest.raises(SourceError, match="state channel, of sensor0, sensor1"):
            read(folder, **topic)
        for k, name in enumerate(("sensor0", "sensor1")):
            source = read(folder, channel=name, **topic)
            np.testing.assert_array_equal(source.frames, pads[4:, k])

    def test_rows_of_several_sensors_are_rows_of_the_frame(self, tmp_path):
        content = {
            "right_tactile_data_palm": FRAMES,
            "right_tactile_data_tips": FRAMES + 1,
        }
        folder = buffer(tmp_path / "a.zarr", **content)
        frames = read(folder, topic="right_tactile_data_palm:0").frames
        np.testing.assert_array_equal(frames, FRAMES[:4])

    @pytest.mark.parametrize("ends", [(4, 3), (4, 9), (0, 7), (-1, 7)])
    def test_ends_that_are_none_are_refused(self, tmp_path, ends):
        folder = buffer(tmp_path / "a.zarr", ends, right_tactile_data_palm=FRAMES)
        stated = {"topic": f"right_tactile_data_palm:{0 if ends[0] < 1 else 1}"}
        with pytest.raises(SourceError, match=r"no episode|holds no topic"):
            read(folder, **stated)


class TestRefused:
    @pytest.fixture
    def folder(self, tmp_path):
        root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
        put(root, "pad", FRAMES, chunks=(4, 4, 3), compressors=numcodecs.Zlib())
        return tmp_path / "a.zarr"

    def test_format_3(self, tmp_path):
        zarr.open_group(str(tmp_path / "b.zarr"), mode="w", zarr_format=3)
        with pytest.raises(
            SourceError, match="is of Zarr format 3; allowed is format 2"
        ):
            read(tmp_path / "b.zarr")

    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"dtype": "|O", "filters": [{"id": "pickle"}]}, "holds Python objects"),
            ({"filters": [{"id": "delta"}]}, "holds Python objects"),
            ({"compressor": {"id": "pickle"}}, "codec 'pickle'; allowed: blosc, zstd"),
            ({"shape": [1 << 40, 4, 3]}, "would have .* bytes, of files of"),
            ({"shape": [7, 1 << 20, 1 << 20]}, "an item holds 1099511627776 numbers"),
            ({"chunks": [4, 4]}, r"\.zarray is malformed"),
            ({"chunks": [0, 4, 3]}, r"\.zarray is malformed"),
            ({"shape": [7, 4, "a"]}, r"\.zarray is malformed"),
            ({"dtype": "<f8"}, "chunk 0.0.0 has 192 bytes in place of 384"),
            ({"fill_value": "AAAA"}, "fill_value 'AAAA' is no number"),
        ],
    )
    def test_what_states_something_else_than_it_holds(self, folder, changes, message):
        head = json.loads((folder / "pad" / ".zarray").read_text())
        (folder / "pad" / ".zarray").write_text(json.dumps({**head, **changes}))
        with pytest.raises(SourceError, match=message):
            read(folder, axes=AXES)

    def test_a_table_without_frames(self, tmp_path):
        store = str(tmp_path / "empty.zarr")
        zarr.create_array(store=store, shape=(0, 4), dtype="f4", zarr_format=2)
        with pytest.raises(SourceError, match=r"holds no frame$"):
            read(store, n_rows=1, unit="N")

    def test_links(self, folder, tmp_path):
        (folder / "pad" / "0.0.0").rename(tmp_path / "elsewhere")
        (folder / "pad" / "0.0.0").symlink_to(tmp_path / "elsewhere")
        with pytest.raises(SourceError, match=r"'0\.0\.0': cannot be read"):
            read(folder, axes=AXES)
        (folder / "pad").rename(tmp_path / "pad")
        (folder / "pad").symlink_to(tmp_path / "pad")
        with pytest.raises(SourceError, match="holds no arrays of frames"):
            read(folder, axes=AXES)

    def test_bombs(self, folder):
        (folder / "pad" / "0.0.0").write_bytes(numcodecs.Zlib().encode(bytes(1 << 20)))
        with pytest.raises(
            SourceError, match=r"chunk 0\.0\.0 has 193 bytes in place of 192"
        ):
            read(folder, axes=AXES)

    @CASES
    @given(data=st.data())
    def test_damaged_files(self, tmp_path, data):
        root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
        codec = data.draw(st.sampled_from(CODECS))
        put(root, "pad", FRAMES, chunks=(4, 4, 3), compressors=codec)
        path = (
            tmp_path
            / "a.zarr"
            / "pad"
            / data.draw(st.sampled_from([".zarray", "0.0.0"]))
        )
        path.write_bytes(mutated(data, path.read_bytes()))
        refusal(lambda: read(tmp_path / "a.zarr"), SourceError)


def test_each_chunk_is_read_once(tmp_path, monkeypatch):
    root = zarr.open_group(str(tmp_path / "a.zarr"), mode="w", zarr_format=2)
    put(root, "pad", np.tile(FRAMES, (10, 1, 1)), chunks=(3, 4, 2))
    names = []
    file_bytes = reader._file_bytes
    monkeypatch.setattr(
        reader,
        "_file_bytes",
        lambda path, *a: names.append(path.name) or file_bytes(path, *a),
    )
    arrays_of_folder = reader.ZarrFolder(tmp_path / "a.zarr")
    names.clear()
    assert sum(map(len, arrays_of_folder.blocks("pad", 0, 5))) == 70
    assert len(names) == len({*names}) == 24 * 2
