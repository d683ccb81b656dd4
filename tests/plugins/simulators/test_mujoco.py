"""MuJoCo models as sources: what the taxels read, and which models are refused."""

from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from damaged import refusal

import sparseskin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.scenes.bodies import Body, build_sole, slab
from sparseskin.nodes.sensor.scenes.scenes import SKIN
from sparseskin.nodes.sensor.scenes.simulation import Drag, Scene, SceneSource
from sparseskin.nodes.sensor.sources import find_address, open_source

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

from sparseskin.plugins.simulators.model import check_model, find_pad, load_model  # noqa: E402
from sparseskin.plugins.simulators.source import MujocoSource  # noqa: E402
from sparseskin.plugins.simulators.touch import Touch  # noqa: E402

MODELS = Path(__file__).parents[3] / "examples" / "models"
PAD = f"{MODELS / 'pad.xml'}#pad"
ARM = f"{MODELS / 'arm.xml'}#tip"
G = 9.81
ISOLATED = "sparseskin.nodes.process.isolation"


@pytest.fixture(autouse=True)
def direct(request, monkeypatch):
    """Check models in this process, without the start of another, unless a test is of that."""
    if "isolated" not in request.keywords:
        name = "sparseskin.plugins.simulators.model.shape_in_child"
        monkeypatch.setattr(
            name, lambda address, n_bytes: MujocoSource(address).pad.shape
        )


def model_of(bodies, folder, site='type="box" size="0.02 0.015 0.005"', more=""):
    """Write a model with a fixed skin of 8 x 6 taxels whose plane is z = 0; its address."""
    path = folder / "model.xml"
    path.write_text(
        f"""<mujoco><option timestep="0.001"/>{more}<worldbody><body name="skin">
        <geom type="box" size="0.02 0.015 0.005" pos="0 0 -0.005" contype="0" conaffinity="0"/>
        <site name="pad" {site} pos="0 0 -0.005"/></body>{bodies}</worldbody></mujoco>"""
    )
    return f"{path}#pad"


def read_once(address, move=None):
    """Forces of the first state of a model, (n_rows, n_cols) in newtons; `move` changes it."""
    path, _, site = address.rpartition("#")
    model = load_model(path)
    data = mujoco.MjData(model)
    if move is not None:
        move(data)
    mujoco.mj_forward(model, data)
    return Touch(model, data, find_pad(model, site, path)).read()


BALL = '<body pos="0 0 {z}"><freejoint/><geom type="sphere" size="0.01" mass="0.1"/></body>'


@pytest.mark.parametrize("depth_m", [0.0002, 0.004])
def test_a_ball_at_rest_is_read_as_deep_as_it_is(tmp_path, depth_m):
    forces = read_once(model_of(BALL.format(z=0.01 - depth_m), tmp_path))
    assert forces.shape == (6, 8)
    row, col = np.mgrid[:6, :8]
    away2 = ((row - 2.5) ** 2 + (col - 3.5) ** 2) * SKIN.pitch_m**2
    depth = depth_m - 0.01 + np.sqrt(np.maximum(0.01**2 - away2, 0.0))
    expected = SKIN.stiffness * np.where(away2 < 0.01**2, np.maximum(depth, 0), 0)
    assert forces == pytest.approx(expected, abs=1e-5)


# about y: points of positive x
@pytest.mark.parametrize(
    ("of", "speed", "down"),
    [
        (2, -0.05, [0.05] * 8),
        (2, 0.5, [-0.5] * 8),
        (
            4,
            2.0,
            (np.arange(8) - 3.5) * SKIN.pitch_m * 2.0,
        ),
    ],
)
def test_damping_acts_on_the_rate_of_penetration_of_each_point(
    tmp_path, of, speed, down
):
    geom = '<geom type="box" size="0.1 0.1 0.01" mass="1"/>'
    slab_ = f'<body pos="0 0 0.009"><freejoint/>{geom}</body>'

    def move(data):
        data.qvel[of] = speed

    forces = read_once(model_of(slab_, tmp_path), move)
    expected = np.maximum(0.0, SKIN.stiffness * 0.001 + SKIN.damping * np.array(down))
    assert forces == pytest.approx(np.tile(expected, (6, 1)), abs=1e-4)


