"""Nodes, settings and topics of one running graph, looked at from outside."""

import json
import re
import signal
import subprocess
import sys

import pytest
from conftest import PATIENCE_S, Program, wait_until
from documented import check
from processes import LOOP, PATIENT_COMMAND, note_of_graph, words

from sparseskin.launch.attach.client import ask_node
from sparseskin.launch.commands.cli import main
from sparseskin.launch.run.running import choose_graph
from sparseskin.messages import PhiState, decode
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.reader import BagReader

NODES = ["sensor", "compressor", "reconstructor", "monitor", "recorder"]
TOPICS = [
    *("/skin/skin", "/skin/taxels", "/skin/truth", "/skin/phi", "/skin/measurements"),
    *("/skin/solver", "/skin/reconstruction"),
]


@pytest.fixture(scope="module")
def graph(tmp_path_factory):
    """A graph of 40 x 40 taxels without an end that records all messages into run.mcap."""
    words = ("--set", "sensor.rate_hz=10", "--set", "reconstructor.iterations=3")
    folder = tmp_path_factory.mktemp("graph")
    (folder / "loop.py").write_text(LOOP)
    with Program(
        *("launch", "path_40", "--record", "run.mcap", "--set", "monitor.port=0"),
        *("--summary", "summary.json", *words),
        *("--set", "sensor.source=loop:path_40"),
        cwd=folder,
    ) as program:
        program.wait_for("[launch] ready")
        note_of_graph(program.notes)
        yield program


@pytest.fixture
def folder(graph, monkeypatch):
    """Where the graph runs; commands of this process find that graph, and no other."""
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(graph.cwd / "graphs"))
    monkeypatch.setenv("COLUMNS", "80")
    # These tests run on, in this process.
    monkeypatch.setattr("sparseskin.launch.commands.topic.give_way", lambda: None)
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)
    return graph.cwd


@pytest.fixture
def run(folder, capsys):
    """Run a command that has to succeed; what it printed."""

    def done(*arguments):
        capsys.readouterr()
        assert main(arguments) == 0
        return capsys.readouterr().out

    return done


@pytest.fixture
def refused(folder, capsys):
    """Run a command that has to be refused in one line; that line."""

    def done(*arguments):
        capsys.readouterr()
        assert main(arguments) == 2
        printed = capsys.readouterr()
        (line,) = printed.err.splitlines()
        assert printed.out == ""
        return line

    return done


@pytest.fixture
def run_json(run):
    """Run a command with --json; the document, or one a line, as it is documented."""

    def done(*arguments, lines=False):
        out = run(*arguments, "--json")
        documents = list(map(json.loads, out.splitlines() if lines else [out]))
        for document in documents:
            if isinstance(document, dict) and "format" in document:
                check(document)
        return documents if lines else documents[0]

    return done


def test_node_list_reports_condition_and_process_of_every_node(graph, run, run_json):
    nodes = []

    def all_run():
        nodes[:] = run_json("node", "list")["nodes"]
        return {node["condition"] for node in nodes} == {"running"}

    wait_until(all_run, "all nodes to answer")
    assert [node["name"] for node in nodes] == NODES
    assert {n["name"]: n["pid"] for n in nodes} == {
        name: graph.pid_of(name) for name in NODES
    }
    head, *lines = run("node", "list").splitlines()
    assert head.split() == ["NODE", "TYPE", "CONDITION", "PID", "RESTARTS"]
    assert [line.split()[0] for line in lines] == NODES


def test_node_info_reports_topics_counts_settings_and_what_it_costs(run, run_json):
    node = run_json("node", "info", "compressor")
    inputs = [(one["topic"], one["publisher"]) for one in node["inputs"]]
    assert inputs == [("/skin/skin", "sensor"), ("/skin/taxels", "sensor")]
    assert node["outputs"][1]["topic"] == "/skin/measurements"
    assert node["outputs"][1]["subscribers"] == ["reconstructor", "monitor", "recorder"]
    assert {one["key"]: one["live"] for one in node["settings"]}["ratio"] is True
    assert node["cpu_s"] > 0
    assert node["memory_mb"] > 5
    assert node["transport"] == "ipc"
    text = run("node", "info", "compressor")
    assert "  transport  ipc (ZeroMQ)" in text
    assert "/skin/measurements" in text
    assert max(map(len, text.splitlines())) <= 80


def test_param_list_reports_value_range_meaning_and_what_is_in_force(run, run_json):
    nodes = run_json("param", "list")["nodes"]
    assert list(nodes) == NODES
    rate = {entry["key"]: entry for entry in nodes["sensor"]}["rate_hz"]
    assert rate["live"]
    assert rate["value"] == 10.0
    told = {
        entry["key"]: (entry["value"], entry["in_force"])
        for entry in nodes["reconstructor"]
    }
    assert told["preset"] == ("skin", "skin")
    assert told["solver"] == (None, "skin")
    assert told["basis"] == (None, None)  # that solver takes none
    assert told["iterations"] == (3, 3)
    text = run("param", "list", "reconstructor")
    assert re.search(r"^\* solver += none \(preset skin: skin\)   \(", text, re.M)
    assert max(map(len, text.splitlines())) <= 80


