"""Study `real`: its methods, what it counts, which files it takes, and its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.compressor.phi.quadtree import Quadtree
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.convert.to_bag import import_file
from sparseskin.studies.evaluate import Alone, Solved
from sparseskin.studies.points import StudyError
from sparseskin.studies.real.methods import (
    CODECS,
    SIMPLE,
    VALUE_BYTES,
    Codec,
    Compared,
    Hold,
    Judgement,
    Lattice,
    Skin,
    acts_values,
    adaptive_values,
    address_bytes,
    classes,
    judgement_of,
    make_methods,
    replayed,
)
from sparseskin.studies.real.page import METHODS, _means, marked, show
from sparseskin.studies.real.recordings import digest_of, files_in, part_of
from sparseskin.studies.real.study import compared, figures_of, readable

SHAPE = (12, 10)


def presses(n_frames: int = 40) -> Floats:
    """A smooth press that comes, moves and goes; the first and last quarter are untouched."""
    i, j = np.indices(SHAPE)
    frames = np.zeros((n_frames, *SHAPE), dtype=np.float32)
    for k in range(n_frames // 4, 3 * n_frames // 4):
        frames[k] = 50 * np.exp(-((i - 5 - 0.05 * k) ** 2 + (j - 5) ** 2) / 6)
    return np.where(frames > 1, frames, np.float32(0))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder with one recording, which is masked in a corner."""
    mask = np.ones(SHAPE, dtype=np.bool_)
    mask[:3, :2] = False
    np.savez(tmp_path / "press.npz", forces=presses() * mask, mask=mask, unit="kPa")
    return tmp_path


def point(path: Path, ratio: int, **changed: Any) -> dict[str, Any]:
    common = {"path": str(path), "digest": digest_of(path), "n_most": 60, "seed": 0}
    return common | {"ratio": ratio} | changed


@pytest.mark.parametrize("k", [2, 3, 4, 5, 8, 16])
@pytest.mark.parametrize("shape", [(1, 16), (4, 4), (12, 10), (31, 11)])
def test_classes_hold_every_taxel_once_and_are_of_equal_density(
    shape: tuple[int, int], k: int
) -> None:
    mask = np.ones(shape, dtype=np.bool_)
    mask[0, :2] = False
    members = classes(mask, k)
    assert np.array_equal(np.sort(np.concatenate(members)), np.flatnonzero(mask))
    assert len(members) == k
    assert max(one.size for one in members) <= mask.size / k + max(shape)


@pytest.mark.parametrize(("k", "least"), [(2, 2), (4, 4), (8, 8)])
def test_taxels_of_a_class_are_as_far_from_each_other_as_on_a_square_lattice(
    k: int, least: int
) -> None:
    for one in classes(np.ones((16, 16), dtype=np.bool_), k):
        i, j = np.divmod(one, 16)
        distance2 = (i[:, None] - i) ** 2 + (j[:, None] - j) ** 2
        assert distance2[distance2 > 0].min() == least


def test_the_lattice_reproduces_a_plane_between_its_taxels_with_its_share_of_values() -> None:
    i, j = np.indices((16, 16))
    plane = (1 + 2 * i + 3 * j).astype(np.float32)
    lattice = Lattice(np.ones((16, 16), dtype=np.bool_), 4)
    assert lattice.n_values == 64
    error = lattice.reconstruct(plane).forces - plane
    assert np.abs(error[3:-3, 3:-3]).max() < 1e-3


