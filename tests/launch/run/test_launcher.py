"""A graph from start to end, whose nodes a test plays: its exit code, its log, what is left."""

import os
import signal
from dataclasses import replace

import pytest
from played import NAMES, Screen, line

from sparseskin.launch.launchfile.hosts import Host
from sparseskin.launch.run import launcher as launchers
from sparseskin.launch.run.fleet import EXIT_FAILED, EXIT_USAGE, START_S
from sparseskin.launch.run.launcher import Launcher
from sparseskin.launch.run.running import (
    GraphError,
    RunningGraph,
    control_path,
    running_graphs,
    runtime_folder,
)


@pytest.fixture
def launcher(stage):
    """A launcher of played nodes that run."""
    played = stage()
    screen = Screen()
    played.launcher = Launcher(played.launch, screen, keys={"p": ("sensor", "pause")})
    played.screen = screen
    played.fleet = played.launcher._fleet
    played.run()
    return played


class Run:
    """A run of a launcher; each time that it serves its nodes, the next act is played."""

    def __init__(self, stage, monkeypatch, launch=None, joined=None):
        self.stage = stage
        self.stage.step_s = 0.01
        self.screen = Screen()
        self.launcher = Launcher(launch or stage.launch, self.screen, joined=joined)
        self.fleet = stage.fleet = self.launcher._fleet
        self._serve = self.fleet.serve
        self._acts = []
        monkeypatch.setattr(self.fleet, "serve", self._next)

    def __call__(self, *acts):
        """The exit code of the run."""
        self._acts = [*acts]
        return self.launcher.run()

    def _next(self):
        # An act more than the run needs: it would go on for ever.
        self._acts.pop(0)()
        self._serve()

    def binds(self):
        for name in self.fleet.nodes:
            self.stage.bound(name)

    def is_ready(self):
        for name in self.fleet.nodes:
            self.stage.says(name, "ready")

    def ends(self, **counts):
        for node in self.fleet:
            self.stage.says(node.name, "ended", counts=counts, report={}, clocks={})
            node.process.code = 0


@pytest.fixture
def run(stage, monkeypatch):
    def make(graph="", launch=None, joined=None):
        return Run(stage(graph), monkeypatch, launch, joined)

    return make


def test_a_graph_that_ends_by_itself_is_a_success_and_leaves_nothing(run):
    begun = run()
    assert begun(begun.binds, begun.is_ready, begun.ends) == 0
    assert begun.screen.lines == [f"[launch] ready: {', '.join(NAMES)}"]
    assert begun.screen.shown == ""
    assert list(runtime_folder().iterdir()) == []


def test_a_graph_is_found_as_starting_until_its_nodes_are_ready(run):
    begun = run()
    seen = []

    def look():
        seen.append([graph.starting for graph in running_graphs(starting=True)])

    def bind():
        look()
        begun.binds()

    def end():
        look()
        begun.ends()

    begun(bind, begun.is_ready, end)
    assert seen == [[True], [False]]


def test_nodes_are_joined_once_all_are_bound_and_started_once_all_are_ready(run):
    begun = run()
    commands = []

    def noted(act):
        def noting():
            commands.append(begun.stage.commands("monitor"))
            act()

        return noting

    begun(noted(begun.binds), noted(begun.is_ready), noted(begun.ends))
    assert commands == [[], ["connect"], ["start"]]


def test_signals_are_handled_as_before_once_a_run_has_ended(run):
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    begun = run()
    during = []

    def end():
        during.extend(signal.getsignal(number) for number in numbers)
        begun.ends()

    begun(begun.binds, begun.is_ready, end)
    assert during == [begun.launcher._on_signal] * 3
    assert [signal.getsignal(number) for number in numbers] == before


def test_nodes_are_ended_where_the_note_of_their_graph_cannot_be_removed(run):
    begun = run()

    def end():
        (note,) = runtime_folder().glob("*.json")
        note.unlink()
        note.mkdir()
        begun.ends()

    assert begun(begun.binds, begun.is_ready, end) == 0
    assert all(node.closed for node in begun.fleet)
    assert not os.path.exists(control_path(os.getpid()))


