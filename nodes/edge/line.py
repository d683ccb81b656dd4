"""The wire from an edge: a serial line, or packets over UDP."""

from __future__ import annotations

import os
import select
import socket
import termios
import tty
from typing import Protocol

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import did_you_mean

FORMS = ("serial:DEVICE", "udp:PORT")
SILENT_S = 2.0
"""Time without a byte after which the edge counts as gone, seconds. Chosen, as for drivers."""
READ_BYTES = 1 << 16


class Line(Protocol):
    """An open wire.

    Attributes
    ----------
    packets : bool
        True if each read is one packet, False if bytes come in any pieces.
    """

    packets: bool

    def read(self) -> bytes:
        """Return what has come, at least one byte; SourceError if nothing comes for 2 s."""
        ...

    def close(self) -> None:
        """Close the wire."""
        ...


def check_line(source: str) -> None:
    """Raise SourceError unless a source is "serial:DEVICE" or "udp:PORT"."""
    kind, _, rest = source.partition(":")
    if kind == "serial" and rest:
        return
    if kind == "udp" and rest.isdecimal() and 1 <= int(rest) <= 65535:
        return
    known = [form.partition(":")[0] for form in FORMS]
    hint = did_you_mean(kind, known) if kind not in known else ""
    hint = hint if "did you mean" in hint else ""
    port = "; PORT is 1..65535" if kind == "udp" else ""
    raise SourceError(f'"{source}": expected {" or ".join(FORMS)}{port}{hint}')


def open_line(source: str, baud: int) -> Line:
    """Open the wire that a source names.

    Parameters
    ----------
    source : str
        As in `check_line`.
    baud : int
        Symbols a second of a serial line.

    Raises
    ------
    SourceError
        If the source has another form, the device or port cannot be opened, or this system has
        no such symbol rate.
    """
    check_line(source)
    kind, _, rest = source.partition(":")
    return SerialLine(rest, baud) if kind == "serial" else UdpLine(int(rest))


class SerialLine:
    """A serial line of 8 data bits, no parity, one stop bit, raw."""

    packets = False

    def __init__(self, device: str, baud: int) -> None:
        speed = getattr(termios, f"B{baud}", None)
        if speed is None:
            allowed = sorted(int(name[1:]) for name in dir(termios) if name[1:].isdecimal())
            known = ", ".join(str(rate) for rate in allowed if rate >= 9600)
            raise SourceError(f"baud: {baud} is not known to this system; allowed: {known}")
        self._device = device
        try:
            self._fd = os.open(device, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise SourceError(f"{device}: {error.strerror}") from error
        try:
            tty.setraw(self._fd, termios.TCSANOW)
            state = termios.tcgetattr(self._fd)
            state[4] = state[5] = speed  # both ways
            termios.tcsetattr(self._fd, termios.TCSANOW, state)
        except termios.error as error:
            os.close(self._fd)
            raise SourceError(f"{device}: is no serial line ({error.args[-1]})") from error

    def read(self) -> bytes:
        if not select.select([self._fd], [], [], SILENT_S)[0]:
            raise SourceError(f"{self._device}: nothing came for {SILENT_S:g} s")
        try:
            data = os.read(self._fd, READ_BYTES)
        except OSError as error:
            raise SourceError(f"{self._device}: {error.strerror}") from error
        if not data:
            raise SourceError(f"{self._device}: the device is gone")
        return data

    def close(self) -> None:
        os.close(self._fd)


class UdpLine:
    """UDP packets to a port of this host."""

    packets = True

    def __init__(self, port: int) -> None:
        self._port = port
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("", port))
        except OSError as error:
            self._socket.close()
            raise SourceError(f"udp:{port}: {error.strerror}") from error
        self._socket.settimeout(SILENT_S)

    def read(self) -> bytes:
        try:
            return self._socket.recv(READ_BYTES)
        except TimeoutError as error:
            raise SourceError(f"udp:{self._port}: no packet for {SILENT_S:g} s") from error

    def close(self) -> None:
        self._socket.close()
