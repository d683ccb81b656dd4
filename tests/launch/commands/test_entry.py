"""The command itself: interrupts, a bare environment, and the lines at the end of a run."""

import os
import shutil
import subprocess
import sys
import textwrap

import pytest

from sparseskin.launch.commands.options import print_ends


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
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "")


def test_next_to_nothing_is_imported_before_an_interrupt_is_handled():
    code = (
        "import sys; before = set(sys.modules); import sparseskin.launch.commands.entry; "
        "print(*set(sys.modules) - before)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
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
    become = ("setpriv", f"--reuid={UNKNOWN_UID}", f"--regid={UNKNOWN_UID}", "--clear-groups")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(("HOME", "XDG_"))}

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
    extremes = {"lowest": -0.5, "highest": 7.25, "f_min": -0.1, "f_max": 2.5, "unit": "N\x1b"}
    counts = {"clipped": 12, "clipped_below": 9, "clipped_above": 3}
    nodes = {
        "sensor": {"type": "sensor", **counts, **extremes},
        "flaky": {"type": "x:Y", "restarts": 2, "failures": ["exit code 1", "killed\x1b"]},
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
            "recording": {"out": "full.mcap", "n_messages": 7, "error": "full.mcap: no space"},
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
