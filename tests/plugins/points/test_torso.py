"""The bundled graph of a torso: real processes, its recording, and what is made of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from conftest import StartProgram

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import load
from sparseskin.messages import SkinState, decode
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.files.file_source import open_file

POINTS = "sensor.points=example:grip"


def test_the_torso_has_4000_taxels() -> None:
    sensor = load("torso").nodes["sensor"]
    (n,) = sensor.cls.facts(sensor.settings).values()
    assert n == 4000


@pytest.mark.slow
def test_a_skin_of_points_is_recorded_exported_and_reprocessed(
    start: StartProgram, tmp_path: Path
) -> None:
    bag = tmp_path / "run.mcap"
    options = ["--frames", "30", "--record", str(bag)]
    for setting in (POINTS, "sensor.rate_hz=0", "reconstructor.fast=off", "monitor.page=false"):
        options += ["--set", setting]
    code, out, _ = start("launch", "torso", *options).finish()
    assert code == 0
    assert "N = 924, M = 308" in out
    with BagReader(bag) as reader:
        (state,) = (decode(m.topic.encode(), m.payload) for m in reader.messages(["/skin/skin"]))
    assert isinstance(state, SkinState)
    assert state.points is not None
    exported, again = tmp_path / "run.npz", tmp_path / "again.mcap"
    assert main(["bag", "export", str(bag), "--to", "npz", "--out", str(exported)]) == 0
    assert np.array_equal(open_file(str(exported)).skin.points, state.points)
    assert main(["reprocess", str(bag), "--out", str(again), "--set", "compressor.ratio=4"]) == 0
    with BagReader(again) as reader:
        assert len(list(reader.messages(["/skin/reconstruction"]))) == 30
