"""The export to Zarr, read by its library, and by the sensor's `file:` source."""

import numpy as np
import pytest
from bags import N_COLS, N_ROWS, PERIOD_NS, frame, make_bag, skin_state
from damaged import refusal

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.files import OutputError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import streams, values_of
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.plugins.zarr import export
from sparseskin.plugins.zarr.export import export_zarr

LENGTHS = (20, 13)


@pytest.fixture
def paths(tmp_path):
    """Bags of several lengths."""
    paths = []
    for number, n in enumerate(LENGTHS):
        paths.append(tmp_path / f"bag{number}.mcap")
        make_bag(paths[-1], [skin_state(), *(m for k in range(n) for m in frame(k))])
    return paths


def exported(paths, out, **options):
    bags = [BagReader(path) for path in paths]
    try:
        return export_zarr(bags, out, **options)
    finally:
        for bag in bags:
            bag.close()


def recorded(path, topic):
    with BagReader(path) as bag:
        messages = [message for message, _ in streams(bag, [topic], "read")]
    stamps = np.array([message.stamp_ns for message in messages])
    return np.stack([values_of(message) for message in messages]), stamps


def name_and_topic(path, schema):
    with BagReader(path) as bag:
        (topic,) = [
            topic for topic, info in bag.topics.items() if info.schema == schema
        ]
    return topic.strip("/").split("/")[0].lower(), topic


def test_episodes_are_read_back_by_the_source(paths, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "CHUNK_BYTES", 7 * 4 * N_ROWS * N_COLS)  # some chunks
    patch, topic = name_and_topic(paths[0], "taxels")
    out = tmp_path / "out.zarr"
    written = exported(paths, out, topics=[topic])
    assert {*written} == {path for path in out.rglob("*") if path.is_file()}
    for number, path in enumerate(paths):
        frames, stamps = recorded(path, topic)
        stated = Layout(
            topic=f"data/right_tactile_data_{patch}:{number}", f_max=99.0, nan="mask"
        )
        source = open_file(out, stated)
        np.testing.assert_array_equal(source.frames, frames)
        seconds = (stamps - stamps[0]) / 1e9
        np.testing.assert_allclose(source.stamp_ns / 1e9, seconds, atol=1e-6)
        assert source.skin.unit == skin_state().unit
        assert source.rate_hz == pytest.approx(1e9 / PERIOD_NS)


def test_the_library_reads_what_a_tactile_dataset_has(paths, tmp_path):
    zarr = pytest.importorskip("zarr", reason="zarr is not installed")
    patch, topic = name_and_topic(paths[0], "reconstruction")
    out = tmp_path / "out.zarr"
    exported(paths, out, side="left", area=3)
    root = zarr.open_group(str(out), mode="r", zarr_format=2)
    assert root["meta/episode_ends"][:].tolist() == [20, 33]
    n = sum(LENGTHS)
    data = root["data"]
    assert data["timestamps"].shape == (n,)
    np.testing.assert_array_equal(
        data[f"left_tactile_area_{patch}"][:], np.full((n, 1), 3)
    )
    assert set(data[f"left_tactile_type_{patch}"][:]) == {"matrix"}
    assert len(data[f"left_tactile_sensor_{patch}"][:]) == n
    frames = np.concatenate([recorded(path, topic)[0] for path in paths])
    array = data[f"left_tactile_data_{patch}"]
    assert array.shape == (n, 1, N_ROWS, N_COLS)
    np.testing.assert_array_equal(array[:, 0], frames)
    assert array.attrs["unit"] == skin_state().unit


def test_rows_hold_the_newest_frame_of_each_topic(paths, tmp_path):
    patch, taxels = name_and_topic(paths[0], "taxels")
    _, reconstruction = name_and_topic(paths[0], "reconstruction")
    out = tmp_path / "out.zarr"
    exported(paths[:1], out, topics=[reconstruction, taxels])
    for schema, topic in (("taxels", taxels), ("reconstruction", reconstruction)):
        stated = Layout(
            topic=f"right_tactile_data_{patch}_{schema}", f_max=99.0, nan="mask"
        )
        np.testing.assert_array_equal(
            open_file(out, stated).frames, recorded(paths[0], topic)[0]
        )


@pytest.mark.parametrize(
    ("patch", "name"),
    [
        ("palm", ("right", "palm")),
        ("left_palm", ("left", "palm")),
        ("righthand", ("right", "righthand")),
        ("right", ("right", "skin")),
        ("left_to_right", ("right", "to")),
    ],
)
def test_the_side_is_a_word_of_the_patch_or_the_stated_one(patch, name):
    assert export._names([f"/{patch}/taxels"], "right") == {f"/{patch}/taxels": name}


def test_what_cannot_be_written_is_refused(paths, tmp_path):
    out = tmp_path / "out.zarr"
    assert "--side up: allowed are" in refusal(
        lambda: exported(paths, out, side="up"), BagError
    )
    assert "--area: -2" in refusal(lambda: exported(paths, out, area=-2), BagError)
    make_bag(tmp_path / "none.mcap", [skin_state()])
    refused = refusal(lambda: exported([tmp_path / "none.mcap"], out), BagError)
    assert "holds no frames to export" in refused
    assert not out.exists()
    out.mkdir()
    assert "out.zarr" in refusal(lambda: exported(paths, out), OutputError)


def test_the_command_writes_several_recordings_as_episodes(paths, tmp_path, capsys):
    out = tmp_path / "a.zarr"
    arguments = [
        "recording",
        "export",
        *map(str, paths),
        "--to",
        "zarr",
        "--out",
        str(out),
    ]
    assert main([*arguments, "--area", "0"]) == 0
    assert str(out / "data" / "timestamps" / ".zarray") in capsys.readouterr().out
