"""The processes of a graph, which a test plays: joined, listened to, started again, ended."""

import os
import signal
from dataclasses import replace

import pytest
from played import NAMES, line

from sparseskin.launch.launchfile.hosts import Host
from sparseskin.launch.run.controls import LiveRecording
from sparseskin.launch.run.fleet import EXIT_FAILED, EXIT_USAGE, GRACE_S, START_S, Fleet
from sparseskin.launch.run.running import RunningGraph, RunningNode, control_path
from sparseskin.launch.run.state import graph_description, graph_state
from sparseskin.launch.run.waiting import late_at_end, waits_for
from sparseskin.nodes.process.control import COUNTED

RESTART = (
    'restart = "on-failure"\nrestart_delay_s = 2.0\nmax_restarts = 2\nhang_s = 10.0'
)


def test_each_node_is_started_with_what_it_reads_and_who_reads_it(stage):
    played = stage()
    played.fleet.spawn()
    assert played.started == [[name] for name in NAMES]
    (config,) = played.received("compressor")
    assert config["name"] == "compressor"
    assert config["inputs"] == ["/skin/skin", "/skin/taxels"]
    assert "reconstructor" in config["readers"]
    assert config["late"] is False
    assert config["companions"] == []
    assert config["distant_readers"] == []
    assert played.fleet.condition(played.node("sensor")) == "starting"


def test_the_start_waits_for_readers_on_other_hosts_but_for_no_observer(stage):
    played = stage()
    nodes = played.launch.nodes

    class Observer(nodes["monitor"].cls):
        observes = True

    elsewhere = {
        "reconstructor": nodes["reconstructor"],
        "monitor": replace(nodes["monitor"], cls=Observer),
    }
    fleet = Fleet(replace(played.launch, elsewhere=elsewhere), 0, played.lines.append)
    assert fleet._links_of("compressor")["distant_readers"] == ["reconstructor"]


def test_a_process_has_all_nodes_that_state_it(stage):
    played = stage('process = "all"')
    played.fleet.spawn()
    assert played.started == [NAMES]


def test_a_node_is_connected_to_its_writers(stage):
    played = stage()
    played.fleet.spawn()
    for name in NAMES:
        played.bound(name)
    played.fleet.serve()
    played.received("reconstructor")
    played.fleet.connect(played.node("reconstructor"))
    (command,) = played.received("reconstructor")
    assert command["command"] == "connect"
    assert [peer["writer"] for peer in command["peers"]] == ["compressor", "sensor"]
    assert [peer["endpoint"] for peer in command["peers"]] == [
        "ipc:///compressor",
        "ipc:///sensor",
    ]


def test_a_node_that_is_ready_runs_and_is_paused_or_silent_as_it_says(stage):
    played = stage()
    played.run()
    assert played.fleet.condition(played.node("sensor")) == "running"
    played.heartbeat("sensor", state={"paused": True}, line="half", refusal="no")
    played.fleet.serve()
    node = played.node("sensor")
    assert played.fleet.condition(node) == "paused"
    assert node.line == "half"
    assert node.refusal == "no"
    played.now_s += 1.5
    assert node.condition == "paused"
    played.now_s += 0.2
    assert node.condition == "not answering"


def test_a_line_of_a_log_is_said_while_it_is_new(stage):
    played = stage()
    played.run()
    played.prints("sensor", "100 Hz asked\n")
    played.fleet.serve()
    assert played.lines == ["[sensor] 100 Hz asked"]
    assert played.node("sensor").said == "100 Hz asked"
    played.now_s += 7.9
    assert played.node("sensor").said == "100 Hz asked"
    played.now_s += 0.2
    assert played.node("sensor").said == ""


def test_what_is_no_event_is_logged(stage):
    played = stage()
    played.run()
    played._ends["sensor"]._channel_of_node.sendall(b'{\n[1]\n{"rate": 1}\n')
    played.fleet.serve()
    assert all("garbage" in garbage for garbage in played.lines)
    assert len(played.lines) == 3


