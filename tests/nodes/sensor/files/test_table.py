"""Tables of frames, and invalid readings of any file."""

import contextlib
import re
import tracemalloc
import zipfile

import numpy as np
import pytest
from damaged import npy, npz, refusal
from drawn_tables import grids, logs, tables, transposed_tables
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.messages import SkinState, Taxels
from sparseskin.messages.skin import Skin
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError, SparseskinError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.numerics.array_files import read_npy, read_npz
from sparseskin.nodes.recorder.convert.to_bag import import_file
from sparseskin.nodes.sensor.calibration.description import of_skin
from sparseskin.nodes.sensor.files import file_source, recording
from sparseskin.nodes.sensor.files.file_source import (
    MIN_WIDENING,
    n_taxels,
    open_file,
)
from sparseskin.nodes.sensor.files.survey import Needs
from sparseskin.nodes.sensor.files.table.table import TableRecording
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.missing import MissingReadings
from sparseskin.nodes.sensor.node import Sensor, SensorSettings
from sparseskin.nodes.sensor.sources import open_source
from sparseskin.recordings import read_recording

GRID = np.arange(12.0).reshape(2, 2, 3)
ROW = {"n_rows": 1, "n_cols": 2}
FORGIVING = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None
)


def read(folder, text, **stated):
    (folder / "log.csv").write_bytes(text.encode())
    return open_file(folder / "log.csv", Layout(**{"unit": "N", **stated}))


@FORGIVING
@given(table=tables() | transposed_tables() | logs() | grids())
def test_a_drawn_table_is_read_as_it_was_written(tmp_path, table):
    source = read(tmp_path, table.text, **table.stated)
    np.testing.assert_array_equal(source.frames, table.frames)
    seconds = (
        0.01 * np.arange(len(table.frames)) if table.seconds is None else table.seconds
    )
    np.testing.assert_allclose(source.stamp_ns / 1e9, seconds, atol=1e-6)
    assert (
        n_taxels(str(tmp_path / "log.csv"), Layout(**table.stated))
        == table.frames[0].size
    )


@FORGIVING
@given(
    prefix=st.sampled_from(["", "field.", "field.data."]),
    taxel=st.sampled_from(["taxel_id", "Sensor", "cell"]),
    value=st.sampled_from(["force", "Value", "counts"]),
    n_taxels=st.integers(2, 9),
    n_frames=st.integers(3, 9),
    seed=st.integers(0, 99),
)
def test_a_line_for_each_taxel_is_read_under_names_that_are_paths_too(
    tmp_path, prefix, taxel, value, n_taxels, n_frames, seed
):
    numbers = np.random.default_rng(seed).integers(0, 999, (n_frames, n_taxels))
    lines = [f"%time,{prefix}frame_id,{prefix}{taxel},{prefix}{value}"]
    for k, frame in enumerate(numbers):
        stamp_ns = 10**18 + k * 10**7
        lines += [f"{stamp_ns},palm,{at},{number}" for at, number in enumerate(frame)]
    source = read(tmp_path, "\n".join(lines), n_rows=1, n_cols=n_taxels)
    np.testing.assert_array_equal(source.frames, numbers[:, np.newaxis])


@FORGIVING
@given(table=tables(), data=st.data())
def test_a_damaged_table_is_read_right_or_refused(tmp_path, table, data):
    text = table.text
    start = data.draw(st.integers(0, len(text)))
    damage = data.draw(st.sampled_from(["cut", "removed", "doubled"]))
    stop = start + data.draw(st.integers(1, 30))
    parts = {
        "cut": text[:start],
        "removed": text[:start] + text[stop:],
        "doubled": text[:stop] + text[start:],
    }
    with contextlib.suppress(SparseskinError):
        source = read(tmp_path, parts[damage], **table.stated)
        lines = [line for line in parts[damage].splitlines() if line]
        assert 1 <= len(source.frames) <= len(lines)
        assert np.isfinite(source.frames).all()


