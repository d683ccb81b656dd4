"""Plain arrays: what .npy, .npz and .csv files must hold, and what is refused."""

import numpy as np
import pytest
from damaged import mutated, npy, npz, refusal
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.node import Context
from sparseskin.nodes.sensor.files.file_source import UNTIMED_PERIOD_NS, open_file
from sparseskin.nodes.sensor.files.recording import ZERO, Policy
from sparseskin.nodes.sensor.node import Sensor, SensorSettings
from sparseskin.nodes.sensor.sources import find_address

FORCES = np.arange(24, dtype=np.float64).reshape(2, 3, 4) / 10


def frames_of(source):
    return np.stack([forces for _, forces in source])


def open_bytes(folder, name, raw, **stated):
    path = folder / name
    path.write_bytes(raw)
    return open_file(path, **stated)


class TestNpy:
    @pytest.mark.parametrize(("dtype", "order"), [(">f4", "C"), ("u1", "F"), ("<u8", "C")])
    def test_any_real_dtype_and_order_is_read_as_float32(self, tmp_path, dtype, order):
        array = np.asarray(FORCES * 10, dtype=dtype, order=order)
        source = open_bytes(tmp_path, "skin.npy", npy(array))
        frames = frames_of(source)
        assert frames.dtype == np.float32
        np.testing.assert_array_equal(frames, FORCES * 10)
        assert (source.skin.n_rows, source.skin.n_cols, source.skin.f_max) == (3, 4, 23.0)

    @pytest.mark.parametrize(("dtype", "unit"), [("f4", "N"), ("u2", "counts"), ("i8", "counts")])
    def test_an_array_alone_has_a_unit_by_its_dtype_and_no_rate(self, tmp_path, dtype, unit):
        source = open_bytes(tmp_path, "skin.npy", npy((10 * FORCES).astype(dtype)))
        assert source.skin.unit == unit
        assert [unit in line or "100 Hz" in line for line in source.take_lines()] == [True, True]
        assert source.rate_hz is None
        assert source.skin.pitch_m is None
        assert source.skin.mask is None
        assert [stamp for stamp, _ in source] == [0, UNTIMED_PERIOD_NS]

    def test_stated_unit_range_and_rate_are_kept(self, tmp_path):
        stated = {"unit": "kPa", "f_max": 2.5, "rate_hz": 1000}
        source = open_bytes(tmp_path, "skin.npy", npy(FORCES), **stated)
        assert (source.skin.unit, source.skin.f_max, source.rate_hz) == ("kPa", 2.5, 1000)
        assert [stamp for stamp, _ in source] == [0, 1_000_000]

    @pytest.mark.parametrize(
        ("array", "message"),
        [
            (np.zeros(4), r"has 1 dimensions, shape \(4,\); expected three"),
            (
                np.zeros((3, 6)),
                "holds 6 .* state shape .*, rate; add n_rows=2 n_cols=3 rate_hz=100$",
            ),
            (np.zeros((0, 3, 4)), "holds no frame"),
            (np.zeros((3, 0)), "a frame holds 0 cells"),
            (np.zeros((1, 2048, 1024), dtype="u1"), "2097152 cells; at most 1048576"),
            (np.zeros((2, 3, 4), dtype=complex), "dtype 'complex128'; allowed are integers"),
            (np.zeros((2, 3, 4)), "all readings are 0, so its range is unknown; state f_max"),
        ],
    )
    def test_what_is_no_stack_of_frames_is_refused(self, tmp_path, array, message):
        with pytest.raises(SourceError, match=rf"skin\.npy.*{message}"):
            open_bytes(tmp_path, "skin.npy", npy(array))

    @pytest.mark.parametrize(
        ("value", "message"),
        [
            (np.nan, "nan is not finite"),
            (-0.5, "-0.5 is below 0; a range starts at 0; add negative=zero"),
            (1e39, r"1e\+39 is above 1e\+30"),
        ],
    )
    def test_what_is_no_reading_is_refused_with_frame_and_cell(self, tmp_path, value, message):
        array = FORCES.copy()
        array[1, 2, 3] = value
        with pytest.raises(SourceError, match=f"frame 1, row 2, column 3: {message}"):
            open_bytes(tmp_path, "skin.npy", npy(array))


