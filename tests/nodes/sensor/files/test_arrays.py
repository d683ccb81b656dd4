"""Plain arrays: how .npy and .npz files are read, and what is refused."""

import io
import re

import numpy as np
import pytest
from damaged import mutated, npy, npz, refusal
from drawn_arrays import arrays, check
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics import array_blocks
from sparseskin.nodes.numerics.array_blocks import StoredArray
from sparseskin.nodes.numerics.array_files import ArrayFileError
from sparseskin.nodes.sensor.files import arrays as arrays_module
from sparseskin.nodes.sensor.files import recording
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.frames import UNTIMED_PERIOD_NS
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.node import Sensor, SensorSettings
from sparseskin.nodes.sensor.sources import find_address

FORCES = np.arange(24, dtype=np.float64).reshape(4, 2, 3) / 10
AXES = "frames,rows,cols"
CASES = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


def open_bytes(folder, name, raw, **stated):
    path = folder / name
    path.write_bytes(raw)
    return open_file(path, Layout(**stated))


def saved(array, suffix):
    """A drawn array as the bytes of a file, and its times beside it in an .npz."""
    if suffix == ".npy":
        return npy(array.stored)
    beside = {array.time_name: array.times} if array.time_name else {}
    buffer = io.BytesIO()
    save = np.savez if suffix == ".npz" else np.savez_compressed
    save(buffer, pressure=array.stored, note="left alone", gain=np.ones(9), **beside)
    return buffer.getvalue()


@pytest.fixture(autouse=True)
def small_blocks(monkeypatch):
    """Blocks of a few frames."""
    monkeypatch.setattr(recording, "BLOCK_NUMBERS", 40)


@CASES
@given(array=arrays(), suffix=st.sampled_from([".npy", ".npz", ".packed.npz"]))
def test_a_drawn_array_whose_axes_are_stated_is_read_as_it_was_written(
    tmp_path, array, suffix
):
    source = open_bytes(
        tmp_path, f"a{suffix}", saved(array, suffix), **array.axes_stated
    )
    check(source, array, has_times=suffix != ".npy")


@CASES
@given(
    array=arrays(), suffix=st.sampled_from([".npy", ".npz"]), knows_shape=st.booleans()
)
def test_without_its_axes_it_is_read_right_or_the_ways_are_named(
    tmp_path, array, suffix, knows_shape
):
    stated = array.shape_stated if knows_shape else {}
    opened = []
    text = refusal(
        lambda: opened.append(
            open_bytes(tmp_path, f"a{suffix}", saved(array, suffix), **stated)
        ),
        SourceError,
    )
    if opened:
        # Rows and columns may be turned where neither shape nor sides tell them apart; frames are
        # frames, but of a square whose numbers change least along its first axis.
        frames = opened[0].frames
        turned = frames.transpose(0, 2, 1)
        is_square = len({*array.stored.shape[1:]}) == 1
        sides = array.frames.shape[1:]
        is_turned = not knows_shape or sides[0] == sides[1]
        ways = [frames, turned] if is_turned else [frames]
        is_right = any(np.array_equal(way, array.frames.astype("f4")) for way in ways)
        is_unknown = is_square and not knows_shape
        assert is_right or (is_unknown and array.axes[0] != "frames")
    if (
        opened
        and array.is_plain
        and (knows_shape or (suffix == ".npz" and array.time_name))
    ):
        check(opened[0], array, has_times=suffix == ".npz")
    if not opened:
        axes = ",".join(array.axes)
        named = re.findall(r"axes=([a-z,-]+)", text)
        in_order = (
            axes.replace("cols", "#").replace("rows", "cols").replace("#", "rows")
        )
        assert axes in named or in_order in named
        check(
            open_bytes(
                tmp_path, f"a{suffix}", saved(array, suffix), **array.axes_stated
            ),
            array,
            has_times=suffix == ".npz",
        )