@pytest.mark.parametrize(
    ("text", "stated", "rate_hz"),
    [
        (
            "# n\n0,1,2,3,4,5\r\n\r\n6, 7 ,8,9,10,1.1e1\n",
            {"n_rows": 2, "n_cols": 3},
            None,
        ),
        ("0;1,0;2;3;4;5\n6;7;8;9;10;11\n", {"n_rows": 2, "n_cols": 3}, None),
        ("r1c0,r1c1,r1c2,r0c0,r0c1,r0c2\n3,4,5,0,1,2\n9,10,11,6,7,8\n", {}, None),
        (
            "2026-11-03T09:30:00.5Z,0,1,2,3,4,5\n2026-11-03T10:30:00.6+01:00,6,7,8,9,10,11\n",
            {"n_rows": 2, "n_cols": 3},
            10,
        ),
        (
            "1790000000,0,1,2,3,4,5\n1790000002,6,7,8,9,10,11\n",
            {"n_rows": 2, "n_cols": 3},
            0.5,
        ),
        (
            "a,when,x0,x1,x2,x3,x4,x5\n9,4,0,1,2,3,4,5\n9,8,6,7,8,9,10,11\n",
            {"n_rows": 2, "time": "when", "time_unit": "us", "columns": "x*"},
            250_000,
        ),
        ("9,0,1,2,3,4,5\n9,6,7,8,9,10,11\n", {"n_rows": 2, "columns": "2-7"}, None),
        ("0,1,2\n3,4,5\n\n6,7,8\n9,10,11\n", {}, None),
        ("0,1,2\n3,4,5\n6,7,8\n9,10,11\n", {"n_rows": 2, "n_cols": 3}, None),
        (
            "Frame 1\n0 1 2\n3 4 5\nFrame 2\n6 7 8\n9 10 11\n",
            {"n_rows": 2, "n_cols": 3},
            None,
        ),
        (
            "10:15:02.120 -> 0,1,2,3,4,5\n10:15:02.140 -> 6,7,8,9,10,11\n",
            {"n_rows": 2},
            50,
        ),
        ("0.5: [0, 1, 2, 3, 4, 5]\n0.6: [6, 7, 8, 9, 10, 11]\n", {"n_rows": 2}, 10),
        (
            "sec,nsec,s0,s1,s2,s3,s4,s5\n1,9e8,0,1,2,3,4,5\n2,0,6,7,8,9,10,11\n",
            {"n_rows": 2},
            10,
        ),
        (
            "t_s,s0,s1,s2,s3,s4,s5\n0,0,1,2,3,4,5\nt_s,s0,s1,s2,s3,s4,s5\n.1,6,7,8,9,10,11\n",
            {"n_rows": 2},
            10,
        ),
        (
            "hand,s0,s1,s2,s3,s4,s5\nl,0,1,2,3,4,5\nr,9,9,9,9,9,9\nl,6,7,8,9,10,11\n",
            {"n_rows": 2, "frame_id": "l"},
            None,
        ),
        (
            "time_s,taxel,value\n"
            + "".join(f"{k / 20},{j + 1},{6 * k + j}\n" for k, j in np.ndindex(2, 6)),
            {"n_rows": 2},
            20,
        ),
        (
            "frame,row,col,value\n"
            + "".join(
                f"{k},{r},{c},{6 * k + 3 * r + c}\n" for k, r, c in np.ndindex(2, 2, 3)
            ),
            {},
            None,
        ),
    ],
)
def test_a_table_as_programs_write_it_is_read(tmp_path, text, stated, rate_hz):
    source = read(tmp_path, text, **stated)
    np.testing.assert_array_equal(source.frames, GRID)
    assert source.rate_hz == rate_hz
    assert source.stamp_ns[1] == round(1e9 / (rate_hz or 100))