@pytest.mark.parametrize(
    ("required", "exit_code", "late_code"),
    [(True, EXIT_FAILED, 0), (False, 0, EXIT_FAILED)],
)
def test_a_node_that_dies_ends_the_graph_that_needs_it(
    stage, required, exit_code, late_code
):
    played = stage()
    played.run()
    name = "monitor"
    cls = type("Observer", (played.node(name).spec.cls,), {"required": required})
    played.node(name).spec = replace(played.node(name).spec, cls=cls)
    played.die(name)
    assert played.lines == [line("died", name, "exit code 3")]
    assert played.fleet.exit_code == exit_code
    assert played.fleet.late_code == late_code
    assert played.node(name).failed
    assert played.fleet.condition(played.node(name)) == "failed"
    played.fleet.serve()
    assert len(played.lines) == 1


def test_a_node_that_was_killed_is_named_with_the_signal(stage):
    played = stage()
    played.run()
    played.die("sensor", -signal.SIGSEGV)
    assert played.lines == [line("died", "sensor", "killed by SIGSEGV")]


def test_the_exit_code_is_that_of_the_first_failure(stage):
    played = stage()
    played.run()
    played.says("sensor", "failed")
    played.fleet.serve()
    played.die("compressor")
    assert played.fleet.exit_code == EXIT_USAGE == 2


def test_an_error_that_a_node_survives_is_no_success(stage):
    played = stage()
    played.run()
    played.says("reconstructor", "raised")
    played.fleet.serve()
    assert played.fleet.exit_code == 0
    assert played.fleet.late_code == EXIT_FAILED
    assert not played.node("reconstructor").failed


def test_a_node_that_has_ended_may_exit(stage):
    played = stage()
    played.run()
    played.says("sensor", "ended", counts={"errors": 0}, report={"n": 7}, clocks={})
    played.fleet.serve()
    played.die("sensor", 0)
    assert played.lines == []
    assert played.node("sensor").report == {"n": 7}
    assert played.node("sensor").closed
    assert played.fleet.condition(played.node("sensor")) == "ended"


def test_a_node_that_dies_is_started_again_where_it_was_and_as_it_was(stage):
    played = stage(RESTART)
    played.run()
    played.heartbeat("sensor", state={"paused": True}, counts={"refused": {"late": 2}})
    played.fleet.serve()
    played.die("sensor")
    assert played.fleet.condition(played.node("sensor")) == "restarting"
    assert played.lines == [line("died", "sensor", "exit code 3")]
    played.now_s += 1.9
    played.fleet.serve()
    assert len(played.started) == 4
    played.now_s += 0.2
    played.fleet.serve()
    assert played.started[4:] == [["sensor"]]
    assert played.lines[1:] == [line("again", "sensor", 1)]
    (config,) = played.received("sensor")
    assert config["late"] is True
    assert config["endpoint"] == "ipc:///sensor"

    played.bound("sensor")
    played.fleet.serve()
    played.says("sensor", "ready")
    played.fleet.serve()
    received = played.received("sensor")
    commands = [fields["command"] for fields in received]
    assert commands == ["connect", "start", "pause"]
    assert received[-1]["value"] is True
    assert played.node("sensor").counts["refused"] == {"late": 2}
    assert played.fleet.exit_code == 0


def test_a_node_that_dies_too_often_ends_the_graph(stage):
    played = stage(RESTART)
    played.run()
    for wait_s in (2.1, 4.1):
        played.die("compressor")
        played.now_s += wait_s
        played.fleet.serve()
    played.die("compressor")
    assert played.lines[-1].endswith("exit code 3" + line("given up", 2, 60))
    assert played.fleet.exit_code == EXIT_FAILED
    assert played.fleet.restarts["compressor"].total == 2


def test_settings_that_are_refused_are_refused_again(stage):
    played = stage(RESTART)
    played.run()
    played.says("compressor", "error", code=EXIT_USAGE, text="ratio")
    played.fleet.serve()
    assert played.lines == [line("error", "compressor", "ratio")]
    assert played.fleet.exit_code == EXIT_USAGE
    assert played.fleet.restarts["compressor"].due_s is None


def test_nodes_of_one_process_fail_together(stage):
    played = stage('process = "all"')
    played.run()
    played.says("sensor", "error", code=EXIT_FAILED, text="driver")
    played.fleet.serve()
    others = ", ".join(NAMES[1:])
    assert played.lines == [
        line("error", "sensor", "driver") + line("of process", others)
    ]
    assert all(node.failed for node in played.fleet)


