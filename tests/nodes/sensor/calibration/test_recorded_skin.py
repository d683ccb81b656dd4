"""A recording carries the calibration of its skin: metadata, table, export, reprocessing."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from bags import skin_state

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.recorder.bag.frames import last_states
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.node import Recorder
from sparseskin.nodes.sensor.calibration.description import Response, SkinDescription, of_messages
from sparseskin.nodes.sensor.calibration.skin_file import load_skin, save_skin
from sparseskin.nodes.sensor.node import Sensor

SHAPE = (8, 8)
MASK = np.ones(SHAPE, dtype=np.bool_)
MASK[0, 0] = False
SKIN = SkinDescription(
    *("palm", *SHAPE, 2.5),
    pitch_mm=2.5,
    mask=MASK,
    baseline=np.full(SHAPE, 64.0),
    gains=np.full(SHAPE, 0.0078125),
    response=Response(np.array([0.5, 2.0]), np.array([0.5, 2.5])),
    noise=0.015625,
)


@pytest.fixture
def bag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_skin("palm.toml", SKIN)
    raw = 64 + np.random.default_rng(0).integers(0, 200, (20, *SHAPE))
    np.save("counts.npy", raw)
    bus = Bus(
        {
            "sensor": (Sensor, Sensor.Settings(source="file:counts.npy", skin="palm.toml", tare=4)),
            "compressor": (Compressor, Compressor.Settings()),
            "reconstructor": (Reconstructor, Reconstructor.Settings()),
            "recorder": (Recorder, Recorder.Settings(out="run.mcap")),
        },
        ManualClock(1),
    )
    bus.run()
    bus.close()
    bus.check()
    return tmp_path / "run.mcap"


def test_table_and_messages(bag, capsys):
    with BagReader(bag) as read:
        assert read.topics["/skin/calibration"].n_messages == 1
        assert read.topics["/skin/taxels"].n_messages == 16
    assert main(["recording", "info", str(bag)]) == 0
    table = capsys.readouterr().out
    assert "/skin/calibration" in table
    assert "palm" in table


def test_the_skin_is_exported_with_the_tared_baseline(bag):
    assert main(["recording", "export", str(bag), "--to", "skin"]) == 0
    found = load_skin(bag.with_name("run.toml"))
    raw = np.load("counts.npy")
    assert found.baseline is not None
    np.testing.assert_array_equal(found.baseline, np.median(raw[:4], axis=0))
    np.testing.assert_array_equal(found.response.force, [0.5, 2.5])
    assert (found.name, found.noise, found.f_max, found.pitch_mm) == ("palm", 0.015625, 2.5, 2.5)
    np.testing.assert_array_equal(found.mask, MASK)


def test_a_reprocessed_recording_carries_it_too(bag):
    assert main(["reprocess", str(bag), "--out", "again.mcap", "--set", "compressor.ratio=2"]) == 0
    with BagReader(Path("again.mcap")) as read:
        assert last_states(read, read.topics)["/skin/skin"]["sigma_end"] == 0.015625


def test_a_recording_without_one_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("n.npy", np.ones((3, 4, 4)))
    assert main(["recording", "import", "n.npy", "--out", "n.mcap"]) == 0
    assert main(["recording", "export", "n.mcap", "--to", "skin"]) == 2
    assert capsys.readouterr().err.endswith("n.mcap: holds no calibration of a skin\n")


@pytest.mark.parametrize("own", [False, True])
def test_a_message_holds_a_description(own):
    reading = np.stack([np.full(SHAPE, 0.5), np.full(SHAPE, 2.0)]) if own else np.array([0.5, 2.0])
    skin = SkinDescription(
        *("a", *SHAPE, 2.5),
        pitch_mm=2.0,
        noise=0.5,
        response=Response(reading, np.array([1.0, 2.0])),
    )

    state = skin_state("p", **vars(skin.skin), has_truth=False, sigma_mid=0.5, sigma_end=0.5)
    found = of_messages(state, skin.message(0, "p"))
    for field in fields(skin):
        if field.name not in ("response", "noise_mid"):
            assert getattr(found, field.name) == getattr(skin, field.name)
    np.testing.assert_array_equal(found.response.reading, reading)
