"""Launch files: checked whole, each fault one line with its place."""

import os
from pathlib import Path

import numpy as np
import pytest
from damaged import launch_faults
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.launch import graph_text
from sparseskin.launch.launchfile.check import MAX_ERROR, MAX_ERRORS, MAX_NODES
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.launch.run.restarts import RestartPolicy
from sparseskin.nodes.process.scheduling import Scheduling
from sparseskin.nodes.sensor.scenes.scenes import SCENES
from sparseskin.nodes.toml import MAX_CHARS

GOOD = """\
[graph]
description = "a test"

[nodes.sensor]
type = "sensor"
source = "scene:path_40"

[nodes.compressor]
type = "compressor"

[nodes.reconstructor]
type = "reconstructor"
iterations = 20

[nodes.monitor]
type = "monitor"
"""


@pytest.fixture
def check(tmp_path, monkeypatch):
    """The error lines of a launch file."""
    monkeypatch.chdir(tmp_path)

    def lines_of(text, *overrides):
        Path("f.toml").write_text(text)
        return launch_faults("f.toml", overrides)

    return lines_of


def test_every_scene_has_a_launch_file_that_checks():
    for name in SCENES:
        assert load(name).nodes["sensor"].settings.source == f"scene:{name}"


def test_all_faults_are_reported_at_once_each_in_one_line_with_its_place(check):
    text = GOOD + "[nodes.other]\n"
    for old, new in {
        "[graph]": "[grap]",
        "scene:path_40": "scene:path_41",
        '"compressor"': '"compresor"',
        "iterations": "itertions",
        "[nodes.monitor]": "[nodes.Monitor]",
    }.items():
        text = text.replace(old, new, 1)
    assert sorted(check(text, "sensor.sead=3", "senser.seed=3", "nonsense")) == [
        "--set nonsense: expected NODE.KEY=VALUE",
        "--set senser.seed=3: unknown node 'senser' (did you mean 'sensor'?)",
        "--set sensor.sead=3: unknown key (did you mean 'seed'?)",
        "f.toml:13: nodes.reconstructor.itertions: unknown key (did you mean 'iterations'?)",
        "f.toml:15: nodes.Monitor: 'Monitor' is no name (allowed: a lower-case letter, then "
        "lower-case letters, digits and underscores)",
        "f.toml:17: nodes.other: the key 'type' is missing or not a text",
        "f.toml:1: grap: unknown table (did you mean 'graph'?)",
        "f.toml:6: nodes.sensor.source: no scene is called 'path_41' (did you mean 'path_40'?)",
        'f.toml:9: nodes.compressor.type: type "compresor" is not known (did you mean '
        "'compressor'?); or \"module:Class\" for your own",
    ]


RECONSTRUCTOR = "f.toml:11: nodes.reconstructor: "


@pytest.fixture
def own_modules(tmp_path, monkeypatch):
    """A driver that must not be imported, a Phi, and a solver."""
    (tmp_path / "driver_of_check.py").write_text(
        "def frames(): yield\nraise SystemExit\n"
    )
    phi = "from sparseskin.nodes.compressor.phi.sbhe import SbhePhi\nclass Own(SbhePhi): pass\n"
    (tmp_path / "phi_of_check.py").write_text(phi)
    solver = (
        "from sparseskin.nodes.reconstructor.solvers.base import Solver\n"
        "class OfTaxels(Solver): reads_taxels = True\n"
    )
    (tmp_path / "solver_of_check.py").write_text(solver)
    monkeypatch.syspath_prepend(tmp_path)


