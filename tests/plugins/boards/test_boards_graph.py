"""A graph whose sensor reads a board: real processes, a pseudo terminal."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from board_lines import Line, a_line
from conftest import StartProgram

from sparseskin.plugins.boards.framing import Framing

FLEXITAC = Framing(16 * 32, start=b"\xaa\x55")
GRAPH = """
[nodes.sensor]
type = "sensor"
source = "{source}"
"""


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    pytest.importorskip("serial")
    with a_line(tmp_path) as found:
        yield found


def flexitac(value: int) -> bytes:
    return FLEXITAC.encode(bytes([value]) * 512)


def test_an_unplugged_board_is_one_line_and_the_graph_goes_on_when_it_is_back(
    start: StartProgram, tmp_path: Path, line: Line
) -> None:
    source = f"serial:{line.device}?profile=flexitac_16x32"
    (tmp_path / "board.toml").write_text(GRAPH.format(source=source))
    program = start("launch", "board.toml", "--summary", "summary.json")
    program.wait_for("[launch] ready")
    line.send(flexitac(1) * 5)
    line.unplug()
    assert program.wait_for("[sensor] ").endswith("the device is gone; waiting for it")
    line.plug()
    assert "is back after" in program.wait_for("[sensor] ")
    line.sending(flexitac(2) for _ in range(10**9))
    program.process.terminate()
    code, stdout, stderr = program.finish()
    assert code in (0, 143)
    assert "Traceback" not in stderr
    assert "the device was gone 1 time" in stdout
    sensor = json.loads((tmp_path / "summary.json").read_text())["nodes"]["sensor"]
    assert sensor["board"]["gone"] == 1
    n_published = sensor["published"].get("/skin/taxels", 0)
    assert sensor["board"]["frames"] == n_published + sensor["board"]["unused_frames"]
