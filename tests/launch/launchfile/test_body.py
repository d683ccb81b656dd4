"""Bodies: patches of a body file or equal ones, checked whole, and the nodes that serve them."""

from pathlib import Path

import pytest
from damaged import launch_faults

from sparseskin.launch.launchfile.body import Batch, read_skin
from sparseskin.launch.launchfile.load import load
from sparseskin.nodes.bus import Bus

GOOD = """
[[patches]]
name = "left_palm"
rows = 8
cols = 8

[[patches]]
name = "right_palm"
rows = 8
cols = 8

[[patches]]
name = "forearm"
rows = 12
cols = 6
pose = [0, 40.5, 0, 0, 0, 90]
mask = ["111111", "111111", "111111", "111111", "111111", "111111",
        "111111", "111111", "111111", "111111", "111110", "111100"]
noise = 0.01

[[patches]]
name = "sole"
skin = "sole.toml"
compressor = { ratio = 2.0 }
"""
SOLE = "rows = 6\ncols = 10\nf_max = 5.0\npitch_mm = 8.0\n"


@pytest.fixture
def body(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "sole.toml").write_text(SOLE)
    (tmp_path / "body.toml").write_text(GOOD)
    return tmp_path / "body.toml"


def lines_of(*overrides):
    return launch_faults("body", overrides)


def test_equal_patches_are_one_batch_of_four_nodes():
    launch = load("body", ["skin.patches=3", "skin.rows=12", "sensor.rate_hz=20"])
    assert list(launch.nodes) == ["sensor", "compressor", "reconstructor", "monitor"]
    sensor = launch.nodes["sensor"].settings
    assert sensor.patches == ("p0", "p1", "p2")
    assert sensor.simulated == {"rows": 12, "cols": 64, "pitch_mm": 5.0, "f_max": 2.5}
    assert (sensor.rate_hz, launch.nodes["monitor"].settings.all_patches) == (20, sensor.patches)
    assert {link.topic for link in launch.links if link.reader == "reconstructor"} == {
        *("/body/skin", "/body/phi", "/body/measurements")
    }


def test_patches_of_a_body_file_are_served_in_batches_of_equal_ones(body):
    launch = load("body", ["skin.body=body.toml"])
    patches = {n: s.settings.patches for n, s in launch.nodes.items() if s.type_name != "monitor"}
    assert patches == {
        f"{node}_{k}": names
        for node in ("sensor", "compressor", "reconstructor")
        for k, names in enumerate((("left_palm", "right_palm"), ("forearm",), ("sole",)), 1)
    }
    forearm, sole = (launch.nodes[f"sensor_{k}"].settings for k in (2, 3))
    assert forearm.address().n_taxels() == 69
    assert launch.nodes["monitor"].settings.poses == {"forearm": [0, 40.5, 0, 0, 0, 90]}
    assert (forearm.simulated["noise"], forearm.simulated["pitch_mm"]) == (0.01, 5.0)
    assert sole.simulated == {"rows": 6, "cols": 10, "f_max": 5.0, "pitch_mm": 8.0}
    assert [launch.nodes[f"compressor_{k}"].settings.ratio for k in (1, 2, 3)] == [3, 3, 2]
    assert launch.nodes["monitor"].settings.all_patches == (
        *("left_palm", "right_palm", "forearm", "sole"),
    )


def test_frames_of_all_patches_reach_the_monitor(body):
    launch = load("body", ["skin.body=body.toml"])
    bus = Bus({name: (spec.cls, spec.settings) for name, spec in launch.nodes.items()})
    bus.run(3)
    patches = bus.reports()["monitor"]["patches"]
    assert {name: patch["frames"]["reconstructed"] for name, patch in patches.items()} == (
        dict.fromkeys(("left_palm", "right_palm", "forearm", "sole"), 3)
    )
    assert (patches["sole"]["f_max"], patches["forearm"]["n"]) == (5.0, 69)


def test_a_batch_has_at_most_as_many_patches_as_stated_and_as_a_message_holds():
    def sizes(**table):
        batches = read_skin(table, Path(), lambda place, what: pytest.fail(what))
        return [len(batch.patches) for batch in batches]

    assert (sizes(patches=10, batch=4), sizes(patches=244)) == ([4, 4, 2], [244])
    assert (sizes(patches=300), sizes(patches=5, rows=512, cols=1024)) == ([256, 44], [2, 2, 1])
    names = [b.name for b in read_skin({"patches": 9, "batch": 5}, Path(), lambda *_: None)]
    assert names == ["body_1", "body_2"]
    assert isinstance(read_skin({"patches": 1}, Path(), lambda *_: None)[0], Batch)


@pytest.mark.parametrize(
    ("before", "after", "line"),
    [
        ("rows = 12", "rows = 0", "patches[2] (forearm): rows: 0 is outside 1..4096"),
        ("40.5, ", "", "(forearm).pose: expected [x, y, z, roll, pitch, yaw]"),
        ("noise =", "nose =", "patches[2].nose: unknown key (did you mean 'noise'?)"),
        ('"left_palm"', '"Left palm"', "patches[0].name: 'Left palm' is no name"),
        ('"left_palm"', '"sole"', "patches[3].name: 'sole' occurs twice"),
        ('"sole.toml"', '"none.toml"', "none.toml: there is no such file"),
        ('"sole.toml"', '"sole.toml"\nrows = 3', "(sole).rows: is stated beside skin"),
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
        (["skin.rows=5000"], "--set skin.rows=5000: 5000 is outside 1..4096"),
        (["skin.patches=200", "skin.batch=2"], "301 nodes; at most 256 are allowed"),
        (["sensor.source=scene:hugs"], "no scene is called 'hugs' (did you mean 'hug'?)"),
    ],
)
def test_a_fault_of_the_table_or_of_a_node_is_one_line(overrides, line):
    (found,) = lines_of(*overrides)
    assert line in found


def test_a_fault_of_a_node_that_is_made_for_each_batch_names_its_table(body):
    found = lines_of("skin.body=body.toml", "reconstructor.iterations=0")
    assert set(found) == {"--set reconstructor.iterations=0: 0 is outside 1..1000"}
