"""Boards on a pseudo terminal, at a UDP port of the loopback interface and on a virtual CAN bus; a
graph of real processes whose sensor reads one.
"""

import json
import random
import socket
import struct
import time
import uuid
from binascii import crc_hqx
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from board_lines import a_line, flexitac, send_packets
from conftest import free_port, wait_until

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.sources import open_source
from sparseskin.plugins.boards import serial_port, udp_port
from sparseskin.plugins.boards import source as source_module
from sparseskin.plugins.boards.framing import Framing
from sparseskin.plugins.boards.source import dropped_text

WAIT_S = 0.05


@pytest.fixture
def line(tmp_path):
    pytest.importorskip("serial")
    with a_line(tmp_path) as found:
        yield found


@pytest.fixture
def opened():
    """Open a board; it is closed at the end."""
    made = []

    def make(source, layout=EMPTY):
        found = open_source(source, seed=0, layout=layout)
        made.append(found)
        return found

    yield make
    for one in made:
        one.close()


def taken(source, n):
    """The next frames of a board, waited for."""
    frames = []

    def enough():
        frame = source.next_frame(WAIT_S)
        frames.extend([] if frame is None else [frame])
        return len(frames) >= n

    wait_until(enough, f"{n} frames")
    return frames


def logged(source, text):
    """The next line of the log that holds a text."""
    found = []

    def said():
        assert source.next_frame(WAIT_S) is None
        found.extend(source.take_lines())
        return any(text in one for one in found)

    wait_until(said, text)
    return next(one for one in found if text in one)


class TestSerial:
    def test_a_flood_of_frames_is_read_in_order_and_none_is_lost(self, line, opened):
        source = opened(f"serial:{line.device}?profile=flexitac_16x32")
        line.sending(flexitac(k % 170) for k in range(301))
        frames = taken(source, 300)
        assert [int(forces[0, 0]) for _, forces in frames] == [
            k % 170 for k in range(300)
        ]
        assert all(
            np.ptp(forces) == 0 and forces.shape == (16, 32) for _, forces in frames
        )
        stamps = [stamp for stamp, _ in frames]
        assert all(b > a for a, b in pairwise(stamps))
        figures = source.figures()
        assert figures.pop("frames") == 300
        assert not any(figures.values())

    def test_what_is_dropped_is_counted_byte_by_byte(self, line, opened):
        source = opened(
            f"serial:{line.device}?n_rows=16&n_cols=32&start=AA55&checksum=crc16"
        )
        framing = Framing(512, start=b"\xaa\x55", checksum="crc16")
        good = framing.encode(bytes(512))
        noise = b"\x01" * 777
        wrong = good[:100] + b"\xff" + good[101:]
        line.sending([noise, good, wrong, good, good[:50], good])
        assert len(taken(source, 3)) == 3
        counts = source.counts
        assert counts.frames == 3
        assert counts.bad_frames == 2
        assert counts.dropped_bytes == 777 + len(wrong) + 50
        assert (
            dropped_text(source.figures())
            == f"2 bad frames, {777 + len(wrong) + 50} bytes"
        )

    def test_a_silent_board_and_a_wrong_profile_are_told_apart(
        self, line, opened, monkeypatch
    ):
        monkeypatch.setattr(source_module, "SILENT_S", 0.05)
        name = f"serial:{line.device}?profile=flexitac_12x32"
        source = opened(name)
        assert logged(source, "came").endswith(": nothing came for 0.05 s")
        with pytest.raises(SourceError, match="another program has it open"):
            opened(name)
        source.close()
        source = opened(f"serial:{line.device}?profile=flexitac_12x32")
        line.sending([flexitac(3)] * 12)
        text = logged(source, "came")
        assert "no frame of 386 bytes: check start, n_rows, n_cols" in text
        assert text.endswith("from AA 55 to AA 55 it is 514 bytes, 512 of readings")