def test_the_lattice_reads_no_cell_without_a_taxel_even_if_few_exist() -> None:
    mask = np.zeros((8, 8), dtype=np.bool_)
    mask[::2, ::2] = True
    taxels = np.where(mask, np.float32(3), np.float32(np.nan))
    for ratio in (3, 4, 8):
        lattice = Lattice(mask, ratio)
        forces = lattice.reconstruct(taxels).forces
        assert lattice.n_values <= -(-16 // ratio)
        assert (forces[mask] == 3).all()
        assert (forces[~mask] == 0).all()


def test_hold_has_a_still_frame_whole_after_as_many_frames_as_classes() -> None:
    frame = presses()[20]
    hold = Hold(np.ones(SHAPE, dtype=np.bool_), 4)
    errors = [np.abs(hold.reconstruct(frame).forces - frame).max() for _ in range(4)]
    assert errors[2] > 0
    assert errors[3] == 0


@pytest.mark.parametrize("kind", CODECS)
def test_codecs_keep_eight_bits_and_state_their_size(kind: str) -> None:
    frames = presses()
    codec = Codec(Skin(np.ones(SHAPE, dtype=np.bool_), float(frames.max())), kind)
    step = frames.max() / 255
    for frame in frames:
        forces = codec.reconstruct(frame).forces
        assert np.abs(forces - frame).max() <= 0.5001 * step
    assert codec.n_bytes < 30  # the last frame is untouched


def test_touched_taxels_cost_a_byte_each_and_a_bit_a_taxel() -> None:
    codec = Codec(Skin(np.ones((8, 8), dtype=np.bool_), 1.0), "touched")
    frame = np.zeros((8, 8), dtype=np.float32)
    codec.reconstruct(frame)
    assert codec.n_bytes == 0
    frame[:3] = 1
    codec.reconstruct(frame)
    assert codec.n_bytes == 24 + 8


@pytest.mark.parametrize("n", [16, 228, 4096])
@pytest.mark.parametrize("ratio", [3, 4, 8])
def test_single_taxels_with_addresses_fill_the_bytes_of_the_measurements(
    n: int, ratio: int
) -> None:
    m = n // ratio
    values = acts_values(n, m)
    assert VALUE_BYTES * values + address_bytes(n, values) <= VALUE_BYTES * m
    assert VALUE_BYTES * (values + 1) + address_bytes(n, values + 1) > VALUE_BYTES * m


@pytest.mark.parametrize("shape", [(4, 8), (19, 12), (64, 64)])
@pytest.mark.parametrize("ratio", [3, 4, 8])
def test_adaptive_rows_and_their_code_fit_into_the_bytes_of_the_measurements(
    shape: tuple[int, int], ratio: int
) -> None:
    skin = Skin(np.ones(shape, dtype=np.bool_), 1.0)
    m = skin.n // ratio
    values = adaptive_values(skin, m)
    assert 2 * m / 3 < values < m
    tree = Quadtree(skin.mask, values)
    code = tree.most_code_bytes(values - tree.n_tiles)
    assert VALUE_BYTES * values + code <= VALUE_BYTES * m


def test_all_methods_of_a_ratio_send_the_same_bytes_to_within_rounding(folder: Path) -> None:
    figures = compared(point(folder / "press.npz", 3))["methods"]
    assert {"skin", "skin, rotating", "skin, alone", "paper", *SIMPLE} <= set(figures)
    assert replayed() in figures
    for found in figures.values():
        assert found["n_bytes"] == pytest.approx(VALUE_BYTES * 114 / 3, abs=6)
        assert found["n_loaded"] == 20
        assert 0 < found["median"] < 100
    assert figures["skin"]["median"] < figures["paper"]["median"]


def test_a_seed_changes_what_is_random_and_nothing_else(folder: Path) -> None:
    first, other = (compared(point(folder / "press.npz", 4, seed=s))["methods"] for s in (0, 1))
    assert first["subsample"]["median"] != other["subsample"]["median"]
    for name in ("lattice", "hold", "acts"):
        assert first[name]["median"] == other[name]["median"]


class _Constant:
    def __init__(self, value: float) -> None:
        self.value = value

    def reconstruct(self, taxels: Floats) -> Solved:
        return Solved(np.full_like(taxels, self.value))


def test_an_estimate_of_nothing_loses_every_contact_and_has_no_ghost(folder: Path) -> None:
    part = part_of(str(folder / "press.npz"), 60)
    figures = figures_of(Compared(_Constant(0), 1, lambda: 2.0), part)
    assert (figures["median"], figures["vanished"], figures["ghosts"]) == (100, 100, 0)
    # 10 untouched frames at the end, and 2 at the begin behind those that are not scored.
    assert (figures["n_loaded"], figures["n_untouched"]) == (20, 12)
    assert figures["flagged"] is None


def test_an_estimate_of_something_everywhere_is_a_ghost_in_every_untouched_frame(
    folder: Path,
) -> None:
    part = part_of(str(folder / "press.npz"), 60)
    assert figures_of(Compared(_Constant(5), 1, lambda: 2.0), part)["ghosts"] == 100


def test_the_mark_of_a_solver_that_has_one_is_read(folder: Path) -> None:
    skin = part_of(str(folder / "press.npz"), 60).skin
    estimator = make_methods(skin, 3, 0)["skin, alone"]().estimator
    assert isinstance(estimator, Alone)
    solver = estimator.method.solver
    solver.error, solver.trusted = 0.5, False
    assert judgement_of(estimator) == Judgement(0.5, flagged=True)
    solver.trusted = True
    assert judgement_of(estimator) == Judgement(0.5, flagged=False)
    solver.error = None
    assert judgement_of(estimator) == Judgement()
    assert judgement_of(_Constant(0)) == Judgement()


def test_marks_and_estimates_are_compared_with_the_true_errors(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part = part_of(str(folder / "press.npz"), 60)
    method = make_methods(part.skin, 3, 0)["skin, alone"]()
    numbers = iter(range(len(part.frames)))

    def alone(taxels: Floats) -> Solved:
        """Right by 5 % in even frames, wrong by 60 % in odd ones; and twice that in every tenth."""
        number = next(numbers)
        off = 0.6 if number % 2 else 0.05
        solver = method.estimator.method.solver  # type: ignore[attr-defined]
        rms = float(np.sqrt(np.mean(np.square(taxels[part.skin.mask], dtype=np.float64))))
        solver.error = off * rms * (2 if number % 10 == 0 else 1)
        solver.trusted = number % 2 == 0 or number % 10 == 5
        return Solved((1 + off) * taxels)

    monkeypatch.setattr(method.estimator, "reconstruct", alone)
    found = figures_of(method, part)
    assert (found["n_wrong"], found["n_right"]) == (10, 10)
    assert (found["flagged_wrong"], found["flagged_right"]) == (80, 0)
    assert found["estimate_low"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_median"] == pytest.approx(1, abs=1e-4)
    assert found["estimate_high"] == pytest.approx(2, abs=0.06)
    row = {"recording": "a", "ratio": 3, "method": "skin, alone", **found}
    (line,) = marked(_means(pd.DataFrame([row])))
    assert line.startswith(
        "skin, alone marks 80.0 % of 10 frames with an error above 50 % and 0.0 % of 10 frames "
        "with an error below 10 %; estimated over true RMS error 1.00 (5 to 95 %: 1.00 to 2.0"
    )


def test_alone_gives_each_frame_what_it_gives_first(folder: Path) -> None:
    part = part_of(str(folder / "press.npz"), 60)
    estimator = make_methods(part.skin, 3, 0)["skin, alone"]().estimator
    first = estimator.reconstruct(part.frames[15]).forces
    estimator.reconstruct(part.frames[25])
    assert np.array_equal(estimator.reconstruct(part.frames[15]).forces, first)


def test_the_part_of_a_recording_is_the_loaded_one_next_to_its_middle(tmp_path: Path) -> None:
    frames = np.zeros((100, 4, 4), dtype=np.float32)
    frames[20:40] = 1
    np.save(tmp_path / "a.npy", frames)
    part = part_of(str(tmp_path / "a.npy"), 30)
    assert (part.first, len(part.frames), part.n_recorded) == (20, 30, 100)
    whole = part_of(str(tmp_path / "a.npy"), 100)
    assert (whole.first, whole.norm, whole.total) == (0, 4, 16)


def test_a_bag_of_a_recording_is_the_same_as_its_file(folder: Path) -> None:
    import_file(folder / "press.npz", folder / "copy.mcap")
    assert [path.name for path in readable(files_in(folder), 60)] == ["copy.mcap", "press.npz"]
    bag, file = (part_of(str(folder / name), 60) for name in ("copy.mcap", "press.npz"))
    np.testing.assert_array_equal(bag.frames, file.frames)
    np.testing.assert_array_equal(bag.skin.mask, file.skin.mask)
    assert (bag.skin.f_max, bag.unit, bag.norm) == (file.skin.f_max, file.unit, file.norm)


def test_unusable_files_get_one_line_each_and_are_skipped(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "README.md").write_text("no recording")
    (folder / "numbers.csv").write_text("1,2\n3,4\n")
    (folder / "broken.mcap").write_bytes(b"\x89MCAP0\r\n")
    np.savez(folder / "zeros.npz", forces=np.zeros((3, 4, 4)), f_max=1.0)
    names = [path.name for path in readable(files_in(folder), 60)]
    assert names == ["press.npz"]
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("real: skipped: ") for line in lines)
    assert "nothing touches the skin" in "".join(lines)


def test_a_folder_without_a_usable_recording_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match=r"no recording; allowed are \.lst, .*\.mcap"):
        files_in(tmp_path)
    with pytest.raises(StudyError, match="No such file"):
        files_in(tmp_path / "gone")
    (tmp_path / "a.npy").write_text("x")
    with pytest.raises(StudyError, match="none of 1 files can be used"):
        readable(files_in(tmp_path), 60)


def test_a_recording_of_zeros_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", forces=np.zeros((3, 4, 4)), f_max=1.0)
    with pytest.raises(SparseskinError, match="nothing touches"):
        part_of(str(tmp_path / "a.npz"), 60)


def test_the_study_prints_its_table_and_writes_page_chart_and_figures(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    np.save(folder / "tiny.npy", np.ones((12, 1, 5), dtype=np.float32))
    out = tmp_path / "out"
    options = ["--recordings", str(folder), "--out", str(out), "--executor", "serial"]
    assert main(["study", "real", "--seeds", "2", "--quick", *options]) == 0
    printed = capsys.readouterr().out
    assert "relative error of loaded frames in %: median (mean)" in printed
    assert "\npress " in printed
    assert "\ntiny " in printed
    flowing = " ".join(printed.split())
    assert "the best simple method beats" in flowing
    assert "all taxels in 8 bits, packed by zstd, are fewer bytes than" in flowing
    page = (out / "real.md").read_text()
    assert "| press | 12 x 10 | 114 | kPa | 0..39 of 40 | 20 | 12 | - | 32 | 2.0 |" in page
    assert "Means over 2 seeds." in page
    assert "| press | N/8 |" in page
    assert "| tiny | N/8 |" not in page  # five taxels
    for name in ("quotients.png", "quotients.svg", "methods.csv", "points.jsonl"):
        assert (out / name).stat().st_size > 100


def test_tables_have_the_ratios_of_each_recording_in_order() -> None:
    figures = dict.fromkeys(("mean", "ghosts", "n_values", "n_bytes", "cpu_ms"), 1.0)
    # Only at N/8 a contact of the first recording is lost, and at all ratios one of the second.
    rows = [
        {"recording": name, "ratio": ratio, "method": replayed(), "median": 9.0, "flagged": None}
        | {"vanished": 100.0 * (name == "b" or ratio == 8)}
        | figures
        for name in ("a", "b")
        for ratio in (3, 4, 8)
    ]
    lines = show(pd.DataFrame(rows))
    (begin,) = (k for k, line in enumerate(lines) if line.startswith("loaded frames with"))
    shown = [line.split()[-2] for line in lines[begin + 2 : begin + 6]]
    assert shown == ["N/8", "N/3", "N/4", "N/8"]


@pytest.mark.parametrize("columns", [60, 80, 120, 200])
def test_tables_fit_the_terminal_and_lose_no_method(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    figures = dict.fromkeys(("median", "mean", "vanished", "flagged", "ghosts"), 12.3)
    figures |= dict.fromkeys(("n_values", "n_bytes", "cpu_ms"), 1.0)
    methods = [*METHODS, *CODECS]
    rows = [
        {"recording": f"recording_of_{k}", "ratio": ratio, "method": name} | figures
        for k in range(2)
        for ratio in (1, 3, 8)
        for name in methods
        if (ratio == 1) == (name in CODECS)
    ]
    lines = show(pd.DataFrame(rows))
    assert max(map(len, lines)) <= columns
    words = "\n".join(lines)
    assert all(name in words for name in methods)
    assert words.count("12.3 (12.3)") == 4 * len(METHODS)


def test_without_recordings_one_line_names_the_option(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["study", "real", "--out", str(tmp_path)]) != 0
    error = capsys.readouterr().err
    assert "--recordings DIR" in error
    assert error.count("\n") == 1
