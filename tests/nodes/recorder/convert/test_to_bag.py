"""Bags made of other files: complete, or absent."""

import numpy as np
import pytest
from bags import frames, make_bag

from sparseskin.messages import decode
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.convert.to_bag import import_file, recover_bag
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ

SIZE = {"n_rows": 2, "n_cols": 3}


def write_frames(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def test_an_imported_bag_holds_every_frame_and_is_the_same_each_time(tmp_path):
    source = write_frames(tmp_path / "a.csv", [f"{k},0,0,0,0,{k + 1}" for k in range(5)])
    for name in ("one.mcap", "two.mcap"):
        assert import_file(source, tmp_path / name, unit="N", f_max=10.0, **SIZE) == 5
    with BagReader(tmp_path / "one.mcap") as one, BagReader(tmp_path / "two.mcap") as two:
        assert list(one.messages()) == list(two.messages())
        assert one.metadata["imported_from"] == "a.csv"
        (recorded,) = one.messages(["/skin/skin"])
        state = decode(b"/skin/skin", recorded.payload)
        assert state.rate_hz == DEFAULT_RATE_HZ
        # The noise of a recording is its own.
        assert (state.has_truth, state.sigma_mid, state.sigma_end) == (False, 0.0, 0.0)
        for k, recorded in enumerate(one.messages(["/skin/taxels"])):
            message = decode(b"/skin/taxels", recorded.payload)
            assert message.seq == k
            np.testing.assert_array_equal(message.forces[0], [[k, 0, 0], [0, 0, k + 1]])


def test_an_import_that_fails_half_way_leaves_no_part_of_a_bag(tmp_path, monkeypatch):
    source = write_frames(tmp_path / "a.csv", ["0,1,2,3,4,5"] * 5)
    seen = []

    def break_off(items, total, doing):
        for item in items:
            yield item
            seen.extend(path.name for path in tmp_path.glob("*.part"))
            raise SparseskinError("frame 1 is malformed")

    monkeypatch.setattr("sparseskin.nodes.recorder.convert.to_bag.progress", break_off)
    with pytest.raises(SparseskinError, match="frame 1 is malformed"):
        import_file(source, tmp_path / "out.mcap", unit="N", f_max=10.0, **SIZE)
    assert seen == ["out.mcap.part"]  # it had begun
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_an_import_to_a_full_disk_names_the_bag_and_leaves_nothing(tmp_path, mount_disk):
    rng = np.random.default_rng(0)
    np.save(tmp_path / "a.npy", rng.random((200, 40, 40)))
    out = mount_disk("400k") / "q.mcap"
    with pytest.raises(BagError) as refused:
        import_file(tmp_path / "a.npy", out)
    assert str(refused.value) == f"{out}: No space left on device; nothing was written"
    assert list(out.parent.iterdir()) == []


def test_a_recovery_that_fails_half_way_leaves_no_part_of_a_bag(tmp_path):
    make_bag(tmp_path / "a.mcap", frames(60), flush_every=24)
    with BagReader(tmp_path / "a.mcap") as bag:
        data = bytearray((tmp_path / "a.mcap").read_bytes())
        data[len(data) // 2] ^= 1  # damaged after it was opened
        (tmp_path / "a.mcap").write_bytes(data)
        with pytest.raises(BagError, match="was changed while it was read"):
            recover_bag(bag, tmp_path / "new.mcap")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]