@pytest.mark.parametrize(
    ("text", "stated", "message"),
    [
        (
            "1,2,3,4\n",
            {"unit": None},
            "state n_rows and n_cols, .*; the unit of .* unit=counts$",
        ),
        (
            "r0c0,r0c1\n1,2\n",
            {"unit": None},
            "unit of the readings is not stated.* unit=counts$",
        ),
        ("r0c0,r0c1\n1,0.5\n", {"unit": None}, "counts or another text$"),
        (
            "1,2,3,4\n",
            {"n_rows": 2, "n_cols": 3},
            "4 columns hold numbers, but .* needs 6",
        ),
        (
            "1,2,3,4\n5,6,7,8\n1,2,3\n9,9,9,9\n",
            {"n_rows": 2},
            "line 3: holds 3 cells; 4 are exp",
        ),
        ("a1,a2\n3,-4\n", {"n_rows": 1}, "frame 0, row 0, column 1: -4 is below 0"),
        (
            "s0,s1\n90,80\n90,-1\n95,85\n",
            {"n_rows": 1},
            "no other reading; add missing=-1$",
        ),
        (
            "s0,s1\n3,4\n5,OVR\n",
            {"n_rows": 1},
            "line 3, .*: 'OVR' is not a number; add missing=OVR$",
        ),
        ("\n# only\n", {"n_rows": 1}, "holds no frame"),
        ("time_s,s0,s1\n2,1,1\n1,1,1\n", {"n_rows": 1}, "time of frame 2 is before"),
        (
            "time,s0,s1\n0,1,1\n2,1,1\n",
            ROW,
            r"time_unit=s \(0.5 Hz\) or time_unit=ms \(500 Hz",
        ),
        (
            "a,b\n1,2\n",
            {"columns": "c*"},
            "columns: 'c.' is none of 2 columns .a, b.; allowed",
        ),
        ("a,b\n1,2\n", {"columns": "2-9"}, "'2-9' is none of 2 columns"),
        ("name\nleft\n", {}, "holds no frame"),
        ("5,a,1,2\n6,a,1,2\n4,a,1,2\n", ROW, "3 columns hold numbers, but .* needs 2"),
        ("0.5,1,0.1\n0.7,1,0.2\n", ROW, "state time=first or time=last or columns$"),
        (
            "time,s0,s1\n0,1,1\n2,1,1\n",
            {},
            "state n_rows .*; the unit of the times is",
        ),
        (
            "when,s0,s1\n3/12/2026 9:00,1,1\n3/12/2026 9:01,1,1\n",
            ROW,
            "'3/12/2026 9:00', like a time",
        ),
        (
            "time_s,s0,s1\n1,1,1\n1,2,2\n1,3,3\n",
            ROW,
            "2 of 3 times repeat the one before; state",
        ),
        (
            "us,s0,s1\n4294967290,1,1\n20,2,2\n",
            {**ROW, "time": "us"},
            "0; add time_wrap=4294967296$",
        ),
        (
            '{"a": 0, "s": 1}\n{"a": 1}\n{"a": 3, "s": 2}\n{"a": 2, "s": 4}\n',
            ROW,
            "line 2: names other values than most lines",
        ),
        (
            "1,2\n3,4\n",
            {**ROW, "axes": "rows,cols,frames"},
            "axes = .*; allowed for a table",
        ),
        (
            "side,s0,s1\nleft,1,2\nright,3,4\n",
            ROW,
            "2 skins, 'left', 'right': state frame_id$",
        ),
        ("L0,L1,R0,R1\n1,2,3,4\n", ROW, "state columns=1-2 or columns=3-4$"),
        ("1,\0", ROW, "not a text table in UTF-8"),
        (
            "t,time,s0,s1\n0,5,1,1\n1,6,1,1\n",
            ROW,
            "2 columns may be the times: state time=t or",
        ),
        (
            "timestep,s0,s1\n0.5,1,1\n0.1,1,1\n",
            ROW,
            "time of frame 2 is before .* by 0.4 s; sort or",
        ),
        (
            "1,2\n3,4\n",
            {},
            "state n_rows and n_cols, 1 x 2 or 2 x 1, or columns if not all are",
        ),
    ],
)
def test_what_is_no_table_of_frames_is_refused_in_one_line(
    tmp_path, text, stated, message
):
    shown = refusal(lambda: read(tmp_path, text, **stated), SourceError)
    assert re.search(f"{tmp_path / 'log.csv'}.*{message}", shown)


