"""A thousand open pages beside a running graph."""

from __future__ import annotations

import contextlib
import resource
import select
import socket
import threading
import time
from collections import Counter
from pathlib import Path
from typing import Any, Self
from urllib.parse import urlsplit

from stress.graphs import PATIENCE_S, ObservedGraph, graph_text, wait_until

from sparseskin.nodes.process.proc import n_files, own_bytes

_READ_BYTES = 1 << 16
_LAST = b"\r\n\r\n"


class Pages:
    """Connections that request the stream of a page with its token, at once, and read it.

    Parameters
    ----------
    url : str
        Address of the page, with its token.
    n : int
        Number of connections.
    reading : int
        Number of those that go on reading once they have their answer; the others stall.
    """

    def __init__(self, url: str, n: int, reading: int) -> None:
        place = urlsplit(url)
        request = f"GET /stream?patch=skin&{place.query} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n"
        self._reading = reading
        self._heads: dict[socket.socket, bytes] = {}
        self._closed: set[socket.socket] = set()
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

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        for made in self._heads:
            made.close()

    def statuses(self) -> dict[str, int]:
        """Answers so far by their status; "closed": closed without an answer; "": none yet."""
        found: Counter[str] = Counter()
        for made, head in list(self._heads.items()):
            if _LAST in head:
                found[head.split(b" ", 2)[1].decode()] += 1
            else:
                found["closed" if made in self._closed else ""] += 1
        return dict(found)

    def _read(self) -> None:
        poller = select.poll()
        by_fd = {made.fileno(): made for made in self._heads}
        for fd in by_fd:
            poller.register(fd, select.POLLIN)
        n_open = 0
        while not self._ending.is_set():
            for fd, _ in poller.poll(50):
                made = by_fd[fd]
                head = self._heads[made]
                try:
                    data = made.recv(_READ_BYTES)
                except OSError:
                    data = b""
                if not data:
                    self._closed.add(made)
                    poller.unregister(fd)
                elif _LAST in head:
                    self.n_bytes += len(data)
                else:
                    self._heads[made] = head = head + data
                    if _LAST in head and b" 200 " in head.split(b"\r\n")[0]:
                        n_open += 1
                        if n_open > self._reading:
                            poller.unregister(fd)  # it never reads again


def measure(point: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Open pages of a graph all at once, hold them for a while, close them; again and again.

    `point`: n: pages. reading: those that go on reading. seconds: how long they are held. times.
    rate_hz.

    Returns
    -------
    dict
        statuses: answers by status, for each time. frames, lost, counted, stopped, left: as of
        `half_open.measure`. files, threads: of the monitor before, at most, and after. grew_mb:
        growth of its memory, at most and after. read_mb: bytes that the pages have read.
    """
    nodes = {"sensor": {"rate_hz": point["rate_hz"]}, "monitor": {"page": True, "port": 0}}
    n_files_needed = point["n"] + 64
    before_limit = resource.getrlimit(resource.RLIMIT_NOFILE)
    if before_limit[0] < n_files_needed <= before_limit[1]:
        resource.setrlimit(resource.RLIMIT_NOFILE, (n_files_needed, before_limit[1]))
    with ObservedGraph(graph_text(**nodes), folder=folder) as graph:
        url = graph.page()
        graph.probe.wait_for_frame()
        monitor = graph.nodes()["monitor"]
        looks = [_look(monitor)]
        statuses, n_bytes = [], 0
        graph.begin()
        for _ in range(point["times"]):
            with Pages(url, point["n"], point["reading"]) as pages:
                wait_until(lambda pages=pages: "" not in pages.statuses(), "all answers")  # type: ignore[misc]
                until_s = time.monotonic() + point["seconds"]
                while time.monotonic() < until_s:
                    looks.append(_look(monitor))
                    time.sleep(0.1)
                statuses.append(pages.statuses())
                n_bytes += pages.n_bytes
            wait_until(
                lambda: all(a <= b for a, b in zip(_look(monitor)[:2], looks[0][:2], strict=True)),
                "the end of all pages",
            )
        graph.probe.wait_for_frame()
        looks.append(_look(monitor))
        lost, n_sensed = graph.probe.lost(graph.began_ns)
        stopped = graph.stopped({"monitor": monitor})
        graph.end()
        most = [max(values) for values in zip(*looks, strict=True)]
        files, threads, memory = zip(looks[0], most, looks[-1], strict=True)
        return {
            "n": point["n"],
            "statuses": statuses,
            "frames": n_sensed,
            "lost": lost,
            "counted": graph.summary()["patches"]["skin"]["frames"]["lost"],
            "stopped": stopped,
            "files": list(files),
            "threads": list(threads),
            "grew_mb": [round((value - memory[0]) / 1e6, 1) for value in memory[1:]],
            "read_mb": round(n_bytes / 1e6, 1),
            "left": graph.left_behind(),
        }


def _look(pid: int) -> tuple[int, int, int]:
    """Open files, threads and memory of a process."""
    return n_files(pid), len(list(Path(f"/proc/{pid}/task").iterdir())), own_bytes(pid)
