"""A graph in two parts, each under a launcher of its own, joined by TCP with keys."""

import json
import shutil
import signal
from pathlib import Path

import pytest
from conftest import free_port, wait_until

from sparseskin.nodes.network.keys import make_key_files

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
    return start("launch", "two.toml", "--host", host, "--summary", f"{host}.json", *more)


def summary(folder, host):
    return json.loads((folder / f"{host}.json").read_text())


def test_a_part_waits_for_the_other_and_no_frame_is_lost_from_the_first_to_the_end(start, tmp_path):
    write(tmp_path)
    edge = part(start, "edge", "--frames", "300")
    line = edge.wait_for("[launch] sensor waits for a subscription from ")
    assert line == "echo, recorder on desk"
    desk = part(start, "desk")
    for program in (edge, desk):
        code, _, stderr = program.finish()
        assert code in (0, 1), stderr  # 1: not one patch has a monitor
    nodes = summary(tmp_path, "desk")["nodes"]
    assert nodes["echo"]["received"] == {"/skin/taxels": 300}
    assert nodes["echo"]["lost"] == {"/skin/taxels": 0}
    assert set(nodes["recorder"]["lost"].values()) == {0}
    clock = summary(tmp_path, "desk")["hosts"]["edge"]
    # One computer: the two launchers set their clocks by the same one.
    assert abs(clock["clock_offset_ms"]) <= clock["clock_uncertainty_ms"] + 5
    assert edge.survivors() == desk.survivors() == {}


@pytest.mark.slow
def test_a_part_that_is_killed_joins_again_and_receives_latched_messages(start, tmp_path):
    write(tmp_path, rate_hz=100)
    edge = part(start, "edge")
    desk = part(start, "desk")
    desk.wait_for("[recorder] connected: sensor on edge")
    desk.kill_all()
    wait_until(lambda: not desk.survivors(), "the end of all its processes")
    for left in tmp_path.glob("two.mcap*"):  # complete where the recorder saw its launcher end
        left.unlink()
    again = part(start, "desk")
    again.wait_for("[recorder] connected: sensor on edge")
    recorded = tmp_path / "two.mcap.part"
    wait_until(lambda: recorded.exists() and recorded.stat().st_size > 20_000, "frames in the file")
    edge.process.send_signal(signal.SIGINT)
    code, _, stderr = again.finish()
    assert code in (0, 1), stderr
    nodes = summary(tmp_path, "desk")["nodes"]
    assert nodes["recorder"]["received"]["/skin/skin"] == 1
    assert nodes["recorder"]["received"]["/skin/taxels"] > 0
    assert nodes["recorder"]["lost"]["/skin/taxels"] == 0
    edge.finish()


def test_a_host_that_is_not_on_the_list_gets_nothing_and_is_named(start, tmp_path):
    write(tmp_path, allow='security.allow = ["edge"]')
    edge = part(start, "edge")
    desk = part(start, "desk")
    line = edge.wait_for("[sensor] turned away 127.0.0.1: ")
    assert line.startswith("its key is that of desk, and not on the list of those allowed")
    line = desk.wait_for("cannot connect to sensor on edge")
    assert "does not let this host in" in line
    for program in (edge, desk):
        program.process.send_signal(signal.SIGINT)
        program.finish()
    assert not any(summary(tmp_path, "desk")["nodes"]["echo"]["received"].values())
