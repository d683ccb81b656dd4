"""A graph in two parts, each under a launcher of its own: by TCP with keys, by a wire that is cut.

SPARSESKIN_LINK_CUT_S states for how many seconds the wire is cut (5 by default).
"""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from conftest import free_port, wait_until

from sparseskin.nodes.network.keys import make_key_files

ADDRESSES = {"edge": "10.203.7.1", "desk": "10.203.7.2"}


def ip(*arguments: str) -> None:
    done = subprocess.run(
        ["ip", *arguments], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


class TwoHosts:
    """Namespaces "edge" and "desk", joined by one wire."""

    def __init__(self) -> None:
        self.names = {host: f"skin{os.getpid()}{host}" for host in ADDRESSES}

    def build(self) -> None:
        edge, desk = self.names.values()
        for name in (edge, desk):
            ip("netns", "add", name)
        ip(*f"-n {edge} link add wire type veth peer name wire netns {desk}".split())
        for host, name in self.names.items():
            ip("-n", name, "addr", "add", f"{ADDRESSES[host]}/24", "dev", "wire")
            for device in ("lo", "wire"):
                ip("-n", name, "link", "set", device, "up")

    def set_wire(self, state: str) -> None:
        ip("-n", self.names["edge"], "link", "set", "wire", state)

    def remove(self) -> None:
        for name in self.names.values():
            with contextlib.suppress(OSError):
                ip("netns", "del", name)

    def prefix(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.names[host]]


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Build both hosts, and remove them; the test is skipped where that is not permitted."""
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (iproute2)")
    made = TwoHosts()
    try:
        made.build()
    except OSError as error:
        made.remove()
        pytest.skip(f"network namespaces are not permitted here: {error}")
    try:
        yield made
    finally:
        made.remove()


STATIONS = Path(__file__).parent / "stations.py"
TWO = """\
hosts.edge = {{ address = "127.0.0.1", base_port = {edge_port} }}
hosts.desk = {{ address = "127.0.0.1", base_port = {desk_port} }}
security.keys = "keys"
{allow}
[nodes]
sensor = {{ type = "sensor", source = "scene:path_40", rate_hz = {rate_hz}, host = "edge" }}
echo = {{ type = "stations:Echo", host = "desk" }}
recorder = {{ type = "recorder", out = "two.mcap", topics = ["/skin/*"], host = "desk" }}
"""


def write(folder, rate_hz=500, allow=""):
    shutil.copy(STATIONS, folder / "stations.py")
    for name in ("edge", "desk"):
        make_key_files(name, folder / "keys")
    ports = {"edge_port": free_port(), "desk_port": free_port()}
    (folder / "two.toml").write_text(TWO.format(**ports, rate_hz=rate_hz, allow=allow))


def part(start, host, *more):
    return start(
        "launch", "two.toml", "--host", host, "--summary", f"{host}.json", *more
    )


def summary(folder, host):
    return json.loads((folder / f"{host}.json").read_text())


@pytest.mark.slow
def test_a_part_waits_for_the_other_and_no_frame_is_lost_from_the_first_to_the_end(
    start, tmp_path
):
    write(tmp_path)
    edge = part(start, "edge", "--frames", "300")
    line = edge.wait_for("[launch] sensor waits for a subscription from ")
    assert line == "echo, recorder on desk"
    desk = part(start, "desk")
    for program in (edge, desk):
        program.ended(0, 1)  # 1: not one patch has a monitor
    nodes = summary(tmp_path, "desk")["nodes"]
    assert nodes["echo"]["received"] == {"/skin/taxels": 300}
    assert nodes["echo"]["lost"] == {"/skin/taxels": 0}
    assert set(nodes["recorder"]["lost"].values()) == {0}
    clock = summary(tmp_path, "desk")["hosts"]["edge"]
    # One computer: the two launchers set their clocks by the same one.
    assert abs(clock["clock_offset_ms"]) <= clock["clock_uncertainty_ms"] + 5
    assert edge.survivors() == desk.survivors() == {}


@pytest.mark.slow
def test_a_part_that_is_killed_joins_again_and_receives_latched_messages(
    start, tmp_path
):
    write(tmp_path, rate_hz=100)
    edge = part(start, "edge")
    desk = part(start, "desk")
    desk.wait_for("[recorder] connected: sensor on edge")
    desk.kill_all()
    wait_until(lambda: not desk.survivors(), "the end of all its processes")
    # complete where the recorder saw its launcher end
    for left in tmp_path.glob("two.mcap*"):
        left.unlink()
    again = part(start, "desk")
    again.wait_for("[recorder] connected: sensor on edge")
    recorded = tmp_path / "two.mcap.part"
    wait_until(
        lambda: recorded.exists() and recorded.stat().st_size > 20_000,
        "frames in the file",
    )
    edge.process.send_signal(signal.SIGINT)
    again.ended(0, 1)
    nodes = summary(tmp_path, "desk")["nodes"]
    assert nodes["recorder"]["received"]["/skin/skin"] == 1
    assert nodes["recorder"]["received"]["/skin/taxels"] > 0
    assert nodes["recorder"]["lost"]["/skin/taxels"] == 0
    edge.finish()


@pytest.mark.slow
def test_a_host_that_is_not_on_the_list_gets_nothing_and_is_named(start, tmp_path):
    write(tmp_path, allow='security.allow = ["edge"]')
    edge = part(start, "edge")
    desk = part(start, "desk")
    line = edge.wait_for("[sensor] turned away 127.0.0.1: ")
    assert line.startswith(
        "its key is that of desk, and not on the list of those allowed"
    )
    line = desk.wait_for("cannot connect to sensor on edge")
    assert "does not let this host in" in line
    for program in (edge, desk):
        program.process.send_signal(signal.SIGINT)
        program.finish()
    assert not any(summary(tmp_path, "desk")["nodes"]["echo"]["received"].values())


CUT_S = float(os.environ.get("SPARSESKIN_LINK_CUT_S", "5"))
HOSTS = """\
hosts.edge.address = "10.203.7.1"
hosts.desk.address = "10.203.7.2"
security.keys = "keys"
"""
GRAPH = f"""{HOSTS}\
[nodes]
sensor = {{ type = "sensor", source = "scene:path_40", rate_hz = 100, host = "edge" }}
echo = {{ type = "stations:Echo", host = "desk" }}
"""
N_FRAMES = 60
BODY = """\
patches = [
    { name = "palm", n_rows = 16, n_cols = 16, host = "edge" },
    { name = "thumb", n_rows = 16, n_cols = 16, host = "edge" },
    { name = "sole", n_rows = 12, n_cols = 24, host = "desk" },
]
"""
BODY_GRAPH = f"""{HOSTS}\
skin.body = "body.toml"
[nodes]
sensor = {{ type = "sensor", source = "scene:lying", rate_hz = 20 }}
compressor.type = "compressor"
reconstructor = {{ type = "reconstructor", depth = 0 }}
monitor = {{ type = "monitor", host = "desk", page = false }}
"""


@pytest.fixture
def hosts(tmp_path):
    with two_hosts() as made:
        for name in ADDRESSES:
            make_key_files(name, tmp_path / "keys")
        shutil.copy(STATIONS, tmp_path / "stations.py")
        (tmp_path / "two.toml").write_text(GRAPH)
        yield made


def half(start, hosts, host, name="two.toml", *more):
    arguments = ("launch", name, "--host", host, "--summary", f"{host}.json", *more)
    arguments += ("--frames", str(N_FRAMES)) if name == "robot.toml" else ()
    return start(*arguments, prefix=hosts.prefix(host))


def finish(folder, edge, desk):
    """Stop the edge, and so the stream; what was sent, received and lost of it."""
    edge.process.send_signal(signal.SIGINT)
    for program in (edge, desk):
        _, _, stderr = program.finish()
        print(stderr)
        assert "Traceback" not in stderr
    sent = json.loads((folder / "edge.json").read_text())["nodes"]["sensor"][
        "published"
    ]
    echo = json.loads((folder / "desk.json").read_text())["nodes"]["echo"]
    topic = "/skin/taxels"
    return sent, {"received": echo["received"][topic], "lost": echo["lost"][topic]}


@pytest.mark.slow
def test_after_a_cut_the_stream_is_back(hosts, start, tmp_path, record_property):
    edge, desk = half(start, hosts, "edge"), half(start, hosts, "desk")
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


@pytest.mark.slow
def test_patches_are_reconstructed_where_they_are_and_watched_at_one_place(
    hosts, start, tmp_path
):
    (tmp_path / "body.toml").write_text(BODY)
    (tmp_path / "robot.toml").write_text(BODY_GRAPH)
    # On one host in a process each, on the other in one together.
    edge = half(start, hosts, "edge", "robot.toml", "--set", "graph.process=all")
    for program in (edge, half(start, hosts, "desk", "robot.toml")):
        program.ended(0, 1)  # 1: the monitor is on the other host
        assert program.survivors() == {}
    found = {
        host: json.loads((tmp_path / f"{host}.json").read_text()) for host in ADDRESSES
    }
    # The hands are served by one host, the foot by the other.
    batches = {host: found[host]["nodes"].keys() for host in ADDRESSES}
    assert batches["edge"] == {"sensor_1", "compressor_1", "reconstructor_1"}
    assert batches["desk"] == {"sensor_2", "compressor_2", "reconstructor_2", "monitor"}
    assert found["edge"]["patches"] == {}
    patches = found["desk"]["patches"]
    assert patches.keys() == {"palm", "thumb", "sole"}
    for patch in patches.values():
        counts = patch["frames"]
        assert counts["sensed"] == counts["reconstructed"] == N_FRAMES
        assert counts["lost"] == counts["skipped"] == 0
        # Sensor and reconstructor of a patch share a host, and so a clock.
        assert patch["latency_uncertainty_ms"] == 0
    assert "edge" in found["desk"]["hosts"]