def test_a_node_that_refuses_its_settings_ends_the_start(run):
    begun = run()

    def refuse():
        begun.stage.says("compressor", "error", code=EXIT_USAGE, text="ratio")

    assert begun(refuse) == EXIT_USAGE
    assert begun.screen.lines[0] == line("error", "compressor", "ratio")
    assert not any("ready" in later for later in begun.screen.lines)


def test_after_four_minutes_the_nodes_that_have_not_started_are_named(run):
    begun = run()

    def wait():
        for name in NAMES[1:]:
            begun.stage.bound(name)
        begun.stage.now_s += START_S

    assert begun(wait) == EXIT_FAILED
    assert begun.screen.lines[0] == line("start", line("imports", "sensor"))
    assert not any("after" in later for later in begun.screen.lines[1:])


def test_after_four_minutes_the_nodes_that_are_not_ready_are_named(run):
    begun = run()

    def wait():
        for name in NAMES[1:]:
            begun.stage.says(name, "ready")
        begun.stage.now_s += START_S

    assert begun(begun.binds, wait) == EXIT_FAILED
    assert begun.screen.lines[0] == line("start", line("no answer", "sensor"))


def test_an_interrupt_of_a_start_is_no_failure_of_a_node(run):
    begun = run()
    code = begun(lambda: begun.launcher._on_signal(signal.SIGINT, None))
    assert code == 128 + signal.SIGINT
    assert not any("after" in later for later in begun.screen.lines)


def test_an_interrupt_drains_the_graph(run):
    begun = run()

    def interrupt():
        begun.launcher._on_signal(signal.SIGINT, None)

    code = begun(begun.binds, begun.is_ready, interrupt, begun.ends)
    assert code == 128 + signal.SIGINT
    sensor = begun.fleet.nodes["sensor"]
    assert sensor.process.signals == [signal.SIGINT]
    assert begun.screen.lines == [f"[launch] ready: {', '.join(NAMES)}"]


def test_errors_that_nodes_have_survived_are_counted_at_the_end(run):
    begun = run()
    begun(begun.binds, begun.is_ready, lambda: begun.ends(errors=3))
    assert begun.screen.lines[1:] == [line("errors", name, 3) for name in NAMES]


def test_a_graph_that_can_do_without_a_node_fails_late_with_it(run):
    begun = run()

    def raise_error():
        begun.stage.says("monitor", "raised")
        begun.ends()

    assert begun(begun.binds, begun.is_ready, raise_error) == EXIT_FAILED


def test_the_late_nodes_of_a_start_are_named_after_a_while(run):
    begun = run()

    def wait():
        begun.stage.now_s += 6.0

    begun(lambda: None, wait, begun.binds, begun.is_ready, begun.ends)
    late = [line("imports", name) for name in NAMES]
    assert begun.screen.lines[:4] == [f"[launch] {text}" for text in late]


def test_a_part_waits_for_another_host_as_long_as_it_takes(run, stage):
    launch = stage().launch
    elsewhere = {"screen": replace(launch.nodes["monitor"], name="screen", host="desk")}
    hosts = {name: Host("127.0.0.1") for name in ("edge", "desk")}
    part = replace(launch, elsewhere=elsewhere, hosts=hosts, host="edge", insecure=True)
    begun = run(launch=part)

    def wait():
        begun.stage.now_s += 10 * START_S

    assert begun(begun.binds, wait, begun.is_ready, begun.ends) == 0
    ready = f"[launch] ready on edge: {', '.join(NAMES)}"
    assert ready in begun.screen.lines


OTHER = RunningGraph("other", os.getpid(), 5, "", {})


def test_a_graph_that_has_ended_is_not_joined(run, monkeypatch):
    monkeypatch.setattr(launchers, "is_running", lambda graph: False)
    begun = run(joined=OTHER)
    with pytest.raises(GraphError):
        begun()
    assert begun.stage.started == []


