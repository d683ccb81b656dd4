"""Recordings in .mat and .h5, and readings that are not valid."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damaged import refusal
from hypothesis import HealthCheck
from scipy.io import savemat

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable
from sparseskin.nodes.node import Context
from sparseskin.nodes.sensor.files import isolated
from sparseskin.nodes.sensor.files.parsed import Policy
from sparseskin.nodes.sensor.files.recorded import n_taxels, open_file
from sparseskin.nodes.sensor.node import Sensor, SensorSettings

FRAMES = np.arange(60, dtype=np.float64).reshape(5, 3, 4)
STATED = {"n_rows": 3, "n_cols": 4}
ISOLATED = "sparseskin.nodes.sensor.files.isolated"


@pytest.fixture(autouse=True)
def direct(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run readers in this process, without the start of another, unless a test is of that."""
    if "isolated" in request.keywords:
        return

    def read(target: str, name: str, n_bytes: int) -> Any:
        most = max(isolated.MAX_GROWN_BYTES, isolated.MAX_GROWTH * n_bytes)
        return find_callable(target, SourceError)(name, most)

    for module in ("matlab", "hdf5"):
        monkeypatch.setattr(f"sparseskin.nodes.sensor.files.{module}.in_child", read)


# --- .mat ------------------------------------------------------------------------------------


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("frames_last", [False, True])
def test_a_mat_file_is_read_in_the_order_that_its_shape_decides(
    tmp_path: Path, frames_last: bool, compressed: bool
) -> None:
    array = np.moveaxis(FRAMES, 0, 2) if frames_last else FRAMES
    held = {"pressure": array, "rate_hz": 50.0, "unit": "kPa", "note": "of no matter"}
    savemat(path := tmp_path / "a.mat", held, do_compression=compressed)
    source = open_file(path, **STATED)
    assert np.array_equal(source.frames, FRAMES)
    assert (source.skin.unit, source.rate_hz) == ("kPa", 50.0)
    assert n_taxels(str(path), **STATED) == 12


def test_a_mat_file_with_stamps_of_matlab_and_a_mask_is_read(tmp_path: Path) -> None:
    mask = np.ones((3, 4))
    mask[1, 2] = 0
    held = {"forces": FRAMES, "stamp_ns": np.arange(5.0) * 1e6, "mask": mask, "f_max": 100.0}
    savemat(path := tmp_path / "a.mat", held)
    source = open_file(path, n_rows=3)
    assert list(source.stamp_ns) == [0, 1_000_000, 2_000_000, 3_000_000, 4_000_000]
    assert source.skin.mask is not None
    assert source.skin.mask.sum() == 11
    assert source.skin.f_max == 100.0
    assert n_taxels(str(path), n_rows=3) is None


@pytest.mark.parametrize(
    ("held", "stated", "text"),
    [
        ({"a": FRAMES}, {}, "set n_rows and n_cols (it holds 5 x 3 x 4)"),
        ({"a": FRAMES}, {"n_rows": 7, "n_cols": 4}, "holds 5 x 3 x 4, which is not n_rows = 7"),
        ({"a": FRAMES, "b": FRAMES}, STATED, "exactly one 3-D array; it holds 'a' 3-D, 'b' 3-D"),
        ({"a": {"inner": FRAMES}}, STATED, "it holds nothing"),
        ({"forces": FRAMES, "mask": np.ones((2, 2))}, STATED, "array 'mask': shape (2, 2)"),
    ],
)
def test_a_mat_file_that_is_not_plain_is_refused(
    tmp_path: Path, held: dict[str, Any], stated: dict[str, int], text: str
) -> None:
    savemat(path := tmp_path / "a.mat", held)
    for read in (open_file, lambda path, **options: n_taxels(str(path), **options)):
        if "mask" in held and read is not open_file:
            continue
        with pytest.raises(SourceError) as refused:
            read(path, **stated)
        assert text in str(refused.value)


def test_a_mat_file_that_would_fill_the_memory_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{ISOLATED}.MAX_GROWN_BYTES", 1 << 25)
    zeros = zlib.compress(bytes(1 << 24), 9)
    savemat(made := io.BytesIO(), {"a": FRAMES})
    bomb = struct.pack("<II", 15, len(zeros)) + zeros
    (tmp_path / "a.mat").write_bytes(made.getvalue()[:128] + bomb * 3)
    with pytest.raises(SourceError, match="its variables are larger than 33554432 bytes"):
        open_file(tmp_path / "a.mat", **STATED)


SHARED = [HealthCheck.function_scoped_fixture]


# --- .h5 -------------------------------------------------------------------------------------


@pytest.fixture
def h5py() -> Any:
    return pytest.importorskip("h5py", reason="the extra files is not installed")


