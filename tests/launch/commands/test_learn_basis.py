"""The command learn-basis, from a recording to a stream that is restored in what was learned."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from bags import MASK, N_COLS, N_ROWS, frame, make_bag, skin_state

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import load
from sparseskin.messages import Reconstruction, SolverState, Taxels, Truth
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock


def recording(path: Path, n_frames: int = 12, truth: bool = True) -> Path:
    kinds = (Taxels, Truth) if truth else (Taxels,)
    frames = [m for k in range(n_frames) for m in frame(k) if isinstance(m, kinds)]
    make_bag(path, [skin_state(), *frames])
    return path


def learn(bag: Path, out: Path, *more: str) -> int:
    return main(["learn-basis", str(bag), "--out", str(out), "--tile", "2", *more])


def test_a_file_reports_what_it_was_learned_from(tmp_path: Path) -> None:
    bag, out = recording(tmp_path / "r.mcap"), tmp_path / "b.npz"
    assert learn(bag, out) == 0
    with np.load(out) as held:
        assert held["atoms"].shape == (4, 4)
        np.testing.assert_allclose(held["atoms"] @ held["atoms"].T, np.eye(4), atol=1e-9)
        facts = {name: held[name].item() for name in held.files if name != "atoms"}
    assert (facts["n_rows"], facts["n_cols"], facts["tile"]) == (N_ROWS, N_COLS, 2)
    assert (facts["source"], facts["topic"]) == ("r.mcap", "/skin/truth")
    assert MASK.sum() == N_ROWS * N_COLS - 1


def test_the_same_seed_gives_the_same_file(tmp_path: Path) -> None:
    bag = recording(tmp_path / "r.mcap")
    for name, seed in (("a", "3"), ("b", "3"), ("c", "4")):
        assert learn(bag, tmp_path / f"{name}.npz", "--seed", seed) == 0
    a, b, c = ((tmp_path / f"{name}.npz").read_bytes() for name in "abc")
    assert a == b
    assert a != c


def test_taxels_serve_where_there_is_no_truth(tmp_path: Path) -> None:
    bag, out = recording(tmp_path / "r.mcap", truth=False), tmp_path / "b.npz"
    assert learn(bag, out) == 0
    with np.load(out) as held:
        assert held["topic"].item() == "/skin/taxels"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (("--topic", "/skin/trut"), "holds no topic '/skin/trut' (did you mean '/skin/truth'?)"),
        (("--topic", "/skin/skin"), "/skin/skin holds no frames of truth or taxels"),
        (("--tile", "6"), "tile: 6 is not allowed for frames of 5 x 7; allowed: 2..5"),
        (("--tile", "5"), "taxels has a force above 0.01; try a smaller --tile"),
        (("--frames", "0"), "--frames 0: expected a whole number, 1 or more"),
        (("--out", "b.txt"), "--out b.txt: expected a name that ends in .npz"),
    ],
)
def test_what_cannot_be_learned_is_one_line_and_leaves_no_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: tuple[str, ...], said: str
) -> None:
    bag = recording(tmp_path / "r.mcap")
    assert learn(bag, tmp_path / "b.npz", *more) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert said in told[0]
    assert not (tmp_path / "b.npz").exists()


def test_a_recording_without_frames_and_one_that_is_missing_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty.mcap"
    make_bag(empty, [skin_state()])
    for bag, said in ((empty, "holds no frames of truth or taxels"), (Path("no"), "no such file")):
        assert learn(bag, tmp_path / "b.npz") == 2
        (line,) = capsys.readouterr().err.strip().splitlines()
        assert said in line


@pytest.mark.parametrize(
    ("n_pressed", "more", "said"),
    [
        (0, (), "0 of 5 frames are in contact (a force above 0.01) and give 0 windows of 2 x 2"),
        (3, (), "3 of 5 frames are in contact (a force above 0.01) and give 3 windows of 2 x 2"),
        (3, (), "needed: 4 windows, of 1 to 4 frames in contact. Press the skin and record longer"),
        (3, ("--frames", "2"), "1 of 2 frames are in contact"),
        (
            3,
            ("--frames", "2"),
            "sparseskin launch NAME --record F.mcap, or look at all: --frames 5",
        ),
    ],
)
def test_too_few_frames_in_contact_are_counted_beside_what_is_needed(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    n_pressed: int,
    more: tuple[str, ...],
    said: str,
) -> None:
    corner = np.zeros((N_ROWS, N_COLS), np.float32)
    corner[0, 0] = 1.0  # stands in one window
    frames = [
        Truth(stamp_ns=10 * k, patch="skin", forces=corner * (k < n_pressed)) for k in range(5)
    ]
    bag = tmp_path / "r.mcap"
    make_bag(bag, [skin_state(), *frames])
    assert learn(bag, tmp_path / "b.npz", *more) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert said in line
    assert not (tmp_path / "b.npz").exists()


def test_a_stream_is_reconstructed_in_a_learned_basis_and_reports_which(tmp_path: Path) -> None:
    out = tmp_path / "tiles.npz"
    assert learn(recording(tmp_path / "r.mcap"), out) == 0
    changes = ["reconstructor.preset=paper", f"reconstructor.basis=learned:{out}"]
    nodes = load("path_40", changes).nodes.values()
    bus = Bus({node.name: (node.cls, node.settings) for node in nodes}, ManualClock(1))
    messages = [message for frame_ in bus.frames(2) for message in frame_]
    assert sum(isinstance(m, Reconstruction) for m in messages) == 2
    node = bus.hosts["reconstructor"].node
    assert node.state()["basis"] == f"learned:{out}"
    (state,) = node.change(node.settings)
    assert isinstance(state, SolverState)
    assert state.basis.startswith("learned:tiles#")
    assert node.status() == f"solver fista in learned:{out}"


def test_a_basis_that_the_solver_does_not_take_is_not_named(tmp_path: Path) -> None:
    out = tmp_path / "tiles.npz"
    assert learn(recording(tmp_path / "r.mcap"), out) == 0
    nodes = load("path_40", [f"reconstructor.basis=learned:{out}"]).nodes.values()
    bus = Bus({node.name: (node.cls, node.settings) for node in nodes}, ManualClock(1))
    bus.run(n_frames=1)
    node = bus.hosts["reconstructor"].node
    (state,) = node.change(node.settings)
    assert isinstance(state, SolverState)
    assert (state.solver, state.basis) == ("skin", "")
    assert (node.status(), node.state()["basis"]) == ("solver skin", None)