def test_nodes_that_have_joined_a_graph_end_without_a_failure_where_it_ends(
    run, monkeypatch
):
    runs = [True]
    monkeypatch.setattr(launchers, "is_running", lambda graph: runs[0])
    begun = run(joined=OTHER)

    def end():
        runs.clear()
        runs.append(False)
        begun.stage.now_s += 1.0

    # It is looked for before the nodes are served.
    acts = (begun.binds, begun.is_ready, end, lambda: None, begun.ends)
    assert begun(*acts) == 0
    assert not any("gone" in later for later in begun.screen.lines)
    assert running_graphs(starting=True) == []


def test_messages_of_a_joined_graph_that_may_be_missing_are_logged(run, monkeypatch):
    runs = [True]
    monkeypatch.setattr(launchers, "is_running", lambda graph: runs[0])
    begun = run(joined=OTHER)

    def end():
        runs[0] = False
        begun.stage.now_s += 1.0

    def wait():
        begun.stage.now_s += 2.0

    assert begun(begun.binds, begun.is_ready, end, lambda: None, wait) == 0
    assert line("gone", OTHER.label) in begun.screen.lines


@pytest.mark.parametrize(
    ("stated", "is_warned"),
    [
        ({"transport": "ipc"}, False),
        ({"transport": "tcp"}, True),
        ({"transport": "tcp", "security": object()}, False),
        ({"insecure": True, "hosts": {"edge": None}}, True),
        ({"insecure": True, "hosts": {}}, False),
    ],
)
def test_a_graph_that_others_can_read_is_warned_of(stage, stated, is_warned):
    launch = replace(stage().launch, **stated)
    screen = Screen()
    Launcher(launch, screen)._warn_of_exposure()
    assert len(screen.lines) == is_warned
    assert all("warning" in warning for warning in screen.lines)


def test_a_key_of_the_terminal_is_a_command_and_others_end_the_graph(launcher):
    launcher.screen.keys = ["p", "x"]
    launcher.launcher._serve()
    assert launcher.commands("sensor") == ["pause"]
    assert launcher.launcher._interrupts == 0
    launcher.screen.keys = ["q"]
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 1
    launcher.screen.keys = ["\x03"]
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 2


def test_the_trace_of_an_error_is_recorded_and_not_shown(launcher):
    launcher.says("sensor", "raised", trace="Traceback\nValueError: no")
    launcher.fleet.serve()
    assert launcher.screen.recorded == ["[sensor] Traceback", "[sensor] ValueError: no"]
    assert launcher.screen.lines == []


def test_the_status_is_that_of_the_ends_of_the_graph(launcher):
    for name in NAMES:
        launcher.heartbeat(name, line=f"line of {name}")
    launcher.launcher._serve()
    assert launcher.screen.shown == "line of monitor"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_the_exit_code_unless_a_node_has_failed(launcher, number):
    launcher.launcher._on_signal(number, None)
    assert launcher.launcher._exit_code == 128 + number
    launcher.launcher._on_signal(signal.SIGINT, None)
    assert launcher.launcher._exit_code == 128 + number
    assert launcher.launcher._interrupts == 2


def test_a_signal_after_a_failure_leaves_its_exit_code(launcher):
    launcher.die("compressor")
    launcher.launcher._on_signal(signal.SIGINT, None)
    assert launcher.launcher._exit_code == EXIT_FAILED


def test_nodes_end_once_the_graph_that_they_joined_is_gone(launcher, monkeypatch):
    """It is looked for twice a second."""
    runs = [True]
    joined = RunningGraph("other", 7, 0, "", {})
    launcher.launcher._joined = joined
    monkeypatch.setattr(launchers, "is_running", lambda graph: runs[0])
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 0
    runs[0] = False
    launcher.now_s += 0.4
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 0
    launcher.now_s += 0.2
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 1
    launcher.now_s += 10.0
    launcher.launcher._serve()
    assert launcher.launcher._interrupts == 1


