"""A graph whose edge is the exported program in C: a process on a pseudo terminal."""

from __future__ import annotations

import contextlib
import os
import pty
import subprocess
import threading
import tty
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from conftest import StartProgram
from edges import as_input, compiled

from sparseskin.messages import (
    Measurements,
    PhiState,
    Reconstruction,
    SkinState,
    Taxels,
    decode,
)
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor, CompressorSettings
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.scenes.scenes import open_scene
from sparseskin.plugins.edge.description import EdgeDescription
from sparseskin.plugins.edge.frames import read_frame
from sparseskin.plugins.edge.twin import compressed

pytest.importorskip("serial", reason="pyserial is not installed")

N_FRAMES = 40


def counts_of_scene(n: int, full_scale: int) -> npt.NDArray[np.uint16]:
    """Frames of a peg that is dropped on 40 x 40 taxels, with noise, in counts."""
    scene = open_scene("path_40", seed=0)
    rng = np.random.default_rng(0)
    found = []
    for k, (_, forces) in enumerate(scene):
        if len(found) == n:
            break
        if k >= 300 and k % 5 == 0:
            noisy = forces / scene.skin.f_max + rng.normal(0, 0.006, forces.shape)
            found.append(np.rint(np.clip(noisy, 0, 1) * full_scale))
    return np.array(found, dtype=np.uint16)


def _feed(edge: subprocess.Popen[bytes], counts: bytes) -> None:
    """Write counts to a program again and again, as fast as it reads them, until it ends."""
    assert edge.stdin is not None
    with contextlib.suppress(OSError):
        while True:
            edge.stdin.write(counts)
    with contextlib.suppress(OSError):
        edge.stdin.close()


def recorded(path: Path, kind: type[Any]) -> list[Any]:
    with BagReader(path) as bag:
        topics = [f"/skin/{kind.schema}"]
        return [decode(m.topic.encode(), m.payload) for m in bag.messages(topics)]


def by_python(
    d: EdgeDescription, skin: SkinState, counts: npt.NDArray[np.uint16], begin: int
) -> tuple[list[Measurements], list[Reconstruction]]:
    """Measurements and reconstructions of the nodes in Python, for the same counts, again and
    again, from frame `begin` on.
    """
    made = {"rows": d.rows, "m": d.m, "bits": d.bits, "block": d.block, "seed": d.seed}
    compressor = Compressor(CompressorSettings(**made), Context("c", ManualClock(1)))  # type: ignore[arg-type]
    reconstructor = Reconstructor(ReconstructorSettings(), Context("r", ManualClock(1)))
    list(reconstructor.step(skin))
    for state in compressor.step(skin):
        list(reconstructor.step(state))
    measured, restored = [], []
    for k in range(begin + N_FRAMES):
        forces = counts[k % len(counts)].astype(np.float32)
        (message,) = compressor.step(Taxels(stamp_ns=k + 2, patch="skin", forces=forces))
        if k < begin:
            continue
        assert isinstance(message, Measurements)
        measured.append(message)
        restored += [m for m in reconstructor.step(message) if isinstance(m, Reconstruction)]
    return measured, restored


def test_its_frames_are_reconstructed_as_those_of_the_edge_in_python(
    start: StartProgram, tmp_path: Path
) -> None:
    d = EdgeDescription.chosen(40, 40, ratio=3, bits=8, rows="rotating")
    out = compiled(d, tmp_path)
    counts = counts_of_scene(N_FRAMES, d.full_scale)
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
    in_c, restored_in_c = recorded(recording, Measurements), recorded(recording, Reconstruction)
    # What came before the line was opened is not read: the frames begin somewhere in the cycle.
    cycle = [read_frame(d, sent[4:-2]) for sent in compressed(d, np.tile(counts, (3, 1, 1)))]
    begin = [frame.measurements(d.bits, 1.0).tobytes() for frame in cycle if frame].index(
        in_c[0].y.tobytes()
    )
    measured, restored = by_python(d, skin, counts, begin)
    assert [m.y.tobytes() for m in in_c] == [m.y.tobytes() for m in measured]
    assert [m.y.step for m in in_c] == [m.y.step for m in measured]  # type: ignore[attr-defined]
    assert [m.phi for m in in_c] == [m.phi for m in measured]
    assert len({m.phi for m in in_c}) == 3
    assert [m.forces.tobytes() for m in restored_in_c] == [m.forces.tobytes() for m in restored]
    assert max(float(m.forces.max()) for m in restored) > 0.1 * d.full_scale
