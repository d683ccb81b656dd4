"""Nodes that are late or asked as a graph runs, and recordings that are live."""

import os
import re
import signal
from types import SimpleNamespace

import pytest
from conftest import wait_until

from sparseskin.launch.launchfile.hosts import Host
from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import LaunchFile, NodeSpec
from sparseskin.launch.run import controls
from sparseskin.launch.run.controls import MAX_OPEN, PATIENCE_S, LiveRecording, Requests
from sparseskin.launch.run.state import hosts_state
from sparseskin.launch.run.waiting import AFTER_S, AGAIN_S, LateLog, waits_for
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.graph import Link
from sparseskin.nodes.node import Node
from sparseskin.nodes.player.node import PlayerSettings


class FakeNode(SimpleNamespace):
    """Stands in for a `NodeProcess`; `told` are the commands to it, each with its fields."""

    def __init__(self, name="", spec=None, **fields):
        known = {
            "endpoint": "tcp://127.0.0.1:1",
            "refusal": "",
            "code": None,
            "heard_s": 0.0,
        }
        known |= dict.fromkeys(("ready", "ended", "failed"), False)
        known |= {key: {} for key in ("counts", "report", "heard", "clocks")}
        known |= {"state": {"paused": False}, "lacks": [], "told": []}
        super().__init__(name=name, spec=spec, **known | fields)

    def exit_code(self):
        return self.code

    def command(self, command, **fields):
        self.told.append((command, fields))


LINKS = [
    Link("/skin/taxels", "sensor", "compressor"),
    Link("/skin/taxels", "sensor", "monitor"),
    Link("/skin/measurements", "compressor", "monitor"),
]
PART = LaunchFile(
    *("drag", "", "ipc", {}, []),
    hosts={name: Host("127.0.0.1") for name in ("edge", "desk", "wall")},
    host="edge",
    elsewhere={
        name: NodeSpec(name, "none", Node, {}, None, host=host)
        for name, host in (("echo", "desk"), ("screen", "wall"))
    },
)


def test_each_node_that_is_not_ready_reports_what_it_waits_for():
    made = (
        FakeNode("sensor", endpoint=""),
        FakeNode("compressor", lacks=["echo", "monitor", "reconstructor"]),
        FakeNode("recorder"),
        FakeNode("monitor", SimpleNamespace(settings=None), ready=True),
        FakeNode("player", failed=True),
    )
    assert [waits_for(node, PART) for node in made] == [
        "sensor has not started: it imports, compiles, or opens its device",
        "compressor waits for a subscription from echo on desk, monitor, reconstructor",
        "recorder has not answered yet",
        "",
        "",
    ]


def test_a_node_that_is_no_player_waits_for_no_readers():
    settings = SimpleNamespace(wait=2)
    node = FakeNode("monitor", SimpleNamespace(settings=settings), ready=True)
    assert waits_for(node, PART) == ""


def test_readers_are_named_with_their_hosts():
    node = FakeNode("compressor", lacks=["echo", "screen", "monitor"])
    line = waits_for(node, PART)
    assert line.endswith(" from echo on desk, screen on wall, monitor")


def test_a_graph_on_one_host_knows_no_other():
    alone = LaunchFile(*("drag", "", "ipc", {}, []), hosts={}, host="")
    assert hosts_state(alone, [FakeNode()]) == {}


def test_of_equal_clocks_the_first_is_kept_and_a_worse_one_not_used():
    clocks = [(1_000_000, 500_000), (9_000_000, 500_000), (7_000_000, 600_000)]
    nodes = [FakeNode(clocks={"desk": clock}) for clock in clocks]
    state = hosts_state(PART, nodes)["desk"]
    assert state["clock_offset_ms"] == pytest.approx(1.0)
    assert state["heard"] is None


def test_a_host_is_heard_where_all_that_is_read_there_is_and_its_best_known_clock_is_reported():
    desk, wall = hosts_state(
        PART,
        [
            FakeNode(
                heard={"echo": True, "screen": False},
                clocks={"desk": (3_000_000, 900_000)},
            ),
            FakeNode(heard={"echo": True}, clocks={"desk": (2_500_000, 400_000)}),
        ],
    ).values()
    assert (desk["heard"], desk["silent"]) == (True, [])
    assert (wall["heard"], wall["silent"]) == (False, ["screen"])
    assert desk["clock_offset_ms"] == pytest.approx(2.5)
    assert desk["clock_uncertainty_ms"] == pytest.approx(0.4)
    assert wall["clock_offset_ms"] is None