def test_an_hdf5_file_is_read_with_what_stands_beside(h5py: Any, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        group = file.create_group("left/sensor")
        forces = group.create_dataset("forces", data=FRAMES, compression="gzip")
        group["stamp_ns"] = np.arange(5) * 10
        forces.attrs["unit"] = "kPa"
        forces.attrs["f_max"] = 80.0
        file["video"] = np.zeros((5, 3, 4))
    source = open_file(tmp_path / "a.h5")
    assert np.array_equal(source.frames, FRAMES)
    assert (source.skin.unit, source.skin.f_max, list(source.stamp_ns)[-1]) == ("kPa", 80.0, 40)
    assert n_taxels(str(tmp_path / "a.h5")) == 12


def test_a_mat_file_of_version_7_3_is_read(h5py: Any, tmp_path: Path) -> None:
    """As MATLAB writes rows x columns x frames: a user block, and the dimensions in reverse."""
    path = tmp_path / "a.mat"
    with h5py.File(path, "w", userblock_size=512) as file:
        file["forces"] = np.moveaxis(FRAMES, 0, 2).T
        file["forces"].attrs["MATLAB_class"] = np.bytes_("double")
        file["unit"] = np.array([[ord("N")]], np.uint16)
        file["unit"].attrs["MATLAB_class"] = np.bytes_("char")
    raw = bytearray(path.read_bytes())
    raw[:10] = b"MATLAB 7.3"
    path.write_bytes(raw)
    assert np.array_equal(open_file(path, **STATED).frames, FRAMES)
    assert n_taxels(str(path), **STATED) == 12


def test_an_hdf5_file_whose_numbers_are_elsewhere_or_too_many_is_refused(
    h5py: Any, tmp_path: Path
) -> None:
    (tmp_path / "secret").write_bytes(bytes(480))
    with h5py.File(tmp_path / "out.h5", "w") as file:
        file.create_dataset(
            "forces", (5, 3, 4), "f8", external=[(str(tmp_path / "secret"), 0, 480)]
        )
    with pytest.raises(SourceError, match="its numbers are in other files"):
        open_file(tmp_path / "out.h5")
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["forces"] = h5py.ExternalLink(str(tmp_path / "out.h5"), "/forces")
    with pytest.raises(SourceError, match="it holds nothing"):
        open_file(tmp_path / "link.h5")
    with h5py.File(tmp_path / "big.h5", "w") as file:
        file.create_dataset("forces", (10**6, 300, 400), "f8", chunks=(1, 300, 400))
    with pytest.raises(SourceError, match="its datasets have 960000000000 bytes; at most"):
        open_file(tmp_path / "big.h5")


def test_without_the_extra_hdf5_names_the_command_that_installs_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(__import__("sys").modules, "h5py", None)
    (tmp_path / "a.h5").write_bytes(b"\x89HDF\r\n\x1a\n")
    with pytest.raises(SourceError, match=r'pip install "sparseskin\[files\]"'):
        open_file(tmp_path / "a.h5")


# --- in a process of their own ---------------------------------------------------------------


@pytest.mark.isolated
@pytest.mark.parametrize("suffix", [".mat", ".h5"])
def test_a_file_is_read_in_a_process_of_its_own_and_a_damaged_one_refused(
    h5py: Any, tmp_path: Path, suffix: str
) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".mat":
        savemat(path, {"forces": FRAMES, "note": {"a": 1}})
    else:
        with h5py.File(path, "w") as file:
            file["forces"] = FRAMES
    assert np.array_equal(open_file(path, **STATED).frames, FRAMES)
    raw = bytearray(path.read_bytes())
    raw[200:] = bytes(reversed(raw[200:]))
    path.write_bytes(raw)
    line = refusal(lambda: open_file(path, **STATED))
    assert line.startswith(f"{path}: ")
    assert line.isprintable()


@pytest.mark.isolated
def test_a_file_on_which_its_reader_fails_or_hangs_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    savemat(tmp_path / "a.mat", {"forces": FRAMES})
    monkeypatch.setattr(f"{ISOLATED}.sys.executable", "/bin/false")
    with pytest.raises(SourceError, match=r"its reader failed \(status 1\)"):
        open_file(tmp_path / "a.mat", **STATED)
    hanging = tmp_path / "python"
    hanging.write_text("#!/bin/sh\nexec sleep 60\n")
    hanging.chmod(0o755)
    monkeypatch.setattr(f"{ISOLATED}.sys.executable", str(hanging))
    monkeypatch.setattr(f"{ISOLATED}.START_S", 0.1)
    with pytest.raises(SourceError, match="not read within 0 s; a damaged or huge file"):
        open_file(tmp_path / "a.mat", **STATED)


# --- foreign .csv ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "text"),
    [
        ("sole_id,timestamp,accel_x,pressure_01", "an export of StappOne has sensors of an insole"),
        ("BodiTrak Pro,,", "an export of BodiTrak is not read"),
    ],
)
def test_an_export_that_is_known_and_not_read_is_named(
    tmp_path: Path, line: str, text: str
) -> None:
    (tmp_path / "a.csv").write_text(f"{line}\n1,2,3,4\n")
    for read in (open_file, lambda path, **stated: n_taxels(str(path), **stated)):
        with pytest.raises(SourceError, match=f"line 1: .*{text}"):
            read(tmp_path / "a.csv", n_rows=2, n_cols=2, unit="N")


