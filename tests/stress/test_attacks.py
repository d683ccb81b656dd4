"""A graph under load by others: nothing is lost, nothing ends, nothing is left behind.

At full size 10,000 half-open connections, and 1,000 pages three times.
"""

import contextlib
import os
import resource
import select
import socket
import threading
import time
from collections import Counter
from typing import NamedTuple
from urllib.parse import urlsplit

import pytest
from processes import wait_until
from stress.graphs import PATIENCE_S, SECURITY, ObservedGraph, graph_text

from sparseskin.nodes.monitor.live.server import MAX_PAGES
from sparseskin.nodes.network.gate import MAX_PENDING
from sparseskin.nodes.network.keys import make_key_files, read_key_pair
from sparseskin.nodes.network.sockets import Reader, make_context
from sparseskin.studies.speed.host import own_bytes

CLOSING = 64
"""Open files of a node that is closing connections, beyond those that it may keep."""
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


class Look(NamedTuple):
    """Open files, threads and memory of a process."""

    files: int
    threads: int
    memory: int

    @classmethod
    def at(cls, pid):
        n_files, n_threads = (
            len(os.listdir(f"/proc/{pid}/{of}")) for of in ("fd", "task")
        )
        return cls(n_files, n_threads, own_bytes(pid))


class Watched:
    """Nodes of a graph that were looked at before an attack, and are looked at again and again."""

    def __init__(self, graph, *names):
        pids = graph.nodes()
        self._graph, self._pids = graph, {name: pids[name] for name in names or pids}
        self._looks = {name: [Look.at(pid)] for name, pid in self._pids.items()}
        graph.begin()

    def look(self):
        for name, pid in self._pids.items():
            self._looks[name].append(Look.at(pid))

    def is_as_before(self):
        """True if no node has more files or threads open than before."""
        now = {name: Look.at(pid) for name, pid in self._pids.items()}
        return all(
            now[name].files <= one.files and now[name].threads <= one.threads
            for name, (one, *_) in self._looks.items()
        )

    def end(self, note, attack, **figures):
        """Wait for the end of the attack, end the graph; before, at most, after by node."""
        wait_until(self.is_as_before, "the end of all connections")
        self._graph.probe.wait_for_frame()
        self.look()
        found = self._graph.outcome()
        lost = self._graph.summary()["patches"]["skin"]["frames"]["lost"]
        seen = {
            name: [looks[0], Look(*map(max, zip(*looks, strict=True))), looks[-1]]
            for name, looks in self._looks.items()
        }
        note(
            attack=attack,
            **figures,
            frames=found.of,
            **{k: list(v) for k, v in seen.items()},
        )
        assert (found.lost, lost, found.stopped, found.left) == (0, 0, [], [])
        assert found.of > 0
        return seen


