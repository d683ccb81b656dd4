"""Lean nodes: the least that carries frames over ZeroMQ, as a yardstick for the shipped nodes.

Sensor, edge and host are a process each. A frame is a struct header and the bytes of one array; a
node waits in a receive that blocks. Phi, solver and frames are those of the graph that they stand
beside. Nothing is checked, watched, numbered, restarted or shown: no graph should run like this.
"""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zmq

from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.lookup import find_callable
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.studies.points import StudyError

NODES = ("sensor", "edge", "host")
HEADER = struct.Struct("<qq")
"""Number of the frame, and the time of its acquisition, ns."""
GO = b"go"
"""A frame before the first one: all nodes of the chain are ready."""
LINGER_MS = 10_000
"""Time for which a node that ends still sends its last frame; chosen."""

Notes = list[tuple[int, int, int]]
"""Of each frame: stamp, time from there until it had been sent or solved, processor time; ns."""


def packed(number: int, stamp_ns: int, array: Floats) -> bytes:
    """Return the buffer of a frame."""
    return HEADER.pack(number, stamp_ns) + array.tobytes()


def unpacked(buffer: bytes) -> tuple[int, int, Floats]:
    """Return number, stamp and array, float32 of one dimension, of a buffer."""
    number, stamp_ns = HEADER.unpack_from(buffer)
    return number, stamp_ns, np.frombuffer(buffer, np.float32, offset=HEADER.size)


def run_lean(point: dict[str, Any]) -> dict[str, Any]:
    """Run the three nodes on the frames of a point; return the notes of each, int64 (n, 3).

    `point`: scene, rate_hz, n_frames, iterations. Raises StudyError if a node fails.
    """
    with tempfile.TemporaryDirectory(prefix="sparseskin-lean-") as folder:
        text = json.dumps({**point, "folder": folder})
        command = [sys.executable, "-m", __name__, text]
        started: dict[str, subprocess.Popen[str]] = {}
        texts = {}
        try:
            for node in NODES:
                started[node] = subprocess.Popen(
                    [*command, node], stdout=subprocess.PIPE, text=True
                )
            for node, process in started.items():
                texts[node], _ = process.communicate()
        finally:
            # If one has failed, the others wait for it for ever.
            for process in started.values():
                process.kill()
    for node, process in started.items():
        if process.returncode:
            raise StudyError(f"lean nodes: {node} failed")

    notes = {}
    for node, text in texts.items():
        notes[node] = np.array(json.loads(text), dtype=np.int64)
    return notes


def main() -> None:
    """Run one node: a point with the folder of its sockets, as JSON, and the name of the node."""
    _, text, node = sys.argv
    point = json.loads(text)
    notes: Notes = []
    with zmq.Context() as context:
        links = _links(context, point["folder"], node)
        try:
            _RUN[node](point, *links, notes)
        finally:
            for link in links:
                link.close(linger=LINGER_MS)
    print(json.dumps(notes))


def _links(
    context: zmq.Context[Any], folder: str, node: str
) -> list[zmq.Socket[bytes]]:
    """Sockets of a node: the one that it reads, and the one that it writes."""
    # Each node binds what it writes: the next one may come later.
    k = NODES.index(node)
    links = []
    if k > 0:
        reader = context.socket(zmq.PULL)
        reader.connect(f"ipc://{Path(folder, NODES[k - 1])}")
        links.append(reader)
    if k + 1 < len(NODES):
        writer = context.socket(zmq.PUSH)
        writer.bind(f"ipc://{Path(folder, node)}")
        links.append(writer)
    # From the host back to the sensor: that it is ready.
    if k == 0:
        begin = context.socket(zmq.PULL)
        begin.bind(f"ipc://{Path(folder, 'begin')}")
        links.append(begin)
    if k + 1 == len(NODES):
        begin = context.socket(zmq.PUSH)
        begin.connect(f"ipc://{Path(folder, 'begin')}")
        links.append(begin)
    return links


def _sensor(
    point: dict[str, Any],
    writer: zmq.Socket[bytes],
    begin: zmq.Socket[bytes],
    notes: Notes,
) -> None:
    source = _source(point)
    writer.send(GO)
    # The host has a solver.
    begin.recv()
    period_ns = round(1e9 / point["rate_hz"])
    begin_ns = time.monotonic_ns()
    frames: Iterator[tuple[int, Floats]] = iter(source)
    for number in range(point["n_frames"]):
        _, taxels = next(frames)
        # From the begin on, so that delays do not add up.
        due_ns = begin_ns + (number + 1) * period_ns
        left_ns = due_ns - time.monotonic_ns()
        if left_ns > 0:
            time.sleep(left_ns / 1e9)
        stamp_ns = time.monotonic_ns()
        writer.send(packed(number, stamp_ns, taxels))
        _note(notes, stamp_ns)
    writer.send(b"")


def _edge(
    point: dict[str, Any],
    reader: zmq.Socket[bytes],
    writer: zmq.Socket[bytes],
    notes: Notes,
) -> None:
    phi = _phi(_source(point))
    # The word to begin, and an empty buffer at the end, go on as they are.
    writer.send(reader.recv())
    for buffer in iter(reader.recv, b""):
        number, stamp_ns, taxels = unpacked(buffer)
        writer.send(packed(number, stamp_ns, phi.forward(taxels)))
        _note(notes, stamp_ns)
    writer.send(b"")


def _host(
    point: dict[str, Any],
    reader: zmq.Socket[bytes],
    begin: zmq.Socket[bytes],
    notes: Notes,
) -> None:
    source = _source(point)
    phi = _phi(source)
    skin = source.skin
    basis = make_basis("haar", skin.n_rows, skin.n_cols)
    solver = make_solver("skin", phi, basis, iterations=point["iterations"])
    # Loops are compiled, and memory is taken, before the first frame.
    solver.solve(np.zeros(phi.m, dtype=np.float32))
    solver.reset()
    begin.send(reader.recv())
    for buffer in iter(reader.recv, b""):
        _, stamp_ns, measurements = unpacked(buffer)
        solver.solve(measurements)
        _note(notes, stamp_ns)


_RUN: dict[str, Callable[..., None]] = {
    "sensor": _sensor,
    "edge": _edge,
    "host": _host,
}


def _note(notes: Notes, stamp_ns: int) -> None:
    notes.append((stamp_ns, time.monotonic_ns() - stamp_ns, time.process_time_ns()))


def _source(point: dict[str, Any]) -> Any:
    return find_callable(f"sparseskin.studies.looped:{point['scene']}", StudyError)()


def _phi(source: Any) -> Phi:
    (phi,) = CompressorSettings(rows=FIXED).phis(source.skin)
    return phi


if __name__ == "__main__":
    main()
