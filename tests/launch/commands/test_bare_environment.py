"""The command where the environment lacks what it takes for granted."""

import os
import shutil
import subprocess
import sys

import pytest

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