class TestUdp:
    NUMBERED = Framing(6 * 4, start=b"", sequence_bytes=2, checksum="crc32")
    QUERY = "n_rows=2&n_cols=3&dtype=float32&sequence=u16&checksum=crc32&f_max=4&unit=N"

    def frame(self, value, number):
        return self.NUMBERED.encode(np.full(6, value, "<f4").tobytes(), number)

    def test_packets_of_one_or_more_frames_are_read_and_others_counted(self, opened):
        port = free_port(socket.SOCK_DGRAM)
        source = opened(f"udp:{port}?{self.QUERY}")
        other = opened(
            f"udp:{free_port(socket.SOCK_DGRAM)}?n_rows=2&n_cols=3&sender=127.0.0.2"
        )
        send_packets(int(other.name.partition(":")[2]), bytes(6))
        one = self.frame(1, 1)
        two = self.frame(2, 2)
        five = self.frame(9, 5)
        wrong = bytes([one[0] ^ 1]) + one[1:]
        send_packets(
            port, one + two, b"", one[:-1], wrong, one, self.frame(np.nan, 3), five
        )
        frames = taken(source, 3)
        # 9 N is clipped to the range; number 4 never came, number 1 came twice.
        assert [float(forces[0, 0]) for _, forces in frames] == [1, 2, 4]
        assert source.clipped.n_above == 6
        assert source.clipped.n == 6
        assert source.clipped.highest == 9.0
        figures = source.figures()
        assert figures["bad_frames"] == 3
        assert figures["not_finite_frames"] == 1
        assert figures["missing_frames"] == 1
        assert figures["late_frames"] == 1
        assert other.next_frame(WAIT_S) is None
        assert other.figures()["other_senders"] == 1

    def test_frames_of_other_senders_are_dropped_and_counted(self, opened, monkeypatch):
        port = free_port(socket.SOCK_DGRAM)
        source = opened(f"udp:{port}?n_rows=2&n_cols=3&sequence=u32")
        framing = Framing(6, sequence_bytes=4)
        send_packets(port, b"no frame")  # of nobody who is then the sender
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            board.connect(("127.0.0.1", port))
            board.send(framing.encode(bytes([1] * 6), 7))
            taken(source, 1)
            send_packets(
                port, *(framing.encode(bytes([9] * 6), k << 20) for k in range(300))
            )
            board.send(framing.encode(bytes([2] * 6), 8))
            # no board has lost so many
            board.send(framing.encode(bytes([3] * 6), 2**31))
            assert [forces.max() for _, forces in taken(source, 2)] == [2, 3]
            (line,) = source.take_lines()
            assert line.endswith(
                f" are dropped; 127.0.0.1:{board.getsockname()[1]} is the sender"
            )
        figures = source.figures()
        assert figures["other_senders"] == 300
        assert figures["missing_frames"] == 0
        assert "300 packets of other senders" in source.dropped()
        monkeypatch.setattr(udp_port, "HOLD_S", 0.0)  # as if the board had been silent
        send_packets(port, framing.encode(bytes([4] * 6), 1))
        assert taken(source, 1)[0][1].max() == 4
        assert source.take_lines()[0].endswith(" is the sender now")

    def test_a_reading_that_is_no_number_is_missing_where_that_is_allowed(self, opened):
        port = free_port(socket.SOCK_DGRAM)
        source = opened(f"udp:{port}?{self.QUERY}", Layout(nan="mask"))
        readings = np.array([0, np.nan, 9, np.inf, -np.inf, 1], "<f4")
        send_packets(port, self.NUMBERED.encode(readings.tobytes(), 1))
        ((_, forces),) = taken(source, 1)
        np.testing.assert_array_equal(forces.ravel(), [0, np.nan, 4, np.nan, np.nan, 1])
        assert source.clipped.n == 1
        assert source.clipped.highest == 9.0

    def test_a_count_that_is_stated_to_be_missing_is_no_reading(self, opened):
        port = free_port(socket.SOCK_DGRAM)
        source = opened(f"udp:{port}?{self.QUERY}", Layout(missing="-1"))
        readings = np.array([0, -1, 3, 2, -1, 1], "<f4")
        send_packets(port, self.NUMBERED.encode(readings.tobytes(), 1))
        ((_, forces),) = taken(source, 1)
        np.testing.assert_array_equal(forces.ravel(), [0, np.nan, 3, 2, np.nan, 1])

    def test_what_the_kernel_drops_is_counted(self, opened):
        port = free_port(socket.SOCK_DGRAM)
        source = opened(f"udp:{port}?n_rows=100&n_cols=100")
        n_sent = 3000
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as board:
            board.connect(("127.0.0.1", port))
            for _ in range(n_sent):
                board.send(bytes(10_000))
            n = 0
            while source.next_frame(0.2) is not None:
                n += 1
            board.send(bytes(10_000))  # with it comes the number
            n += len(taken(source, 1))
        assert n + source.figures()["kernel_packets"] == n_sent + 1
        with pytest.raises(
            SourceError, match=f"port {port} of 127.0.0.1 cannot be opened: Addr"
        ):
            opened(f"udp:{port}?n_rows=2&n_cols=3")


class TestCan:
    def test_frames_come_over_a_virtual_bus(self, opened):
        can = pytest.importorskip("can")
        channel = uuid.uuid4().hex
        query = "n_rows=8&n_cols=8&ids=0x18DA0001-0x18DA0002&fd=true&dtype=uint16&interface=virtual"
        source = opened(f"can:{channel}?{query}")
        with can.Bus(channel=channel, interface="virtual") as bus:
            for number in range(20):
                raw = (np.arange(64, dtype="<u2") * 256 + number).tobytes()
                for k, one in enumerate((0x18DA0001, 0x18DA0002)):
                    data = raw[64 * k : 64 * (k + 1)]
                    bus.send(can.Message(arbitration_id=one, data=data, is_fd=True))
                bus.send(
                    can.Message(
                        arbitration_id=0x7F0, data=b"other", is_extended_id=False
                    )
                )
            frames = taken(source, 20)
        for number, (_, forces) in enumerate(frames):
            np.testing.assert_array_equal(forces.ravel(), np.arange(64) * 256 + number)
        assert source.counts.frames == 20
        assert not dropped_text(source.figures())