@FORGIVING
@given(data=st.data())
def test_a_column_that_rises_without_a_name_is_never_dropped_without_a_word(
    tmp_path, data
):
    n_lines = data.draw(st.integers(8, 20))
    n_taxels = data.draw(st.integers(2, 5))
    rng = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1)))
    readings = rng.integers(1, 1000, (n_lines, n_taxels))
    readings[-1] = readings[0] - 1
    seconds = np.cumsum(rng.integers(8, 40, n_lines)) / 1000
    place = data.draw(st.integers(0, n_taxels))
    cells = np.insert(readings.astype(float), place, seconds, axis=1)
    taxels = ",".join(str(k + 1) for k in range(n_taxels + 1) if k != place)
    stated = {"n_rows": 1, "n_cols": n_taxels, "columns": taxels}
    text = "".join(",".join(f"{cell:g}" for cell in line) + "\n" for line in cells)
    header = ",".join(chr(ord("a") + k) for k in range(n_taxels + 1)) + "\n"
    text = header * data.draw(st.booleans()) + text
    label = header[2 * place] if text.startswith("a") else str(place + 1)

    shown = refusal(lambda: read(tmp_path, text, **stated), SourceError)
    ask = f"1 column rises in all lines: state time={label} or time=none, if these are no times"
    assert f"{ask}; add time=" in shown
    source = read(tmp_path, text, **stated, time=label)
    np.testing.assert_array_equal(source.frames[:, 0], readings)
    np.testing.assert_allclose(source.stamp_ns / 1e9, seconds - seconds[0], atol=1e-6)
    assert read(tmp_path, text, **stated, time="none").rate_hz is None
    assert read(tmp_path, text, **stated, rate_hz=25).rate_hz == 25


def test_what_is_not_read_is_said(tmp_path):
    source = read(
        tmp_path, "time_s,x,s0,s1\n0.0,5,1,2\n0.1,6,3,4\n", n_rows=1, rate_hz=20
    )
    assert "left out: 1 column, x" in source.notes
    assert "times: column 'time_s', not read, since a rate is stated" in source.notes
    assert source.frames.tolist() == [[[1, 2]], [[3, 4]]]


def test_lines_in_are_frames_out_and_drops_by_name(tmp_path):
    text = "made by hand\n\ntime_s,s0,s1\n[s],[N],[N]\n0.0,1,2\n# pause\n0.1,3,4\n0.2,5"
    source = read(tmp_path, text, n_rows=1, n_cols=2)
    assert source.frames.tolist() == [[[1, 2]], [[3, 4]]]
    account = source.notes[-1]
    assert account.startswith("8 lines: 2 frames, ")
    for drop in (
        "1 blank lines",
        "1 header",
        "1 line of units",
        "1 comments",
        "1 cut last line",
    ):
        assert drop in account


@FORGIVING
@given(
    n_settings=st.integers(1, 6),
    n_frames=st.integers(7, 20),
    n_cols=st.integers(2, 5),
    n_words=st.integers(6, 9),
)
def test_settings_before_a_table_may_have_more_cells_than_its_lines(
    tmp_path, n_settings, n_frames, n_cols, n_words
):
    words = ",".join(f"word{k}" for k in range(n_words))
    line = ",".join(map(str, range(n_cols)))
    text = f"{words}\n" * n_settings + f"{line}\n" * n_frames
    source = read(tmp_path, text, n_rows=1, n_cols=n_cols)
    assert source.frames.shape == (n_frames, 1, n_cols)


