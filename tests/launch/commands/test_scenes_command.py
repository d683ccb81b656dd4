"""Short recordings that are made on first use."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.offline.scenarios import (
    SCENARIOS,
    ScenarioError,
    data_folder,
    make_scenario,
    resolve_recording,
)
from sparseskin.messages import Truth, decode
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.recorder.bag.reader import BagReader

MAX_BYTES = 5_000_000


@pytest.fixture(autouse=True)
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_scenario("tap_peg", tmp_path_factory.mktemp("made"))


@pytest.mark.parametrize(
    "name",
    ["tap_peg", *(pytest.param(n, marks=pytest.mark.slow) for n in SCENARIOS if n != "tap_peg")],
)
def test_a_scenario_is_small_whole_complete_and_in_contact(
    name: str, made: Path, tmp_path: Path
) -> None:
    path = made if name == "tap_peg" else make_scenario(name, tmp_path)
    assert path.stat().st_size < MAX_BYTES
    with BagReader(path) as bag:
        assert bag.recovered == ""
        unasked = ("end", "resultant", "contacts", "calibration")
        asked = [name for name in SCHEMAS if name not in unasked]
        assert set(bag.topics) == {f"/skin/{name}" for name in asked}
        assert bag.topics["/skin/taxels"].rate_hz == pytest.approx(100)
        peaks = []
        for message in bag.messages(["/skin/truth"]):
            truth = decode(message.topic.encode(), message.payload)
            assert isinstance(truth, Truth)
            peaks.append(float(truth.forces.max()))
    assert len(peaks) == SCENARIOS[name].n_frames
    assert sum(peak > 0.01 for peak in peaks) > len(peaks) / 4


def test_a_name_is_made_on_first_use_the_same_each_time_and_found_afterwards(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = resolve_recording("tap_peg")
    assert path == data_folder() / "tap_peg.mcap"
    assert "made on first use" in capsys.readouterr().err
    with BagReader(path) as first, BagReader(made) as other:
        payloads = ([message.payload for message in bag.messages()] for bag in (first, other))
        assert next(payloads) == next(payloads)
    before = path.stat().st_mtime_ns
    assert resolve_recording("tap_peg") == path
    assert capsys.readouterr().err == ""
    assert path.stat().st_mtime_ns == before


def test_paths_are_left_as_they_are_and_other_names_are_refused(tmp_path: Path) -> None:
    assert resolve_recording("any/where.mcap") == Path("any/where.mcap")
    assert resolve_recording(str(tmp_path)) == tmp_path
    with pytest.raises(ScenarioError, match="did you mean 'tap_peg'"):
        resolve_recording("tap_pgg")


def test_the_list_names_every_scene_and_recording(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scenes", "list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in (*SCENARIOS, "path_40", "drag_wrench_64"))
    assert max(map(len, out.splitlines())) <= 80
