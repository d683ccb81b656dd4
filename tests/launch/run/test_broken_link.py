"""Two hosts, made of network namespaces, and the wire between them cut and slowed.

SPARSESKIN_LINK_CUT_S states for how many seconds the wire is cut (5 by default).
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import Program, StartProgram, wait_until
from slow_wire import SlowWire

from sparseskin.nodes.network.keys import make_key_files

CUT_S = float(os.environ.get("SPARSESKIN_LINK_CUT_S", "5"))
ADDRESSES = {"edge": "10.203.7.1", "desk": "10.203.7.2"}
STATIONS = Path(__file__).parent / "stations.py"
GRAPH = """\
[hosts.edge]
address = "10.203.7.1"
[hosts.desk]
address = "10.203.7.2"
[security]
keys = "keys"
[nodes.sensor]
type = "sensor"
source = "scene:path_40"
rate_hz = 100
host = "edge"
[nodes.echo]
type = "stations:Echo"
host = "desk"
"""


def ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


class TwoHosts:
    """Namespaces "edge" and "desk", joined by one wire; a slow one delays packets by 20 ms and
    loses one of a hundred.
    """

    def __init__(self) -> None:
        self.names = {host: f"skin{os.getpid()}{host}" for host in ADDRESSES}
        self.slow_wire: SlowWire | None = None

    def build(self, slow: bool) -> None:
        edge, desk = self.names.values()
        for name in (edge, desk):
            ip("netns", "add", name)
        if slow:
            self.slow_wire = SlowWire(self._place, delay_s=0.02, loss=0.01)
        else:
            ip(*f"-n {edge} link add wire type veth peer name wire netns {desk}".split())
        for host, name in self.names.items():
            ip("-n", name, "addr", "add", f"{ADDRESSES[host]}/24", "dev", "wire")
            for device in ("lo", "wire"):
                ip("-n", name, "link", "set", device, "up")

    def _place(self, end: int, device: str) -> None:
        name = list(self.names.values())[end]
        ip("link", "set", device, "netns", name)
        ip("-n", name, "link", "set", device, "name", "wire")

    def set_wire(self, state: str) -> None:
        ip("-n", self.names["edge"], "link", "set", "wire", state)

    def remove(self) -> None:
        if self.slow_wire is not None:
            self.slow_wire.close()
        for name in self.names.values():
            with contextlib.suppress(OSError):
                ip("netns", "del", name)

    def prefix(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.names[host]]


@pytest.fixture
def hosts(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[TwoHosts]:
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (iproute2)")
    made = TwoHosts()
    try:
        made.build(slow=getattr(request, "param", False))
    except OSError as error:
        made.remove()
        pytest.skip(f"network namespaces are not permitted here: {error}")
    for name in ADDRESSES:
        make_key_files(name, tmp_path / "keys")
    shutil.copy(STATIONS, tmp_path / "stations.py")
    (tmp_path / "two.toml").write_text(GRAPH)
    yield made
    made.remove()


def part(start: StartProgram, hosts: TwoHosts, host: str) -> Program:
    arguments = ("launch", "two.toml", "--host", host, "--summary", f"{host}.json")
    return start(*arguments, prefix=hosts.prefix(host))


def finish(folder: Path, edge: Program, desk: Program) -> tuple[dict[str, int], dict[str, int]]:
    """Stop the edge, and so the stream; what was sent, received and lost of it."""
    edge.process.send_signal(signal.SIGINT)
    for program in (edge, desk):
        _, _, stderr = program.finish()
        print(stderr)
        assert "Traceback" not in stderr
    sent = json.loads((folder / "edge.json").read_text())["nodes"]["sensor"]["published"]
    echo = json.loads((folder / "desk.json").read_text())["nodes"]["echo"]
    topic = "/skin/taxels"
    return sent, {"received": echo["received"][topic], "lost": echo["lost"][topic]}


@pytest.mark.slow
def test_after_a_cut_the_stream_is_back_and_what_was_lost_is_counted(
    hosts: TwoHosts, start: StartProgram, tmp_path: Path, record_property: pytest.RecordProperty
) -> None:
    edge, desk = part(start, hosts, "edge"), part(start, hosts, "desk")
    desk.wait_for("[echo] connected: sensor on edge")
    desk.wait_for("[echo] takes frames")
    cut_s = time.monotonic()
    hosts.set_wire("down")
    desk.wait_for("[echo] disconnected: sensor on edge")
    record_property("noticed_s", time.monotonic() - cut_s)
    time.sleep(max(0.0, cut_s + CUT_S - time.monotonic()))
    up_s = time.monotonic()
    hosts.set_wire("up")
    desk.wait_for("[echo] connected: sensor on edge")
    record_property("back_s", time.monotonic() - up_s)
    sent, got = finish(tmp_path, edge, desk)
    assert got["lost"] > 0
    assert got["received"] > 0
    assert got["received"] + got["lost"] == sent["/skin/taxels"]


@pytest.mark.parametrize("hosts", [True], indirect=True, ids=["slow"])
@pytest.mark.slow
def test_over_a_slow_wire_that_loses_packets_no_frame_is_lost(
    hosts: TwoHosts, start: StartProgram, tmp_path: Path, record_property: pytest.RecordProperty
) -> None:
    edge, desk = part(start, hosts, "edge"), part(start, hosts, "desk")
    desk.wait_for("[echo] connected: sensor on edge")
    desk.wait_for("[echo] takes frames")
    assert hosts.slow_wire is not None
    n_carried = hosts.slow_wire.n_carried
    wait_until(lambda: hosts.slow_wire.n_carried > n_carried + 250, "packets")  # type: ignore[union-attr]
    sent, got = finish(tmp_path, edge, desk)
    assert got == {"received": sent["/skin/taxels"], "lost": 0}
    assert hosts.slow_wire.n_lost > 0
    clock = json.loads((tmp_path / "desk.json").read_text())["hosts"]["edge"]
    record_property("clock_uncertainty_ms", clock["clock_uncertainty_ms"])
    # Two launchers on one computer: their clocks agree, and the way there and back takes 40 ms.
    assert clock["clock_uncertainty_ms"] >= 20
    assert abs(clock["clock_offset_ms"]) <= clock["clock_uncertainty_ms"]