# --- invalid readings ------------------------------------------------------------------------

BAD = np.array([[[1, 2], [3, 4]], [[np.nan, -1], [5, np.inf]], [[2, 2], [-3, 1]]], np.float32)


def treated(policy: Policy, folder: Path) -> Any:
    np.save(folder / "a.npy", BAD)
    return open_file(folder / "a.npy", f_max=10.0, policy=policy)


@pytest.mark.parametrize(
    ("nan", "negative", "expected", "mask"),
    [
        ("zero", "zero", [[1, 2, 3, 4], [0, 0, 5, 0], [2, 2, 0, 1]], None),
        ("hold", "zero", [[1, 2, 3, 4], [1, 0, 5, 4], [2, 2, 0, 1]], None),
        ("hold", "offset", [[4, 5, 6, 7], [4, 2, 8, 7], [5, 5, 0, 4]], None),
        ("mask", "zero", [[0, 2, 3, 0], [0, 0, 5, 0], [0, 2, 0, 0]], [False, True, True, False]),
        ("zero", "mask", [[1, 0, 0, 4], [0, 0, 0, 0], [2, 0, 0, 1]], [True, False, False, True]),
    ],
)
def test_invalid_readings_become_what_the_settings_say(
    tmp_path: Path, nan: str, negative: str, expected: Any, mask: Any
) -> None:
    source = treated(Policy(nan, negative), tmp_path)
    assert source.frames.reshape(3, 4).tolist() == expected
    assert (source.treated.n_nan, source.treated.n_negative) == (2, 2)
    held = None if source.skin.mask is None else source.skin.mask.ravel().tolist()
    assert held == mask


@pytest.mark.parametrize(
    ("policy", "text"),
    [
        (Policy(), "frame 1, row 0, column 0: nan is not finite; or set nan to zero, hold or mask"),
        (Policy("zero"), "frame 1, row 0, column 1: -1 is below 0; a range starts at 0; or set"),
        (Policy("nought"), "nan = 'nought'; allowed are refuse, zero, hold, mask"),
        (Policy("zero", "hold"), "negative = 'hold'; allowed are refuse, zero, offset, mask"),
        (Policy("mask", "mask"), "no cell of the skin is a taxel, all are masked"),
    ],
)
def test_invalid_readings_are_refused_unless_a_setting_treats_them(
    tmp_path: Path, policy: Policy, text: str
) -> None:
    with pytest.raises(SourceError) as refused:
        treated(policy, tmp_path)
    assert text in str(refused.value)


def test_missing_and_negative_cells_of_a_csv_are_treated_too(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("1,,NaN,4\n-2,5,6,7\n")
    options: dict[str, Any] = {"n_rows": 2, "n_cols": 2, "unit": "N"}
    source = open_file(tmp_path / "a.csv", **options, policy=Policy("zero", "offset"))
    assert source.frames.reshape(2, 4).tolist() == [[3, 2, 2, 6], [0, 7, 8, 9]]
    assert source.treated.counts() == {
        "not_finite": 2,
        "negative": 1,
        "masked_taxels": 0,
        "offset": -2.0,
    }
    with pytest.raises(SourceError, match="line 1, row 0, column 1: '' is not a number"):
        open_file(tmp_path / "a.csv", **options)


def test_a_sensor_counts_invalid_readings_in_its_log_and_report(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", BAD)
    lines: list[str] = []
    chosen = SensorSettings(source=f"file:{tmp_path / 'a.npy'}", nan="hold", negative="offset")
    sensor = Sensor(chosen, Context("sensor", ManualClock(0), lines.append))
    list(sensor.start())
    assert lines == [
        "2 readings of the file are not finite: replaced by the last finite one",
        "2 readings of the file are below 0: -3 N subtracted from all readings",
    ]
    counts = {"not_finite": 2, "negative": 2, "masked_taxels": 0, "offset": -3.0}
    assert sensor.report()["invalid"] == counts