class TestNpz:
    def test_everything_that_an_archive_can_state_is_read(self, tmp_path):
        mask = np.ones((3, 4), dtype=bool)
        mask[0, 0] = mask[2, 3] = False
        raw = npz(
            forces=FORCES,
            stamp_ns=np.array([5_000, 9_000]),
            rate_hz=250.0,
            mask=mask,
            f_max=2.5,
            unit="raw",
            pitch_m=0.005,
            remark="left alone",
        )
        source = open_bytes(tmp_path, "skin.npz", raw)
        assert ([stamp for stamp, _ in source], source.rate_hz) == ([0, 4_000], 250.0)
        assert source.skin.n_taxels == 10
        assert (source.skin.f_max, source.skin.unit, source.skin.pitch_m) == (2.5, "raw", 0.005)
        frames = frames_of(source)
        np.testing.assert_array_equal(frames[:, mask], FORCES[:, mask].astype(np.float32))
        assert not frames[:, ~mask].any()

    def test_the_only_3_d_array_is_taken_under_any_name(self, tmp_path):
        raw = npz(pressure=FORCES, other=np.zeros(3))
        np.testing.assert_array_equal(
            frames_of(open_bytes(tmp_path, "skin.npz", raw)), FORCES.astype(np.float32)
        )

    @pytest.mark.parametrize(
        ("arrays", "message"),
        [
            ({"a": FORCES, "b": FORCES}, r"a \(3-D\), b \(3-D\); add topic=a"),
            ({}, "holds no arrays of frames"),
            ({"forces": FORCES, "mask": np.zeros((3, 4), bool)}, "no cell of the skin is a taxel"),
            ({"forces": FORCES, "mask": np.ones((4, 3), bool)}, r"array 'mask': shape \(4, 3\)"),
            ({"forces": FORCES, "stamp_ns": [1, 2, 3]}, r"expected one a frame: \(2,\)"),
            ({"forces": FORCES, "stamp_ns": [7, 7]}, "stamp 1 is 7, not after"),
            ({"forces": FORCES, "rate_hz": -1.0}, "array 'rate_hz': -1 must be above 0"),
            ({"forces": FORCES, "f_max": "2.5"}, "array 'f_max': expected one number"),
            ({"forces": FORCES, "f_max": 1.0}, "f_max = 1 is below the largest reading, 2.3"),
            ({"forces": FORCES, "unit": "a\nb"}, "expected 1 to 32 printable characters"),
            ({"forces": np.array([[["a", None]]], dtype=object)}, "holds Python objects"),
        ],
    )
    def test_what_an_archive_must_not_hold_is_refused(self, tmp_path, arrays, message):
        with pytest.raises(SourceError, match=rf"skin\.npz.*{message}"):
            open_bytes(tmp_path, "skin.npz", npz(**arrays))

    def test_unsigned_stamps_far_apart_do_not_wrap_round(self, tmp_path):
        stamps = np.array([0, 2**64 - 1], dtype=np.uint64)
        with pytest.raises(SourceError, match=r"lasts longer than 2\*\*63 ns"):
            open_bytes(tmp_path, "skin.npz", npz(forces=FORCES, stamp_ns=stamps))


class TestAnyBytes:
    @settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
    @given(data=st.data(), suffix=st.sampled_from(["npy", "npz", "csv"]))
    def test_random_and_mutated_files_never_raise_anything_else(self, tmp_path, data, suffix):
        whole = {
            "npy": npy(FORCES),
            "npz": npz(forces=FORCES, mask=np.ones((3, 4), bool), unit="N", rate_hz=2.0),
            "csv": b"t,a,b\n2026-11-03,3,4\n2026-11-04T01:00Z,7,8\n",
        }[suffix]
        raw = mutated(data, data.draw(st.just(whole) | st.binary(min_size=1, max_size=200)))
        stated = {"n_rows": 1, "unit": "N"} if suffix == "csv" else {}
        found = []
        opened = lambda: found.append(open_bytes(tmp_path, f"any.{suffix}", raw, **stated))  # noqa: E731
        refusal(opened, SourceError)
        for source in found:
            frames = frames_of(source)
            assert np.isfinite(frames).all()
            assert 0 <= frames.min() <= frames.max() <= np.float32(source.skin.f_max)


@pytest.mark.parametrize(("suffix", "order"), [(".npy", "F"), (".npz", "C")])
def test_a_reading_that_is_refused_is_named_by_the_sensor_with_its_place(tmp_path, suffix, order):
    forces = np.asarray(np.ones((3, 512, 1024), np.float32), order=order)  # some parts of it
    forces[2, 511, 7] = np.nan
    raw = npy(forces) if suffix == ".npy" else npz(forces=forces, mask=np.ones((512, 1024)) > 0)
    path = tmp_path / f"skin{suffix}"
    path.write_bytes(raw)
    find_address(f"file:{path}").check()  # reads the begin alone
    settings = SensorSettings(source=f"file:{path}")
    shown = refusal(lambda: Sensor(settings, Context("sensor", ManualClock(0))), SourceError)
    place = f"{path}: frame 2, row 511, column 7: nan is not finite; add --set sensor.nan=hold"
    assert shown.startswith(place)
    open_file(path, policy=Policy(nan=ZERO))


def test_readings_of_cells_without_a_taxel_are_not_checked(tmp_path):
    forces = FORCES.copy()
    forces[:, 1, 2] = np.nan
    mask = np.ones((3, 4), np.bool_)
    mask[1, 2] = False
    path = tmp_path / "skin.npz"
    path.write_bytes(npz(forces=forces, mask=mask))
    assert not open_file(path).frames[:, 1, 2].any()
    forces[1, 0, 0] = -1
    path.write_bytes(npz(forces=forces, mask=mask, more=1))
    with pytest.raises(SourceError, match="frame 1, row 0, column 0: -1 is below 0"):
        open_file(path)
    open_file(path, policy=Policy(raw=True))


def test_an_npz_may_hold_the_points_of_its_taxels(tmp_path):
    mask = np.array([[True, False], [True, True]])
    points = np.zeros((3, 6), np.float32)
    points[:, 0], points[:, 5] = (1, 2, 3), 1
    path = tmp_path / "points.npz"
    held = {"forces": np.ones((4, 2, 2)), "mask": mask, "unit": np.array("N"), "points": points}
    np.savez(path, **held)
    assert np.array_equal(open_file(str(path)).skin.points, points)
    for wrong, what in (
        (points[:2], "the points are float32 .2, 6., expected float32 .3, 6."),
        (points * 2, "normal 0 has length 2, expected 1"),
        (np.where(points == 3, np.nan, points).astype(np.float32), "point 2 is not within"),
    ):
        np.savez(path, **{**held, "points": wrong})
        with pytest.raises(SourceError, match=what):
            open_file(str(path))
