"""Launch files of several hosts: checked whole, and safe unless stated otherwise."""

from pathlib import Path

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.nodes.network.keys import make_key_files

TWO = """\
[graph]
description = "an edge and a desk"

[hosts.edge]
address = "192.168.1.10"

[hosts.desk]
address = "192.168.1.20"
base_port = 6000

[security]
keys = "keys"

[nodes.sensor]
type = "sensor"
source = "scene:path_40"
host = "edge"

[nodes.compressor]
type = "compressor"
host = "edge"

[nodes.reconstructor]
type = "reconstructor"
host = "desk"

[nodes.monitor]
type = "monitor"
host = "desk"
"""
NO_KEYS = TWO.replace('[security]\nkeys = "keys"\n', "")


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("edge", "desk"):
        make_key_files(name, tmp_path / "keys")


def write(text):
    Path("f.toml").write_text(text)
    return "f.toml"


def faults(text, host=None):
    with pytest.raises(LaunchError) as caught:
        load(write(text)).part(host)
    return caught.value.lines


def test_each_publishing_node_has_an_endpoint_that_a_recorder_more_on_one_host_does_not_move():
    nodes = load(write(TWO)).nodes
    assert {name: node.public for name, node in nodes.items()} == {
        "sensor": "tcp://192.168.1.10:5700",
        "compressor": "tcp://192.168.1.10:5701",
        "reconstructor": "tcp://192.168.1.20:6000",
        "monitor": "",
    }
    recorded = load(write(TWO), record="out.mcap").nodes
    assert all(recorded[name].public == node.public for name, node in nodes.items())


def test_a_part_has_its_own_nodes_and_knows_of_the_others():
    launch = load(write(TWO))
    edge, desk = launch.part("edge"), launch.part("desk")
    assert list(edge.nodes) == ["sensor", "compressor"] == list(desk.elsewhere)
    assert list(desk.nodes) == ["reconstructor", "monitor"] == list(edge.elsewhere)
    crossing = {(link.writer, link.reader) for link in edge.links} & {
        (link.writer, link.reader) for link in desk.links
    }
    assert crossing == {
        *(("sensor", "reconstructor"), ("compressor", "reconstructor")),
        *(("sensor", "monitor"), ("compressor", "monitor")),
    }


def test_each_host_lets_in_the_others_by_default_and_else_those_on_the_list():
    keys = load(write(TWO)).part("edge").credentials
    assert sorted(keys.allowed.values()) == ["desk", "edge"]
    listed = TWO.replace('keys = "keys"', 'keys = "keys"\nallow = ["edge"]')
    keys = load(write(listed)).part("edge").credentials
    assert list(keys.allowed.values()) == ["edge"]


def test_without_a_host_the_command_names_them_and_starts_nothing(capsys):
    assert main(["launch", write(TWO)]) == 2
    assert capsys.readouterr().err == "f: several hosts: choose one with --host (edge, desk)\n"
    assert main(["launch", "f.toml", "--host", "egde"]) == 2
    assert "has no such host (did you mean 'edge'?)" in capsys.readouterr().err
    assert main(["launch", "path_40", "--host", "edge"]) == 2
    assert "path_40 has no tables [hosts.NAME]" in capsys.readouterr().err
    assert main(["launch", "f.toml", "--dry-run"]) == 0
    assert "compressor at tcp://192.168.1.10:5701" in " ".join(capsys.readouterr().out.split())


def test_an_address_that_others_reach_is_refused_without_keys(capsys):
    assert main(["launch", write(NO_KEYS), "--host", "edge"]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition(" can be")[0] for line in lines] == [
        "f.toml:5: hosts.edge.address: 192.168.1.10",
        "f.toml:8: hosts.desk.address: 192.168.1.20",
    ]
    assert "insecure = true in [graph]" in lines[0]
    # Where it is stated, or nobody can reach it:
    assert load(write(NO_KEYS.replace("[graph]", "[graph]\ninsecure = true"))).insecure
    local = NO_KEYS.replace("192.168.1.10", "127.0.0.1").replace("192.168.1.20", "127.0.0.2")
    assert not load(write(local)).insecure


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        ('"192.168.1.10"', '"edge.local"', "5: hosts.edge.address: 'edge.local' is no addr"),
        (
            'path_40"\nhost = "edge"\n',
            'path_40"\n',
            "14: nodes.sensor: the key 'host' is missing (hosts:",
        ),
        (
            'reconstructor"\nhost = "desk"',
            'reconstructor"\nhost = "dsk"',
            "25: nodes.reconstructor.host: 'dsk' is no host (did you mean 'desk'?)",
        ),
        (
            '20"\nbase_port = 6000',
            '10"\nbase_port = 5701',
            "23: nodes.reconstructor: publishes at tcp://192.168.1.10:5701, where compressor does",
        ),
        ('"keys"', '"keys"\nallow = "edge"', "13: security.allow: expected a list of"),
        ('"keys"', '"keys"\nkey = "edge"', "13: security.key: with several hosts each"),
    ],
)
def test_each_fault_has_its_place(old, new, line):
    assert TWO.count(old) == 1
    assert faults(TWO.replace(old, new))[0].startswith(f"f.toml:{line}")


def test_a_key_that_is_missing_or_open_to_others_starts_nothing(capsys):
    Path("keys/edge.key").chmod(0o644)
    assert main(["launch", write(TWO), "--host", "edge"]) == 2
    assert capsys.readouterr().err.startswith("keys/edge.key: mode 0644 lets other users read")
    Path("keys/edge.key").unlink()
    assert main(["launch", "f.toml", "--host", "edge"]) == 2
    assert "(make one: sparseskin keys make edge)" in capsys.readouterr().err
    Path("keys/edge.pub").unlink()
    assert main(["launch", "f.toml", "--host", "desk"]) == 2
    assert "keys/edge.pub: No such file" in capsys.readouterr().err


def test_a_graph_of_one_host_names_its_key():
    one = '[security]\nkeys = "keys"\n[nodes.sensor]\ntype = "sensor"\nsource = "scene:path_40"\n'
    assert faults(one) == ["f.toml:1: security.key: expected the name of this graph's key, a text"]
    launch = load(write(one.replace('"keys"', '"keys"\nkey = "edge"'))).part(None)
    assert list(launch.credentials.allowed.values()) == ["edge"]
