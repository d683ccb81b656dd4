"""Two hosts, made of network namespaces, and the wire between them cut.

SPARSESKIN_LINK_CUT_S states for how many seconds the wire is cut (5 by default).
"""

import json
import os
import shutil
import signal
import time
from pathlib import Path

import pytest
from namespaces import ADDRESSES, two_hosts

from sparseskin.nodes.network.keys import make_key_files

CUT_S = float(os.environ.get("SPARSESKIN_LINK_CUT_S", "5"))
STATIONS = Path(__file__).parent / "stations.py"
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
    { name = "palm", rows = 16, cols = 16, host = "edge" },
    { name = "thumb", rows = 16, cols = 16, host = "edge" },
    { name = "sole", rows = 12, cols = 24, host = "desk" },
]
"""
BODY_GRAPH = f"""{HOSTS}\
skin.body = "body.toml"
[nodes]
sensor = {{ type = "sensor", source = "scene:lying", rate_hz = 20 }}
compressor.type = "compressor"
reconstructor.type = "reconstructor"
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


def part(start, hosts, host, name="two.toml"):
    arguments = ("launch", name, "--host", host, "--summary", f"{host}.json")
    arguments += ("--frames", str(N_FRAMES)) if name == "robot.toml" else ()
    return start(*arguments, prefix=hosts.prefix(host))


def finish(folder, edge, desk):
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
    hosts, start, tmp_path, record_property
):
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


@pytest.mark.slow
def test_patches_are_reconstructed_where_they_are_and_watched_at_one_place(hosts, start, tmp_path):
    (tmp_path / "body.toml").write_text(BODY)
    (tmp_path / "robot.toml").write_text(BODY_GRAPH)
    for program in [part(start, hosts, host, "robot.toml") for host in ADDRESSES]:
        code, _, stderr = program.finish()
        assert code in (0, 1), stderr  # 1: the monitor is on the other host
        assert "Traceback" not in stderr
        assert program.survivors() == {}
    found = {host: json.loads((tmp_path / f"{host}.json").read_text()) for host in ADDRESSES}
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
