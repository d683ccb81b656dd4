"""Completion in a shell, without a running graph, and what starts a command."""

import os
import shutil
import subprocess
import sys
import textwrap
from argparse import Action, Namespace

import pytest
from processes import PROGRAM, words

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.completion import candidates
from sparseskin.launch.commands.options import print_ends
from sparseskin.nodes.reconstructor.settings import PRESETS

CELLS = ["camera.n_rows=", "camera.n_cols="]
SHELLS = ("bash", "zsh", "fish")


@pytest.fixture(autouse=True)
def no_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("topic ", ["list", "info", "echo", "hz"]),
        ("topic echo /palm/taxels --field f", ["forces"]),
        ("launch path", ["path_40", "path.toml"]),
        ("launch drag_wrench_40 --frames ", []),
        ("study stability --out ", ["a folder/"]),
        ("recording info my", ["my\\ skin.mcap"]),
        ("launch path_40 --set=mon", ["monitor.page="]),
    ],
)
def test_a_line_is_completed(tmp_path, line, found):
    for name in ("path.toml", "my skin.mcap", ".hidden"):
        (tmp_path / name).touch()
    (tmp_path / "a folder").mkdir()
    completed = words(line)
    if line.endswith("=mon"):
        assert set(found) <= set(completed)
    else:
        assert [word.replace("a\\ folder", "a folder") for word in completed] == found


def overrides(launch, begun):
    """Candidates of `--set BEGUN`, of `launch LAUNCH` or, without a name, of `reprocess`."""
    typed = Namespace() if launch is None else Namespace(name=launch)
    action = Action(["--set"], "set", metavar="NODE.KEY=VALUE")
    return list(candidates(prefix=begun, action=action, parsed_args=typed))


@pytest.mark.parametrize(
    ("launch", "begun", "found"),
    [
        (
            "path_40",
            "",
            ["graph.", "sensor.", "compressor.", "reconstructor.", "monitor."],
        ),
        ("path_40", "graph.transport=", ["graph.transport=ipc", "graph.transport=tcp"]),
        ("path_40", "compressor.b", ["compressor.bits=", "compressor.block="]),
        (
            "path_40",
            "reconstructor.preset=",
            [f"reconstructor.preset={p}" for p in PRESETS],
        ),
        ("path_40", "sensor.source=scene:p", ["sensor.source=scene:path_40"]),
        ("no_such_file", "", []),
        ("own.toml", "", ["graph.", "camera.", "mine."]),
        (
            "own.toml",
            "camera.n",
            [*CELLS, "camera.nan=", "camera.negative=", "camera.noise="],
        ),
        (None, "", ["compressor.", "reconstructor."]),
    ],
)
def test_after_set_come_nodes_settings_and_values(tmp_path, launch, begun, found):
    own = '[nodes.camera]\ntype = "sensor"\n[nodes.mine]\ntype = "no_module:Node"\n'
    (tmp_path / "own.toml").write_text(own)
    assert overrides(launch, begun) == found