def test_a_setting_is_changed_by_its_node_and_the_recording_has_it(
    run, folder, run_json
):
    assert run("param", "set", "compressor", "ratio", "5") == "compressor: ratio = 5\n"
    assert run("param", "get", "compressor", "ratio") == "5.0\n"
    assert run("param", "get", "compressor", "rows") == "none (in force: rotating)\n"
    assert run_json("param", "get", "compressor", "ratio")["value"] == 5

    def recorded():
        try:
            with BagReader(folder / "run.mcap.part") as bag:
                states = [
                    decode(b"/skin/phi", m.payload) for m in bag.messages(["/skin/phi"])
                ]
        except BagError:
            return False  # nothing of it is written yet
        return any(isinstance(state, PhiState) and state.m == 320 for state in states)

    wait_until(recorded, "the change in the recording")


def test_settings_of_one_command_are_changed_all_or_none(run, refused):
    before = run("param", "get", "sensor", "noise")
    line = refused("param", "set", "sensor", "noise", "0.25", "rate_hz", "-1")
    assert line.startswith("sensor: rate_hz: -1.0 is outside 0")
    assert run("param", "get", "sensor", "noise") == before
    answer = run("param", "set", "sensor", "noise", "0.25", "rate_hz", "11")
    assert answer == "sensor: noise = 0.25, rate_hz = 11\n"
    assert run("param", "get", "sensor", "noise") == "0.25\n"
    assert run("param", "set", "reconstructor", "iterations", "4").endswith(
        "iterations = 4\n"
    )
    answer = run("param", "set", "reconstructor", "iterations", "none")
    assert answer == "reconstructor: iterations is no longer stated\n"
    assert run("param", "get", "reconstructor", "iterations") == "none\n"


OWN_SOLVER = """\
from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver


class Own(FistaSolver):
    def __init__(self, phi, basis, mask, *, iterations=3, n_rounds=4, seed=0):
        super().__init__(phi, basis, mask, iterations=iterations)
        if n_rounds < 1:
            raise SolverError(f"own: n_rounds = {n_rounds} is not allowed; allowed: 1..")
"""


def test_options_of_the_solver_are_set_one_by_one(
    start, run, refused, tmp_path, monkeypatch
):
    (tmp_path / "solver_of_user.py").write_text(OWN_SOLVER)
    settings = (
        "reconstructor.solver=solver_of_user:Own",
        "sensor.rate_hz=20",
        "monitor.page=false",
    )
    stated = [word for one in settings for word in ("--set", one)]
    start("launch", "path_40", *stated).wait_for("[launch] ready")
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    note_of_graph(tmp_path / "graphs")
    options = ["param", "set", "reconstructor", "options.n_rounds"]
    answer = run(*options, "20", "options.seed", "3")
    assert answer == 'reconstructor: options = {"n_rounds": 20, "seed": 3}\n'
    run(*options, "30")
    both = {"n_rounds": 30, "seed": 3}
    assert json.loads(run("param", "get", "reconstructor", "options")) == both
    assert refused(*options, "0").endswith(
        "own: n_rounds = 0 is not allowed; allowed: 1.."
    )
    assert json.loads(run("param", "get", "reconstructor", "options")) == both
    run("param", "set", "reconstructor", "options", "none")
    assert run("param", "get", "reconstructor", "options") == "none\n"


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (
            "param set compressor ratio.x 3",
            "compressor: ratio: expected a number, got {'x': 3}",
        ),
        ("node info sensr", "no such node (did you mean 'sensor'?)"),
        (
            "param get sensor nois",
            "sensor: nois: no such setting (did you mean 'noise'?)",
        ),
        (
            "param set reconstructor preset skn",
            "preset: 'skn' is not allowed while the graph runs (did you mean 'skin'?); "
            "allowed: paper, skin",
        ),
        (
            "param set sensor seed 1",
            "sensor: seed: cannot be changed while the graph runs",
        ),
        ("param set sensor noise 1 rate_hz", "rate_hz: a setting without a value"),
        ("topic info /skin/taxel", "no such topic (did you mean '/skin/taxels'?)"),
        ("topic echo skin/phi --field nn", "phi has no such field (did you mean 'n'?)"),
        ("topic echo skin/taxels --field forces[40,0]", "forces is 40 x 40"),
        ("node list --graph drag", "--graph drag: no such graph runs"),
    ],
)
def test_what_is_not_there_is_refused_in_one_line(refused, arguments, line):
    assert line in refused(*arguments.split())


