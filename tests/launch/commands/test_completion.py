"""Completion of commands, options and values in a shell, without a running graph."""

import os
import shutil
import subprocess
from argparse import Action, Namespace

import pytest
from shells import COMMAND, words

from sparseskin.launch.commands.cli import main
from sparseskin.launch.commands.completion import candidates
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
        ("path_40", "", ["graph.", "sensor.", "compressor.", "reconstructor.", "monitor."]),
        ("path_40", "graph.transport=", ["graph.transport=ipc", "graph.transport=tcp"]),
        ("path_40", "compressor.b", ["compressor.bits=", "compressor.block="]),
        ("path_40", "reconstructor.preset=", [f"reconstructor.preset={p}" for p in PRESETS]),
        ("path_40", "sensor.source=scene:p", ["sensor.source=scene:path_40"]),
        ("no_such_file", "", []),
        ("own.toml", "", ["graph.", "camera.", "mine."]),
        ("own.toml", "camera.n", ["camera.noise=", *CELLS, "camera.nan=", "camera.negative="]),
        (None, "", ["compressor.", "reconstructor."]),
    ],
)
def test_after_set_come_nodes_of_the_launch_file_their_settings_and_values(
    tmp_path, launch, begun, found
):
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
    program.write_text(f'#!/bin/sh\nexec {" ".join(COMMAND)} "$@"\n')
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
