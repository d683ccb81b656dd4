"""Recordings as NPZ and CSV, and files as recordings."""

import json

import numpy as np
import pytest
from bags import N_COLS, N_ROWS, frames, make_bag
from damaged import refusal
from exported import N_FRAMES, points_bag, rich_frames

from sparseskin.messages import Contacts, Measurements, Reconstruction, Taxels, decode
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.convert.csv import export_csv
from sparseskin.nodes.recorder.convert.npz import export_npz
from sparseskin.nodes.recorder.convert.to_bag import import_file, recover_bag
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ


@pytest.fixture
def rich(tmp_path):
    make_bag(tmp_path / "a.mcap", rich_frames())
    return tmp_path / "a.mcap"


def test_an_npz_and_a_csv_have_the_row_of_the_points_file_of_each_taxel(tmp_path):
    path = tmp_path / "a.mcap"
    state = points_bag(path)
    with BagReader(path) as bag:
        (npz,) = export_npz(bag, path.with_name("a.npz"))
    skin = open_file(npz).skin
    assert skin.point_rows is not None
    assert state.point_rows is not None
    assert np.array_equal(skin.point_rows, state.point_rows)
    with np.load(npz) as arrays:
        assert np.array_equal(arrays["point_rows"], state.point_rows)
        assert np.array_equal(arrays["points"], state.points)
        changed = {**arrays, "point_rows": arrays["point_rows"][:-1]}
    np.savez(path.with_name("c.npz"), **changed)
    n = len(state.point_rows)
    line = f"skin: point_rows are int32 [{n - 1}], expected int32 [{n}]"
    assert line in refusal(lambda: open_file(path.with_name("c.npz")))

    with BagReader(path) as bag:
        export_csv(bag, path.with_name("a_csv"))
    comment = (path.with_name("a_csv") / "skin_taxels.csv").read_text().splitlines()[1]
    skin = json.loads(comment.removeprefix("# "))["skin"]
    assert skin["point_rows"] == state.point_rows.tolist()


def test_an_npz_names_what_it_holds(rich):
    with BagReader(rich) as bag:
        (npz,) = export_npz(bag, rich.with_name("a.npz"))
    with np.load(npz) as arrays:
        for name, kind in (("forces", Taxels), ("reconstruction", Reconstruction)):
            maps = [m.forces for m in rich_frames() if isinstance(m, kind)]
            assert np.array_equal(arrays[name], np.concatenate(maps))
        assert arrays["phi_seed"].tolist() == [7]
        assert arrays["phi_rows"].tolist() == ["fixed"]
        assert arrays["reconstruction_trusted"].tolist() == [
            k != 3 for k in range(N_FRAMES)
        ]
        assert np.isnan(arrays["reconstruction_sd"][0]).all()
        assert np.isfinite(arrays["reconstruction_sd"][1]).all()
        found = [m for m in rich_frames() if isinstance(m, Contacts)]
        for name in ("stamp_ns", "id", "total", "col", "x_mm", "trusted"):
            sent_columns = np.concatenate([m.columns()[name] for m in found])
            assert np.array_equal(
                arrays[f"contacts_{name}"], sent_columns, equal_nan=name == "x_mm"
            )
        assert arrays["contacts_event"].tolist() == ["begin"] * len(
            arrays["contacts_id"]
        )
        assert arrays["contacts_event_id"].tolist() == arrays["contacts_id"].tolist()
        assert arrays["rate_hz"] == 50.0  # the last state
        sent = [m for m in rich_frames() if isinstance(m, Measurements)]
        for row, message in zip(arrays["measurements"], sent, strict=True):
            assert np.array_equal(row[: message.y.size], message.y[0])
            assert np.isnan(row[message.y.size :]).all()
        assert json.loads(str(arrays["states"]))["/skin/calibration"]["name"] == "palm"
        assert json.loads(str(arrays["metadata"]))["scene"] == "test"
    assert import_file(npz, rich.with_name("b.mcap")) == N_FRAMES


