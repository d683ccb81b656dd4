"""What the live page costs: `make page-load` (4 minutes).

One graph at 30 Hz: the monitor's share of a core without a page, with one that is read, and with
one that stalls beside it, its memory, and the rate at which frames come. Then a graph at 100 Hz,
with and without a page, turn by turn: the latency from sensor to reconstruction.
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
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np

from sparseskin.messages import Reconstruction, decode
from sparseskin.nodes.monitor.server import MAX_PAGES
from sparseskin.nodes.recorder.bag_reader import BagReader

COMMAND = [sys.executable, "-m", "sparseskin.launch.entry", "launch", "drag_wrench_64"]
CHROMIUM = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-sync"),
    *("--disable-background-networking", "--disable-component-update"),
)
TURN_S = 6.0
TURNS = 3
STALL_S = 60.0


class Graph:
    """A graph that runs, and the process of its monitor."""

    def __init__(self, *arguments: str) -> None:
        self._process = subprocess.Popen(
            [*COMMAND, "--set", "monitor.port=0", *arguments],
            stderr=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        assert self._process.stderr is not None
        self.url = ""
        for line in self._process.stderr:
            found = re.search(r"live page: (\S+)", line)
            self.url = found[1] if found else self.url
            if "ready:" in line:
                break
        children = Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text()
        (self.monitor,) = (
            int(pid)
            for pid in children.split()
            if Path(f"/proc/{pid}/cmdline").read_bytes().rstrip(b"\0").endswith(b"monitor")
        )

    def cpu_s(self) -> float:
        """Seconds of processor time that the monitor has used."""
        fields = Path(f"/proc/{self.monitor}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def memory_mb(self) -> float:
        """Memory of the monitor that is resident, in MB."""
        pages = int(Path(f"/proc/{self.monitor}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6

    def close(self) -> str:
        """End the graph; how many frames it sensed, reconstructed and lost."""
        self._process.terminate()
        table, _ = self._process.communicate()
        return re.sub(" +", " ", next((k for k in table.splitlines() if "sensed" in k), ""))


class Client:
    """Reads the stream of a page, and counts the frames that come."""

    def __init__(self, url: str) -> None:
        self.n_frames = 0
        self._connection = http.client.HTTPConnection(urlsplit(url).netloc)
        self._connection.request("GET", "/stream?patch=skin")
        self._answer = self._connection.getresponse()
        self.refusal = ""
        if self._answer.status != http.client.OK:
            self.refusal = f"{self._answer.status} {self._answer.read().decode().strip()}"
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

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
    """A page that asks for the stream and never reads it."""
    place = urlsplit(url)
    made = socket.create_connection((place.hostname, place.port))
    made.sendall(f"GET /stream?patch=skin HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode())
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


def measure(graph: Graph, seconds: float, client: Client | None = None) -> tuple[float, float]:
    """Percent of a core that the monitor takes, and frames a second that the client gets."""
    cpu_s, began_s, n_frames = graph.cpu_s(), time.monotonic(), client.n_frames if client else 0
    time.sleep(seconds)
    took_s = time.monotonic() - began_s
    frames = (client.n_frames - n_frames) / took_s if client else 0.0
    return 100 * (graph.cpu_s() - cpu_s) / took_s, frames


def load() -> None:
    """The monitor's share of a core and its memory, at 30 Hz."""
    graph = Graph("--set", "sensor.rate_hz=30")
    try:
        time.sleep(3)
        print(f"{'30 Hz, one patch of 64 x 64':<42}{'CPU %':>8}{'frames/s':>10}{'MB':>8}")
        row("no page", *measure(graph, 20), graph)
        client = Client(graph.url)
        row("one page", *measure(graph, 20, client), graph)
        before_mb = graph.memory_mb()
        held = stalled(graph.url)
        row(f"one page, one stalled for {STALL_S:.0f} s", *measure(graph, STALL_S, client), graph)
        print(f"memory grew by {graph.memory_mb() - before_mb:+.2f} MB while one page was stalled")
        held.close()
        crowd = [Client(graph.url) for _ in range(MAX_PAGES - 2)]
        row(f"{MAX_PAGES - 1} pages", *measure(graph, 20, client), graph)
        crowd.append(Client(graph.url))
        print(f"the page after {MAX_PAGES}: {Client(graph.url).refusal}")
        for one in [*crowd, client]:
            one.close()
        time.sleep(3)
        if shutil.which("chromium"):
            with chromium(graph.url):
                time.sleep(5)
                row("one page, in Chromium", *measure(graph, 20), graph)
    finally:
        print(f"the graph all the while: {graph.close()}")


def row(title: str, cpu: float, frames: float, graph: Graph) -> None:
    shown = f"{frames:.1f}" if frames else "-"
    print(f"{title:<42}{cpu:>8.1f}{shown:>10}{graph.memory_mb():>8.1f}", flush=True)


def latency() -> None:
    """Latency with and without a page, turn by turn in one run at 100 Hz."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "run.mcap"
        graph = Graph("--set", "sensor.rate_hz=100", "--record", str(file))
        turns: list[tuple[str, int, int]] = []
        ways = ["no page", "one page"] + ["Chromium"] * bool(shutil.which("chromium"))
        try:
            for _ in range(TURNS):
                for way in ways:
                    with looked_at(graph.url, way):
                        time.sleep(2)
                        began_ns = time.time_ns()
                        time.sleep(TURN_S)
                        turns.append((way, began_ns, time.time_ns()))
        finally:
            graph.close()
        with BagReader(str(file)) as bag:
            times = [
                (m.stamp_ns, m.done_ns)
                for recorded in bag.messages(["/skin/reconstruction"])
                for m in [decode(recorded.topic.encode(), recorded.payload)]
                if isinstance(m, Reconstruction)
            ]
    stamps, done = np.array(times, dtype=np.int64).T
    print(f"\n{'latency at 100 Hz, ' + str(TURNS) + ' turns each':<42}{'p50 ms':>8}{'p99 ms':>10}")
    p50s = {}
    for way in ways:
        inside = np.zeros(len(stamps), dtype=bool)
        for name, began_ns, ended_ns in turns:
            if name == way:
                inside |= (stamps >= began_ns) & (stamps < ended_ns)
        p50, p99 = np.quantile((done - stamps)[inside] / 1e6, [0.5, 0.99])
        p50s[way] = p50
        print(f"{way:<42}{p50:>8.2f}{p99:>10.2f}   x {p50 / p50s['no page']:.3f}")


@contextlib.contextmanager
def looked_at(url: str, way: str) -> Iterator[None]:
    if way == "Chromium":
        with chromium(url):
            time.sleep(3)
            yield
        return
    client = Client(url) if way == "one page" else None
    try:
        yield
    finally:
        if client is not None:
            client.close()


if __name__ == "__main__":
    load()
    latency()