def test_what_is_late_is_logged_after_a_while_and_again_now_and_then():
    now_s, logged, late = [100.0], list[str](), ["a"]
    log = LateLog(lambda: list(late), logged.append, now_s=lambda: now_s[0])
    for step_s, changed, n in (
        (0.0, ["a"], 0),
        (AFTER_S - 0.1, ["a"], 0),
        (0.2, ["a"], 1),
        (AGAIN_S - 0.2, ["a"], 1),
        (0.3, ["a"], 2),
        (AGAIN_S, ["b"], 2),
        (AFTER_S, ["b"], 3),
        (2 * AGAIN_S, [], 3),
    ):
        now_s[0], late[:] = now_s[0] + step_s, changed
        log.look()
        assert len(logged) == n, (step_s, changed)
    assert logged == ["[launch] a", "[launch] a", "[launch] b"]


def test_what_is_late_is_logged_after_five_seconds_and_then_each_thirty():
    now_s = 0.0
    times_s = []
    log = LateLog(lambda: ["a"], lambda _: times_s.append(now_s), lambda: now_s)
    for k in range(140):
        now_s = 100.0 + k / 2
        log.look()
    assert times_s == [105.0, 135.0, 165.0]


def test_what_is_no_longer_late_is_not_logged():
    now_s = 100.0
    late = ["a"]
    logged = []
    log = LateLog(lambda: list(late), logged.append, lambda: now_s)
    log.look()
    late.clear()
    now_s = 200.0
    log.look()
    now_s = 400.0
    log.look()
    assert logged == []


LATCHED, SENT = ({"published": {topic: 1}} for topic in ("/skin/skin", "/skin/taxels"))
WAITS = "from another terminal: sparseskin monitor --graph drag, or sparseskin record --graph drag"


@pytest.mark.parametrize(
    ("stated", "fields", "line"),
    [
        ({"lockstep": True}, {}, f"player waits for a reader; {WAITS}"),
        ({"wait": 1}, {"counts": LATCHED}, f"player waits for a reader; {WAITS}"),
        ({"wait": 1}, {"counts": SENT}, ""),
        ({"lockstep": True}, {"state": {"paused": True}}, ""),
        ({"lockstep": True}, {"ended": True}, ""),
        ({"lockstep": True}, {"failed": True}, ""),
        ({"lockstep": True}, {"state": {}}, ""),
        ({"lockstep": True}, {"counts": {}}, f"player waits for a reader; {WAITS}"),
        ({"wait": 3}, {}, f"player waits for 3 readers; {WAITS}"),
        ({"wait": 2, "lockstep": True}, {}, f"player waits for 2 readers; {WAITS}"),
        ({}, {}, ""),
    ],
)
def test_a_player_that_has_sent_no_frame_reports_which_readers_it_waits_for(
    stated, fields, line
):
    spec = SimpleNamespace(settings=PlayerSettings(**stated))
    assert waits_for(FakeNode("player", spec, ready=True, **fields), PART) == line


@pytest.mark.slow
def test_who_holds_up_the_end_is_named_with_what_waits_for_it(start):
    program = start("launch", "path_40", "--set", "monitor.page=false", limits=True)
    program.wait_for("[launch] ready")
    os.kill(program.pid_of("compressor"), signal.SIGSTOP)
    program.process.send_signal(signal.SIGINT)
    told = program.wait_for("[launch] not drained after 5 s: ")
    assert told.startswith(
        "compressor (has not ended its stream), reconstructor (waits for comp"
    )
    assert "monitor (waits for compressor, reconstructor)" in told
    program.wait_for("[launch] compressor does not end: SIGTERM")
    program.wait_for("[launch] compressor does not end: SIGKILL")
    program.finish()
    wait_until(lambda: program.survivors() == {}, "the end of all processes")


class Desk:
    """A graph of fake processes, the requests to it, and the answers that came."""

    def __init__(self, monkeypatch):
        specs = load("path_40").nodes
        self.nodes = {
            name: FakeNode(name, spec, ready=True) for name, spec in specs.items()
        }
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
        (
            "sensor",
            "pase",
            None,
            "sensor: has no command 'pase' (did you mean 'pause'?)",
        ),
        (
            "compressor",
            "pause",
            None,
            "compressor: has no command 'pause' (known: set)",
        ),
        ("launch", "recrd", True, "launch: recrd: expected the command 'record'"),
        (3, "pause", None, "expected the texts id, node and command"),
    ],
)
def test_what_cannot_be_done_is_refused_at_once_and_reports_why(
    desk, node, command, value, text
):
    assert desk.refusal(node, command, value).startswith(text)


