"""Recordings of sparseskin itself as files of readings."""

import numpy as np
import pytest
from bags import PERIOD_NS, frame, frames, make_bag, skin_state

from sparseskin.messages import Taxels
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.bag import BagRecording
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.format import is_bag
from sparseskin.nodes.sensor.files.recording import File
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout, UnstatedError


def recording(path, layout=EMPTY):
    with path.open("rb") as opened:
        return BagRecording(File(opened, str(path), layout=layout))


def test_taxels_are_read_with_their_stamps_and_what_their_skin_states(tmp_path):
    make_bag(tmp_path / "a.mcap", frames(90))
    assert is_bag((tmp_path / "a.mcap").read_bytes())
    read = recording(tmp_path / "a.mcap")
    head = read.head()
    assert head.unit == "N"
    assert head.f_max == 2.5
    assert head.rate_hz == 100.0
    assert head.pitch_m == 0.005
    assert head.n_items == 90
    assert head.time_unit == "ns"
    for _ in range(2):
        (block,) = read.blocks()
        np.testing.assert_array_equal(
            block.numbers, [frame(k)[0].forces[0] for k in range(90)]
        )
        assert list(block.times) == [k * PERIOD_NS for k in range(90)]
        assert read.tally.text == "90 messages: 90 frames"


def test_readings_that_were_missing_are_no_number(tmp_path):
    forces = np.ones((5, 7), np.float32)
    missing = np.zeros((5, 7), bool)
    missing[1, 2] = True
    bits = np.packbits(missing.ravel(), bitorder="little")
    taxels = Taxels(stamp_ns=0, patch="skin", forces=forces, missing=bits)
    expected = taxels.missing_cells((5, 7))
    assert expected is not None
    make_bag(tmp_path / "a.mcap", [skin_state(), taxels])
    (block,) = recording(tmp_path / "a.mcap").blocks()
    np.testing.assert_array_equal(np.isnan(block.numbers[0]), expected)


def test_of_several_patches_none_is_chosen(tmp_path):
    messages = [
        message for k in range(3) for name in ("a", "b") for message in frame(k, name)
    ]
    make_bag(tmp_path / "a.mcap", [skin_state("a"), skin_state("b"), *messages])
    with pytest.raises(UnstatedError) as refused:
        recording(tmp_path / "a.mcap").head()
    assert refused.value.options == ({"topic": "/a/taxels"}, {"topic": "/b/taxels"})
    source = open_file(tmp_path / "a.mcap", Layout(topic="/b/taxels"))
    np.testing.assert_array_equal(
        source.frames, [frame(k, "b")[0].forces[0] for k in range(3)]
    )
    make_bag(tmp_path / "none.mcap", [skin_state()])
    with pytest.raises(SourceError, match="holds no topics of taxels"):
        recording(tmp_path / "none.mcap").head()
