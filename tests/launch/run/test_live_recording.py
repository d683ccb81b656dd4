"""A recording begun and ended while the graph runs: what is on, and what each request is told."""

import re

import pytest
from fake_node import FakeNode

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.run.live_recording import LiveRecording
from sparseskin.nodes.errors import RefusedError


class FakeFleet:
    """Keeps what it is to start."""

    def __init__(self):
        self.nodes = {}
        self.started = []

    def add(self, spec, topics):
        self.started.append((spec, topics))
        self.nodes[spec.name] = FakeNode(spec.name)


class Desk:
    """A graph of which recordings are asked for."""

    def __init__(self):
        self.fleet = FakeFleet()
        self.launch = load("path_40", ["compressor.ratio=4"])
        self.recording = LiveRecording(self.launch, self.fleet)
        self.said = []

    def take(self, step, node=None):
        """A request, "on" or "off", or an event of the recorder, by default of the last one."""
        if step not in ("on", "off"):
            self.recording.hear(node or self.fleet.nodes[list(self.fleet.nodes)[-1]], step)
            return
        try:
            self.recording.command("record", step == "on", lambda *said: self.said.append(said))
        except RefusedError as error:
            self.said.append((False, str(error)))


@pytest.fixture
def desk(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Desk()


def test_a_recorder_of_all_topics_joins_the_graph(desk):
    desk.take("on")
    ((spec, topics),) = desk.fleet.started
    assert (spec.name, spec.type_name) == ("live_recorder_1", "recorder")
    assert set(topics) == {
        *("/skin/skin", "/skin/taxels", "/skin/truth", "/skin/phi"),
        *("/skin/measurements", "/skin/solver", "/skin/reconstruction"),
    }
    assert len(topics) == len(set(topics)) == len(spec.settings.topics)
    assert spec.settings.source == "path_40"
    assert spec.settings.launch.startswith("# --set compressor.ratio=4\n")


BUSY, OFF = "record: the last request is still being done", "record: not on"
BEGUN, DONE = "recording to OUT", "OUT: 321 messages recorded"


@pytest.mark.parametrize(
    ("steps", "done", "refused"),
    [
        ("on ready off ended on ready", [BEGUN, DONE, BEGUN], []),
        ("on failed ended", [], ["OUT: cannot be recorded; see the log"]),
        ("on error ended on ready", [BEGUN], ["OUT: cannot be recorded; see the log"]),
        ("on ready failed off", [BEGUN], [OFF]),
        ("on ready ended", [BEGUN], []),  # with its streams: nobody asked for it
        ("on ready on", [BEGUN], ["record: already on: OUT"]),
        ("on on", [], [BUSY]),
    ],
)
def test_each_request_is_answered_once_and_what_is_on_is_known(desk, steps, done, refused):
    out = ""
    for step in steps.split():
        desk.take(step)
        out = desk.recording.out or out
        for node in desk.fleet.nodes.values():
            node.report = {"recording": {"n_messages": 321, "error": None}}
    said = [(is_done, re.sub(r"path_40-2[-\d]+\.mcap", "OUT", text)) for is_done, text in desk.said]
    assert [text for is_done, text in said if is_done] == done
    assert [text for is_done, text in said if not is_done] == refused
    ended = steps.split()[-1] in ("ended", "failed", "error") or refused == [OFF]
    assert (desk.recording.out is None) == ended
    assert [node.told for node in desk.fleet.nodes.values()][:1] == (
        [[("stop", {})] if "ready off" in steps else []]
    )


def test_why_a_recorder_failed_is_in_the_answer(desk):
    desk.take("on")
    out, node = desk.recording.out, desk.fleet.nodes["live_recorder_1"]
    node.refusal = "failed: no space left"
    desk.take("failed")
    assert desk.said == [(False, f"{out}: failed: no space left")]
    for step in ("on", "ready", "off"):
        desk.take(step)
    node = desk.fleet.nodes["live_recorder_2"]
    node.report = {"recording": {"n_messages": 3, "error": "a.mcap: no space left"}}
    desk.take("ended")
    assert desk.said[2:] == [(False, "a.mcap: no space left")]


@pytest.mark.parametrize(("name", "value"), [("record", 1), ("recrd", True)])
def test_any_other_request_is_refused(desk, name, value):
    with pytest.raises(RefusedError, match=f"launch: {name}: expected the command 'record', true"):
        desk.recording.command(name, value, lambda *said: None)
    assert desk.fleet.started == []


def test_a_file_that_is_there_already_is_not_written_over(desk, tmp_path, monkeypatch):
    monkeypatch.setattr("time.strftime", lambda form: "now")
    name = f"{desk.recording._launch.name}-now.mcap"
    (tmp_path / name).write_text("precious")
    with pytest.raises(RefusedError, match=f"record: out: {re.escape(name)}: exists already"):
        desk.recording.command("record", True, lambda *said: None)
    assert (desk.recording.out, desk.fleet.started) == (None, [])
    (tmp_path / name).unlink()
    desk.take("on")
    assert desk.recording.out == name