def test_frames_before_the_start_and_while_paused_are_counted_as_unused(line):
    settings = Sensor.Settings(source=f"serial:{line.device}?profile=flexitac_16x32")
    sensor = Sensor(settings, Context("sensor", ManualClock(10**18)))
    board = sensor._source

    def idle_until(n_unused):
        def reached():
            sensor.idle()
            return board.n_unused == n_unused

        wait_until(reached, f"{n_unused} unused frames")

    line.sending([flexitac(1)] * 4)
    idle_until(3)
    sensor.begin(10**18)
    sensor.command("pause", True)
    line.sending([flexitac(1)] * 4)
    idle_until(7)
    # A board does not stop sending: what nobody reads would be lost uncounted.
    assert not sensor.follows_readers
    sensor.close({})


@pytest.mark.parametrize("clock", ["source", "arrival"])
def test_frames_of_a_board_with_a_clock_have_its_time(line, monkeypatch, clock):
    """A board whose clock is 100 ppm fast, wraps and restarts, with 5 ms of jitter."""
    query = "n_rows=2&n_cols=3&start=A55A&sequence=u16&skip=4&stamp=u32&stamp_at=4&checksum=crc16"
    now = ManualClock(10**18)
    here = SimpleNamespace(monotonic_ns=now.now_ns, monotonic=time.monotonic)
    monkeypatch.setattr(serial_port, "time", here)
    monkeypatch.setattr(source_module, "time", here)
    logged = []
    source = f"serial:{line.device}?{query}"
    sensor = Sensor(
        Sensor.Settings(source=source, clock=clock), Context("s", now, logged.append)
    )
    list(sensor.start())
    sensor.begin(now.now_ns())
    rng = random.Random(0)
    begin_ns = now.now_ns()
    stamps = []
    late_ms = []
    for k in range(1700):
        true_ns = begin_ns + k * 10**7
        now.advance(max(0, true_ns + rng.randint(0, 5 * 10**6) - now.now_ns()))
        up_ns = (true_ns - begin_ns) * 1.0001 + (
            2**32 - 5 * 10**6 if k < 1000 else -(10**10)
        ) * 1e3
        line.send(frame_with_stamp(k, int(up_ns / 1000) % 2**32))
        stamps.append(next_stamp(sensor, now.now_ns()))
        late_ms.append((stamps[-1] - true_ns) / 1e6)
        assert stamps[-1] <= now.now_ns()
    assert all(b > a for a, b in pairwise(stamps))
    state = sensor.state()
    within = max(map(abs, late_ms[500:1000] + late_ms[1500:]))
    sensor.close({})
    assert state["clock"] == clock
    if clock == "arrival":
        assert within > 4.5
        return
    assert within < 0.5
    assert logged == [
        f"serial:{line.device}: its clock was set or started again; it is mapped anew"
    ]
    assert state["clock_drift_ppm"] == pytest.approx(
        100, abs=3 * state["clock_drift_sd_ppm"]
    )
    assert (
        sensor.report()["clock_jitter_after_ms"]
        < 0.1
        < 1
        < state["clock_jitter_before_ms"]
    )


def frame_with_stamp(number, stamp):
    """A frame with a stamp: A5 5A, u16 number, u32 stamp, 6 readings, CRC-16."""
    body = struct.pack("<HI6B", number, stamp, *range(6))
    return b"\xa5\x5a" + body + struct.pack("<H", crc_hqx(body, 0xFFFF))


def next_stamp(sensor, now_ns):
    """Stamp of the next frame, waited for."""
    found = []

    def came():
        found.extend(sensor.acquire(Tick(now_ns, 0)))
        return bool(found)

    wait_until(came, "a frame")
    return found[0].stamp_ns


GRAPH = """
[nodes.sensor]
type = "sensor"
source = "{source}"
"""


def test_an_unplugged_board_is_one_line_until_it_is_back(start, tmp_path, line):
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
    stdout, _ = program.ended(0, 143)
    assert "the device was gone 1 time" in stdout
    sensor = json.loads((tmp_path / "summary.json").read_text())["nodes"]["sensor"]
    assert sensor["board"]["gone"] == 1
    n_published = sensor["published"].get("/skin/taxels", 0)
    assert sensor["board"]["frames"] == n_published + sensor["board"]["unused_frames"]
