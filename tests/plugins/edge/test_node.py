"""The node that reads frames of the edge, by itself and in a graph."""

import contextlib
import os
import pty
import socket
import subprocess
import threading
import tty

import numpy as np
import pytest
from board_lines import a_line, send_packets
from conftest import free_port, wait_until
from damaged import refusal
from edges import as_input, compiled, random_counts
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import (
    Measurements,
    PhiState,
    Reconstruction,
    SkinState,
    decode,
)
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.quantiser import quantised
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.edge.description import (
    EdgeDescription,
    compressed,
    read_frame,
    stated,
)
from sparseskin.plugins.edge.node import Edge

pytest.importorskip("serial", reason="pyserial is not installed")

D = EdgeDescription.chosen(6, 8, ratio=3, bits=10, rows="rotating")
COUNTS = random_counts(D, 12)
FRAMES = list(compressed(D, COUNTS))
OTHER = list(compressed(EdgeDescription.chosen(6, 8, ratio=3, bits=10, seed=1), COUNTS))


@pytest.fixture
def described(tmp_path):
    path = tmp_path / "edge.toml"
    path.write_text(D.to_toml())
    return str(path)


@pytest.fixture
def line(tmp_path):
    with a_line(tmp_path) as found:
        yield found


def opened(lines=None, **settings):
    log = (lines if lines is not None else []).append
    return Edge(Edge.Settings(**settings), Context("edge", ManualClock(5), log))


def received(node, n):
    found = []
    wait_until(
        lambda: len(found) >= n or bool(found.extend(node.tick(Tick(0, 0)))), "frames"
    )
    assert all(isinstance(message, Measurements) for message in found)
    return found


@pytest.mark.parametrize(("f_max", "unit"), [(None, None), (2.5, "N")])
def test_it_publishes_skin_phi_and_codes_times_a_step(f_max, unit, described, line):
    node = opened(
        source=f"serial:{line.device}", description=described, f_max=f_max, unit=unit
    )
    skin, phi = node.start()
    stated = (skin.skin.shape, skin.f_max, skin.unit, skin.has_taxels)
    assert stated == ((6, 8), f_max or 4095, unit or "counts", False)
    assert phi.fingerprint == D.phi.fingerprint
    assert phi.m == 16
    assert phi.rows == "rotating"
    thread = line.sending(FRAMES)
    messages = received(node, len(FRAMES))
    thread.join()
    node.close({})
    for k, (message, counts) in enumerate(zip(messages, COUNTS, strict=True)):
        subset = D.subsets[k % 4]
        y = quantised(subset.forward(counts.reshape(-1).astype(np.float32)), 10)
        assert message.phi == subset.fingerprint
        if f_max is None:
            assert message.y.tobytes() == y.tobytes()
        else:
            np.testing.assert_allclose(message.y[0], y * (f_max / 4095), rtol=3e-7)


def test_lost_damaged_and_foreign_bytes_cost_themselves_alone(described, line):
    lines = []
    node = opened(lines, source=f"serial:{line.device}", description=described)
    damaged = FRAMES[3][:20] + b"\x00\x01" + FRAMES[3][22:]
    parts = [
        FRAMES[0][5:],
        b"\xaa",
        FRAMES[1],
        FRAMES[2][:7],
        damaged,
        b"\xaa\xaa\x55",
        FRAMES[5],
    ]
    thread = line.sending([*parts, OTHER[6], FRAMES[7]])
    messages = received(node, 3)
    thread.join()
    node.close({})
    assert [m.phi for m in messages] == [
        D.subsets[k % 4].fingerprint for k in (1, 5, 7)
    ]
    report = node.report()["board"]
    assert report["frames"] == 3
    assert report["missing_frames"] == 3
    assert report["other_matrix"] == 1
    assert report["bad_frames"] >= 1
    (stranger,) = (text for text in lines if "another matrix" in text)
    tag = int.from_bytes(OTHER[6][5:9], "little")
    assert f"the last {tag:08x}; described {D.phi.fingerprint[:8]}" in stranger
    assert stated(b"\x02" + OTHER[6][5:13]) == "form 2, read is 1"


@given(data=st.binary(min_size=8 + D.code_bytes, max_size=8 + D.code_bytes))
def test_a_payload_of_any_bytes_is_refused_or_has_codes_of_its_bits(data):
    for payload in (data, FRAMES[0][4:8] + data[4:]):
        frame = read_frame(D, payload)
        if frame is None:
            continue
        assert frame.phi in D.tags.values()
        assert 0 < frame.step < np.inf
        assert np.abs(frame.codes).max() <= 511