def test_a_key_press_imports_no_numpy(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise SystemExit('numpy is imported')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert words("launch path")


@pytest.mark.parametrize("text", ["[nodes", "[nodes]\nsensor = 3", "\udcff"])
def test_of_a_launch_file_that_cannot_be_read_nothing_is_offered(tmp_path, text):
    path = tmp_path / "f.toml"
    path.write_bytes(text.encode(errors="surrogateescape"))
    assert overrides(str(path), "") == []


@pytest.fixture
def shell_folder(tmp_path, monkeypatch, capsys):
    """A folder with a completion script for each shell, the program itself, and a recording."""
    for shell in SHELLS:
        assert main(["completion", shell]) == 0
        (tmp_path / f"c.{shell}").write_text(capsys.readouterr().out)
    program = tmp_path / "sparseskin"
    program.write_text(f'#!/bin/sh\nexec {" ".join(PROGRAM)} "$@"\n')
    program.chmod(0o755)
    (tmp_path / "my skin.mcap").touch()
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    return tmp_path


def shell(name, script, folder):
    """Lines that a shell prints, which has read its completion script."""
    done = subprocess.run(
        [name, "-c", f"source ./c.{name}\n{script}"],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout.splitlines()


LINES = {
    "node in": "info",
    "recording info my": "my\\ skin.mcap",
    "launch path_40 --set reconstructor.preset=pa": "paper",
    "study pap": "paper-tables",
}


def test_bash_itself_completes(shell_folder):
    asked = "".join(
        f"COMP_LINE='sparseskin {line}'; COMP_POINT=${{#COMP_LINE}}\n"
        '_python_argcomplete sparseskin; (IFS=,; echo "${COMPREPLY[*]}")\n'
        for line in LINES
    )
    registered, *found = shell("bash", f"complete -p sparseskin\n{asked}", shell_folder)
    assert registered == "complete -o nospace -F _python_argcomplete sparseskin"
    assert [word.rstrip() for word in found] == list(LINES.values())


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
def test_zsh_takes_the_script_and_completes(shell_folder):
    # Words go to _describe, which works at a prompt alone: a function of its name prints them.
    stand_in = "compdef() {}\n_describe() { print -l -- ${(P)2} }\n"
    (shell_folder / "c.zsh").write_text(stand_in + (shell_folder / "c.zsh").read_text())
    asked = "".join(
        f"BUFFER='sparseskin {line}'; CURSOR=${{#BUFFER}}; words=(sparseskin)\n"
        "_python_argcomplete\n"
        for line in ("node in", "launch path_40 --set compressor.bl")
    )
    found = shell("zsh", asked, shell_folder)
    assert [word.partition(":")[0] for word in found] == ["info", "compressor.block="]


@pytest.mark.parametrize("module", ["argparse", "sparseskin.launch.commands.cli"])
def test_an_interrupt_of_the_imports_ends_with_130_and_no_traceback(module, tmp_path):
    # Importing the module interrupts, as Ctrl-C would at that moment.
    (tmp_path / "sitecustomize.py").write_text(
        textwrap.dedent(f"""
        import os, signal, sys

        # A background job of a shell would ignore it.
        signal.signal(signal.SIGINT, signal.default_int_handler)

        class Interrupting:
            def find_spec(self, name, path=None, target=None):
                if name == "{module}":
                    os.kill(os.getpid(), signal.SIGINT)

        sys.meta_path.insert(0, Interrupting())
        """)
    )
    done = subprocess.run(
        [sys.executable, "-m", "sparseskin", "--version"],
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 130
    assert done.stdout == ""
    assert done.stderr == ""


def test_next_to_nothing_is_imported_before_an_interrupt_is_handled():
    code = (
        "import sys; before = set(sys.modules); import sparseskin.launch.commands.entry; "
        "print(*set(sys.modules) - before)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    own = ("sparseskin", "importlib._bootstrap")  # the latter has run before anything
    others = {name for name in done.stdout.split() if not name.startswith(own)}
    assert others <= {"__future__", "importlib", "warnings"}


ENTRY = (sys.executable, "-P", "-m", "sparseskin.launch.commands.entry")
UNKNOWN_UID = 54321


def test_a_graph_runs_while_standard_files_are_closed(start, tmp_path):
    program = start(
        *("launch", "path_40", "--frames", "3", "--set", "monitor.page=false"),
        *("--summary", "summary.json", "--set", "graph.log_dir=logs"),
        prefix=("bash", "-c", 'exec "$@" <&- >&- 2>&-', "-"),
    )
    assert program.finish() == (0, "", "")
    assert (tmp_path / "summary.json").exists()
    (folder,) = (tmp_path / "logs").iterdir()
    assert "ready" in (folder / "launch.log").read_text()


def test_a_user_without_name_and_home_gets_no_traceback():
    if os.geteuid() != 0 or shutil.which("setpriv") is None:
        pytest.skip("only root, with setpriv (util-linux), can act as an unknown user")
    become = (
        "setpriv",
        f"--reuid={UNKNOWN_UID}",
        f"--regid={UNKNOWN_UID}",
        "--clear-groups",
    )
    environment = {
        k: v for k, v in os.environ.items() if not k.startswith(("HOME", "XDG_"))
    }

    def run(*command):
        return subprocess.run(
            [*become, *command],
            env=environment,
            cwd="/",
            capture_output=True,
            text=True,
            check=False,
        )

    if run(*ENTRY[:2], "-c", "import sparseskin.launch.commands.entry").returncode:
        pytest.skip("the unknown user cannot read this installation")
    done = run(*ENTRY, "launch", "path_40", "--dry-run")
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


def test_the_end_of_a_run_states_what_was_clipped_restarted_recorded_and_played(capsys):
    extremes = {
        "lowest": -0.5,
        "highest": 7.25,
        "f_min": -0.1,
        "f_max": 2.5,
        "unit": "N\x1b",
    }
    counts = {"clipped": 12, "clipped_below": 9, "clipped_above": 3}
    nodes = {
        "sensor": {"type": "sensor", **counts, **extremes},
        "flaky": {
            "type": "x:Y",
            "restarts": 2,
            "failures": ["exit code 1", "killed\x1b"],
        },
        "good": {"type": "sensor", "clipped": 0},
        "own": {"type": "mine:Sensor", "clipped": "some", "played": 3},
        "dead": {"type": "sensor"},
        "recorder": {
            "type": "recorder",
            "lost": {"/skin/taxels": 2, "/skin/truth": 1},
            "recording": {"out": "drag.mcap", "n_messages": 4803, "error": None},
        },
        "full": {
            "type": "recorder",
            "recording": {
                "out": "full.mcap",
                "n_messages": 7,
                "error": "full.mcap: no space",
            },
        },
        "silent": {
            "type": "recorder",
            "recording": {"out": "none.mcap", "n_messages": 0, "error": None},
        },
        "player": {"type": "player", "played": {"file": "drag.mcap", "frames": 1200}},
    }
    print_ends(nodes)
    assert capsys.readouterr().out.splitlines() == [
        r"sensor: readings clipped to the range: 3 above 2.5 N\x1b (highest 7.25), "
        r"9 below -0.1 N\x1b (lowest -0.5)",
        r"flaky: restarted 2 times after a failure; the last: killed\x1b",
        "drag.mcap: 4803 messages recorded, 3 dropped",
        "none.mcap: no message came, so there is no file",
        "drag.mcap: 1200 frames played",
    ]