@CASES
@given(
    array=arrays(max_side=9),
    axis=st.integers(0, 2),
    size=st.integers(1, 12),
    run_bytes=st.integers(1, 64),
    can_seek=st.booleans(),
)
def test_blocks_along_any_axis_are_those_of_the_array(
    array, axis, size, run_bytes, can_seek
):
    stored = array.stored
    by_columns = stored.flags.f_contiguous and not stored.flags.c_contiguous
    stored = stored if by_columns else np.ascontiguousarray(stored)
    raw = stored.tobytes("F" if by_columns else "C")
    opened = lambda: io.BytesIO(raw)  # noqa: E731
    of = StoredArray(opened, stored.dtype, stored.shape, by_columns, can_seek)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(array_blocks, "MIN_RUN_BYTES", run_bytes)
        blocks = list(of.blocks(axis, size))
        np.testing.assert_array_equal(of.whole(), stored)
    assert [len(block) for block in blocks[:-1]] == [size] * (len(blocks) - 1)
    np.testing.assert_array_equal(np.concatenate(blocks), np.moveaxis(stored, axis, 0))
    cut = StoredArray(
        lambda: io.BytesIO(raw[:-1]), stored.dtype, stored.shape, by_columns, can_seek
    )
    with pytest.raises(ArrayFileError, match="ends before the last"):
        list(cut.blocks(axis, size))


class TestWhichArray:
    GRID = np.ones((9, 4, 3))

    @pytest.mark.parametrize(
        ("beside", "stated"),
        [
            ({"qpos": np.ones((9, 7))}, {}),
            ({"image": np.ones((9, 8, 8, 3))}, {"n_rows": 4, "n_cols": 3}),
            ({"table": np.ones((9, 64))}, {"topic": "grid", "axes": AXES}),
            ({"table": np.ones((9, 64))}, {"n_rows": 4, "n_cols": 3}),
            ({"t": np.arange(9) / 50, "valid": np.ones((9, 5, 5), bool)}, {}),
            ({"other": np.array([None, {}])}, {}),
        ],
    )
    def test_the_only_one_that_can_be_frames_is_read(self, tmp_path, beside, stated):
        raw = npz(grid=self.GRID, **beside)
        stated = stated or {"axes": AXES}
        assert open_bytes(tmp_path, "a.npz", raw, **stated).frames.shape == (9, 4, 3)

    @pytest.mark.parametrize(
        "beside",
        [
            {"table": np.ones((9, 64))},
            {"image": np.ones((9, 8, 8, 3))},
            {"joints": np.ones((9, 12))},
            {"other": np.ones((9, 4, 3))},
        ],
    )
    def test_of_several_none_is_chosen(self, tmp_path, beside):
        (name,) = beside
        with pytest.raises(SourceError, match=f"grid .*{name} .*; state topic"):
            open_bytes(tmp_path, "a.npz", npz(grid=self.GRID, **beside))

    def test_forces_are_read_before_others(self, tmp_path):
        raw = npz(forces=self.GRID[:, :2], other=self.GRID)
        assert open_bytes(tmp_path, "a.npz", raw).frames.shape == (9, 2, 3)

    def test_true_and_false_are_one_and_zero(self, tmp_path):
        touched = np.arange(24).reshape(4, 2, 3) % 2 == 0
        source = open_bytes(tmp_path, "a.npy", npy(touched), axes=AXES)
        np.testing.assert_array_equal(source.frames, touched)
        assert "True and False are read as 1 and 0" in source.notes