def test_topics_are_reported_with_fields_publishers_and_what_subscribers_received(
    run, run_json
):
    topics = {topic["topic"]: topic for topic in run_json("topic", "list")["topics"]}
    assert list(topics) == TOPICS
    assert [name for name, one in topics.items() if one["latched"]] == [
        *("/skin/skin", "/skin/phi", "/skin/solver")
    ]
    phi = topics["/skin/phi"]
    assert phi["schema"] == "phi"
    assert phi["publisher"] == "compressor"
    assert [one["node"] for one in phi["subscribers"]] == [
        "reconstructor",
        "monitor",
        "recorder",
    ]
    topic = run_json("topic", "info", "skin/taxels")
    assert list(topic["fields"]) == [
        *("stamp_ns", "patch", "run_id", "seq", "names", "missing", "reason", "forces")
    ]
    lost = {one["node"]: one["lost"] for one in topic["subscribers"]}
    assert lost == {"compressor": 0, "monitor": 0, "recorder": 0}
    for line in (("topic", "list"), ("topic", "info", "/skin/taxels")):
        # The address of a socket is a path, as long as the folder of the test.
        shown = [text for text in run(*line).splitlines() if "address" not in text]
        assert max(map(len, shown)) <= 80


def test_echo_summarises_arrays_and_prints_them_in_full_where_asked(run, run_json):
    (brief,) = run_json("topic", "echo", "/skin/taxels", "--once", lines=True)
    assert brief["forces"]["shape"] == [40, 40]
    assert brief["forces"]["min"] <= brief["forces"]["mean"] <= brief["forces"]["max"]
    (forces,) = run_json(
        *("topic", "echo", "/skin/taxels", "--once", "--full", "--field", "forces"),
        lines=True,
    )
    assert [len(row) for row in forces["data"]] == [40] * 40
    text = run("topic", "echo", "/skin/taxels", "--once")
    assert "forces: float32, 40 x 40: min 0, mean" in text
    assert max(map(len, text.splitlines())) <= 80
    # It shows the last message of a latched topic at once, and leaves none out in JSON.
    assert run("topic", "echo", "/skin/skin", "--once", "--field", "n_rows") == "40\n"
    seqs = run_json(
        "topic", "echo", "/skin/taxels", "-n", "20", "--field", "seq", lines=True
    )
    assert seqs == list(range(seqs[0], seqs[0] + 20))


def test_hz_reports_what_is_sent_and_what_arrives(run_json):
    last = run_json("topic", "hz", "/skin/taxels", "-n", "20", lines=True)[-1]
    assert last["final"]
    assert last["messages"] == 20
    assert last["over"] == 20
    assert last["lost"] == 0
    assert last["sent_hz"] > 0
    assert last["sent_hz"] == pytest.approx(1e3 / last["interval_ms"]["mean"])
    assert last["arrives_hz"] > 0
    assert (
        1600 * 4
        < last["size_bytes"]["min"]
        <= last["size_bytes"]["max"]
        < 1600 * 4 + 300
    )
    assert last["bytes_per_s"] > 0
    age = last["delay_ms"]
    assert 0 < age["min"] <= age["p50"] <= age["p99"] <= age["max"]


def test_where_nothing_comes_it_reports_why(folder, capsys):
    graph = choose_graph(None)
    assert ask_node(graph, "sensor", "pause", True) == "paused"
    try:
        main(["topic", "hz", "skin/taxels", "--duration", "1.5"])
        assert re.search(
            r"no message for \d+ s \(sensor: paused\)", capsys.readouterr().err
        )
        assert main(["topic", "echo", "skin/taxels", "--duration", "0.2"]) == 1
        assert (
            capsys.readouterr().err
            == "/skin/taxels: no message came (sensor: paused)\n"
        )
    finally:
        ask_node(graph, "sensor", "pause", False)


@pytest.mark.parametrize("closed", [False, True])
def test_an_interrupt_ends_with_a_summary_and_a_pipe_that_closes_is_no_matter(
    folder, closed
):
    command = [sys.executable, *PATIENT_COMMAND, "topic", "hz", "/skin/taxels"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert " ms old | lost " in process.stdout.readline()
        if closed:
            process.stdout.close()
            process.stdout = None
        else:
            process.send_signal(signal.SIGTERM)
        out, error = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.communicate()
    assert error == ""
    if not closed:
        assert process.returncode == 0
        assert out.splitlines()[-1][:4] == "all "


def test_a_shell_completes_names_of_the_running_graph(folder):
    assert words("node info ") == NODES
    assert words("topic hz --duration 50 /skin/ta") == ["/skin/taxels"]
    assert words("param set sensor ") == ["rate_hz", "noise", "invert", "drift"]
    assert words("param set reconstructor preset pa") == ["paper"]
    assert words("topic hz --graph=pa") == ["path_40"]


def test_stop_ends_the_graph_as_ctrl_c_does(graph, run, run_json, refused, folder):
    (found,) = run_json("graph", "list")["graphs"]
    assert found["name"] == "path_40"
    assert found["nodes"] == NODES
    assert run_json("param", "set", "compressor", "ratio", "4")["set"] == {"ratio": 4}
    assert run_json("sources")["scenes"]
    label = f"path_40-{graph.process.pid}"
    assert run("stop") == f"{label} has ended: {', '.join(NODES)}\n"
    stdout, _ = graph.ended(130)
    assert ": skin" in stdout  # the table
    assert graph.survivors() == {}
    assert "no graph runs" in refused("stop")
    check(json.loads((folder / "summary.json").read_text()))
    assert run_json("recording", "info", str(folder / "run.mcap"))["recovered"] == ""