@pytest.mark.parametrize(
    ("graph", "names", "have"),
    [("", "sensor", "has"), ('process = "all"', ", ".join(NAMES), "have")],
)
def test_a_node_that_is_silent_for_too_long_is_killed(stage, graph, names, have):
    played = stage(f"{RESTART}\n{graph}")
    played.run()
    played.now_s += 9.9
    for name in NAMES[1:]:
        played.heartbeat(name)
    played.fleet.serve()
    assert played.lines == []
    if graph:
        played.now_s += 10.1
    played.now_s += 0.2
    played.fleet.serve()
    assert played.node("sensor").process.signals == [signal.SIGKILL]
    assert played.lines[0] == line("silent", names, have, 10)
    assert not any("silent" in later for later in played.lines[1:])


def test_a_node_that_starts_may_be_silent_for_long(stage):
    played = stage(RESTART)
    played.run()
    played.node("sensor").ready = False
    played.now_s += START_S - 0.1
    for name in NAMES[1:]:
        played.heartbeat(name)
    played.fleet.serve()
    assert played.lines == []
    played.now_s += 0.2
    played.fleet.serve()
    assert played.lines == [line("silent", "sensor", "has", START_S)]


def test_without_restarts_nobody_is_killed_for_being_silent(stage):
    played = stage()
    played.run()
    played.now_s += 1000.0
    played.fleet.serve()
    assert played.lines == []


def test_a_graph_that_is_ended_asks_then_signals_then_kills(stage):
    played = stage()
    played.run()
    began_s = played.now_s
    polite, deaf = played.node("compressor"), played.node("sensor")
    polite.process.obeys |= {signal.SIGTERM}
    for name in ("reconstructor", "monitor"):
        played.node(name).process.code = 0
    played.step_s = 0.1
    played.fleet.end_all()
    assert polite.process.signals == [signal.SIGTERM]
    assert deaf.process.signals == [signal.SIGTERM, signal.SIGKILL]
    assert played.lines == [
        line("stubborn", "sensor", "SIGTERM"),
        line("stubborn", "compressor", "SIGTERM"),
        line("stubborn", "sensor", "SIGKILL"),
    ]
    assert played.commands("sensor") == ["stop"]
    assert played.now_s - began_s >= 2 * GRACE_S
    assert all(node.closed for node in played.fleet)


def test_a_node_that_is_still_starting_is_ended_by_a_signal(stage):
    played = stage()
    played.fleet.spawn()
    for node in played.fleet:
        node.process.obeys |= {signal.SIGTERM}
    played.fleet.end_all()
    assert [node.process.signals for node in played.fleet] == [[signal.SIGTERM]] * 4
    assert played.lines == []


def test_the_state_of_a_graph_leaves_out_recorders_that_have_ended(stage):
    played = stage()
    played.run()
    played.heartbeat(
        "compressor", counts={"refused": {"a": 1, "b": 2}, "lost": {"/skin/skin": 4}}
    )
    played.fleet.serve()
    state = graph_state(played.launch, played.fleet, None)
    assert [node["name"] for node in state["nodes"]] == NAMES
    compressor = state["nodes"][1]
    assert compressor["refused"] == 3
    assert compressor["lost"] == 4
    assert compressor["condition"] == "running"
    assert compressor["patch"] == "skin"
    played.node("sensor").name = "live_recorder_1"
    played.fleet.restarts["live_recorder_1"] = played.fleet.restarts["sensor"]
    assert len(graph_state(played.launch, played.fleet, None)["nodes"]) == 4
    played.node("sensor").ended = True
    names = [
        node["name"] for node in graph_state(played.launch, played.fleet, None)["nodes"]
    ]
    assert names == NAMES[1:]


def test_a_failure_of_another_node_ends_no_recording(stage):
    played = stage()
    played.run()
    recording = LiveRecording(played.launch, played.fleet)
    answers = []
    recording.command("record", True, lambda *answer: answers.append(answer))
    recording.hear(played.node("sensor"), "failed")
    assert recording.out is not None
    assert answers == []
    recording.hear(played.node("live_recorder_1"), "ready")
    assert [done for done, _ in answers] == [True]


def test_a_description_has_the_settings_of_the_node_that_is_asked_for(stage):
    played = stage()
    played.run()
    described = graph_description(played.launch, played.fleet, None, "compressor")
    with_settings = [node["name"] for node in described["nodes"] if "settings" in node]
    assert with_settings == ["compressor"]
    outputs = described["nodes"][1]["outputs"]
    assert {"topic": "/skin/measurements", "latched": False, "sent": 0} in outputs
    assert described["nodes"][1]["transport"] == "ipc"