class TestTimes:
    T = np.array([0.0, 0.02, 0.04, 0.5])
    NS = (T * 1e9).astype(np.int64)

    @pytest.mark.parametrize(
        "beside",
        [
            {"timestamps": 1.7e9 + T},
            {"t_ms": (1000 * T).astype(np.uint16)},
            {"t_left": T, "t_right": T + 1, "stamp_ns": NS, "time": "stamp_ns"},
            {"pad_timestamps": T, "camera_timestamps": T + 3},
            {
                "time": np.datetime64("2026-03-01T10:00:00", "us")
                + (NS // 1000).astype("m8[us]")
            },
            {"stamps": [f"2026-03-01T10:00:0{t:.2f}+02:00" for t in T]},
            {"clock": [f"23:59:59.{k:03d}" for k in (0, 20, 40, 500)]},
            {"time": T[:, None], "elapsed": np.arange(9)},
        ],
    )
    def test_they_are_those_of_an_array_with_such_a_name(self, tmp_path, beside):
        time = beside.pop("time", "") if isinstance(beside.get("time"), str) else ""
        source = open_bytes(tmp_path, "a.npz", npz(pad=FORCES, **beside), time=time)
        np.testing.assert_allclose(source.stamp_ns / 1e9, self.T, atol=1e-6)

    def test_of_several_none_is_chosen(self, tmp_path):
        raw = npz(pad=FORCES, time=self.T, stamps=self.T)
        ways = "state time=time or time=stamps or time=none"
        with pytest.raises(SourceError, match=ways):
            open_bytes(tmp_path, "a.npz", raw)
        stamps = open_bytes(tmp_path, "a.npz", raw, time="none", axes=AXES).stamp_ns
        np.testing.assert_array_equal(stamps, UNTIMED_PERIOD_NS * np.arange(4))

    def test_those_of_other_length_are_not_read_and_that_is_said(self, tmp_path):
        raw = npz(pad=FORCES, time=np.arange(9.0))
        notes = open_bytes(tmp_path, "a.npz", raw, axes=AXES).notes
        assert "not read as times of 4 frames: time (9)" in notes
        with pytest.raises(SourceError, match="time: not read as times of 4 frames"):
            open_bytes(tmp_path, "a.npz", raw, axes=AXES, time="time")
        with pytest.raises(
            SourceError, match="'gain' is no array of one axis; allowed: time, none"
        ):
            open_bytes(tmp_path, "a.npz", raw, axes=AXES, time="gain")

    def test_a_shape_that_contradicts_them_is_refused(self, tmp_path):
        raw = npz(pad=np.ones((6, 4, 3)), time=np.arange(6.0))
        stated = {"n_rows": 6, "n_cols": 4}
        with pytest.raises(
            SourceError, match="axis 1 of 6 x 4 x 3 is as long as the times"
        ):
            open_bytes(tmp_path, "a.npz", raw, **stated)
        assert open_bytes(
            tmp_path, "a.npz", raw, time="none", **stated
        ).frames.shape == (3, 6, 4)

    @pytest.mark.parametrize("time", [[0, np.nan, 2, 3], [0, 1, np.inf, 3]])
    def test_a_time_that_is_none_is_refused(self, tmp_path, time):
        with pytest.raises(
            SourceError, match="array 'time': a time is not a finite number"
        ):
            open_bytes(tmp_path, "a.npz", npz(pad=FORCES, time=np.array(time, float)))

    @pytest.mark.parametrize("place", ["first", "last"])
    def test_a_column_of_a_table_may_hold_them(self, tmp_path, place):
        rows = FORCES.reshape(4, 6)
        at = 0 if place == "first" else 6
        shape = {"n_rows": 2, "n_cols": 3}
        dates = npy(np.insert(rows, at, 1.7e9 + self.T, axis=1))
        source = open_bytes(tmp_path, "a.npy", dates, **shape)
        np.testing.assert_array_equal(source.frames, FORCES.astype(np.float32))
        np.testing.assert_allclose(source.stamp_ns / 1e9, self.T, atol=1e-6)
        assert f"column {at + 1} holds dates: the times" in source.notes

        seconds = npy(np.insert(rows, at, self.T, axis=1))
        with pytest.raises(
            SourceError, match=f"the first and the last column rise: .*time={place}"
        ):
            open_bytes(tmp_path, "a.npy", seconds, **shape)
        source = open_bytes(tmp_path, "a.npy", seconds, time=place, **shape)
        np.testing.assert_allclose(source.stamp_ns / 1e9, self.T)
        np.testing.assert_array_equal(source.frames, FORCES.astype(np.float32))


class TestChannels:
    XYZ = np.stack([FORCES + 1, FORCES + 2, FORCES + 3], axis=-1)

    @pytest.mark.parametrize(
        ("array", "stated"),
        [
            (XYZ, {"channel": "z", "axes": "rows,cols,channel"}),
            (
                np.tile(XYZ, (1, 1, 2, 1))[:, :, :3],
                {"channel": "z", "n_rows": 2, "n_cols": 3},
            ),
            (XYZ, {"channel": "2", "n_rows": 2, "n_cols": 3}),
            (
                np.moveaxis(XYZ, -1, 1),
                {"channel": "2", "axes": "frames,channel,rows,cols"},
            ),
            (np.moveaxis(XYZ, -1, 1), {"channel": "z", "n_rows": 2, "n_cols": 3}),
            (XYZ.reshape(4, 6, 3), {"channel": "z", "n_rows": 2, "n_cols": 3}),
        ],
    )
    def test_the_stated_one_is_read(self, tmp_path, array, stated):
        source = open_bytes(tmp_path, "a.npy", npy(array), **stated)
        np.testing.assert_array_equal(source.frames, (FORCES + 3).astype(np.float32))

    def test_none_is_chosen(self, tmp_path):
        ways = "axes=frames,rows,cols,channel or axes=frames,rows,channel,cols"
        with pytest.raises(
            SourceError, match=f"{ways} or axes=frames,channel,rows,cols"
        ):
            open_bytes(tmp_path, "a.npy", npy(self.XYZ))
        with pytest.raises(SourceError, match=f"{ways} or axes=rows,"):
            open_bytes(tmp_path, "a.npy", npy(self.XYZ), channel="z")
        source = open_bytes(
            tmp_path, "a.npy", npy(self.XYZ), axes="rows,cols,channel", channel="z"
        )
        np.testing.assert_array_equal(source.frames, (FORCES + 3).astype(np.float32))


class TestRecords:
    @pytest.mark.parametrize("form", [("f4", (2, 3)), ("f4", 6), None])
    @pytest.mark.parametrize("stamp", [("stamp_ns", "i8"), ("t", "f8")])
    def test_a_field_is_the_frames_and_another_their_times(self, tmp_path, form, stamp):
        fields = [("data", *form)] if form else [(f"s{k}", "f4") for k in range(6)]
        records = np.zeros(len(FORCES), [stamp, *fields])
        times = np.arange(len(FORCES)) / 50
        name, kind = stamp
        records[name] = times * 1e9 if kind == "i8" else times
        flat = FORCES.reshape(len(FORCES), -1)
        for k, (field, *_) in enumerate(fields):
            of_field = flat.reshape(records[field].shape) if form else flat[:, k]
            records[field] = of_field
        source = open_bytes(tmp_path, "a.npy", npy(records), n_rows=2, n_cols=3)
        np.testing.assert_array_equal(source.frames, FORCES.astype(np.float32))
        np.testing.assert_allclose(source.stamp_ns / 1e9, times, atol=1e-9)


class TestNpy:
    @pytest.mark.parametrize(
        ("dtype", "unit"), [("f4", "N"), ("u2", "counts"), ("i8", "counts")]
    )
    def test_an_array_alone_has_a_unit_by_its_dtype_and_no_rate(
        self, tmp_path, dtype, unit
    ):
        source = open_bytes(
            tmp_path, "skin.npy", npy((10 * FORCES).astype(dtype)), axes=AXES
        )
        assert source.skin.unit == unit
        assert any(unit in line for line in source.notes)
        assert any("100 Hz" in line for line in source.notes)
        assert source.rate_hz is None
        assert source.skin.pitch_m is None
        assert source.skin.mask is None
        np.testing.assert_array_equal(source.stamp_ns, UNTIMED_PERIOD_NS * np.arange(4))

    def test_stated_unit_range_and_rate_are_kept(self, tmp_path):
        stated = {"unit": "kPa", "f_max": 2.5, "rate_hz": 1000.0, "axes": AXES}
        source = open_bytes(tmp_path, "skin.npy", npy(FORCES), **stated)
        assert source.skin.unit == "kPa"
        assert source.skin.f_max == 2.5
        assert source.rate_hz == 1000
        np.testing.assert_array_equal(source.stamp_ns, 1_000_000 * np.arange(4))

    @pytest.mark.parametrize(
        ("array", "message"),
        [
            (np.zeros(4), r"has 1 axes, 4; expected frames, rows and columns"),
            (
                np.zeros((8, 6)),
                "holds 6 readings, .* shape is not stated: state n_rows and n_cols",
            ),
            (
                np.zeros((3, 4, 6)),
                "axes=frames,rows,cols or axes=rows,frames,cols or axes=cols,frames,rows",
            ),
            (np.zeros((0, 3, 4)), "axes=frames,rows,cols or axes="),
            (np.zeros((3, 0)), "holds 0 numbers"),
            (np.zeros((4096, 2048, 1024), "u1")[:1], "2048 x 1024 = 2097152 cells"),
            (
                np.zeros((4, 2, 3), complex),
                "holds dtype complex128; allowed are integers",
            ),
            (
                np.zeros((4, 2), [("t", "f8"), ("f", "f4", 9)]),
                "holds dtype .*; allowed are integers",
            ),
            (
                np.zeros((4, 2, 3)),
                "all readings are 0, so its range is unknown; state f_max",
            ),
        ],
    )
    def test_what_is_no_stack_of_frames_is_refused(self, tmp_path, array, message):
        stated = {"axes": AXES} if array.size > 1e6 or len(array) == 4 else {}
        stated = stated if array.ndim == 3 else {}
        with pytest.raises(SourceError, match=rf"skin\.npy.*{message}"):
            open_bytes(tmp_path, "skin.npy", npy(array), **stated)

    @pytest.mark.parametrize(
        ("stated", "message"),
        [
            (
                {"axes": "frames,rows"},
                "but the array is 4 x 2 x 3; state each of its 3 axes",
            ),
            (
                {"axes": "frames,rows,rows"},
                "array is 4 x 2 x 3; state each of its 3 axes once",
            ),
            (
                {"axes": "frames,-,cols"},
                "axes = frames,-,cols, but .* - for one of one entry",
            ),
            (
                {"n_rows": 5, "n_cols": 3},
                "no axis of 4 x 2 x 3 leaves a frame of 5 x 3 taxels",
            ),
            (
                {"time": "first", "axes": AXES},
                "time = first, but a frame is no row of numbers",
            ),
            ({"topic": "left"}, "holds no topic 'left'"),
        ],
    )
    def test_what_is_stated_must_fit(self, tmp_path, stated, message):
        with pytest.raises(SourceError, match=message):
            open_bytes(tmp_path, "skin.npy", npy(FORCES), **stated)

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (np.nan, "nan is not finite"),
            (-0.5, "-0.5 is below 0"),
            (1e39, r"1e\+39 is (above 1e\+30|not finite)"),
        ],
    )
    def test_what_is_no_reading_is_refused_with_frame_and_cell(
        self, tmp_path, value, message
    ):
        array = FORCES.copy()
        array[3, 1, 2] = value
        with pytest.raises(SourceError, match=f"frame 3, row 1, column 2: {message}"):
            open_bytes(tmp_path, "skin.npy", npy(array), axes=AXES)

    @pytest.mark.parametrize("sides", [(1, 3, 3), (1, 4, 3), (2, 1, 3, 3)])
    def test_a_first_axis_of_few_entries_may_be_the_rows(self, tmp_path, sides):
        array = 1 + np.arange(np.prod(sides), dtype=float).reshape(sides)
        text = refusal(lambda: open_bytes(tmp_path, "a.npy", npy(array)), SourceError)
        ways = re.findall(r"axes=([a-z,-]+)", text)
        assert len(ways) > 2
        for way in ways:
            source = open_bytes(
                tmp_path,
                "a.npy",
                npy(array),
                axes=way,
                channel="2" if "channel" in way else "",
                n_rows=1 if "taxels" in way else None,
            )
            at = way.split(",").index("frames")
            assert len(source.frames) == sides[at]

    @pytest.mark.parametrize(
        ("sides", "n_rows", "n_cols", "axes"),
        [
            ((1, 3, 3), 3, 3, "frames,rows,cols"),
            ((9, 3, 1), 3, 1, "frames,rows,cols"),
            ((1, 3, 5), 1, 3, "rows,cols,frames"),
            ((1, 3, 5), 3, 5, "frames,rows,cols"),
        ],
    )
    def test_a_stated_shape_decides(self, tmp_path, sides, n_rows, n_cols, axes):
        array = 1 + np.arange(np.prod(sides), dtype=float).reshape(sides)
        shape = {"n_rows": n_rows, "n_cols": n_cols}
        frames = open_bytes(tmp_path, "a.npy", npy(array), **shape).frames
        stated = open_bytes(tmp_path, "a.npy", npy(array), axes=axes).frames
        np.testing.assert_array_equal(frames, stated)

    def test_one_frame_of_the_stated_shape_is_read(self, tmp_path):
        source = open_bytes(tmp_path, "a.npy", npy(FORCES[1]), n_rows=2, n_cols=3)
        np.testing.assert_array_equal(source.frames, FORCES[1:2].astype(np.float32))


