"""Scenes on points: forces in balance with the push; skins of points in nodes, files, batches."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import load
from sparseskin.launch.launchfile.spec import LaunchError
from sparseskin.messages import SkinState, Taxels, Truth, decode
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.description import SkinFileError
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.nodes.sensor.scenes.scenes import SKIN
from sparseskin.nodes.sensor.skin_file import load_skin, save_skin
from sparseskin.plugins.points.placing import placed
from sparseskin.plugins.points.scenes import SCENES, PointScene


def test_the_forces_of_a_ball_at_rest_are_those_of_its_depth():
    """At rest k sum(d_i cos_i) is the push; each d_i is that of a ball at one place in space."""
    placement = placed("example:grip")
    scene = PointScene("ball_presses", placement, seed=2)
    *_, (_, image) = islice(scene, 58)  # 0.58 s: just before it is lifted
    forces = image.reshape(-1)[placement.cells].astype(np.float64)
    points = placement.points
    radius = 0.5 * placement.pitch_m
    touched = np.flatnonzero(forces > 0)
    assert touched.size > 4
    middles = points.places - radius * points.normals
    # The distances of the touched taxels to the middle of the ball follow from their forces: three
    # and more spheres meet in that point.
    away = SCENES["ball_presses"].radius_m + radius - forces[touched] / SKIN.stiffness
    some = middles[touched]
    a = np.concatenate([2 * some, np.ones((len(some), 1))], axis=1)
    found = np.linalg.lstsq(a, (some**2).sum(axis=1) - away**2, rcond=None)[0][:3]
    assert np.abs(np.linalg.norm(some - found, axis=1) - away).max() < 1e-4
    push = (forces[touched, None] * (found - some) / away[:, None]).sum(axis=0)
    assert np.linalg.norm(push) == pytest.approx(
        SCENES["ball_presses"].push_n, rel=0.05
    )


@pytest.mark.parametrize("name", SCENES)
def test_a_scene_presses_and_repeats_itself(name):
    scene = PointScene(name, placed("example:grip"), seed=1)
    frames = [(stamp, forces.copy()) for stamp, forces in islice(scene, 60)]
    assert [stamp for stamp, _ in frames] == [k * 10_000_000 for k in range(60)]
    assert 0.05 < max(forces.max() for _, forces in frames) <= 2.5
    assert min(forces.min() for _, forces in frames) >= 0
    for (_, a), (_, b) in zip(frames, islice(scene, 60), strict=True):
        assert np.array_equal(a, b)


class Run:
    """A sensor with its settings checked, its log and what it publishes."""

    def __init__(self, **values):
        self.log = []
        self.settings = Sensor.Settings(**values)
        self.settings.check()
        self.sensor = Sensor(
            self.settings, Context("s", ManualClock(), log=self.log.append)
        )
        (self.state,) = (m for m in self.sensor.start() if isinstance(m, SkinState))

    def frame(self):
        return list(self.sensor.tick(Tick(1, 0)))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Six taxels of 2 x 3, in the order of their file, and a recording of their readings."""
    (tmp_path / "six.csv").write_text(
        "x_mm,y_mm,z_mm\n4,0,0\n0,4,0\n8,0,0\n0,0,0\n8,4,0\n4,4,0\n"
    )
    np.save(
        tmp_path / "six.npy", np.arange(1.0, 7.0).reshape(1, 1, 6).repeat(5, axis=0)
    )
    (tmp_path / "six.toml").write_text(
        'points = "six.csv"\nf_max = 10.0\ngains = [1, 2, 1, 1, 1, 1]\n'
    )
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_the_sensor_publishes_places_and_forces_of_a_scene():
    run = Run(source="scene:finger_path", points="example:grip")
    assert run.state.skin.points is not None
    assert run.log[0] == "grip: 924 taxels on a virtual grid of 21 x 44, 4.99 mm apart"
    assert [type(message) for message in run.frame()] == [Taxels, Truth]
    assert list(Sensor.facts(run.settings).values()) == [924]