def test_an_exported_csv_states_its_skin_and_is_a_recording(rich):
    with BagReader(rich) as bag:
        paths = export_csv(bag, rich.with_name("a_csv"))
    names = {path.name for path in paths}
    assert {"skin_reconstruction.csv", "skin_reconstruction_sd.csv"} < names
    file = rich.with_name("a_csv") / "skin_taxels.csv"
    skin = json.loads(file.read_text().splitlines()[1].removeprefix("# "))["skin"]
    assert skin["f_max"] == 2.5
    assert skin["unit"] == "N"
    assert skin["pitch_m"] == 0.005
    assert skin["rate_hz"] == 50
    again = open_file(file, Layout(unit="N"))
    taxels = [one.forces[0] for one in rich_frames() if isinstance(one, Taxels)]
    np.testing.assert_array_equal(again.frames, taxels)


def test_an_exported_csv_is_a_table_with_a_header(rich):
    pandas = pytest.importorskip("pandas", reason="pandas is not installed")
    with BagReader(rich) as bag:
        export_csv(bag, rich.with_name("a_csv"))
    sent = [m for m in rich_frames() if isinstance(m, Reconstruction)]
    table = pandas.read_csv(
        rich.with_name("a_csv") / "skin_reconstruction.csv", comment="#"
    )
    assert table["stamp_ns"].tolist() == [m.stamp_ns for m in sent]
    assert table["trusted"].tolist() == [m.trusted[0] for m in sent]
    assert table["error"].isna().tolist() == [m.error[0] is None for m in sent]
    cells = table.loc[:, "r0c0":].to_numpy(np.float32).reshape(-1, N_ROWS, N_COLS)
    assert np.array_equal(cells, np.concatenate([m.forces for m in sent]))
    contacts = pandas.read_csv(
        rich.with_name("a_csv") / "skin_contacts.csv", comment="#"
    )
    frames = [m for m in rich_frames() if isinstance(m, Contacts)]
    assert contacts["total"].tolist() == [
        one for m in frames for one in m.total.tolist()
    ]
    assert contacts["trusted"].tolist() == [m.trusted[0] for m in frames for _ in m.id]
    assert contacts["x_mm"].notna().tolist() == [
        m.id.size == 1 for m in frames for _ in m.id
    ]
    events = pandas.read_csv(
        rich.with_name("a_csv") / "skin_contacts_events.csv", comment="#"
    )
    assert events["stamp_ns"].tolist() == contacts["stamp_ns"].tolist()
    assert set(events["event"]) == {"begin"}
    sd = pandas.read_csv(
        rich.with_name("a_csv") / "skin_reconstruction_sd.csv", comment="#"
    )
    expected = np.stack([m.sd for m in sent if m.sd is not None])
    assert np.array_equal(
        sd.loc[:, "r0c0":].to_numpy(np.float32).reshape(expected.shape), expected
    )


SIZED = Layout(n_rows=2, n_cols=3, unit="N", f_max=10.0)


def write_frames(path, lines):
    path.write_text("\n".join(lines) + "\n")
    return path


def test_an_imported_bag_holds_every_frame_and_is_the_same_each_time(tmp_path):
    source = write_frames(
        tmp_path / "a.csv", [f"{k},0,0,0,0,{k + 1}" for k in range(5)]
    )
    for name in ("one.mcap", "two.mcap"):
        assert import_file(source, tmp_path / name, layout=SIZED) == 5
    with (
        BagReader(tmp_path / "one.mcap") as one,
        BagReader(tmp_path / "two.mcap") as two,
    ):
        assert list(one.messages()) == list(two.messages())
        assert one.metadata["imported_from"] == "a.csv"
        (recorded,) = one.messages(["/skin/skin"])
        state = decode(b"/skin/skin", recorded.payload)
        assert state.rate_hz == DEFAULT_RATE_HZ
        # The noise of a recording is its own.
        assert not state.has_truth
        assert state.sigma_mid == 0.0
        assert state.sigma_end == 0.0
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
        import_file(source, tmp_path / "out.mcap", layout=SIZED)
    assert seen == ["out.mcap.part"]  # it had begun
    assert [path.name for path in tmp_path.iterdir()] == ["a.csv"]


def test_an_import_to_a_full_disk_names_the_bag_and_leaves_nothing(
    tmp_path, mount_disk
):
    np.save(tmp_path / "a.npy", np.random.default_rng(0).random((200, 40, 40)))
    out = mount_disk("400k") / "q.mcap"
    line = refusal(lambda: import_file(tmp_path / "a.npy", out), BagError)
    assert line == f"{out}: No space left on device; nothing was written"
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
