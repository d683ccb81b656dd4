"""Launch files of several hosts and of bodies: checked whole, safe unless stated otherwise."""

from pathlib import Path

import pytest
from bags import launched
from damaged import launch_faults

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.body import Batch, read_skin
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
    assert (
        capsys.readouterr().err
        == "f: several hosts: choose one with --host (edge, desk)\n"
    )
    assert main(["launch", "f.toml", "--host", "egde"]) == 2
    assert "has no such host (did you mean 'edge'?)" in capsys.readouterr().err
    assert main(["launch", "path_40", "--host", "edge"]) == 2
    assert "path_40 has no tables [hosts.NAME]" in capsys.readouterr().err
    assert main(["launch", "f.toml", "--dry-run"]) == 0
    assert "compressor at tcp://192.168.1.10:5701" in " ".join(
        capsys.readouterr().out.split()
    )


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
    local = NO_KEYS.replace("192.168.1.10", "127.0.0.1").replace(
        "192.168.1.20", "127.0.0.2"
    )
    assert not load(write(local)).insecure


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            '"192.168.1.10"',
            '"edge.local"',
            "5: hosts.edge.address: 'edge.local' is no addr",
        ),
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
    assert capsys.readouterr().err.startswith(
        "keys/edge.key: mode 0644 lets other users read"
    )
    Path("keys/edge.key").unlink()
    assert main(["launch", "f.toml", "--host", "edge"]) == 2
    assert "(make one: sparseskin keys make edge)" in capsys.readouterr().err
    Path("keys/edge.pub").unlink()
    assert main(["launch", "f.toml", "--host", "desk"]) == 2
    assert "keys/edge.pub: No such file" in capsys.readouterr().err


def test_a_graph_of_one_host_names_its_key():
    one = '[security]\nkeys = "keys"\n[nodes.sensor]\ntype = "sensor"\nsource = "scene:path_40"\n'
    assert faults(one) == [
        "f.toml:1: security.key: expected the name of this graph's key, a text"
    ]
    launch = load(write(one.replace('"keys"', '"keys"\nkey = "edge"'))).part(None)
    assert list(launch.credentials.allowed.values()) == ["edge"]


GOOD = """
[[patches]]
name = "left_palm"
n_rows = 8
n_cols = 8

[[patches]]
name = "right_palm"
n_rows = 8
n_cols = 8

[[patches]]
name = "forearm"
n_rows = 12
n_cols = 6
pose = [0, 40.5, 0, 0, 0, 90]
mask = ["111111", "111111", "111111", "111111", "111111", "111111",
        "111111", "111111", "111111", "111111", "111110", "111100"]
noise = 0.01

[[patches]]
name = "sole"
skin = "sole.toml"
compressor = { ratio = 2.0 }
"""
SOLE = "n_rows = 6\nn_cols = 10\nf_max = 5.0\npitch_mm = 8.0\n"