@pytest.mark.usefixtures("own_modules")
@pytest.mark.parametrize(
    ("overrides", "lines"),
    [
        (
            ["compressor.ratio=5000"],
            ["{0}: 5000 leaves no measurement of 1600 taxels; allowed: 1..1600"],
        ),
        (
            ["compressor.phi=phi_of_check:Own"],
            [
                f"{RECONSTRUCTOR}phi: the compressor's 'phi_of_check:Own' is not built in, and "
                "is not imported because a message names it; "
                "state phi = 'phi_of_check:Own' here too"
            ],
        ),
        (
            ["reconstructor.solver=solver_of_check:OfTaxels"],
            [
                "f.toml:13: nodes.reconstructor.iterations: solver solver_of_check:OfTaxels has "
                "none; allowed: to leave it out, or a solver that has it (preset paper)",
                '{0}: solver "solver_of_check:OfTaxels": phi "sbhe" mixes taxels; '
                "allowed: a phi that reads single taxels, as subsample",
            ],
        ),
    ],
)
def test_faults_between_nodes_are_found_before_any_starts(check, overrides, lines):
    assert check(GOOD, *overrides) == [
        line.format(f"--set {overrides[0]}") for line in lines
    ]


def test_all_faults_of_a_node_are_reported_but_none_that_follows_from_another(check):
    text = GOOD.replace(
        "iterations = 20", 'depth = -1\nlambda_n = 1\npreset = "papr"\nfast = "no"'
    )
    assert check(
        text, "compressor.ratio=2000", "compressor.block=33", "sensor.noise=-1"
    ) == [
        "--set sensor.noise=-1: -1.0 is outside 0.0..100.0",
        "--set compressor.block=33: 33 is not a power of two (1, 2, 4 ...)",
        "f.toml:13: nodes.reconstructor.depth: -1 is outside 0..1000",
        "f.toml:16: nodes.reconstructor.fast: 'no' is not allowed; allowed: auto, on, off",
        "f.toml:15: nodes.reconstructor.preset: 'papr' is not known (did you mean 'paper'?); "
        "allowed: paper, skin",
        "--set compressor.ratio=2000: 2000 leaves no measurement of 1600 taxels; allowed: 1..1600",
    ]


SOLVER = "solver_of_user:Own"
OWN_SOLVER = """\
class Own:
    def __init__(self, phi, basis, mask, *, iterations=30, lambda_n=0.0, n_rounds=4, seed=0):
        pass
"""
WITH_OPTION = GOOD.replace(
    "[nodes.monitor]",
    f'solver = "{SOLVER}"\n\n[nodes.reconstructor.options]\nn_rounds = 30\n\n[nodes.monitor]',
)