def test_a_node_that_has_reported_no_counts_is_described_with_none(stage):
    played = stage()
    played.run()
    described = graph_description(played.launch, played.fleet, None, None)
    compressor = described["nodes"][1]
    assert compressor["refused"] == {}
    counted = {"topic": "/skin/taxels", "latched": False}
    assert counted | dict.fromkeys(COUNTED, 0) in compressor["inputs"]


def test_a_setting_that_is_not_stated_is_described_by_what_the_node_takes_for_it(stage):
    played = stage()
    played.run()
    played.heartbeat("reconstructor", state={"depth": 1, "watch_rows": False})
    played.fleet.serve()
    described = graph_description(played.launch, played.fleet, None, "reconstructor")
    settings = {entry["key"]: entry for entry in described["nodes"][2]["settings"]}
    assert settings["depth"]["value"] is None
    assert settings["depth"]["in_force"] == 1
    # One that is stated is that of the settings, whatever the state has of this name.
    assert settings["watch_rows"]["value"] is True
    assert settings["watch_rows"]["in_force"] is True
    assert settings["budget_ms"]["in_force"] is None


def test_at_the_end_each_late_node_is_named_with_those_that_it_waits_for(stage):
    played = stage()
    played.run()
    played.node("sensor").ended = True
    assert late_at_end(played.fleet, played.launch.links) == [
        line("last", "compressor"),
        line("late", "reconstructor", "compressor"),
        line("late", "monitor", "compressor, reconstructor"),
    ]


def test_nothing_is_waited_for_once_a_node_runs(stage):
    played = stage()
    played.fleet.spawn()
    compressor = played.node("compressor")
    assert waits_for(compressor, played.launch) == line("imports", "compressor")
    played.node("compressor").endpoint = "ipc:///x"
    assert waits_for(compressor, played.launch) == line("no answer", "compressor")
    played.node("compressor").ready = True
    assert waits_for(played.node("compressor"), played.launch) == ""


def test_a_node_is_configured_as_its_launch_file_states(stage):
    played = stage("restart = 'never'")
    fleet = Fleet(played.launch, 77, played.lines.append, max_frames=9)
    played.fleet = fleet
    fleet.spawn()
    configs = {name: played.received(name)[0] for name in NAMES}
    for name, config in configs.items():
        assert config["type"] == name
        assert config["settings"] == played.launch.nodes[name].values
        assert config["folder"] == played.launch.folder
        assert config["offset_ns"] == 77
        assert config["max_frames"] == 9
        assert config["public"] == ""
        assert config["security"] is None
    endpoints = {config["endpoint"] for config in configs.values()}
    assert len(endpoints) == len(NAMES)
    assert all(endpoint.startswith("ipc:///") for endpoint in endpoints)
    pages = {config["page_file"] for config in configs.values()}
    assert len(pages) == len(NAMES)


def test_over_tcp_each_node_chooses_a_port_of_this_host(stage):
    played = stage('transport = "tcp"')
    played.fleet.spawn()
    endpoints = [played.received(name)[0]["endpoint"] for name in NAMES]
    assert endpoints == ["tcp://127.0.0.1:*"] * len(NAMES)


def test_a_monitor_alone_asks_its_launcher(stage):
    played = stage()
    played.fleet.spawn()
    controls = [played.received(name)[0]["control"] for name in NAMES]
    assert controls == ["", "", "", control_path(os.getpid())]


def test_the_note_of_a_graph_has_what_others_need_to_read_it(stage):
    played = stage()
    played.run()
    note = played.fleet.note()
    assert note.name == played.launch.name
    assert note.pid == os.getpid()
    assert note.launch == played.launch.text
    assert list(note.nodes) == NAMES
    sensor = note.nodes["sensor"]
    assert sensor.type_name == "sensor"
    assert sensor.endpoint == "ipc:///sensor"
    assert sensor.outputs == list(played.launch.nodes["sensor"].outputs)
    assert sensor.key == note.key_file == ""
    assert {node.config["page_token"] for node in played.fleet} == {note.page_token}
    assert len(note.page_token) > 20


def test_topics_that_a_node_does_not_publish_are_not_in_the_note(stage):
    played = stage()
    played.fleet.spawn()
    unused = ["/skin/truth"]
    played.says("sensor", "bound", endpoint="ipc:///a", unused=unused)
    played.fleet.serve()
    outputs = played.fleet.note().nodes["sensor"].outputs
    assert "/skin/truth" not in outputs
    assert "/skin/taxels" in outputs


