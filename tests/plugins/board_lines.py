"""Emulated boards: a pseudo terminal that can be unplugged, and packets to a UDP port."""

import contextlib
import os
import pty
import select
import socket
import threading
import time
import tty
from collections.abc import Iterable, Iterator
from pathlib import Path

PATIENCE_S = 60.0
"""When a send is given up, seconds: far beyond what any takes."""


class Line:
    """A serial port whose device is a link; `unplug` removes it, as when a cable is drawn."""

    def __init__(self, folder: Path) -> None:
        self.device = folder / "ttyTEST"
        self._fd = -1
        self.plug()

    def plug(self) -> None:
        """Plug the board in: a new device of the same name."""
        self._fd, host = pty.openpty()
        tty.setraw(host)
        os.set_blocking(self._fd, False)
        self.device.symlink_to(os.ttyname(host))
        self._host = host

    def unplug(self) -> None:
        """Draw the cable."""
        self.device.unlink()
        fd, self._fd = self._fd, -1
        os.close(fd)
        os.close(self._host)

    def send(self, data: bytes) -> None:
        """Send bytes; a line that is full waits for its reader. OSError once it is unplugged."""
        deadline = time.monotonic() + PATIENCE_S
        while data:
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                assert time.monotonic() < deadline, "nobody reads the line"
                select.select([], [self._fd], [], 0.05)

    def sending(self, pieces: Iterable[bytes]) -> threading.Thread:
        """Send from a thread."""

        def run() -> None:
            # the test has closed the line
            with contextlib.suppress(OSError, ValueError):
                for piece in pieces:
                    self.send(piece)

        thread = threading.Thread(target=run, daemon=True)
        thread.start()
        return thread

    def close(self) -> None:
        if self._fd >= 0:
            self.unplug()


@contextlib.contextmanager
def a_line(folder: Path) -> Iterator[Line]:
    """A line that is closed at the end."""
    line = Line(folder)
    try:
        yield line
    finally:
        line.close()


def flexitac(value: int) -> bytes:
    """A frame of the profile flexitac_16x32, all readings the same."""
    return b"\xaa\x55" + bytes([value]) * 512


def send_packets(port: int, *packets: bytes) -> None:
    """Send packets to a port of the loopback interface."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
        for packet in packets:
            board.sendto(packet, ("127.0.0.1", port))