def test_a_folder_of_frames_is_read_in_the_order_of_its_numbers(tmp_path):
    for k in (2, 10, 1):
        np.savetxt(tmp_path / f"frame_{k}.txt", np.full((3, 2), k), fmt="%d")
    source = open_file(tmp_path, Layout(n_rows=3, n_cols=2, unit="counts"))
    assert source.frames[:, 0, 0].tolist() == [1, 2, 10]


def test_a_taxel_without_a_reading_is_missing_and_not_left_out(tmp_path):
    source = read(
        tmp_path, "s0,s1,s2\n1,NaN,2\n3,NaN,4\n", n_rows=1, n_cols=3, missing="NaN"
    )
    np.testing.assert_array_equal(source.frames, [[[1, np.nan, 2]], [[3, np.nan, 4]]])


def test_a_first_line_that_counts_is_a_header_or_named(tmp_path):
    wide = ",".join(map(str, range(1, 10)))
    source = read(tmp_path, f"{wide}\n{'7,' * 8}7\n", n_rows=3, n_cols=3)
    assert len(source.frames) == 1
    source = read(tmp_path, "1,2\n7,7\n", n_rows=1)
    assert len(source.frames) == 2
    assert any("skip=1 if it is names" in line for line in source.notes)


def test_repeated_times_cost_1_ns_and_are_said(tmp_path):
    source = read(tmp_path, "time_s,s0,s1\n0,1,1\n0.1,1,1\n0.1,1,1\n5,1,1\n", **ROW)
    assert source.stamp_ns.tolist() == [0, 100_000_000, 100_000_001, 5_000_000_000]
    assert "1 times repeat the one before: 1 ns later each" in source.notes


def test_a_large_table_is_read_by_blocks_as_a_small_one(tmp_path, monkeypatch):
    text = "time_ms,s0,s1\n" + "".join(
        f"{20 * k},{k % 97},{k % 89}\n" for k in range(500)
    )
    small = read(tmp_path, text, **ROW)
    monkeypatch.setattr(file_source, "KEPT_BYTES", 100)
    monkeypatch.setattr(recording, "BLOCK_NUMBERS", 64)
    large = read(tmp_path, text, **ROW)
    np.testing.assert_array_equal(large.frames, small.frames)
    np.testing.assert_array_equal(large.stamp_ns, small.stamp_ns)
    assert large.skin.f_max == small.skin.f_max == 96


BAD = np.array(
    [[[1, 2], [3, 4]], [[np.nan, -1], [5, np.inf]], [[2, 2], [-3, 1]]], np.float32
)


