"""Cost of the live page: `make page-load` (4 minutes).

One graph at 30 Hz: the monitor's share of a core without a page, with one that is read, and with
one that stalls beside it, its memory, and the rate at which frames come. Then a graph at 100 Hz,
with and without a page in turns: the latency from sensor to reconstruction.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import shutil
import socket
import struct
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import numpy as np

from sparseskin.launch.launchfile.load import BUNDLED
from sparseskin.nodes.monitor.live.server import MAX_PAGES
from sparseskin.nodes.process.proc import cpu_s, resident_bytes
from sparseskin.studies.graph_run import GraphRun

from .turns import LATENCIES, Turn, latencies_ms, take_turn

LAUNCH = (BUNDLED / "drag_wrench_64.toml").read_text()
CHROMIUM = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)
TURN_S = 6.0
TURNS = 3
STALL_S = 60.0


class PageGraph(GraphRun):
    """A graph with a live page at `url`, and the figures of its monitor."""

    def __init__(self, launch: str, rate_hz: float) -> None:
        settings = ("monitor.port=0", f"sensor.rate_hz={rate_hz}")
        super().__init__(launch, *(word for one in settings for word in ("--set", one)))
        found = re.search(r"live page: (\S+)", self.wait_for("live page: "))
        assert found is not None
        self.url = found[1]
        self._monitor = self.nodes()["monitor"]

    def cpu_s(self) -> float:
        """Seconds of processor time that the monitor has used."""
        return cpu_s(self._monitor)

    def memory_mb(self) -> float:
        """Resident memory of the monitor, in MB."""
        return resident_bytes(self._monitor) / 1e6


class Client:
    """Reads the stream of a page, and counts the frames that come."""

    def __init__(self, url: str) -> None:
        self.n_frames = 0
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc)
        self._connection.request("GET", f"/stream?patch=skin&{urlsplit(url).query}")
        self._answer = self._connection.getresponse()
        self.refusal = ""
        if self._answer.status != http.client.OK:
            self.refusal = f"{self._answer.status} {self._answer.read().decode().strip()}"
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        with contextlib.suppress(OSError, ValueError, struct.error, http.client.HTTPException):
            while True:
                n_head, n_data = struct.unpack("<II", self._answer.read(8))
                head = self._answer.read(n_head)
                self._answer.read(n_data)
                self.n_frames += b'"kind":"maps"' in head

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._answer.close()
        self._connection.close()


def stalled(url: str) -> socket.socket:
    """A page that requests the stream and never reads it."""
    place = urlsplit(url)
    made = socket.create_connection((place.hostname, place.port))
    head = f"GET /stream?patch=skin&{place.query} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n"
    made.sendall(head.encode())
    return made


@contextlib.contextmanager
def chromium(url: str) -> Iterator[None]:
    """The page in a real browser without a window."""
    with tempfile.TemporaryDirectory() as profile:
        process = subprocess.Popen(
            ["chromium", *CHROMIUM, "--remote-debugging-port=0", f"--user-data-dir={profile}", url],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            yield
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, 9)
            process.wait()
            time.sleep(0.5)  # its children still write their profile


def load() -> None:
    """Print the monitor's share of a core and its memory, at 30 Hz."""
    with PageGraph(LAUNCH, 30) as graph:

        def row(title: str, seconds: float, client: Client | None = None) -> None:
            n_before = client.n_frames if client else 0
            turn = take_turn(title, 0.0, seconds, graph.cpu_s)
            took_s = (turn.ended_ns - turn.began_ns) / 1e9
            shown = f"{(client.n_frames - n_before) / took_s:.1f}" if client else "-"
            share = 100 * turn.cpu_s / took_s
            print(f"{title:<42}{share:>8.1f}{shown:>10}{graph.memory_mb():>8.1f}", flush=True)

        time.sleep(3)
        print(f"{'30 Hz, one patch of 64 x 64':<42}{'CPU %':>8}{'frames/s':>10}{'MB':>8}")
        row("no page", 20)
        client = Client(graph.url)
        row("one page", 20, client)
        before_mb = graph.memory_mb()
        held = stalled(graph.url)
        row(f"one page, one stalled for {STALL_S:.0f} s", STALL_S, client)
        print(f"memory grew by {graph.memory_mb() - before_mb:+.2f} MB while one page was stalled")
        held.close()
        crowd = [Client(graph.url) for _ in range(MAX_PAGES - 2)]
        row(f"{MAX_PAGES - 1} pages", 20, client)
        crowd.append(Client(graph.url))
        print(f"the page after {MAX_PAGES}: {Client(graph.url).refusal}")
        for one in [*crowd, client]:
            one.close()
        time.sleep(3)
        if shutil.which("chromium"):
            with chromium(graph.url):
                time.sleep(5)
                row("one page, in Chromium", 20)
        graph.end()
        frames = graph.summary()["patches"]["skin"]["frames"]
    print(f"the graph all the while: {', '.join(f'{n} {what}' for what, n in frames.items())}")


def latency() -> None:
    """Print the latency with and without a page, in turns of one run at 100 Hz."""
    ways = ["no page", "one page"] + ["Chromium"] * bool(shutil.which("chromium"))
    turns: list[Turn] = []
    with PageGraph(LAUNCH + LATENCIES, 100) as graph:
        for way in ways * TURNS:
            with viewed(graph.url, way):
                turns.append(take_turn(way, 2.0, TURN_S, graph.cpu_s))
        graph.end()
        found = latencies_ms(turns, np.load(graph.folder / "latencies.npy"))
    print(f"\n{'latency at 100 Hz, ' + str(TURNS) + ' turns each':<42}{'p50 ms':>8}{'p99 ms':>10}")
    p50s = {}
    for way in ways:
        of_way = [ms for turn, ms in zip(turns, found, strict=True) if turn.way == way]
        p50s[way], p99 = np.quantile(np.concatenate(of_way), [0.5, 0.99])
        print(f"{way:<42}{p50s[way]:>8.2f}{p99:>10.2f}   x {p50s[way] / p50s['no page']:.3f}")


@contextlib.contextmanager
def viewed(url: str, way: str) -> Iterator[None]:
    """The page, viewed in one of the ways while the context lasts."""
    if way == "Chromium":
        with chromium(url):
            time.sleep(3)
            yield
        return
    with contextlib.ExitStack() as stack:
        if way == "one page":
            stack.enter_context(contextlib.closing(Client(url)))
        yield


if __name__ == "__main__":
    load()
    latency()