@pytest.mark.parametrize(
    ("bodies", "expected"),
    [
        # Rows lie along y, columns along x.
        ('<geom pos="0.0125 -0.0075 0.003" size="0.004" mass="0.1"/>', 1),
        # Behind the skin, and above it.
        ('<geom pos="0 0 -0.05" size="0.01" mass="0.1"/>', 0),
        ('<geom pos="0 0 0.02" size="0.01" mass="0.1"/>', 0),
        # Deeper than is read: the deepest.
        ('<geom type="box" pos="0 0 0.03" size="0.1 0.1 0.06" mass="1"/>', 48),
    ],
)
def test_bodies_are_felt_where_they_are(tmp_path, bodies, expected):
    forces = read_once(model_of(f"<body><freejoint/>{bodies}</body>", tmp_path))
    assert np.count_nonzero(forces) == expected
    if expected == 1:
        assert np.argwhere(forces > 0).tolist() == [[1, 6]]
    if expected == 48:
        assert forces == pytest.approx(np.full((6, 8), SKIN.stiffness * 0.02), rel=1e-5)


def test_a_skin_may_lie_in_any_direction(tmp_path):
    path = tmp_path / "model.xml"
    path.write_text(
        """<mujoco><worldbody><body pos="1 2 3" euler="40 70 20"><site name="pad" type="box"
        size="0.02 0.015 0.005" pos="0 0 -0.005"/><body pos="0 0 0.009"><joint axis="0 0 1"
        type="slide"/><geom type="sphere" size="0.01" mass="1"/></body></body></worldbody>
        </mujoco>"""
    )
    address = f"{path}#pad"
    assert read_once(address).sum() == pytest.approx(
        read_once(model_of(BALL.format(z=0.009), tmp_path)).sum(), rel=1e-4
    )


def test_forces_in_mujoco_are_those_of_the_contact_model():
    """The same box dropped on the same skin: sums within 1 %, footprints equal, 60 dB at rest."""
    n_steps = 700
    sides = (-0.03, 0.03, -0.02, 0.02)
    scene = Scene(
        name="box",
        shape=(32, 32),
        n_steps=n_steps,
        dt_ns=1_000_000,
        body=Body(build_sole([slab(*sides, 0.0)], sides, 0.0), 0.3, 1.0),
        surface=SKIN,
        drop_height_m=0.03,
        motion=Drag(at_s=9.0, velocity_m_s=(0.0, 0.0)),
        place_m=(-0.03, 0.0),
    )
    ours = np.zeros((n_steps, 32, 32), np.float32)
    for frame, state in zip(ours, SceneSource(scene, 0).states(), strict=True):
        state.write_forces(frame)
    theirs = np.stack([forces for _, forces in islice(MujocoSource(PAD), n_steps)])
    rest = slice(500, n_steps)
    assert np.array_equal(ours[rest] > 0, theirs[rest] > 0)
    assert theirs[rest].sum((1, 2)) == pytest.approx(ours[rest].sum((1, 2)), rel=0.01)
    assert sparseskin.psnr_db(theirs[rest], ours[rest]).min() > 60
    assert theirs.max() == pytest.approx(ours.max(), rel=0.05)  # of the impact


def test_a_source_runs_at_1_khz_and_anew_each_time_an_arm_presses_and_lets_go(tmp_path):
    total = np.array([forces.sum() for _, forces in MujocoSource(ARM)])
    assert total[500] == 0
    assert total[-1] == 0
    assert total[1400] > 5
    source = open_source(f"mujoco:{PAD}", seed=0)
    assert source.rate_hz == pytest.approx(1000)
    assert source.skin.shape == (32, 32)
    assert source.skin.pitch_m == 0.005
    assert source.n_frames == 2000
    one, two = ([(t, f.tobytes()) for t, f in islice(source, 150)] for _ in range(2))
    assert one == two
    assert [t for t, _ in one[:3]] == [0, 1_000_000, 2_000_000]
    address = model_of(BALL.format(z=0.02), tmp_path)
    path = Path(address.rpartition("#")[0])
    path.write_text(path.read_text().replace('timestep="0.001"', 'timestep="0.00025"'))
    assert [t for t, _ in islice(MujocoSource(address), 3)] == [0, 1_000_000, 2_000_000]


def test_where_the_skin_collides_the_contact_of_mujoco_bears_the_load(tmp_path):
    address = model_of(BALL.format(z=0.011), tmp_path)
    path = Path(address.rpartition("#")[0])
    path.write_text(path.read_text().replace('contype="0" conaffinity="0"', ""))
    source = MujocoSource(address)
    for _ in islice(source, 800):
        pass
    assert not source.touch.presses
    assert source.touch.contact_force() == pytest.approx(0.1 * G, rel=0.01)
    assert not source.data.xfrc_applied.any()