class TestPasses:
    """How often a file is decoded."""

    @pytest.fixture
    def n_passes(self, monkeypatch):
        passes = []
        blocks = TableRecording.blocks

        def counted(recording):
            passes.append(0)
            for block in blocks(recording):
                passes[-1] += len(block.numbers)
                yield block

        monkeypatch.setattr(TableRecording, "blocks", counted)
        monkeypatch.setattr(file_source, "KEPT_BYTES", 80)
        monkeypatch.setattr(recording, "BLOCK_NUMBERS", 4)
        return passes

    TEXT = "t_ms,s0,s1\n" + "".join(f"{10 * k},{k},1\n" for k in range(20))

    def test_arrays_decode_it_once(self, tmp_path, n_passes):
        (tmp_path / "log.csv").write_text(self.TEXT)
        arrays = read_recording(tmp_path / "log.csv", n_rows=1, unit="N")
        assert arrays["forces"].shape == (20, 1, 2)
        assert n_passes == [20]

    def test_a_graph_begins_with_the_range_of_the_first_frames(
        self, tmp_path, n_passes
    ):
        (tmp_path / "log.csv").write_text(self.TEXT)
        source = f"file:{tmp_path / 'log.csv'}"
        chosen = SensorSettings(source=source, n_rows=1, unit="N")
        sensor = Sensor(chosen, Context("sensor", ManualClock(0)))
        messages = [*sensor.start()]
        for k in range(20):
            messages += sensor.tick(Tick(k * 10_000_000, k))
        ranges = []
        n_frames = 0
        for message in messages:
            if isinstance(message, SkinState):
                ranges.append(message.f_max)
            if isinstance(message, Taxels):
                # Each frame is within the range that was published before it.
                assert message.forces.max() <= ranges[-1]
                n_frames += 1
        assert n_frames == 20
        assert n_passes[1:] == [20]
        assert n_passes[0] < 20
        assert ranges[0] < 19
        wider = np.array(ranges[1:]) / ranges[:-1]
        assert (wider >= MIN_WIDENING).all()

    def test_an_import_decodes_it_twice(self, tmp_path, n_passes):
        (tmp_path / "log.csv").write_text(self.TEXT)
        layout = Layout(n_rows=1, unit="N")
        assert (
            import_file(tmp_path / "log.csv", tmp_path / "log.mcap", layout=layout)
            == 20
        )
        assert n_passes == [20, 20]

    @pytest.mark.parametrize("stated", [{"f_max": 50.0}, {"skin": True}])
    def test_no_pass_comes_before_the_first_frame_where_the_range_is_known(
        self, tmp_path, n_passes, stated
    ):
        (tmp_path / "log.csv").write_text(self.TEXT)
        layout = Layout(n_rows=1, unit="N", f_max=stated.get("f_max"))
        described = of_skin("skin", Skin(1, 2, 50.0)) if "skin" in stated else None
        where = f"file:{tmp_path / 'log.csv'}"
        source = open_source(
            where, layout=layout, raw="skin" in stated, described=described
        )
        assert n_passes
        assert max(n_passes) < 20
        assert len(source.frames) == 20
        assert source.rate_hz == 100


def treated(layout, folder):
    np.save(folder / "a.npy", BAD)
    return open_file(folder / "a.npy", layout)


@pytest.mark.parametrize(
    ("nan", "negative", "expected", "mask"),
    [
        ("zero", "zero", [[1, 2, 3, 4], [0, 0, 5, 0], [2, 2, 0, 1]], None),
        ("hold", "zero", [[1, 2, 3, 4], [1, 0, 5, 4], [2, 2, 0, 1]], None),
        ("hold", "offset", [[4, 5, 6, 7], [4, 2, 8, 7], [5, 5, 0, 4]], None),
        ("mask", "zero", [[1, 2, 3, 4], [2.5, 0, 5, 2.5], [2, 2, 0, 1]], None),
        (
            "zero",
            "mask",
            [[1, 0, 0, 4], None, [2, 0, 0, 1]],
            [True, False, False, True],
        ),
    ],
)
def test_invalid_readings_become_what_the_settings_say(
    tmp_path, nan, negative, expected, mask
):
    shape = {"n_rows": 2, "n_cols": 2}
    source = treated(Layout(nan=nan, negative=negative, f_max=10.0, **shape), tmp_path)
    readings = MissingReadings(nan, source.skin, learns=False)
    filled = [readings.fill(frame, 0) for frame in source.frames]
    assert [found and found[0].ravel().tolist() for found in filled] == expected
    counts = source.report()["invalid"]
    assert counts["not_finite"] == 2
    assert counts["negative"] == 2
    held = None if source.skin.mask is None else source.skin.mask.ravel().tolist()
    assert held == mask