@pytest.mark.parametrize("state", [{"ready": False}, {"ended": True}, {"code": -9}])
def test_a_node_that_does_not_run_is_not_asked(desk, state):
    for name, value in state.items():
        setattr(desk.nodes["sensor"], name, value)
    assert desk.refusal("sensor", "pause") == "sensor does not run just now"


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


def test_the_launcher_answers_for_itself_and_what_is_sent_back_is_short(desk):
    desk.ask("launch", "record", True)
    assert desk.own == [("record", True)]
    assert desk.answers.pop() == {
        "id": "7",
        "node": "launch",
        "done": True,
        "text": "recording",
    }
    long = "x" * 10_000
    desk.ask(long, long, number=long)
    (answer,) = desk.answers
    assert len(answer["id"]) == len(answer["node"]) == 64
    assert len(answer["text"]) < 200


class FakeFleet:
    """Keeps what it is to start."""

    def __init__(self):
        self.nodes = {}
        self.started = []

    def add(self, spec, topics):
        self.started.append((spec, topics))
        self.nodes[spec.name] = FakeNode(spec.name)


class Recorded:
    """A graph of which recordings are asked for."""

    def __init__(self):
        self.fleet = FakeFleet()
        self.launch = load("path_40", ["compressor.ratio=4"])
        self.recording = LiveRecording(self.launch, self.fleet)
        self.said = []

    def take(self, step, node=None):
        """A request, "on" or "off", or an event of the recorder, by default of the last one."""
        if step not in ("on", "off"):
            self.recording.hear(
                node or self.fleet.nodes[list(self.fleet.nodes)[-1]], step
            )
            return
        try:
            self.recording.command(
                "record", step == "on", lambda *said: self.said.append(said)
            )
        except RefusedError as error:
            self.said.append((False, str(error)))


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return Recorded()


def test_a_recorder_of_all_topics_joins_the_graph(recorded):
    recorded.take("on")
    ((spec, topics),) = recorded.fleet.started
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
def test_each_request_is_answered_once_and_what_is_on_is_known(
    recorded, steps, done, refused
):
    out = ""
    for step in steps.split():
        recorded.take(step)
        out = recorded.recording.out or out
        for node in recorded.fleet.nodes.values():
            node.report = {"recording": {"n_messages": 321, "error": None}}
    said = [
        (ok, re.sub(r"path_40-2[-\d]+\.mcap", "OUT", text))
        for ok, text in recorded.said
    ]
    assert [text for is_done, text in said if is_done] == done
    assert [text for is_done, text in said if not is_done] == refused
    ended = steps.split()[-1] in ("ended", "failed", "error") or refused == [OFF]
    assert (recorded.recording.out is None) == ended
    assert [node.told for node in recorded.fleet.nodes.values()][:1] == (
        [[("stop", {})] if "ready off" in steps else []]
    )


def test_why_a_recorder_failed_is_in_the_answer(recorded):
    recorded.take("on")
    out, node = recorded.recording.out, recorded.fleet.nodes["live_recorder_1"]
    node.refusal = "failed: no space left"
    recorded.take("failed")
    assert recorded.said == [(False, f"{out}: failed: no space left")]
    for step in ("on", "ready", "off"):
        recorded.take(step)
    node = recorded.fleet.nodes["live_recorder_2"]
    node.report = {"recording": {"n_messages": 3, "error": "a.mcap: no space left"}}
    recorded.take("ended")
    assert recorded.said[2:] == [(False, "a.mcap: no space left")]


@pytest.mark.parametrize(("name", "value"), [("record", 1), ("recrd", True)])
def test_any_other_request_is_refused(recorded, name, value):
    with pytest.raises(
        RefusedError, match=f"launch: {name}: expected the command 'record', true"
    ):
        recorded.recording.command(name, value, lambda *said: None)
    assert recorded.fleet.started == []


def test_a_file_that_is_there_already_is_not_written_over(
    recorded, tmp_path, monkeypatch
):
    monkeypatch.setattr("time.strftime", lambda form: "now")
    name = f"{recorded.recording._launch.name}-now.mcap"
    (tmp_path / name).write_text("precious")
    with pytest.raises(
        RefusedError, match=f"record: out: {re.escape(name)}: exists already"
    ):
        recorded.recording.command("record", True, lambda *said: None)
    assert (recorded.recording.out, recorded.fleet.started) == (None, [])
    (tmp_path / name).unlink()
    recorded.take("on")
    assert recorded.recording.out == name