def test_packets_are_whole_frames_or_counted(described):
    port = free_port(socket.SOCK_DGRAM)
    node = opened(source=f"udp:{port}", description=described)
    packets = (FRAMES[0], b"", FRAMES[1][:-1], FRAMES[1] + b"\0", OTHER[2], FRAMES[3])
    send_packets(port, *packets)
    messages = received(node, 2)
    node.close({})
    assert [m.phi for m in messages] == [D.subsets[k].fingerprint for k in (0, 3)]
    report = node.report()["board"]
    assert report["frames"] == 2
    assert report["missing_frames"] == 1
    assert report["other_matrix"] == 1
    assert report["bad_frames"] >= 2


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"source": "seral:/dev/x"}, "(did you mean 'serial'?)"),
        (
            {"source": "serial:/dev/x?boud=9600"},
            "boud: unknown key (did you mean 'baud'?)",
        ),
        ({"source": "udp:70000"}, "is no port"),
        ({"source": "udp:0050051111"}, "is no port"),
        ({"description": "none.toml"}, "description: none.toml: cannot be read"),
        ({"f_max": 0.0}, "f_max: 0.0 is outside"),
    ],
)
def test_settings_are_refused_by_name(settings, line, described):
    assert line in refusal(
        lambda: Edge.Settings(
            **{"source": "udp:5", "description": described, **settings}
        ).check(),
        SparseskinError,
    )


N_FRAMES = 40


def _feed(edge, counts):
    """Write counts to a program again and again, as fast as it reads them, until it ends."""
    with contextlib.suppress(OSError):
        while True:
            edge.stdin.write(counts)
    with contextlib.suppress(OSError):
        edge.stdin.close()


def recorded(path, kind):
    with BagReader(path) as bag:
        topics = [f"/skin/{kind.schema}"]
        return [decode(m.topic.encode(), m.payload) for m in bag.messages(topics)]


def test_its_frames_are_recorded_with_their_bits_and_reconstructed(start, tmp_path):
    d = EdgeDescription.chosen(40, 40, ratio=3, bits=8, rows="rotating")
    out = compiled(d, tmp_path)
    rng = np.random.default_rng(0)
    counts = rng.integers(0, d.full_scale, (N_FRAMES, 40, 40), np.uint16, endpoint=True)
    board, host = pty.openpty()
    tty.setraw(host)
    edge = subprocess.Popen([out / "edge_stream"], stdin=subprocess.PIPE, stdout=board)
    feed = threading.Thread(target=_feed, args=(edge, as_input(d, counts)), daemon=True)
    feed.start()
    try:
        program = start(
            *("launch", "edge", "--frames", str(N_FRAMES), "--record", "out.mcap"),
            *("--set", f"edge.source=serial:{os.ttyname(host)}"),
            *("--set", f"edge.description={out / 'edge.toml'}"),
            *("--set", "reconstructor.depth=0"),  # frames come as fast as they are read
            *("--set", "monitor.page=false"),
        )
        program.wait_for("[launch] ready")
        code, _, stderr = program.finish()
    finally:
        edge.kill()
        edge.wait()
        feed.join()
        os.close(board)
        os.close(host)
    assert code == 0, stderr
    recording = tmp_path / "out.mcap"
    (skin,) = recorded(recording, SkinState)
    (phi,) = recorded(recording, PhiState)
    assert skin.skin.shape == (40, 40)
    assert not skin.has_taxels
    assert skin.unit == "counts"
    assert skin.f_max == 4095.0
    assert phi.rows == "rotating"
    assert phi.m == d.m
    in_c = recorded(recording, Measurements)
    restored = recorded(recording, Reconstruction)
    # What came before the line was opened is not read: the frames begin somewhere in the cycle.
    cycle = [
        read_frame(d, sent[4:-2]) for sent in compressed(d, np.tile(counts, (3, 1, 1)))
    ]
    expected = [
        (f.phi, f.measurements(d.bits, 1.0).tobytes(), f.step) for f in cycle if f
    ]
    found = [(m.phi, m.y.tobytes(), m.y.step) for m in in_c]
    begin = expected.index(found[0])
    assert found == expected[begin : begin + N_FRAMES]
    assert len({phi for phi, _, _ in found}) == 3
    assert len(restored) == N_FRAMES
    assert max(float(m.forces.max()) for m in restored) > 0.1 * d.full_scale