def test_missing_and_negative_cells_of_a_csv_are_treated_too(tmp_path):
    (tmp_path / "a.csv").write_text("1,,NaN,4\n-2,5,6,7\n")
    options = {"n_rows": 2, "n_cols": 2, "unit": "N"}
    source = open_file(
        tmp_path / "a.csv", Layout(**options, nan="zero", negative="offset")
    )
    found = np.nan_to_num(source.frames, nan=-1).reshape(2, 4)
    assert found.tolist() == [[3, -1, -1, 6], [0, 7, 8, 9]]
    counts = {"not_finite": 2, "negative": 1, "masked_taxels": 0, "offset": -2.0}
    assert source.report()["invalid"] == counts
    with pytest.raises(SourceError, match="line 1, column 2: '' is not a number"):
        open_file(tmp_path / "a.csv", Layout(**options))


def test_a_sensor_counts_invalid_readings_in_its_log_and_report(tmp_path):
    np.save(tmp_path / "a.npy", BAD)
    lines = []
    chosen = SensorSettings(
        source=f"file:{tmp_path / 'a.npy'}",
        nan="hold",
        negative="offset",
        n_rows=2,
        n_cols=2,
    )
    sensor = Sensor(chosen, Context("sensor", ManualClock(0), lines.append))
    list(sensor.start())
    assert lines[-2:] == [
        "2 readings of the file are missing: replaced by the last ones",
        "2 readings of the file are below 0: -3 N subtracted from all readings",
    ]
    counts = {"not_finite": 2, "negative": 2, "masked_taxels": 0, "offset": -3.0}
    assert sensor.report()["invalid"] == counts


def test_a_look_reads_the_begin_alone_and_says_so(tmp_path, monkeypatch):
    monkeypatch.setattr(file_source, "LOOK_BYTES", 100_000)
    lines = [f"{k % 11},{k % 7},{k % 5},{k % 3}\n" for k in range(60_000)]
    (tmp_path / "log.csv").write_text("".join(lines) + "1,2\n")
    layout = Layout(n_rows=2, n_cols=2, unit="counts", time="none")
    source = open_file(tmp_path / "log.csv", layout, needs=Needs(begin=True))
    n = len(source.frames)
    assert n < 60_000
    said = f"the first {n} frames alone were read: import reads and checks all"
    assert said in source.notes
    with pytest.raises(SourceError, match="line 60001: holds 2 cells; 4 are expected"):
        open_file(tmp_path / "log.csv", layout)


MB = 1_000_000


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


def test_an_archive_that_grows_far_is_read_by_blocks(tmp_path):
    path = tmp_path / "grows.npz"
    frames = np.zeros((100_000, 32, 32), np.uint8)
    frames[-1] = 1
    path.write_bytes(npz(forces=frames))
    n_bytes = frames.nbytes
    del frames
    assert path.stat().st_size < MB
    with peak_below(n_bytes):
        assert open_file(path).n_frames == 100_000


def test_headers_of_arrays_are_not_believed(tmp_path):
    head = npy(np.zeros((1, 4, 4)))[:128].replace(b"(1, 4, 4)", b"(1000000, 400, 4)")[
        :128
    ]
    path = tmp_path / "lies.npz"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("forces.npy", head + bytes(64))
    with (
        peak_below(MB),
        pytest.raises(SourceError, match=r"lies\.npz: its header states 1000000 x 400"),
    ):
        open_file(path)
    path = tmp_path / "true.npy"
    path.write_bytes(
        npy(np.ones((1, 8, 8))).replace(b"(1, 8, 8), }   ", b"(True, 8, 8), }")
    )
    with pytest.raises(SourceError, match=r"true\.npy: not a readable NumPy file"):
        open_file(path)


def test_a_recording_of_bytes_takes_the_memory_of_its_frames_and_no_more(tmp_path):
    path = tmp_path / "bytes.npy"
    np.save(path, np.ones((4000, 32, 32), np.uint8))
    # The file, its frames in float32, and a part that is checked.
    with peak_below(path.stat().st_size * (1 + 4) + 12 * MB):
        assert open_file(path).n_frames == 4000
