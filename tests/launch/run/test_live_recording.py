"""A recording begun and ended while the graph runs: what is on, and what each request is told."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import NodeSpec
from sparseskin.launch.run.live_recording import LiveRecording
from sparseskin.nodes.errors import RefusedError


@dataclass
class FakeProcess:
    """A recorder's process as far as a live recording needs it."""

    name: str
    refusal: str = ""
    report: dict[str, Any] = field(default_factory=dict)
    told: list[str] = field(default_factory=list)

    def command(self, command: str) -> None:
        self.told.append(command)


class FakeFleet:
    """Keeps what it is to start."""

    def __init__(self) -> None:
        self.nodes: dict[str, FakeProcess] = {}
        self.started: list[tuple[NodeSpec, list[str]]] = []

    def add(self, spec: NodeSpec, topics: list[str]) -> None:
        self.started.append((spec, topics))
        self.nodes[spec.name] = FakeProcess(spec.name)


class Desk:
    """A graph of which recordings are asked for."""

    def __init__(self) -> None:
        self.fleet = FakeFleet()
        self.launch = load("path_40", ["compressor.ratio=4"])
        self.recording = LiveRecording(self.launch, self.fleet)  # type: ignore[arg-type]
        self.said: list[tuple[bool, str]] = []

    def record(self, on: object) -> None:
        self.recording.command("record", on, lambda done, text: self.said.append((done, text)))

    def begin(self) -> FakeProcess:
        self.record(True)
        node = self.fleet.nodes[self.fleet.started[-1][0].name]
        self.hear(node, "ready")
        return node

    def hear(self, node: Any, event: str) -> None:
        self.recording.hear(node, event)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Desk:
    monkeypatch.chdir(tmp_path)
    return Desk()


def test_a_recorder_of_all_topics_joins_the_graph(desk: Desk) -> None:
    desk.record(True)
    ((spec, topics),) = desk.fleet.started
    assert (spec.name, spec.type_name) == ("live_recorder_1", "recorder")
    assert set(topics) == {
        *("/skin/skin", "/skin/taxels", "/skin/truth", "/skin/phi"),
        *("/skin/measurements", "/skin/solver", "/skin/reconstruction"),
    }
    assert len(topics) == len(set(topics)) == len(spec.settings.topics)
    assert spec.settings.source == "path_40"
    assert spec.settings.launch.startswith("# --set compressor.ratio=4\n")


def test_it_is_on_once_the_recorder_is_ready_and_the_file_is_named(desk: Desk) -> None:
    desk.record(True)
    assert desk.said == []
    out = desk.recording.out
    assert out is not None
    assert out.startswith("path_40-2")
    assert out.endswith(".mcap")
    desk.hear(desk.fleet.nodes["live_recorder_1"], "ready")
    assert desk.said == [(True, f"recording to {out}")]
    assert desk.recording.out == out


def test_it_is_off_once_the_recorder_has_ended_and_reports_what_it_holds(desk: Desk) -> None:
    node = desk.begin()
    out = desk.recording.out
    desk.record(False)
    assert node.told == ["stop"]
    assert desk.recording.out == out
    node.report = {"recording": {"out": out, "n_messages": 321, "error": None}}
    desk.hear(node, "ended")
    assert desk.recording.out is None
    assert desk.said[1:] == [(True, f"{out}: 321 messages recorded")]


def test_a_recording_that_went_wrong_is_no_success(desk: Desk) -> None:
    node = desk.begin()
    desk.record(False)
    node.report = {"recording": {"n_messages": 3, "error": "a.mcap: no space left"}}
    desk.hear(node, "ended")
    assert desk.said[1:] == [(False, "a.mcap: no space left")]


@pytest.mark.parametrize("event", ["failed", "error"])
@pytest.mark.parametrize(
    ("refusal", "text"),
    [("", "cannot be recorded; see the log"), ("failed: no space left", "failed: no space left")],
)
def test_a_recorder_that_fails_at_the_start_is_reported_in_the_answer(
    desk: Desk, event: str, refusal: str, text: str
) -> None:
    desk.record(True)
    out, node = desk.recording.out, desk.fleet.nodes["live_recorder_1"]
    node.refusal = refusal
    desk.hear(node, event)
    desk.hear(node, "ended")
    assert desk.said == [(False, f"{out}: {text}")]
    assert desk.recording.out is None
    desk.begin()
    assert desk.said[1][0]


def test_a_recorder_that_fails_later_ends_the_recording(desk: Desk) -> None:
    node = desk.begin()
    desk.hear(node, "failed")
    assert desk.recording.out is None
    with pytest.raises(RefusedError, match="record: not on"):
        desk.record(False)


def test_a_recording_that_ends_with_its_streams_is_off(desk: Desk) -> None:
    desk.hear(desk.begin(), "ended")
    assert desk.recording.out is None
    assert len(desk.said) == 1  # nobody asked for the end


def test_each_recording_has_a_recorder_of_its_own(desk: Desk) -> None:
    first = desk.begin()
    desk.record(False)
    desk.hear(first, "ended")
    second = desk.begin()
    assert (first.name, second.name) == ("live_recorder_1", "live_recorder_2")
    desk.hear(first, "ended")  # an old one's news changes nothing
    assert desk.recording.out is not None


def test_the_news_of_other_nodes_change_nothing(desk: Desk) -> None:
    desk.begin()
    for event in ("ended", "failed", "error"):
        desk.hear(FakeProcess("sensor"), event)
    assert desk.recording.out is not None
    assert len(desk.said) == 1


def test_what_is_on_cannot_be_begun_and_what_is_off_not_ended(desk: Desk) -> None:
    with pytest.raises(RefusedError, match="record: not on"):
        desk.record(False)
    desk.begin()
    with pytest.raises(RefusedError, match=r"record: already on: path_40-.*\.mcap"):
        desk.record(True)


@pytest.mark.parametrize("on", [True, False])
def test_one_request_at_a_time(desk: Desk, on: bool) -> None:
    desk.record(True)
    with pytest.raises(RefusedError, match="record: the last request is still being done"):
        desk.record(on)
    assert desk.said == []


@pytest.mark.parametrize(
    ("name", "value"), [("record", 1), ("record", None), ("record", "true"), ("recrd", True)]
)
def test_any_other_request_is_refused(desk: Desk, name: str, value: object) -> None:
    with pytest.raises(RefusedError, match=f"launch: {name}: expected the command 'record', true"):
        desk.recording.command(name, value, lambda *said: None)
    assert desk.fleet.started == []


def test_a_file_that_is_there_already_is_not_written_over(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("time.strftime", lambda form: "now")
    name = f"{desk.recording._launch.name}-now.mcap"
    (tmp_path / name).write_text("precious")
    with pytest.raises(RefusedError, match=f"record: out: {re.escape(name)}: exists already"):
        desk.record(True)
    assert (desk.recording.out, desk.fleet.started) == (None, [])
    (tmp_path / name).unlink()
    desk.begin()
    assert desk.recording.out == name
