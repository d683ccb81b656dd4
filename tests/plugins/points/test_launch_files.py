"""Launch files with skins of points, and the bundled graph of a torso: its recording, and what is
made of it.
"""

from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import LaunchError
from sparseskin.messages import decode
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.files.file_source import open_file

POINTS = "sensor.points=example:grip"


@pytest.mark.slow
def test_a_skin_of_points_is_recorded_exported_and_reprocessed(start, tmp_path):
    bag = tmp_path / "run.mcap"
    options = ["--frames", "30", "--record", str(bag)]
    for setting in (POINTS, "sensor.rate_hz=0", "reconstructor.fast=off", "monitor.page=false"):
        options += ["--set", setting]
    code, out, _ = start("launch", "torso", *options).finish()
    assert code == 0
    assert "N = 924, M = 308" in out
    with BagReader(bag) as reader:
        (state,) = (decode(m.topic.encode(), m.payload) for m in reader.messages(["/skin/skin"]))
    assert state.points is not None
    exported, again = tmp_path / "run.npz", tmp_path / "again.mcap"
    assert main(["recording", "export", str(bag), "--to", "npz", "--out", str(exported)]) == 0
    assert np.array_equal(open_file(str(exported)).skin.points, state.points)
    assert main(["reprocess", str(bag), "--out", str(again), "--set", "compressor.ratio=4"]) == 0
    with BagReader(again) as reader:
        assert len(list(reader.messages(["/skin/reconstruction"]))) == 30


BODY = """
[[patches]]
name = "palm"
rows = 8
cols = 8
f_max = 2.5
[[patches]]
name = "sole"
points = "example:grip"
f_max = 5.0
"""


def test_of_an_invalid_points_file_no_fault_of_its_scene_follows(tmp_path):
    path = tmp_path / "points.csv"
    path.write_text("x_mm,y_mm,z_mm\n1,2\n")
    stated = f"sensor.points={path}"
    with pytest.raises(LaunchError) as caught:
        load("torso", [stated, "sensor.noise=-1"])
    assert str(caught.value).splitlines() == [
        "--set sensor.noise=-1: -1.0 is outside 0.0..100.0",
        f"--set {stated}: {path}, line 2: 2 numbers; expected 3",
    ]


def test_patches_of_points_are_a_batch_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("body.toml").write_text(BODY)
    launch = load("body", ["skin.body=body.toml"])
    found = (node.settings for node in launch.nodes.values())
    (sensor,) = (one for one in found if "points" in (getattr(one, "simulated", None) or {}))
    assert sensor.patches == ("sole",)
    assert sensor.address().n_taxels() == 924
    Path("body.toml").write_text(BODY.replace("example:grip", "a.csv"))
    with pytest.raises(LaunchError, match=r"a\.csv: there is no such file"):
        load("body", ["skin.body=body.toml"])
