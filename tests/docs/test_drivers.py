"""The drivers in examples/ against simulated skins: frames, silence, floods, garbage."""

import os
import pty
import socket
import sys
import threading
import tty
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import free_port

import sparseskin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable
from sparseskin.nodes.sensor.sources import open_source

EXAMPLES = Path(__file__).parents[2] / "examples"
UDP_SHAPE = (40, 40)
SERIAL_SHAPE = (12, 32)


@pytest.fixture
def opened(monkeypatch):
    """Open one of the examples, with some of its constants changed."""
    monkeypatch.syspath_prepend(str(EXAMPLES))
    made = []

    def make(name, **constants):
        find_callable(f"{name}:frames", SourceError)
        for key, value in constants.items():
            monkeypatch.setattr(sys.modules[name], key, value)
        made.append(open_source(f"{name}:frames"))
        return made[-1]

    yield make
    for source in made:
        source.close()


class UdpSkin:
    """A skin that sends packets from a thread, again and again, until `stop` is called."""

    def __init__(self, *packets, pause_s=0.001):
        self.port = free_port(socket.SOCK_DGRAM)
        self._packets = packets
        self._pause_s = pause_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as skin:
            while not self._stop.wait(self._pause_s):
                for packet in self._packets:
                    skin.sendto(packet, ("127.0.0.1", self.port))

    def stop(self):
        self._stop.set()
        self._thread.join()


def udp_frame(value):
    return np.full(UDP_SHAPE, value, "<u2").tobytes()


def serial_frame(value):
    taxels = np.full(SERIAL_SHAPE, value, "u1").tobytes()
    return b"\xaa\x55" + taxels + bytes([sum(taxels) % 256])


def taken(source, n):
    return [forces for _, (_, forces) in zip(range(n), source, strict=False)]


def test_packets_become_frames_in_newtons(opened):
    skin = UdpSkin(udp_frame(0), udp_frame(65535))
    source = opened("udp_skin", PORT=skin.port)
    assert source.skin.shape == UDP_SHAPE
    assert source.skin.f_max == 2.5
    frames = taken(source, 20)
    skin.stop()
    assert {float(frame.max()) for frame in frames} == {0.0, 2.5}
    assert all(np.ptp(frame) == 0 for frame in frames)


def test_a_udp_skin_that_falls_silent_is_named(opened):
    skin = UdpSkin(udp_frame(1))
    source = opened("udp_skin", PORT=skin.port, SILENT_S=0.2)
    skin.stop()
    with pytest.raises(
        SourceError, match=r"udp_skin:frames: the driver failed: .* no packet for"
    ):
        taken(source, 10**9)


def test_packets_of_a_wrong_size_are_counted_and_left_out(opened, capsys):
    skin = UdpSkin(*[os.urandom(n) for n in (0, 1, 3199, 3201, 60_000)], udp_frame(7))
    frames = taken(opened("udp_skin", PORT=skin.port), 5)
    skin.stop()
    assert all(np.all(frame == np.float32(7 * 2.5 / 65535)) for frame in frames)
    assert "packets of a wrong size, 0 dropped by the kernel" in capsys.readouterr().out


@pytest.fixture
def line():
    """The skin's end of a serial line, and the name of the other."""
    skin, host = pty.openpty()
    tty.setraw(host)  # as the driver will: nothing is changed that came before
    yield skin, os.ttyname(host)
    os.close(skin)
    os.close(host)


def test_a_serial_line_becomes_frames_in_newtons(opened, line):
    skin, device = line
    writer = threading.Thread(
        target=lambda: [os.write(skin, serial_frame(k)) for k in (51, 102, 255)],
        daemon=True,
    )
    writer.start()
    source = opened("serial_skin", DEVICE=device)
    assert source.skin.shape == SERIAL_SHAPE
    frames = taken(source, 3)
    writer.join()
    assert [round(float(frame[0, 0]), 6) for frame in frames] == [0.5, 1.0, 2.5]


def test_garbage_between_the_frames_of_a_serial_line_is_counted(opened, line, capsys):
    skin, device = line
    cut = serial_frame(9)[:200]  # as after an overrun: the rest never came
    wrong = serial_frame(9)[:-1] + b"\0"
    parts = [
        b"\xaa",
        b"\x55\xaa" * 9,
        cut,
        serial_frame(51),
        wrong,
        b"\x01\x02",
        serial_frame(102),
    ]
    parts += [serial_frame(255)] * 2
    writer = threading.Thread(
        target=lambda: [os.write(skin, p) for p in parts], daemon=True
    )
    writer.start()
    frames = taken(opened("serial_skin", DEVICE=device), 4)
    writer.join()
    assert [round(float(frame[0, 0]), 6) for frame in frames] == [0.5, 1.0, 2.5, 2.5]
    assert all(np.ptp(frame) == 0 for frame in frames)
    assert f"{device}: 1 frames with a wrong sum" in capsys.readouterr().out


def test_skins_that_fall_silent_or_are_not_there_are_named(opened, line):
    skin, device = line
    os.write(skin, serial_frame(1))
    source = opened("serial_skin", DEVICE=device, SILENT_S=0.2)
    with pytest.raises(SourceError, match=f"{device}: nothing came for 0.2 s"):
        taken(source, 10**9)
    with pytest.raises(SourceError, match="No such file or directory: '/dev/no-skin'"):
        opened("serial_skin", DEVICE="/dev/no-skin")


def test_taxels_that_the_glove_of_wuji_lacks_are_masked(monkeypatch):
    pressure = np.where(np.arange(768).reshape(24, 32) % 5, 0.5, np.nan).astype(
        np.float32
    )

    class Glove:  # the part of `wujihandpy` that the driver uses
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def start_streaming(self, call):
            for _ in range(3):
                call(SimpleNamespace(pressure=pressure))

    wujihandpy = SimpleNamespace(tactile=SimpleNamespace(Glove=Glove))
    monkeypatch.setitem(sys.modules, "wujihandpy", wujihandpy)
    monkeypatch.syspath_prepend(str(EXAMPLES))
    settings = ["sensor.source=wuji_glove:frames", "sensor.f_max=1", "sensor.unit=raw"]
    frames = list(sparseskin.run_launch("replay", 3, [*settings, "sensor.nan=mask"]))
    assert [frame.taxels[~np.isnan(pressure)].min() for frame in frames] == [0.5] * 3