class TestNpz:
    def test_everything_that_an_archive_can_state_is_read(self, tmp_path):
        mask = np.ones((2, 3), dtype=bool)
        mask[0, 0] = mask[1, 2] = False
        raw = npz(
            forces=FORCES,
            stamp_ns=np.array([5_000, 9_000, 9_500, 10_000]),
            rate_hz=250.0,
            mask=mask,
            f_max=2.5,
            unit="raw",
            pitch_m=0.005,
            remark="left alone",
        )
        source = open_bytes(tmp_path, "skin.npz", raw)
        assert source.stamp_ns.tolist() == [0, 4_000, 4_500, 5_000]
        assert source.rate_hz == 250.0
        assert source.skin.n_taxels == 4
        assert source.skin.f_max == 2.5
        assert source.skin.unit == "raw"
        assert source.skin.pitch_m == 0.005
        frames = source.frames
        np.testing.assert_array_equal(
            frames[:, mask], FORCES[:, mask].astype(np.float32)
        )
        assert not frames[:, ~mask].any()

    @CASES
    @given(array=arrays(), is_flat=st.booleans(), data=st.data())
    def test_a_mask_is_that_of_the_frames(self, tmp_path, array, is_flat, data):
        n_rows, n_cols = array.frames.shape[1:]
        bits = data.draw(
            st.lists(st.booleans(), min_size=n_rows * n_cols, max_size=n_rows * n_cols)
        )
        mask = np.array([True, *bits[1:]]).reshape(n_rows, n_cols)
        stored = array.stored
        axes = array.axes_stated
        if is_flat:
            stored = array.frames.reshape(len(array.frames), -1)
            axes = array.shape_stated
            axes["axes"] = "frames,taxels"
        raw = npz(forces=stored, mask=mask)
        source = open_bytes(tmp_path, "a.npz", raw, **axes)
        if is_flat or array.is_plain:
            np.testing.assert_array_equal(source.skin.exists, mask)
            np.testing.assert_array_equal(source.frames, array.frames * mask)

    def test_a_mask_of_something_else_is_not_read_and_that_is_said(self, tmp_path):
        raw = npz(pad=FORCES, mask=np.ones((4, 5, 5)))
        source = open_bytes(tmp_path, "a.npz", raw, axes=AXES)
        assert source.skin.mask is None
        assert "array mask is no mask of a frame: not read" in source.notes

    @pytest.mark.parametrize(
        ("names", "rate_hz"),
        [
            ({"fs": 50}, 50),
            ({"fps": 50.0, "rate": [50]}, 50),
            ({"fs": 50, "rate": 40}, None),
        ],
    )
    def test_a_rate_is_read_where_one_is_stated(self, tmp_path, names, rate_hz):
        source = open_bytes(tmp_path, "a.npz", npz(pad=FORCES, **names), axes=AXES)
        assert source.rate_hz == rate_hz
        assert any("fs" in note or "fps" in note for note in source.notes)

    @pytest.mark.parametrize(
        ("arrays", "message"),
        [
            (
                {"a": FORCES, "b": FORCES},
                r"a \(4 x 2 x 3\), b \(4 x 2 x 3\); state topic",
            ),
            ({}, "holds no arrays of frames"),
            (
                {"forces": FORCES, "mask": np.zeros((2, 3), bool)},
                "no cell of the skin is a taxel",
            ),
            (
                {"forces": FORCES, "mask": np.ones((4, 3), bool)},
                "'mask': is 4 x 3, but a frame 2 x",
            ),
            (
                {"forces": FORCES, "mask": np.full((2, 3), 7)},
                "array 'mask': expected bool",
            ),
            (
                {"forces": FORCES, "stamp_ns": [7, 9, 8, 10]},
                "the time of frame 3 is before",
            ),
            (
                {"forces": FORCES, "rate_hz": -1.0},
                "array 'rate_hz': -1 must be above 0",
            ),
            ({"forces": FORCES, "f_max": "2.5"}, "array 'f_max': expected one number"),
            (
                {"forces": FORCES, "f_max": 1.0},
                "f_max = 1 is below the largest reading, 2.3",
            ),
            (
                {"forces": FORCES, "unit": "a\nb"},
                "expected 1 to 32 printable characters",
            ),
            ({"forces": FORCES, "unit": 3.0}, "array 'unit': expected one text"),
            (
                {"forces": np.array([[["a", None]]], dtype=object)},
                "holds Python objects",
            ),
        ],
    )
    def test_what_an_archive_must_not_hold_is_refused(self, tmp_path, arrays, message):
        with pytest.raises(SourceError, match=rf"skin\.npz.*{message}"):
            open_bytes(tmp_path, "skin.npz", npz(**arrays))

    def test_unsigned_stamps_far_apart_do_not_wrap_round(self, tmp_path):
        stamps = np.array([0, 1, 2, 2**64 - 1], dtype=np.uint64)
        with pytest.raises(SourceError, match=r"lasts longer than 2\*\*63 ns"):
            open_bytes(tmp_path, "skin.npz", npz(forces=FORCES, stamp_ns=stamps))

    def test_a_flipped_bit_is_found_by_the_checksum(self, tmp_path):
        buffer = io.BytesIO()
        np.savez(buffer, forces=FORCES)
        raw = bytearray(buffer.getvalue())
        raw[raw.index(FORCES.tobytes()) + 80] ^= 1
        with pytest.raises(SourceError, match="not a readable NumPy file"):
            open_bytes(tmp_path, "skin.npz", bytes(raw))

    def test_arrays_far_larger_than_the_file_are_refused(self, tmp_path, monkeypatch):
        monkeypatch.setattr(arrays_module, "MAX_GROWN_BYTES", 1 << 10)
        raw = npz(forces=np.zeros((1 << 10, 16, 16), "u1"))
        with pytest.raises(
            SourceError, match=r"array 'forces' would have \d+ bytes, of a file of"
        ):
            open_bytes(tmp_path, "skin.npz", raw)