def test_a_control_of_your_own_drives_the_model():
    seen = []

    def control(model, data, time_s):
        seen.append(time_s)
        data.ctrl[:] = 0.01

    assert sum(1 for _ in MujocoSource(PAD, control=control, duration_s=0.05)) == 50
    assert seen == pytest.approx([k * 1e-3 for k in range(50)])
    with pytest.raises(SourceError, match="control failed: ZeroDivisionError"):
        list(MujocoSource(PAD, control=lambda *_: 1 / 0, duration_s=0.05))


def test_a_simulation_that_diverges_is_reported(tmp_path):
    stiff = '<custom><numeric name="pad_stiffness" data="1e9"/></custom>'
    address = model_of(
        BALL.format(z=0.006).replace("0.1", "0.001"), tmp_path, more=stiff
    )
    with pytest.raises(
        SourceError, match=r"diverges at 0\.[0-9]+ s; allowed: a smaller time step"
    ):
        list(islice(MujocoSource(address), 3000))


@pytest.mark.parametrize(
    ("bodies", "site", "more", "text"),
    [
        ("", "", "", "site 'pad' is no box"),
        (
            "",
            'type="box" size="0.02 0.013 0.005"',
            "",
            "has 5.20 taxels of 5 mm along y; allowed",
        ),
        ("", 'type="box" size="0.02 0.015 0.005"', "", "no geom can touch site 'pad'"),
        (
            BALL.format(z=1),
            'type="box" size="0.02 0.015 0.005"',
            '<custom><numeric name="pad_pitch_m" data="-1"/></custom>',
            "numeric 'pad_pitch_m': expected one number in",
        ),
    ],
)
def test_a_model_without_a_skin_is_refused(
    tmp_path, monkeypatch, bodies, site, more, text
):
    monkeypatch.chdir(tmp_path)
    address = model_of(bodies, tmp_path, site, more)
    assert text in refusal(
        lambda: find_address(f"mujoco:{address}").check(), SourceError
    )
    # no log of MuJoCo
    assert [path.name for path in tmp_path.iterdir()] == ["model.xml"]


@pytest.mark.parametrize("step_s", ["1e-12", "1000"])
def test_a_time_step_that_never_ends_or_skips_all_is_refused(tmp_path, step_s):
    path = Path(model_of(BALL.format(z=1), tmp_path).partition("#")[0])
    path.write_text(
        path.read_text().replace('timestep="0.001"', f'timestep="{step_s}"')
    )
    with pytest.raises(
        SourceError, match=rf"a time step of {step_s} s; allowed: 1e-06\.\.0\.1 s"
    ):
        load_model(str(path))


@pytest.mark.parametrize(
    ("source", "stated", "text"),
    [
        ("pad.xml", {}, "expected mujoco:MODEL.xml#SITE"),
        (PAD.replace("#pad", "#pat"), {}, "has no site 'pat' (did you mean 'pad'?)"),
        (f"{__file__}#pad", {}, "expected a MuJoCo model, .xml or .mjb"),
        (
            PAD,
            {"layout": Layout(n_rows=16)},
            "n_rows = 16 is stated, but the frames have 32",
        ),
    ],
)
def test_a_bad_address_is_refused_in_one_line(source, stated, text):
    assert text in refusal(
        lambda: find_address(f"mujoco:{source}", **stated).check(), SourceError
    )


@pytest.mark.isolated
def test_a_model_is_checked_in_a_process_whose_time_and_memory_are_bounded(
    tmp_path, monkeypatch
):
    text = (MODELS / "pad.xml").read_text()
    (tmp_path / "pad.xml").write_text(text)
    assert check_model(f"{tmp_path / 'pad.xml'}#pad", None, None) == 1024
    huge = tmp_path / "huge.xml"
    huge.write_text(text.replace("<worldbody>", '<size memory="4000G"/><worldbody>'))
    with pytest.raises(
        SourceError, match=r"huge\.xml: MuJoCo refuses it: .*allocate memory$"
    ):
        check_model(f"{huge}#pad", None, None)
    many = '<worldbody><replicate count="1000000000"><body><geom size="1"/></body></replicate>'
    endless = tmp_path / "endless.xml"
    endless.write_text(text.replace("<worldbody>", many))
    monkeypatch.setattr(f"{ISOLATED}.START_S", 1.0)
    with pytest.raises(
        SourceError, match=r"endless\.xml#pad: not read within 1 s; a damaged or"
    ):
        check_model(f"{endless}#pad", None, None)