def test_a_graph_that_drains_stops_its_sources_and_names_who_is_late(launcher):
    launcher.step_s = 0.5
    launcher.launcher._drain()
    for node in launcher.fleet:
        assert node.process.signals == [signal.SIGINT]
    (drained,) = launcher.screen.lines
    assert drained.startswith(line("drain", line("last", "sensor")))


def test_one_who_interrupts_a_drain_is_told_nothing_more(launcher):
    launcher.launcher._interrupts = 2
    launcher.launcher._drain()
    assert launcher.screen.lines == []


def test_nodes_behind_one_that_is_dead_need_not_drain(launcher):
    assert not launcher.launcher._all_drained()
    launcher.node("sensor").ended = True
    launcher.node("compressor").process.code = -9
    assert launcher.launcher._all_drained()


def test_a_summary_after_a_restart_has_what_each_node_reports(launcher):
    launcher.says(
        "monitor", "ended", counts={"refused": {}}, report={"n": 7}, clocks={}
    )
    launcher.fleet.serve()
    launcher.fleet.restarts["sensor"].total = 2
    summary = launcher.launcher.summary()
    assert summary["nodes"]["monitor"]["n"] == 7
    assert summary["nodes"]["sensor"]["restarts"] == 2


def test_a_summary_has_what_each_node_reports_and_counts(launcher):
    launcher.says(
        "monitor", "ended", counts={"refused": {}}, report={"n": 7}, clocks={}
    )
    launcher.fleet.serve()
    summary = launcher.launcher.summary()
    assert summary["nodes"]["monitor"]["n"] == 7
    assert summary["nodes"]["monitor"]["type"] == "monitor"
    assert summary["nodes"]["monitor"]["restarts"] == 0
    assert summary["launch"] == launcher.launch.name


def test_a_summary_has_the_patches_that_all_nodes_report(launcher):
    reports = {"sensor": {"left": {"a": 1}}, "monitor": {"left": {"b": 2}, "right": {}}}
    for name, patches in reports.items():
        launcher.says(name, "ended", counts={}, report={"patches": patches}, clocks={})
    launcher.fleet.serve()
    summary = launcher.launcher.summary()
    assert summary["patches"] == {"left": {"b": 2}, "right": {}}
    assert "patches" not in summary["nodes"]["sensor"]


def test_a_summary_states_why_nodes_have_failed_and_what_they_have_left(launcher):
    launcher.fleet.restarts["sensor"].failures.extend(["cable", "heat"])
    launcher.fleet.left["sensor"] = ["a.mcap.part is left"]
    report = {"lines": ["3 frames"]}
    launcher.says("sensor", "ended", counts={"errors": 2}, report=report, clocks={})
    launcher.fleet.serve()
    summary = launcher.launcher.summary()["nodes"]["sensor"]
    assert summary["failures"] == ["cable", "heat"]
    assert summary["lines"] == ["3 frames", "a.mcap.part is left"]
    assert summary["errors"] == 2


def test_a_summary_of_a_part_has_its_host_and_what_is_known_of_the_others(launcher):
    assert "host" not in launcher.launcher.summary()
    hosts = {name: Host("127.0.0.1") for name in ("edge", "desk")}
    launcher.launcher._launch = replace(launcher.launch, hosts=hosts, host="edge")
    summary = launcher.launcher.summary()
    assert summary["host"] == "edge"
    assert summary["hosts"].keys() == {"desk"}


def test_after_a_restart_of_any_node_reports_are_those_of_all_runs(launcher):
    """Of nodes that were started again, and of the others."""
    asked = []
    for node in launcher.fleet:
        cls = type("Counted", (node.spec.cls,), {"totals": classmethod(
            lambda cls, settings, report, counts, again: asked.append(again) or {"n": 9}
        )})  # fmt: skip
        node.spec = replace(node.spec, cls=cls)
    assert "n" not in launcher.launcher.summary()["nodes"]["sensor"]
    launcher.fleet.restarts["compressor"].total = 1
    summary = launcher.launcher.summary()
    assert asked == [False, True, False, False]
    assert summary["nodes"]["sensor"]["n"] == 9