@contextlib.contextmanager
def few_files(limit):
    """Limit the open files of processes that are started in the context."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limit is not None:
        resource.setrlimit(resource.RLIMIT_NOFILE, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


def half_open(port, k):
    """A connection silent after the k-th kind of beginning; half from addresses of their own."""
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


def is_closed(connection):
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


def join(graph):
    """Seconds until a reader that comes now, with a key, has a message of the sensor."""
    keys = read_key_pair(graph.cwd / "keys/edge.key")
    context = make_context()
    try:
        reader = Reader(context, "late", (), ["/skin/taxels"], present=False, keys=keys)
        sensor = graph.note()["nodes"]["sensor"]
        reader.connect(sensor["endpoint"], sensor["key"])
        return wait_until(
            lambda: reader.receive() is not None, "a message to a reader with a key"
        )
    finally:
        context.destroy(linger=0)


@pytest.mark.parametrize("files", [None, 64])
def test_half_open_connections_cost_a_graph_with_keys_nothing(
    files, full, note, tmp_path
):
    n, n_wave, rate_hz = (10_000, 10_000, 50.0) if full else (900, 500, 20.0)
    n_wave = min(n_wave, resource.getrlimit(resource.RLIMIT_NOFILE)[0] - SPARE_FILES)
    make_key_files("edge", tmp_path / "keys")
    launch = graph_text({"transport": "tcp"}, sensor={"rate_hz": rate_hz}) + SECURITY
    with few_files(files):
        graph = ObservedGraph(launch, folder=tmp_path)
    with graph:
        graph.probe.wait_for_frame()
        noted = graph.note()["nodes"]
        ports = [int(noted[name]["endpoint"].rpartition(":")[2]) for name in WRITERS]
        watched = Watched(graph)
        n_left, n_closed, joined_s = n, 0, []
        while n_left:  # in waves, of which each is closed before the next
            with contextlib.ExitStack() as stack:
                held = []
                for k in range(min(n_wave, n_left)):
                    held.append(
                        stack.enter_context(
                            half_open(ports[k % len(ports)], n_left - k)
                        )
                    )
                    if k % PART == 0:
                        watched.look()
                n_left -= len(held)
                joined_s.append(round(join(graph), 2))
                watched.look()
                n_closed += sum(map(is_closed, held))
        attack = f"{n} half-open connections, {files or 'all'} files"
        seen = watched.end(note, attack, closed=n_closed, joined_s=joined_s)
        n_lines = sum("turned away" in line for line in graph.log)
    for before, most, after in seen.values():
        assert after.files == before.files
        assert most.files <= (files or before.files + MAX_PENDING + CLOSING)
    assert max(most.files for _, most, _ in seen.values()) > 50
    assert n_closed >= n - len(joined_s) * 3 * MAX_PENDING
    assert full or (len(joined_s) == 2 and n_lines < 3 * 300)


class Pages:
    """Connections that request the stream of a page at once; all but `reading` stall afterwards."""

    def __init__(self, url, n, reading):
        place = urlsplit(url)
        request = f"GET /stream?patch=skin&{place.query} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n"
        self._reading = reading
        self._heads = {}
        self._closed = set()
        self._ending = threading.Event()
        self.n_bytes = 0
        for _ in range(n):
            made = socket.create_connection((place.hostname, place.port), PATIENCE_S)
            self._heads[made] = b""
            with contextlib.suppress(OSError):  # it may be closed already
                made.sendall(request.encode())
            made.setblocking(False)
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._ending.set()
        self._thread.join()
        for made in self._heads:
            made.close()

    def statuses(self):
        """Answers so far by their status; "closed": closed without an answer; "": none yet."""
        found = Counter()
        for made, head in list(self._heads.items()):
            if b"\r\n\r\n" in head:
                found[head.split(b" ", 2)[1].decode()] += 1
            else:
                found["closed" if made in self._closed else ""] += 1
        return dict(found)

    def _read(self):
        poller = select.poll()
        by_fd = {made.fileno(): made for made in self._heads}
        for fd in by_fd:
            poller.register(fd, select.POLLIN)
        n_open = 0
        while not self._ending.is_set():
            for fd, _ in poller.poll(50):
                made = by_fd[fd]
                had_answer = b"\r\n\r\n" in self._heads[made]
                try:
                    data = made.recv(1 << 16)
                except OSError:
                    data = b""
                if not data:
                    self._closed.add(made)
                    poller.unregister(fd)
                elif had_answer:
                    self.n_bytes += len(data)
                else:
                    self._heads[made] = head = self._heads[made] + data
                    if b"\r\n\r\n" in head and b" 200 " in head.split(b"\r\n")[0]:
                        n_open += 1
                        if n_open > self._reading:
                            poller.unregister(fd)  # it never reads again


def test_open_pages_cost_a_graph_nothing_and_are_refused_in_order(full, note, tmp_path):
    n, reading, held_s, times, rate_hz = (
        (1000, 60, 3.0, 3, 50.0) if full else (300, 30, 0.5, 2, 20.0)
    )
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    if limits[0] < n + 64 <= limits[1]:
        resource.setrlimit(resource.RLIMIT_NOFILE, (n + 64, limits[1]))
    nodes = {"sensor": {"rate_hz": rate_hz}, "monitor": {"page": True, "port": 0}}
    with ObservedGraph(graph_text(**nodes), folder=tmp_path) as graph:
        url = graph.page()
        graph.probe.wait_for_frame()
        watched = Watched(graph, "monitor")
        n_bytes = 0
        for _ in range(times):
            with Pages(url, n, reading) as pages:
                wait_until(
                    lambda pages=pages: "" not in pages.statuses(), "all answers"
                )
                until_s = time.monotonic() + held_s
                while time.monotonic() < until_s:
                    watched.look()
                    time.sleep(0.1)
                assert pages.statuses() == {"200": MAX_PAGES, "503": n - MAX_PAGES}
                n_bytes += pages.n_bytes
            wait_until(watched.is_as_before, "the end of all pages")
        read_mb = round(n_bytes / 1e6, 1)
        ((before, most, after),) = watched.end(
            note, f"{n} pages", read_mb=read_mb
        ).values()
    assert read_mb > 0
    assert before.files < most.files
    assert before.threads < most.threads
    assert (after.files, after.threads) == (before.files, before.threads)