def test_nodes_that_join_a_graph_read_its_topics_at_once(stage):
    played = stage()
    writer = RunningNode("sensor", "ipc:///theirs", ["/skin/skin", "/skin/taxels"])
    joined = RunningGraph("other", 7, 0, "", {"sensor": writer})
    nodes = {"compressor": played.launch.nodes["compressor"]}
    launch = replace(played.launch, nodes=nodes)
    fleet = Fleet(launch, 0, played.lines.append, joined=joined)
    played.fleet = fleet
    fleet.spawn()
    (config,) = played.received("compressor")
    assert config["late"] is True
    fleet.connect(played.node("compressor"))
    (command,) = played.received("compressor")
    (peer,) = command["peers"]
    assert peer["writer"] == "sensor"
    assert peer["endpoint"] == "ipc:///theirs"


def test_a_recorder_that_is_added_reads_the_topics_that_are_stated(stage):
    played = stage()
    played.run()
    spec = replace(played.launch.nodes["monitor"], name="added")
    played.fleet.add(spec, ["/skin/taxels", "/skin/measurements"])
    (config,) = played.received("added")
    assert config["inputs"] == ["/skin/taxels", "/skin/measurements"]
    assert config["late"] is True
    played.bound("added")
    played.fleet.serve()
    (command,) = played.received("added")
    assert [peer["writer"] for peer in command["peers"]] == ["compressor", "sensor"]


def test_writers_on_another_host_are_connected_once_a_node_is_ready(stage):
    played = stage()
    nodes = dict(played.launch.nodes)
    sensor = replace(nodes.pop("sensor"), host="desk", public="tcp://desk:5000")
    hosts = {name: Host("127.0.0.1") for name in ("edge", "desk")}
    elsewhere = {"sensor": sensor}
    part = {"nodes": nodes, "elsewhere": elsewhere, "hosts": hosts, "host": "edge"}
    launch = replace(played.launch, **part)
    fleet = Fleet(launch, 0, played.lines.append)
    played.fleet = fleet
    fleet.spawn()
    (config,) = played.received("compressor")
    assert config["distant_inputs"] == dict.fromkeys(config["inputs"], "desk")
    played.bound("compressor")
    fleet.serve()
    fleet.connect(played.node("compressor"))
    (command,) = played.received("compressor")
    assert command["peers"] == []
    played.says("compressor", "ready")
    fleet.serve()
    (command,) = played.received("compressor")
    (peer,) = command["peers"]
    assert peer["endpoint"] == "tcp://desk:5000"
    assert peer["host"] == "desk"


def test_a_node_that_is_added_to_a_graph_is_started(stage):
    played = stage()
    played.run()
    spec = replace(played.launch.nodes["monitor"], name="added")
    played.fleet.add(spec, ["/skin/taxels"])
    played.received("added")
    played.bound("added")
    played.says("added", "ready")
    played.fleet.serve()
    assert played.commands("added") == ["connect", "start"]


def test_what_a_dead_node_leaves_is_kept_by_its_name(stage):
    played = stage()
    played.run()
    left = classmethod(lambda cls, settings: "a.part is left")
    cls = type("Leaves", (played.node("sensor").spec.cls,), {"left_behind": left})
    played.node("sensor").spec = replace(played.node("sensor").spec, cls=cls)
    played.die("sensor")
    assert played.fleet.left == {"sensor": ["a.part is left"]}


def test_numbers_of_compiled_loops_are_known_while_a_node_starts(stage):
    played = stage()
    played.fleet.spawn()
    assert played.node("sensor").compiled is None
    played.says("sensor", "compiled", done=2, of=20)
    played.fleet.serve()
    assert played.node("sensor").compiled == (2, 20)


def test_a_file_that_is_watched_is_handled_when_it_can_be_read(stage):
    played = stage()
    reader, writer = os.pipe()
    handled = []
    played.fleet.watch(reader, lambda: handled.append(os.read(reader, 9)))
    played.fleet.serve()
    assert handled == []
    os.write(writer, b"a")
    played.fleet.serve()
    assert handled == [b"a"]
    played.fleet.unwatch(reader)
    os.write(writer, b"b")
    played.fleet.serve()
    assert handled == [b"a"]
    os.close(reader)
    os.close(writer)
