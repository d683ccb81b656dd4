"""A body whose patches are served by two hosts, each with a network of its own."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from conftest import Program, StartProgram
from namespaces import ADDRESSES, TwoHosts, two_hosts

from sparseskin.nodes.network.keys import make_key_files

N_FRAMES = 60
BODY = """\
[[patches]]
name = "palm"
rows = 16
cols = 16
host = "edge"
[[patches]]
name = "thumb"
rows = 16
cols = 16
host = "edge"
[[patches]]
name = "sole"
rows = 12
cols = 24
host = "desk"
"""
GRAPH = """\
[hosts.edge]
address = "10.203.7.1"
[hosts.desk]
address = "10.203.7.2"
[security]
keys = "keys"
[skin]
body = "body.toml"
[nodes.sensor]
type = "sensor_batch"
source = "scene:lying"
rate_hz = 20
[nodes.compressor]
type = "compressor_batch"
[nodes.reconstructor]
type = "reconstructor_batch"
[nodes.monitor]
type = "monitor"
host = "desk"
page = false
"""


def part(start: StartProgram, hosts: TwoHosts, host: str, *more: str) -> Program:
    arguments = ("launch", "robot.toml", "--host", host, "--summary", f"{host}.json", *more)
    return start(*arguments, prefix=hosts.prefix(host))


@pytest.mark.slow
def test_patches_are_reconstructed_where_they_are_and_watched_at_one_place(
    start: StartProgram, tmp_path: Path
) -> None:
    with two_hosts() as hosts:
        for name in ADDRESSES:
            make_key_files(name, tmp_path / "keys")
        (tmp_path / "body.toml").write_text(BODY)
        (tmp_path / "robot.toml").write_text(GRAPH)
        frames = ("--frames", str(N_FRAMES))
        programs = {host: part(start, hosts, host, *frames) for host in ADDRESSES}
        for program in programs.values():
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
