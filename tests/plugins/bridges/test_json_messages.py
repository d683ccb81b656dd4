"""MCAP files of messages in JSON, drawn at random, as files of readings."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="rosbags is not installed")
from mcap.writer import Writer

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout

BEGIN_NS = 1_790_000_000_000_000_000
DRAWN = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)


def write(path, contents, log_ns, encoding="json", topic="/skin"):
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("Skin", "jsonschema", b"{}")
        channel = writer.register_channel(topic, encoding, schema)
        for content, stamp_ns in zip(contents, log_ns, strict=True):
            data = json.dumps(content).encode()
            writer.add_message(channel, stamp_ns, data, stamp_ns)
        writer.finish()
    return path


def read(path, shape, **stated):
    n_rows, n_cols = shape
    layout = Layout(unit="counts", n_rows=n_rows, n_cols=n_cols, **stated)
    return open_file(path, layout)


@DRAWN
@given(
    shape=st.tuples(st.integers(2, 4), st.integers(2, 5)),
    form=st.sampled_from(["list", "grid", "taxels", "modules"]),
    time=st.sampled_from(["log", "stamp", "header", "seconds"]),
    scale=st.sampled_from([1, 4]),
    steps_ms=st.lists(st.integers(5, 50), min_size=2, max_size=6),
    seed=st.integers(0, 1000),
)
def test_messages_in_json_are_read_as_they_were_written(
    tmp_path, shape, form, time, scale, steps_ms, seed
):
    stamps_ns = BEGIN_NS + np.cumsum([0, *steps_ms]) * 1_000_000
    n = len(stamps_ns)
    frames = np.random.default_rng(seed).integers(1, 900, (n, *shape)) / scale
    contents = []
    for frame, stamp_ns in zip(frames.tolist(), stamps_ns.tolist(), strict=True):
        flat = [reading for row in frame for reading in row]
        taxels = [{"id": k, "x": 0, "y": -1, "z": z} for k, z in enumerate(flat)]
        body = {
            "list": {"readings": flat},
            "grid": {"readings": frame},
            "taxels": {"taxels": taxels},
            "modules": {"modules": [{"board": 1, "taxels": taxels}]},
        }[form]
        sec, nsec = divmod(stamp_ns, 10**9)
        stamps = {
            "log": {},
            "stamp": {"timestamp": {"sec": sec, "nsec": nsec}},
            "header": {
                "header": {"stamp": {"sec": sec, "nanosec": nsec}, "frame_id": "palm"}
            },
            "seconds": {"time_s": (stamp_ns - BEGIN_NS) / 1e9},
        }[time]
        contents.append({**stamps, "battery": 3.7, "name": "palm", **body})
    # The times of the recording are those of messages without one of their own.
    log_ns = stamps_ns if time == "log" else stamps_ns + np.arange(n)
    path = write(tmp_path / "a.mcap", contents, log_ns.tolist())
    source = read(path, shape)
    np.testing.assert_array_equal(source.frames, frames.astype("f4"))
    np.testing.assert_allclose(source.stamp_ns, stamps_ns - stamps_ns[0], atol=500)


def test_what_is_no_reading_in_json_is_never_a_number(tmp_path):
    path = tmp_path / "a.mcap"
    contents = [{"data": [1, 2]}, {"data": [3, None]}]
    write(path, contents, [1, 2])
    with pytest.raises(SourceError, match="nan is not finite"):
        read(path, (1, 2))
    source = read(path, (1, 2), nan="hold")
    assert np.isnan(source.frames[1, 0, 1])

    # Of another length, or no list at all.
    write(path, [*contents, {"data": [1, 2, 3]}], [1, 2, 3])
    source = read(path, (1, 2), nan="hold")
    assert len(source.frames) == 2
    assert any("1 messages of another shape" in note for note in source.notes)
    write(path, [{"data": "1,2"}], [1])
    with pytest.raises(SourceError, match="holds no list of numbers"):
        read(path, (1, 2))


def test_other_encodings_are_named(tmp_path):
    write(tmp_path / "a.mcap", [{"data": [1, 2]}], [1], encoding="protobuf")
    with pytest.raises(SourceError, match="its messages are in protobuf; read are"):
        read(tmp_path / "a.mcap", (1, 2))


def test_two_skins_in_json_are_asked_for(tmp_path):
    frames = [{"frame_id": side, "data": [1, 2]} for side in ("left", "right")]
    path = write(tmp_path / "a.mcap", frames * 2, [1, 2, 3, 4])
    with pytest.raises(SourceError, match="2 frames, 'left', 'right'; state frame_id"):
        read(path, (1, 2))
    assert len(read(path, (1, 2), frame_id="left").frames) == 2