@pytest.fixture
def own_solver(tmp_path, monkeypatch):
    """A solver of the user's own, with options, in the folder where launch files are checked."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "solver_of_user.py").write_text(OWN_SOLVER)


@pytest.mark.usefixtures("own_solver")
def test_options_are_those_that_the_solver_has(check):
    text = WITH_OPTION.replace("n_rounds = 30", "n_rounds = []")
    options = {"n_round": "3", "lambda_n": "3", "seed": "[3]"}
    stated = [f"reconstructor.options.{key}={value}" for key, value in options.items()]
    kinds = "is not allowed; allowed: a finite number, a text, true or false"
    assert sorted(check(text, *stated)) == [
        "--set reconstructor.options.lambda_n=3: is a setting of its own; allowed: lambda_n",
        f"--set reconstructor.options.n_round=3: is no option of solver {SOLVER} (did you mean "
        "'n_rounds'?); allowed: n_rounds, seed",
        f"--set reconstructor.options.seed=[3]: [3] {kinds}",
        f"f.toml:18: nodes.reconstructor.options.n_rounds: [] {kinds}",
    ]
    Path("f.toml").write_text(WITH_OPTION)
    reconstructor = load("f.toml", ["reconstructor.options.seed=2"]).nodes[
        "reconstructor"
    ]
    assert reconstructor.settings.options == {"n_rounds": 30, "seed": 2}
    chosen = {
        "solver": SOLVER,
        "basis": "haar",
        "iterations": 20,
        "n_rounds": 30,
        "seed": 2,
    }
    assert reconstructor.settings.chosen() == chosen


def test_a_topic_has_one_writer_and_every_reader_has_one(check):
    twice = GOOD + '\n[nodes.second]\ntype = "sensor"\n'
    assert check(twice) == [
        "f.toml: second: writes /skin/skin, which sensor writes too"
    ]
    (line,) = check(
        GOOD.replace('type = "compressor"', 'type = "compressor"\npatch = "left"')
    )
    assert line.startswith("f.toml: compressor: reads /left/skin, which no node writes")


@given(st.data())
def test_a_mutated_launch_file_is_used_or_refused_in_lines(tmp_path_factory, data):
    text = list(GOOD)
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(text) - 1))
        text[place] = data.draw(st.characters(codec="utf-8") | st.just(""))
    path = tmp_path_factory.mktemp("mutated") / "f.toml"
    path.write_text("".join(text), encoding="utf-8", newline="")
    try:
        lines = [] if load(str(path)).nodes else ["no node"]
    except LaunchError as error:
        lines = error.lines or ["no line"]
    for line in lines:  # each begins with the file, and stays one line on a terminal
        assert line.startswith(str(path))
        assert line.isprintable()
        assert line.partition(": ")[2]


def test_a_recording_in_a_read_only_folder_is_refused(capsys, tmp_path, monkeypatch):
    out = tmp_path / "a.mcap"
    # root may write anywhere
    monkeypatch.setattr("os.access", lambda path, mode: path != tmp_path)
    assert main(["launch", "path_40", "--record", str(out)]) == 2
    assert capsys.readouterr() == ("", f"--record: {out}: cannot be written to\n")


REPLAYED = {
    "replay": "sensor.source=file:PATH",
    "replay_measurements": "player.file=PATH.mcap",
}


@pytest.mark.parametrize(("name", "hint"), REPLAYED.items())
def test_a_launch_file_without_its_recording_is_refused_with_a_hint(name, hint):
    (line,) = launch_faults(name)
    assert line.endswith(f"no such file; name yours: --set {hint}")
    place = hint.partition("=")[0]
    assert f": nodes.{place}: " in line
    missing = f"{place}={'file:' if 'sensor' in place else ''}missing.mcap"
    assert launch_faults(name, [missing]) == [
        f"--set {missing}: missing.mcap: no such file"
    ]
    # one of the recording follows
    (line,) = launch_faults("replay", ["sensor.skin=a.toml"])
    assert line == "--set sensor.skin=a.toml: a.toml: no such file"


@pytest.mark.parametrize("name", ["launch", "live_recorder_1"])
def test_names_of_the_launchers_own_are_refused(tmp_path, name):
    path = tmp_path / "g.toml"
    path.write_text(f'[nodes.{name}]\ntype = "sensor"\n')
    with pytest.raises(
        LaunchError, match=rf"g.toml:1: nodes.{name}: 'launch' and 'live_recorder_"
    ):
        load(str(path))


def test_set_states_the_keys_of_the_graph(tmp_path):
    changes = ["transport=tcp", "insecure=true", "log_dir=logs", "restart=on-failure"]
    changes += [
        "max_restarts=2",
        "hang_s=3",
        "restart_delay_s=1",
        "description=two words",
    ]
    (tmp_path / "f.toml").write_text(GOOD.partition("\n\n")[2])
    launch = load(str(tmp_path / "f.toml"), [f"graph.{change}" for change in changes])
    assert (launch.transport, launch.insecure, launch.log_dir) == ("tcp", True, "logs")
    assert launch.description == "two words"
    for node in launch.nodes.values():
        assert node.restart == RestartPolicy(
            "on-failure", 2, restart_delay_s=1, hang_s=3
        )


@pytest.mark.parametrize(
    ("change", "what"),
    [
        ("transport=unix", "'unix' is not allowed; allowed: ipc, tcp"),
        ("insecure=1", "expected true or false, got 1"),
        ("priority=99", "99 is outside 0..98"),
        ("cpus=0", "expected a list of whole numbers, got 0"),
    ],
)
def test_a_wrong_set_of_the_graph_is_refused(check, change, what):
    assert check(GOOD, f"graph.{change}") == [f"--set graph.{change}: {what}"]


def test_cpus_and_priority_are_of_the_graph_or_of_a_node(tmp_path):
    path = tmp_path / "f.toml"
    path.write_text(GOOD)
    changes = [
        "graph.cpus=[0]",
        "graph.priority=5",
        "sensor.priority=0",
        "monitor.cpus=[1, 0]",
    ]
    nodes = load(str(path), changes).nodes
    assert nodes["sensor"].scheduling == Scheduling((0,))
    assert nodes["compressor"].scheduling == Scheduling((0,), 5)
    assert nodes["monitor"].scheduling == Scheduling((0, 1), 5)
    assert "priority" not in nodes["sensor"].values


def test_nodes_that_may_not_be_scheduled_are_refused(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1})
    monkeypatch.chdir(tmp_path)
    Path("f.toml").write_text(GOOD)
    assert (
        main(
            [
                "launch",
                "f.toml",
                "--set",
                "graph.cpus=[0, 7]",
                "--set",
                "sensor.cpus=[1]",
            ]
        )
        == 2
    )
    nodes = ", ".join(name for name in load("f.toml").nodes if name != "sensor")
    assert capsys.readouterr().err == (
        f"f.toml: {nodes}: cpus: CPU 7 is not there for this process (allowed: 0, 1)\n"
    )


@pytest.mark.parametrize(
    "source",
    [
        'file:whole.npy"\naxes = "frames,rows,cols',
        'file:a.csv"\nn_rows = 6\nunit = "N',
    ],
)
def test_m_that_the_skin_of_a_source_does_not_allow_is_refused_before_the_start(
    check, source
):
    frames = np.full((9, 6, 8), 0.5, np.float32)
    np.save("whole.npy", frames)
    np.savetxt("a.csv", frames.reshape(9, -1), delimiter=",", fmt="%.2f")
    (line,) = check(GOOD.replace("scene:path_40", source), "compressor.m=49")
    end = "phi: m = 49 is not allowed; allowed: 1..48 (n = 48 taxels)"
    assert line == f"--set compressor.m=49: {end}"
    load("f.toml", ["compressor.m=48"])


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "\n[graph]\ndescription = " + "9" * 5000,
            ":3: not TOML: a whole number beyond 64 bits",
        ),
        (
            "[graph]\ndescription = 0x" + "f" * 5000,
            "graph.description: a whole number beyond 64",
        ),
        (
            "".join(f"[t{k}]\n" for k in range(200_000)),
            f"more than {MAX_CHARS} characters",
        ),
        (
            "\n[graph]\na" + ".a" * 9000 + " = 1",
            ":3: not TOML: a key of more than 100 parts",
        ),
        ("a" + ".a" * 50 + " = 1", "more than 8 tables or lists in each other"),
        ("a = " + "[" * 900 + "]" * 900, "more than 8 tables or lists"),
        (
            "".join(f"[nodes.n{k}]\n" for k in range(3000)),
            f"3000 nodes; at most {MAX_NODES}",
        ),
        ("[graph]\ntransport = 'x" + "y" * 60_000 + "'", "graph.transport: 'xyyy"),
        (
            "".join(f"a{k} = 1\n" for k in range(6000)),
            "g.toml: perhaps more; these come first",
        ),
        ("[nodes.n]\ntype = '\\u001b[2J'".replace("'", '"'), r"\x1b[2J"),
    ],
)
def test_a_hostile_file_is_refused_in_lines_that_name_the_place(tmp_path, text, line):
    path = tmp_path / "g.toml"
    path.write_text(text)
    lines = launch_faults(str(path))
    assert any(line in one for one in lines)
    assert max(map(len, lines)) < 3 * MAX_ERROR
    assert len(lines) <= MAX_ERRORS + 1


def test_a_dry_run_shows_the_graph(capsys):
    assert main(["launch", "path_40", "--dry-run"]) == 0
    out = capsys.readouterr().out
    assert out.rstrip() == graph_text(load("path_40"))
    (line,) = (
        line for line in out.splitlines() if line.startswith("/skin/measurements ")
    )
    assert line.split() == [
        "/skin/measurements",
        "compressor",
        "reconstructor,",
        "monitor",
    ]
    assert "\ntransport ipc\n" in out
    changes = ["graph.transport=tcp", "graph.cpus=[1, 0]", "sensor.priority=7"]
    text = " ".join(graph_text(load("path_40", changes)).split())
    assert " transport tcp " in text
    assert (text.count("cpus = [0, 1]"), text.count("priority = 7")) == (4, 1)
