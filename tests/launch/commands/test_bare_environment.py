"""The command where the environment lacks what it takes for granted."""

import os
import shutil
import subprocess
import sys

import pytest

from sparseskin.launch.commands.cli import main

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


def test_a_dry_run_names_the_modules_whose_code_it_ran(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "node_of_dry_run.py").write_text(
        "from sparseskin.nodes.sensor.node import Sensor as Mine\n"
    )
    (tmp_path / "g.toml").write_text('[nodes.mine]\ntype = "node_of_dry_run:Mine"\n')
    assert main(["launch", "g.toml", "--dry-run"]) == 0
    assert capsys.readouterr().err == "imported, and so run, to be checked: node_of_dry_run\n"
    (tmp_path / "package_of_dry_run").mkdir()
    (tmp_path / "package_of_dry_run" / "__init__.py").touch()
    (tmp_path / "package_of_dry_run" / "driver.py").write_text("raise SystemExit\n")
    source = "package_of_dry_run.driver:frames"
    assert main(["launch", "path_40", "--dry-run", "--set", f"sensor.source={source}"]) == 0
    note = "imported, and so run, to be checked: package_of_dry_run\n"
    assert capsys.readouterr().err == note
    assert main(["launch", "path_40", "--dry-run"]) == 0
    assert capsys.readouterr().err == ""
