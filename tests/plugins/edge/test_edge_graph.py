"""A graph whose edge is the exported program in C: a process on a pseudo terminal."""

import contextlib
import os
import pty
import subprocess
import threading
import tty

import numpy as np
import pytest
from edges import as_input, compiled

from sparseskin.messages import Measurements, PhiState, Reconstruction, SkinState, decode
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.edge.description import EdgeDescription, compressed, read_frame

pytest.importorskip("serial", reason="pyserial is not installed")

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
    (skin,), (phi,) = recorded(recording, SkinState), recorded(recording, PhiState)
    assert (skin.skin.shape, skin.has_taxels) == ((40, 40), False)
    assert (skin.unit, skin.f_max, phi.rows, phi.m) == ("counts", 4095.0, "rotating", d.m)
    in_c, restored = recorded(recording, Measurements), recorded(recording, Reconstruction)
    # What came before the line was opened is not read: the frames begin somewhere in the cycle.
    cycle = [read_frame(d, sent[4:-2]) for sent in compressed(d, np.tile(counts, (3, 1, 1)))]
    expected = [(f.phi, f.measurements(d.bits, 1.0).tobytes(), f.step) for f in cycle if f]
    found = [(m.phi, m.y.tobytes(), m.y.step) for m in in_c]
    begin = expected.index(found[0])
    assert found == expected[begin : begin + N_FRAMES]
    assert len({phi for phi, _, _ in found}) == 3
    assert len(restored) == N_FRAMES
    assert max(float(m.forces.max()) for m in restored) > 0.1 * d.full_scale