@CASES
@given(data=st.data(), suffix=st.sampled_from(["npy", "npz"]))
def test_random_and_mutated_files_never_raise_anything_else(tmp_path, data, suffix):
    mask = np.ones((2, 3), bool)
    stamps = np.arange(4) * 1000
    whole = {
        "npy": npy(FORCES),
        "npz": npz(forces=FORCES, mask=mask, unit="N", rate_hz=2.0, stamp_ns=stamps),
    }[suffix]
    raw = mutated(data, data.draw(st.just(whole) | st.binary(min_size=1, max_size=200)))
    sources = []
    refusal(
        lambda: sources.append(open_bytes(tmp_path, f"any.{suffix}", raw)), SourceError
    )
    for source in sources:
        frames = source.frames
        assert np.isfinite(frames).all()
        assert 0 <= frames.min() <= frames.max() <= np.float32(source.skin.f_max)


@pytest.mark.parametrize(("suffix", "order"), [(".npy", "F"), (".npz", "C")])
def test_a_reading_that_is_refused_is_named_by_the_sensor_with_its_place(
    tmp_path, suffix, order
):
    # some blocks of it
    forces = np.asarray(np.ones((40, 8, 8), np.float32), order=order)
    forces[38, 3, 7] = np.nan
    raw = (
        npy(forces)
        if suffix == ".npy"
        else npz(forces=forces, mask=np.ones((8, 8)) > 0)
    )
    path = tmp_path / f"skin{suffix}"
    path.write_bytes(raw)
    find_address(f"file:{path}").check()  # reads the begin alone
    settings = SensorSettings(source=f"file:{path}")
    shown = refusal(
        lambda: Sensor(settings, Context("sensor", ManualClock(0))), SourceError
    )
    place = f"{path}: frame 38, row 3, column 7: nan is not finite; "
    assert shown.startswith(place)
    assert open_file(path, Layout(nan="zero")).n_frames == 40