def test_readings_in_the_order_of_the_file_stand_on_the_grid(folder):
    run = Run(source="file:six.npy", points="six.csv", unit="N", f_max=10.0)
    (taxels,) = run.frame()
    assert taxels.forces[0].tolist() == [[2, 6, 5], [4, 1, 3]]
    assert np.allclose(run.state.points[0, :3], [0, 0.004, 0])
    assert run.state.point_rows.tolist() == [1, 5, 4, 3, 0, 2]


def test_a_skin_file_with_points_is_calibrated_in_their_order(folder):
    run = Run(source="file:six.npy", skin="six.toml", drift=0.0)
    (taxels,) = run.frame()
    assert taxels.forces[0].tolist() == [[4, 6, 5], [4, 1, 3]]
    assert run.state.point_rows.tolist() == [1, 5, 4, 3, 0, 2]
    again = folder / "again.toml"
    save_skin(again, load_skin("six.toml"))
    loaded = load_skin(again)
    assert loaded.points is not None
    assert np.array_equal(loaded.skin.points, run.state.points)
    for line, what in (
        ('points = "six.csv"\nn_rows = 2', "n_rows: is stated beside points"),
        ("points = 3", "points: expected the name of a file"),
        (
            'points = "six.csv"\nbaseline = [1, 2]',
            "baseline: six: a frame has 2 readings",
        ),
    ):
        (folder / "bad.toml").write_text(f"f_max = 1.0\n{line}")
        with pytest.raises(SkinFileError, match=f"bad.toml: {what}"):
            load_skin("bad.toml")


@pytest.mark.parametrize(
    ("values", "what"),
    [
        (
            {"source": "scene:path_40"},
            "scene path_40 presses a flat grid; allowed on points: fin",
        ),
        ({"source": "scene:finger_pat"}, "no scene on points is called 'finger_pat'"),
        (
            {"points": "", "source": "scene:limb_path"},
            "limb_path presses a skin of points; state",
        ),
        ({"points": "none.csv"}, "points: none.csv: no such file"),
        ({"skin": "six.toml"}, "points: the file of the skin has its own"),
        (
            {"source": "file:five.npy", "unit": "N", "f_max": 10.0},
            "six: a frame has 5 readings; ex",
        ),
    ],
)
def test_settings_that_contradict_the_points_are_refused(folder, values, what):
    np.save("five.npy", np.ones((2, 1, 5)))
    settings = {"points": "six.csv", "source": "file:six.npy", **values}
    with pytest.raises((SettingsError, SourceError), match=what):
        Run(**settings)


POINTS = "sensor.points=example:grip"


@pytest.mark.slow
def test_a_skin_of_points_is_recorded_exported_and_reprocessed(start, tmp_path):
    bag = tmp_path / "run.mcap"
    options = ["--frames", "30", "--record", str(bag)]
    for setting in (
        POINTS,
        "sensor.rate_hz=0",
        "reconstructor.fast=off",
        "monitor.page=false",
    ):
        options += ["--set", setting]
    out, _ = start("launch", "torso", *options).ended()
    assert "N = 924, M = 308" in out
    with BagReader(bag) as reader:
        (state,) = (
            decode(m.topic.encode(), m.payload) for m in reader.messages(["/skin/skin"])
        )
    assert state.points is not None
    exported = tmp_path / "run.npz"
    again = tmp_path / "again.mcap"
    assert (
        main(["recording", "export", str(bag), "--to", "npz", "--out", str(exported)])
        == 0
    )
    assert np.array_equal(open_file(str(exported)).skin.points, state.points)
    assert (
        main(
            ["reprocess", str(bag), "--out", str(again), "--set", "compressor.ratio=4"]
        )
        == 0
    )
    with BagReader(again) as reader:
        assert len(list(reader.messages(["/skin/reconstruction"]))) == 30


BODY = """
[[patches]]
name = "palm"
n_rows = 8
n_cols = 8
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
    (sensor,) = (
        one for one in found if "points" in (getattr(one, "simulated", None) or {})
    )
    assert sensor.patches == ("sole",)
    assert sensor.address().n_taxels() == 924
    Path("body.toml").write_text(BODY.replace("example:grip", "a.csv"))
    with pytest.raises(LaunchError, match=r"a\.csv: no such file"):
        load("body", ["skin.body=body.toml"])
