"""Thousands of TCP connections that never finish a handshake, against a graph with keys."""

from __future__ import annotations

import contextlib
import resource
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from stress.graphs import PATIENCE_S, ObservedGraph, graph_text, wait_until

from sparseskin.nodes.network.keys import make_key_files, read_key_pair
from sparseskin.nodes.network.sockets import Reader, make_context
from sparseskin.nodes.process.proc import n_files, own_bytes

SPARE_FILES = 256
"""File descriptors of this process that are not used for connections."""
PART = 100
"""Connections between two looks at the nodes."""
WRITERS = ("sensor", "compressor", "reconstructor")
SENT = (
    b"",
    b"\xff" + 8 * b"\0",
    b"\xff" + 8 * b"\0" + b"\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + 32 * b"\0",
)
"""What the peer of a connection sends before it is silent: nothing, a part of ZeroMQ's greeting, or
the whole greeting without the handshake that has to follow (ZMTP 3.0).
"""
_SECURITY = """
[security]
keys = "keys"
key = "edge"
"""


def measure(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Open connections to the nodes of a graph in turn, in waves, and close them again.

    A wave has as many as file descriptors allow. Half of the connections come from one address,
    the others from as many addresses as there are.

    `point`: n: connections in all. n_wave: most at once. files: limit of open files of each
    process of the graph, None: that of this process. rate_hz.

    Returns
    -------
    dict
        n, waves. closed: connections that the nodes closed while they were held. frames, lost:
        acquired during the attack, and of these not reconstructed. counted: lost frames by the
        graph's own count. stopped: nodes that ended. files: open files of each node before, at
        most, and after. grew_mb: growth of memory, at most and after. joined_s: time until a reader
        with a key had a message, in each wave. lines: lines in the log about refused peers. left:
        what the graph left behind.
    """
    make_key_files("edge", folder / "keys")
    launch = graph_text({"transport": "tcp"}, sensor={"rate_hz": point["rate_hz"]}) + _SECURITY
    with _few_files(point["files"]):
        graph = ObservedGraph(launch, folder=folder)
    with graph:
        graph.probe.wait_for_frame()
        nodes = graph.nodes()
        ports = [
            int(graph.note()["nodes"][name]["endpoint"].rpartition(":")[2]) for name in WRITERS
        ]
        before = {name: (n_files(pid), own_bytes(pid)) for name, pid in nodes.items()}
        looks: list[dict[str, tuple[int, int]]] = []
        graph.begin()

        def look() -> None:
            looks.append({name: (n_files(pid), own_bytes(pid)) for name, pid in nodes.items()})

        n_wave = min(point["n_wave"], resource.getrlimit(resource.RLIMIT_NOFILE)[0] - SPARE_FILES)
        n_left, closed, joined_s = point["n"], 0, []
        while n_left:
            with contextlib.ExitStack() as stack:
                held = []
                for k in range(min(n_wave, n_left)):
                    held.append(stack.enter_context(_half_open(ports[k % len(ports)], n_left - k)))
                    if k % PART == 0:
                        look()
                n_left -= len(held)
                joined_s.append(_join(graph))
                look()
                closed += sum(map(_is_closed, held))
        wait_until(
            lambda: all(n_files(pid) <= before[name][0] for name, pid in nodes.items()),
            "the end of all connections",
        )
        graph.probe.wait_for_frame()
        look()
        lost, n_sensed = graph.probe.lost(graph.began_ns)
        stopped = graph.stopped(nodes)
        graph.end()
        return {
            "n": point["n"],
            "waves": len(joined_s),
            "closed": closed,
            "frames": n_sensed,
            "lost": lost,
            "counted": graph.summary()["patches"]["skin"]["frames"]["lost"],
            "stopped": stopped,
            "files": {
                name: [before[name][0], max(one[name][0] for one in looks), looks[-1][name][0]]
                for name in nodes
            },
            "grew_mb": {
                name: [
                    round((value - before[name][1]) / 1e6, 1)
                    for value in (max(one[name][1] for one in looks), looks[-1][name][1])
                ]
                for name in nodes
            },
            "joined_s": [round(seconds, 2) for seconds in joined_s],
            "lines": sum("turned away" in line for line in graph.log),
            "left": graph.left_behind(),
        }


def _half_open(port: int, k: int) -> socket.socket:
    """A connection that is silent after the k-th kind of beginning, from the k-th address."""
    made = socket.socket()
    try:
        if k % 2:
            made.bind((f"127.{1 + k // 62500 % 250}.{k // 250 % 250}.{1 + k % 250}", 0))
        made.settimeout(PATIENCE_S)
        made.connect(("127.0.0.1", port))
        with contextlib.suppress(OSError):  # it may be closed already
            made.sendall(SENT[k % len(SENT)])
    except BaseException:
        made.close()
        raise
    return made


def _is_closed(connection: socket.socket) -> bool:
    """True if the other side has ended a connection."""
    connection.setblocking(False)
    try:
        while connection.recv(4096):  # ZeroMQ's greeting
            pass
    except BlockingIOError:
        return False
    except OSError:
        pass
    return True


def _join(graph: ObservedGraph) -> float:
    """Seconds until a reader that comes now, with a key, has a message of the sensor."""
    keys = read_key_pair(graph.folder / "keys/edge.key")
    context = make_context()
    try:
        began_s = time.monotonic()
        reader = Reader(context, "late", (), ["/skin/taxels"], present=False, keys=keys)
        sensor = graph.note()["nodes"]["sensor"]
        reader.connect(sensor["endpoint"], sensor["key"])
        wait_until(lambda: reader.receive() is not None, "a message to a reader with a key")
        return time.monotonic() - began_s
    finally:
        context.destroy(linger=0)


@contextlib.contextmanager
def _few_files(limit: int | None) -> Iterator[None]:
    """Limit the open files of processes that are started in the context."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)