def test_readings_of_cells_without_a_taxel_are_not_checked(tmp_path):
    forces = FORCES.copy()
    forces[:, 1, 2] = np.nan
    mask = np.ones((2, 3), np.bool_)
    mask[1, 2] = False
    path = tmp_path / "skin.npz"
    path.write_bytes(npz(forces=forces, mask=mask))
    assert not open_file(path).frames[:, 1, 2].any()
    forces[1, 0, 0] = -1
    path.write_bytes(npz(forces=forces, mask=mask))
    with pytest.raises(SourceError, match="frame 1, row 0, column 0: -1 is below 0"):
        open_file(path)
    assert open_file(path, raw=True).frames.min() == -1


def test_an_npz_may_hold_the_points_of_its_taxels(tmp_path):
    mask = np.array([[True, False], [True, True]])
    points = np.zeros((3, 6), np.float32)
    points[:, 0] = (1, 2, 3)
    points[:, 5] = 1
    path = tmp_path / "points.npz"
    whole = {
        "forces": np.ones((4, 2, 2)),
        "mask": mask,
        "unit": np.array("N"),
        "points": points,
    }
    np.savez(path, **whole)
    assert np.array_equal(open_file(path).skin.points, points)
    for wrong, what in (
        (points[:2], "the points are float32 .2, 6., expected float32 .3, 6."),
        (points * 2, "normal 0 has length 2, expected 1"),
        (
            np.where(points == 3, np.nan, points).astype(np.float32),
            "point 2 is not within",
        ),
    ):
        np.savez(path, **{**whole, "points": wrong})
        with pytest.raises(SourceError, match=what):
            open_file(path)
