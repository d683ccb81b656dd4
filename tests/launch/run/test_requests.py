"""Requests: each reaches the node it is meant for, and is answered once."""

import pytest
from fake_node import FakeNode

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.run import controls
from sparseskin.launch.run.controls import MAX_OPEN, PATIENCE_S, Requests
from sparseskin.nodes.errors import RefusedError


class Desk:
    """A graph of fake processes, the requests to it, and the answers that came."""

    def __init__(self, monkeypatch):
        specs = load("path_40").nodes
        self.nodes = {name: FakeNode(name, spec, ready=True) for name, spec in specs.items()}
        self.answers = []
        self.own = []
        self.now_s = 100.0
        self.requests = Requests(self.nodes, self._own)
        monkeypatch.setattr(controls, "awake_s", lambda: self.now_s)

    def _own(self, command, value, say):
        if command != "record":
            raise RefusedError(f"launch: {command}: expected the command 'record'")
        self.own.append((command, value))
        say(True, "recording")

    def ask(self, node, command, value=None, number="7"):
        request = {"id": number, "node": node, "command": command, "value": value}
        self.requests.take(request, self.answers.append)

    def refusal(self, node, command, value=None):
        """Why a request is refused at once; no node is told of it."""
        before = len(self.answers)
        self.ask(node, command, value)
        (answer,) = self.answers[before:]
        assert not answer["done"]
        assert not any(process.told for process in self.nodes.values())
        return str(answer["text"])

    def reply(self, node, done=True, text="done"):
        """The node answers the last thing it was told."""
        _, fields = self.nodes[node].told[-1]
        self.requests.answered({"id": fields["id"], "done": done, "text": text})


@pytest.fixture
def desk(monkeypatch):
    return Desk(monkeypatch)


def test_two_askers_with_one_number_get_their_own_answers(desk):
    heard = {"a": [], "b": []}
    for asker, value in (("a", True), ("b", False)):
        request = {"id": "1", "node": "sensor", "command": "pause", "value": value}
        desk.requests.take(request, heard[asker].append)
    assert [fields["value"] for _, fields in desk.nodes["sensor"].told] == [True, False]
    first, second = (fields["id"] for _, fields in desk.nodes["sensor"].told)
    desk.requests.answered({"id": second, "done": True, "text": "runs"})
    desk.requests.answered({"id": first, "done": True, "text": "paused"})
    done = {"id": "1", "node": "sensor", "done": True}
    assert heard == {"a": [{**done, "text": "paused"}], "b": [{**done, "text": "runs"}]}


@pytest.mark.parametrize(
    ("node", "command", "value", "text"),
    [
        ("sensr", "pause", None, "sensr: no such node (did you mean 'sensor'?)"),
        ("sensor", "pase", None, "sensor: has no command 'pase' (did you mean 'pause'?)"),
        ("compressor", "pause", None, "compressor: has no command 'pause' (known: set)"),
        ("launch", "recrd", True, "launch: recrd: expected the command 'record'"),
        (3, "pause", None, "expected the texts id, node and command"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once_and_reports_why(desk, node, command, value, text):
    assert desk.refusal(node, command, value).startswith(text)


@pytest.mark.parametrize("state", [{"ready": False}, {"ended": True}, {"code": -9}])
def test_a_node_that_does_not_run_is_not_asked(desk, state):
    for name, value in state.items():
        setattr(desk.nodes["sensor"], name, value)
    assert desk.refusal("sensor", "pause") == "sensor does not run just now"


def test_the_launcher_answers_for_itself(desk):
    desk.ask("launch", "record", True)
    assert desk.own == [("record", True)]
    assert desk.answers == [{"id": "7", "node": "launch", "done": True, "text": "recording"}]


def test_a_node_that_does_not_answer_is_answered_for(desk):
    desk.ask("sensor", "pause")
    desk.now_s += 0.99 * PATIENCE_S
    desk.requests.expire()
    assert desk.answers == []
    desk.now_s += 0.02 * PATIENCE_S
    desk.requests.expire()
    (answer,) = desk.answers
    assert answer["text"] == "sensor has not answered within 20 s, and may still do it"
    assert not answer["done"]
    desk.reply("sensor")  # too late
    assert len(desk.answers) == 1


def test_a_node_that_has_gone_is_answered_for_at_once(desk):
    desk.ask("sensor", "pause")
    desk.ask("compressor", "set", {"ratio": 2.0}, number="8")
    desk.nodes["sensor"].code = -9
    desk.requests.expire()
    assert [(a["id"], a["text"]) for a in desk.answers] == [("7", "sensor has ended")]
    desk.reply("compressor")
    assert desk.answers[1]["done"]


def test_a_flood_of_requests_is_refused_until_some_are_answered(desk):
    for _ in range(MAX_OPEN):
        desk.ask("sensor", "pause")
    assert desk.answers == []
    desk.ask("sensor", "pause")
    assert desk.answers.pop()["text"] == "256 requests wait for an answer already"
    desk.reply("sensor")
    desk.answers.clear()
    desk.ask("sensor", "pause")
    assert desk.answers == []


def test_what_is_sent_back_is_short_however_long_the_request_was(desk):
    long = "x" * 10_000
    desk.ask(long, long, number=long)
    (answer,) = desk.answers
    assert len(answer["id"]) == len(answer["node"]) == 64
    assert len(answer["text"]) < 200
