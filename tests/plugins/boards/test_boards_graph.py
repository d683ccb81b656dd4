"""Graphs whose sensor reads a board: real processes, a pseudo terminal, UDP, a virtual CAN bus."""

from __future__ import annotations

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from board_lines import Line, a_line, send_packets
from conftest import Program, StartProgram, free_port

from sparseskin.plugins.boards.framing import Framing

FLEXITAC = Framing(16 * 32, start=b"\xaa\x55")
GRAPH = """
[nodes.sensor]
type = "sensor"
source = "{source}"

[nodes.recorder]
type = "recorder"
out = "board.mcap"
"""


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    pytest.importorskip("serial")
    with a_line(tmp_path) as found:
        yield found


def flexitac(value: int) -> bytes:
    return FLEXITAC.encode(bytes([value]) * 512)


def launched(
    start: StartProgram, folder: Path, source: str, *words: str, more: str = ""
) -> Program:
    (folder / "board.toml").write_text(GRAPH.format(source=source, more=more))
    return start("launch", "board.toml", "--summary", "summary.json", *words)


def board_of(folder: Path) -> tuple[int, dict[str, Any]]:
    """Frames that the sensor has published, and the figures of its board."""
    sensor = json.loads((folder / "summary.json").read_text())["nodes"]["sensor"]
    return sensor["published"].get("/skin/taxels", 0), sensor["board"]


class Sending:
    """Calls `send` again and again, in a thread, until it is stopped."""

    def __init__(self, send: Any) -> None:
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(send,), daemon=True)
        self._thread.start()

    def _run(self, send: Any) -> None:
        with contextlib.suppress(OSError, ValueError):  # the line is closed
            while not self._stop.wait(0.005):
                send()

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def test_an_unplugged_board_is_one_line_and_the_graph_goes_on_when_it_is_back(
    start: StartProgram, tmp_path: Path, line: Line
) -> None:
    program = launched(start, tmp_path, f"serial:{line.device}?profile=flexitac_16x32")
    program.wait_for("[launch] ready")
    line.send(flexitac(1) * 5)
    line.unplug()
    assert program.wait_for("[sensor] ").endswith("the device is gone; waiting for it")
    line.plug()
    assert "is back after" in program.wait_for("[sensor] ")
    sending = Sending(lambda: line.send(flexitac(2)))
    program.process.terminate()
    code, stdout, stderr = program.finish()
    line.close()
    sending.stop()
    assert code in (0, 143)
    assert "Traceback" not in stderr
    assert "the device was gone 1 time" in stdout
    n_published, board = board_of(tmp_path)
    assert board["gone"] == 1
    assert board["frames"] == n_published + board["unused_frames"]


def test_frames_over_udp_come_through_a_graph(start: StartProgram, tmp_path: Path) -> None:
    port = free_port(socket.SOCK_DGRAM)
    source = f"udp:{port}?rows=4&cols=4&dtype=uint16&byte_order=big"
    program = launched(start, tmp_path, source, "--frames", "30")
    program.wait_for("[launch] ready")
    frame = np.full(16, 300, ">u2").tobytes()
    sending = Sending(lambda: send_packets(port, frame, frame + b"\0"))
    code, stdout, _ = program.finish()
    sending.stop()
    assert code == 0
    n_published, board = board_of(tmp_path)
    assert n_published == 30
    assert board["bad_frames"] > 0
    assert "sensor: dropped: " in stdout


def test_frames_over_a_can_bus_of_several_processes_come_through_a_graph(
    start: StartProgram, tmp_path: Path
) -> None:
    can = pytest.importorskip("can")
    group, options = "239.74.163.2", {"interface": "udp_multicast", "fd": True}
    try:
        bus = can.Bus(channel=group, **options)
    except (can.CanError, OSError) as error:
        pytest.skip(f"no multicast here: {error}")
    source = f"can:{group}?rows=8&cols=16&ids=0x155-0x156&fd=true&interface=udp_multicast"
    with bus:
        program = launched(start, tmp_path, source, "--frames", "30")
        program.wait_for("[launch] ready")

        def send() -> None:
            for k in range(2):
                bus.send(
                    can.Message(
                        arbitration_id=0x155 + k, data=bytes(64), is_fd=True, is_extended_id=False
                    )
                )

        sending = Sending(send)
        code, _, stderr = program.finish()
        sending.stop()
    assert code == 0, stderr
    assert board_of(tmp_path)[0] == 30