@pytest.fixture
def body(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sole.toml").write_text(SOLE)
    (tmp_path / "body.toml").write_text(GOOD)
    return tmp_path / "body.toml"


def lines_of(*overrides):
    return launch_faults("body", overrides)


def test_equal_patches_are_one_batch_of_four_nodes():
    launch = load("body", ["skin.patches=3", "skin.n_rows=12", "sensor.rate_hz=20"])
    assert list(launch.nodes) == ["sensor", "compressor", "reconstructor", "monitor"]
    sensor = launch.nodes["sensor"].settings
    assert sensor.patches == ("p0", "p1", "p2")
    assert sensor.simulated == {
        "n_rows": 12,
        "n_cols": 64,
        "pitch_mm": 5.0,
        "f_max": 2.5,
    }
    assert (sensor.rate_hz, launch.nodes["monitor"].settings.all_patches) == (
        20,
        sensor.patches,
    )
    assert {link.topic for link in launch.links if link.reader == "reconstructor"} == {
        *("/body/skin", "/body/phi", "/body/measurements")
    }


def test_patches_of_a_body_file_are_served_in_batches_of_equal_ones(body):
    launch = load("body", ["skin.body=body.toml"])
    patches = {
        n: s.settings.patches
        for n, s in launch.nodes.items()
        if s.type_name != "monitor"
    }
    assert patches == {
        f"{node}_{k}": names
        for node in ("sensor", "compressor", "reconstructor")
        for k, names in enumerate(
            (("left_palm", "right_palm"), ("forearm",), ("sole",)), 1
        )
    }
    forearm, sole = (launch.nodes[f"sensor_{k}"].settings for k in (2, 3))
    assert forearm.address().n_taxels() == 69
    assert launch.nodes["monitor"].settings.poses == {"forearm": [0, 40.5, 0, 0, 0, 90]}
    assert (forearm.simulated["noise"], forearm.simulated["pitch_mm"]) == (0.01, 5.0)
    assert sole.simulated == {"n_rows": 6, "n_cols": 10, "f_max": 5.0, "pitch_mm": 8.0}
    assert [launch.nodes[f"compressor_{k}"].settings.ratio for k in (1, 2, 3)] == [
        3,
        3,
        2,
    ]
    assert launch.nodes["monitor"].settings.all_patches == (
        *("left_palm", "right_palm", "forearm", "sole"),
    )


def test_frames_of_all_patches_reach_the_monitor(body):
    bus = launched("body", "skin.body=body.toml")
    bus.run(3)
    patches = bus.reports()["monitor"]["patches"]
    assert {
        name: patch["frames"]["reconstructed"] for name, patch in patches.items()
    } == (dict.fromkeys(("left_palm", "right_palm", "forearm", "sole"), 3))
    assert (patches["sole"]["f_max"], patches["forearm"]["n"]) == (5.0, 69)


def test_a_batch_has_at_most_as_many_patches_as_stated_and_as_a_message_holds():
    def sizes(**table):
        batches = read_skin(table, Path(), lambda place, what: pytest.fail(what))
        return [len(batch.patches) for batch in batches]

    assert (sizes(patches=10, batch=4), sizes(patches=244)) == ([4, 4, 2], [244])
    assert (sizes(patches=300), sizes(patches=5, n_rows=512, n_cols=1024)) == (
        [256, 44],
        [2, 2, 1],
    )
    names = [
        b.name for b in read_skin({"patches": 9, "batch": 5}, Path(), lambda *_: None)
    ]
    assert names == ["body_1", "body_2"]
    assert isinstance(read_skin({"patches": 1}, Path(), lambda *_: None)[0], Batch)


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ("n_rows = 12", "n_rows = 0", "patches[2] (forearm): n_rows: 0 is outside 1..4096"),
        ("40.5, ", "", "(forearm).pose: expected [x, y, z, roll, pitch, yaw]"),
        ("noise =", "nose =", "patches[2].nose: unknown key (did you mean 'noise'?)"),
        ('"left_palm"', '"Left palm"', "patches[0].name: 'Left palm' is no name"),
        ('"left_palm"', '"sole"', "patches[3].name: 'sole' occurs twice"),
        ('"sole.toml"', '"none.toml"', "none.toml: no such file"),
        ('"sole.toml"', '"sole.toml"\nn_rows = 3', "(sole).n_rows: is stated beside skin"),
        ("[[patches]]", "[patches]", "body.toml: cannot be read"),
    ],
)  # fmt: skip
def test_a_fault_of_a_body_file_is_one_line_with_its_place(body, before, after, line):
    body.write_text(GOOD.replace(before, after))
    (found,) = lines_of("skin.body=body.toml")
    assert found.startswith("--set skin.body=body.toml: ")
    assert line in found


@pytest.mark.parametrize(
    ("overrides", "line"),
    [
        (["skin.patchs=3"], "unknown key (did you mean 'patches'?)"),
        (["skin.n_rows=5000"], "--set skin.n_rows=5000: 5000 is outside 1..4096"),
        (["skin.patches=200", "skin.batch=2"], "301 nodes; at most 256 are allowed"),
        (
            ["sensor.source=scene:hugs"],
            "no scene is called 'hugs' (did you mean 'hug'?)",
        ),
    ],
)
def test_a_fault_of_the_table_or_of_a_node_is_one_line(overrides, line):
    (found,) = lines_of(*overrides)
    assert line in found


def test_a_fault_of_a_node_that_is_made_for_each_batch_names_its_table(body):
    found = lines_of("skin.body=body.toml", "reconstructor.iterations=0")
    assert set(found) == {"--set reconstructor.iterations=0: 0 is outside 1..1000"}
