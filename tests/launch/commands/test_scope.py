"""The commands `sources` and `scope`."""

from __future__ import annotations

import json
import os
import pty
import select
import subprocess
import sys
from importlib.metadata import EntryPoint, EntryPoints
from pathlib import Path

import numpy as np
import pytest
from boards import a_line
from conftest import COMMAND, PATIENCE_S, wait_until

from sparseskin.launch.commands import sources
from sparseskin.launch.commands.cli import main
from sparseskin.nodes.sensor.boards.framing import Framing

FLEXITAC = Framing(16 * 32, start=b"\xaa\x55")


def test_sources_lists_what_there_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("step.npy", np.zeros((2, 3, 4)))
    Path("notes.txt").touch()
    offered = EntryPoints([EntryPoint("glove", "my_glove:frames", sources.GROUP)])
    monkeypatch.setattr(sources, "entry_points", lambda group: offered.select(group=group))
    assert main(["sources", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [one["source"] for one in found["files"]] == ["file:step.npy"]
    assert {"source": "my_glove:frames", "about": "glove"} in found["drivers"]
    assert "scene:path_40" in [one["source"] for one in found["scenes"]]
    assert "scene:limb_path" in [one["source"] for one in found["points"]]
    assert "example:torso" in [one["name"] for one in found["layouts"]]
    assert "flexitac_16x32" in [one["name"] for one in found["profiles"]]
    assert all(one["about"] for one in found["profiles"])
    assert main(["sources"]) == 0
    text = capsys.readouterr().out
    for word in (
        "file:step.npy",
        "my_glove:frames",
        "scene:path_40",
        "flexitac_16x32",
        "example:grip",
    ):
        assert word in text


def test_scope_prints_figures_where_the_output_is_no_terminal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("step.npy", np.arange(24, dtype=np.float32).reshape(2, 3, 4))
    assert main(["scope", "file:step.npy", "--set", "unit=kPa"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "step: 2 frames; min 0, max 23 kPa"


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["scene:path_41"], "did you mean 'path_40'?"),
        (["serial:/dev/no-board?profile=flexitac_16x32"], "there is no device"),
        (["scene:path_40", "--set", "n_row=3"], "did you mean 'n_rows'?"),
        (["scene:path_40", "--set", "n_rows"], "--set n_rows: expected KEY=VALUE"),
        (["scene:path_40", "--set", "n_rows=x"], "--set n_rows: expected a whole number"),
        (["scene:path_40", "--set", "f_max=-1"], "--set f_max: -1.0 is outside"),
    ],
)
def test_scope_refuses_in_one_line(
    words: list[str], fault: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("serial")
    assert main(["scope", *words]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert fault in line


def test_scope_draws_in_a_terminal_and_leaves_it_as_it_was(tmp_path: Path) -> None:
    pytest.importorskip("serial")
    screen, terminal = pty.openpty()
    with a_line(tmp_path) as line:
        name = f"serial:{line.device}?profile=flexitac_16x32"
        process = subprocess.Popen(
            [sys.executable, *COMMAND, "scope", name],
            stdin=terminal,
            stdout=terminal,
            stderr=terminal,
            env={**os.environ, "TERM": "xterm-256color", "COLUMNS": "300", "LINES": "24"},
        )
        os.close(terminal)
        line.sending(FLEXITAC.encode(bytes([k % 160] * 512)) for k in range(10**9))
        shown = bytearray()

        def read() -> None:
            if select.select([screen], [], [], 0.05)[0]:
                try:
                    shown.extend(os.read(screen, 65536))
                except OSError:  # the other end is closed
                    return

        def has_drawn() -> bool:
            read()
            return shown.count(b"\x1b[H") >= 3 and "▀".encode() in shown

        def has_ended() -> bool:
            read()
            return process.poll() is not None and b"frames; min" in shown

        try:
            wait_until(has_drawn, "three pictures")
            os.write(screen, b"q")
            wait_until(has_ended, "its end")
            assert process.wait(timeout=PATIENCE_S) == 0
        finally:
            process.kill()
            process.wait()
            os.close(screen)
    text = shown.decode()
    assert "16 x 32 taxels, 0..255 raw" in text
    # The other screen and the hidden cursor are left again, and the summary stands on the first.
    assert text.index("\x1b[?1049h") < text.rindex("\x1b[?25h\x1b[?1049l") < text.rindex("frames;")
