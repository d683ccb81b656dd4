"""The sensor node with the file of a skin: what it publishes, tares and refuses."""

from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from bags import chain, skin_state
from damaged import refusal

from sparseskin.launch.commands.cli import main
from sparseskin.messages import Calibration, SkinState, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError, SettingsError, SourceError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.recorder.bag.frames import last_states
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.description import (
    Response,
    SkinDescription,
    of_messages,
)
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.skin_file import load_skin, save_skin

SHAPE = (3, 4)
BASELINE = 100.0 + np.arange(12.0).reshape(SHAPE)
TRUTH = np.linspace(0, 2, 12).reshape(SHAPE)
MASK = np.ones(SHAPE, dtype=np.bool_)
MASK[2, 0] = False


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A skin of 0.01 N a count, its file, and a recording of counts: 40 untouched, 60 pressed."""
    described = SkinDescription(
        *("palm", *SHAPE, 2.5),
        pitch_mm=2.0,
        mask=MASK,
        baseline=BASELINE,
        gains=np.full(SHAPE, 0.01),
        noise=0.02,
        noise_mid=0.03,
    )
    save_skin(tmp_path / "palm.toml", described)
    raw = np.concatenate([[BASELINE] * 40, [BASELINE + 100 * TRUTH] * 60])
    np.save(tmp_path / "counts.npy", raw)
    np.save(tmp_path / "signed.npy", raw - 105)
    monkeypatch.chdir(tmp_path)
    return tmp_path


class Run:
    """A sensor, its log and what it publishes."""

    def __init__(self, **settings):
        self.log = []
        self.clock = ManualClock()
        context = Context("s", self.clock, log=self.log.append)
        self.settings = Sensor.Settings(**{"source": "file:counts.npy", **settings})
        self.settings.check()
        self.sensor = Sensor(self.settings, context)
        self.published = list(self.sensor.start())
        self.n = 0

    def frames(self, n):
        found = []
        for _ in range(n):
            made = list(self.sensor.acquire(Tick(self.n, self.n)))
            self.published += made
            self.n += 1
            found += [one.forces[0] for one in made if isinstance(one, Taxels)]
        return found

    def of(self, kind):
        return [one for one in self.published if isinstance(one, kind)]


@pytest.mark.usefixtures("folder")
def test_counts_become_newtons_and_the_state_is_that_of_the_file():
    run = Run(skin="palm.toml")
    frames = run.frames(100)
    assert len(frames) == 100
    assert not frames[0].any()
    np.testing.assert_allclose(frames[-1], np.where(MASK, TRUTH, 0), atol=1e-6)
    (state,) = run.of(SkinState)
    assert state.f_max == 2.5
    assert state.unit == "N"
    assert state.pitch_m == 0.002
    assert state.f_min == 0
    assert state.sigma_end == 0.02
    assert state.sigma_mid == 0.03
    assert not state.has_truth
    np.testing.assert_array_equal(state.mask, MASK)
    (calibration,) = run.of(Calibration)
    assert calibration.name == "palm"
    np.testing.assert_array_equal(calibration.baseline, BASELINE.astype(np.float32))
    assert calibration.response_force is None


@pytest.mark.usefixtures("folder")
def test_a_tare_at_the_start_takes_its_frames_and_works_without_a_file():
    run = Run(source="file:signed.npy", tare=30, f_max=250.0)
    frames = run.frames(100)
    assert len(frames) == 70
    assert not frames[0].any()
    np.testing.assert_allclose(frames[-1], 100 * TRUTH, rtol=1e-6)
    assert "tared: forces changed by at most 6 raw" in run.log


@pytest.mark.usefixtures("folder")
def test_a_tare_on_command_is_announced_and_published():
    run = Run(skin="palm.toml")
    run.frames(50)
    assert (
        run.sensor.command("tare", 20)
        == "the baseline becomes the median of the next 20 frames"
    )
    assert run.sensor.state()["tare_left"] == 20
    frames = run.frames(21)
    # The frames of the tare are published with the baseline before.
    np.testing.assert_allclose(frames[18], np.where(MASK, TRUTH, 0), atol=1e-6)
    assert run.sensor.state()["tare_left"] == 0
    assert not run.frames(1)[0].any()
    _, after = run.of(Calibration)
    np.testing.assert_allclose(after.baseline, BASELINE + 100 * TRUTH, rtol=1e-6)
    assert run.log[-1].startswith(
        "tared: forces changed by at most 2 N, of 10 taxels by more than 5 %"
    )


@pytest.mark.usefixtures("folder")
def test_a_tare_is_refused_without_a_calibration_or_with_a_wrong_number():
    with pytest.raises(
        RefusedError, match=r"has no baseline; state sensor\.skin, or sensor\.tare"
    ):
        Run().sensor.command("tare", None)
    sensor = Run(skin="palm.toml").sensor
    for value in (0, -1, 10_001, True, "all", 2.5):
        with pytest.raises(RefusedError, match="is no number of frames"):
            sensor.command("tare", value)
    assert "next 30 frames" in sensor.command("tare", None)


@pytest.mark.usefixtures("folder")
def test_a_recording_that_ends_before_its_tare_says_so():
    run = Run(tare=200)
    assert run.frames(3) == []
    assert "counts: ended before its tare" in run.log
    assert run.sensor.exhausted


@pytest.mark.parametrize(
    ("settings", "line"),
    [
        ({"skin": "plam.toml"}, "skin: plam.toml: no such file"),
        (
            {"skin": "palm.toml", "f_max": 1.0},
            "f_max: the file of the skin has its own",
        ),
        ({"skin": "palm.toml", "source": "scene:path_40"}, "skin: a scene has its own"),
        ({"unit": "N\n"}, "expected 1 to 32 printable"),
        ({"skin": "palm.toml", "n_rows": 5}, "leaves a frame of 5 x any taxels"),
        ({"f_min": 0.1}, "f_min: 0.1 is outside"),
        (
            {"noise": 0.5},
            "noise: is added to true forces alone; state that of readings in",
        ),
    ],
)
@pytest.mark.usefixtures("folder")
def test_wrong_settings_are_refused_in_one_line(settings, line):
    assert line in refusal(lambda: Run(**settings), SettingsError)


def test_a_source_of_another_shape_is_refused_and_a_table_of_counts_needs_no_unit(
    folder,
):
    np.save(folder / "small.npy", np.ones((5, 2, 2)))
    with pytest.raises(
        SourceError, match=r"describes 3 x 4 taxels, but the source has 2 x 2"
    ):
        Run(skin="palm.toml", source="file:small.npy")
    np.savetxt(
        folder / "counts.csv", np.load("counts.npy").reshape(100, -1), delimiter=","
    )
    for negative in ("refuse", "zero"):
        run = Run(source="file:counts.csv", skin="palm.toml", negative=negative)
        np.testing.assert_allclose(run.frames(50)[-1], TRUTH * MASK, atol=1e-4)


def test_negative_counts_of_a_driver_are_not_clipped_before_the_baseline(folder):
    (folder / "signed_skin.py").write_text(
        "import numpy as np\n\n\ndef frames():\n"
        "    for k in range(100):\n        yield k * 10_000_000, np.load('signed.npy')[k]\n"
    )
    save_skin(
        folder / "signed.toml",
        SkinDescription(
            *("signed", *SHAPE, 2.5),
            baseline=BASELINE - 105,
            gains=np.full(SHAPE, 0.01),
            response=Response(np.array([1.0, 2.0]), np.array([1.0, 2.5])),
        ),
    )
    run = Run(skin="signed.toml", source="signed_skin:frames")
    frames = run.frames(90)
    expected = np.where(TRUTH < 1, TRUTH, 1 + 1.5 * (TRUTH - 1))
    np.testing.assert_allclose(frames[-1], expected, atol=1e-6)
    (calibration,) = run.of(Calibration)
    assert calibration.response_reading.shape == (2, 1, 1)
    run.sensor.close({})


def test_clipped_readings_are_logged_once_and_then_at_most_every_10_s(folder):
    (folder / "wrong_range.py").write_text(
        "import numpy as np\n\n\ndef frames():\n"
        "    for k in range(100):\n"
        "        yield k, np.array([[-1.0, 0.5], [5.0, 6.0]] if k else [[0.0, 0.0], [0.0, 3.0]])\n"
    )
    run = Run(source="wrong_range:frames", f_max=2.5)
    clipped = "readings clipped to the range: {} above 2.5 N (highest {:g})"
    run.frames(40)
    assert [line for line in run.log if "clipped" in line] == [clipped.format(1, 3.0)]
    run.clock.advance(9_999_999_999)
    run.frames(1)
    assert len([line for line in run.log if "clipped" in line]) == 1
    run.clock.advance(1)
    run.frames(10)
    second = f"{clipped.format(83, 6.0)}, 41 below 0 N (lowest -1)"
    assert [line for line in run.log if "clipped" in line][1:] == [second]
    run.sensor.close({})


def test_drift_is_followed_only_with_a_calibration_unless_stated_and_can_be_changed(
    folder,
):
    counts = 0.5 + 0.01 * (np.arange(100) % 2)  # equal frames are of a board that hangs
    np.save(folder / "risen.npy", BASELINE + counts[:, None, None])
    np.save(folder / "risen_forces.npy", np.full((100, *SHAPE), 0.005))
    uncalibrated = Run(source="file:risen_forces.npy", f_min=-1.0)
    uncalibrated.frames(99)
    assert uncalibrated.sensor.state()["drift"] == 0.0
    run = Run(skin="palm.toml", source="file:risen.npy")
    run.frames(50)
    found = run.sensor.state()["drift"]
    assert found > 0.0
    list(run.sensor.change(run.settings.changed({"drift": 0.0})))
    run.frames(49)
    assert run.sensor.state()["drift"] == found


GRID = (8, 8)
EXISTS = np.ones(GRID, dtype=np.bool_)
EXISTS[0, 0] = False
SKIN = SkinDescription(
    *("palm", *GRID, 2.5),
    pitch_mm=2.5,
    mask=EXISTS,
    baseline=np.full(GRID, 64.0),
    gains=np.full(GRID, 0.0078125),
    response=Response(np.array([0.5, 2.0]), np.array([0.5, 2.5])),
    noise=0.015625,
)


@pytest.fixture
def bag(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save_skin("palm.toml", SKIN)
    raw = 64 + np.random.default_rng(0).integers(0, 200, (20, *GRID))
    np.save("counts.npy", raw)
    sensor = {"source": "file:counts.npy", "skin": "palm.toml", "tare": 4}
    bus = chain(ManualClock(1), sensor=sensor, recorder={"out": "run.mcap"})
    bus.run()
    bus.close()
    bus.check()
    return tmp_path / "run.mcap"


def test_a_recording_its_table_and_what_is_reprocessed_carry_the_skin(bag, capsys):
    with BagReader(bag) as read:
        assert read.topics["/skin/calibration"].n_messages == 1
        assert read.topics["/skin/taxels"].n_messages == 16
    assert main(["recording", "info", str(bag)]) == 0
    table = capsys.readouterr().out
    assert "/skin/calibration" in table
    assert "palm" in table
    assert (
        main(
            [
                "reprocess",
                str(bag),
                "--out",
                "again.mcap",
                "--set",
                "compressor.ratio=2",
            ]
        )
        == 0
    )
    with BagReader(Path("again.mcap")) as read:
        assert last_states(read, read.topics)["/skin/skin"]["sigma_end"] == 0.015625


def test_the_skin_is_exported_with_the_tared_baseline(bag):
    assert main(["recording", "export", str(bag), "--to", "skin"]) == 0
    found = load_skin(bag.with_name("run.toml"))
    raw = np.load("counts.npy")
    assert found.baseline is not None
    np.testing.assert_array_equal(found.baseline, np.median(raw[:4], axis=0))
    np.testing.assert_array_equal(found.response.force, [0.5, 2.5])
    assert found.name == "palm"
    assert found.noise == 0.015625
    assert found.f_max == 2.5
    assert found.pitch_mm == 2.5
    np.testing.assert_array_equal(found.mask, EXISTS)


def test_a_recording_without_one_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    np.save("n.npy", np.ones((3, 4, 4)))
    assert main(["recording", "import", "n.npy", "--out", "n.mcap"]) == 0
    assert main(["recording", "export", "n.mcap", "--to", "skin"]) == 2
    assert capsys.readouterr().err.endswith("n.mcap: holds no calibration of a skin\n")


@pytest.mark.parametrize("own", [False, True])
def test_a_message_holds_a_description(own):
    reading = (
        np.stack([np.full(GRID, 0.5), np.full(GRID, 2.0)])
        if own
        else np.array([0.5, 2.0])
    )
    skin = SkinDescription(
        *("a", *GRID, 2.5),
        pitch_mm=2.0,
        noise=0.5,
        response=Response(reading, np.array([1.0, 2.0])),
    )

    state = skin_state(
        "p", **vars(skin.skin), has_truth=False, sigma_mid=0.5, sigma_end=0.5
    )
    found = of_messages(state, skin.message(0, "p"))
    for field in fields(skin):
        if field.name not in ("response", "noise_mid"):
            assert getattr(found, field.name) == getattr(skin, field.name)
    np.testing.assert_array_equal(found.response.reading, reading)
