"""Launch files with skins of points."""

from __future__ import annotations

from pathlib import Path

import pytest

from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import LaunchError

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


def test_of_an_invalid_points_file_no_fault_of_its_scene_follows(tmp_path: Path) -> None:
    path = tmp_path / "points.csv"
    path.write_text("x_mm,y_mm,z_mm\n1,2\n")
    stated = f"sensor.points={path}"
    with pytest.raises(LaunchError) as caught:
        load("torso", [stated, "sensor.noise=-1"])
    assert str(caught.value).splitlines() == [
        "--set sensor.noise=-1: -1.0 is outside 0.0..100.0",
        f"--set {stated}: {path}, line 2: 2 numbers; expected 3",
    ]


def test_patches_of_points_are_a_batch_of_their_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
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
