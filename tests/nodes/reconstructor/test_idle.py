"""Idle patches: false alarms as stated, contacts noticed, forces as if all had been solved."""

import functools

import numpy as np
import pytest
from bags import chain, skin_state
from pressed import noisy, sliding_disc
from stress.test_contacts import SKIN, Watched, missed

from sparseskin.messages import Measurements, PhiState, Reconstruction, Taxels, Truth
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.faults.repeats import FRAMES
from sparseskin.nodes.reconstructor.idle import FALSE_ALARMS, REFRESH
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.scenes.tiled import TiledScene

SIDE = 32
UNTOUCHED = np.zeros(SKIN.shape, np.float32)
BATCH = {"patch": "body", "patches": ("left", "right", "back", "hand")}


@functools.cache
def batches(skip_idle=True):
    """Reconstructions and true forces of a walking body, two patches of which are idle."""
    skin = {
        "simulated": {"n_rows": SIDE, "n_cols": SIDE},
        "source": "scene:walk",
        "active": 0.5,
    }
    bus = chain(
        sensor=BATCH | skin,
        compressor=BATCH,
        reconstructor=BATCH | {"skip_idle": skip_idle},
    )
    made = [m for messages in bus.frames(60) for m in messages]
    return [
        [m for m in made if isinstance(m, kind)] for kind in (Reconstruction, Truth)
    ]


@pytest.mark.parametrize("pressed", [False, True])
@pytest.mark.slow
def test_false_alarms_are_about_as_many_as_stated(pressed):
    truth = TiledScene("hug", SKIN, 1).forces(2.2)[0] if pressed else UNTOUCHED
    watched = Watched(16, truth)
    solved = [watched.frame(truth) for _ in range(5 * REFRESH)]
    # Of 5120 frames 5 are expected to alarm: 20 or more have a probability below 1e-6.
    assert 0 <= np.mean(solved) - 1 / REFRESH < 4 * FALSE_ALARMS


def test_a_contact_of_three_sigma_is_noticed_at_once_and_one_of_one_sigma_soon():
    assert missed(8, 3.0, 20)[0] == 0.0
    assert missed(8, 2.0, 20)[1] == 0.0
    assert missed(8, 1.0, 20)[2] <= 0.1
    faint = missed(8, 0.05, 20)
    assert faint[0] >= 0.9
    assert faint == sorted(faint, reverse=True)


def test_an_idle_patch_is_solved_every_64_frames():
    truth = UNTOUCHED.copy()
    watched = Watched(8, truth)
    solved = np.array([watched.frame(truth) for _ in range(2 * REFRESH)])
    assert (solved[:REFRESH].sum(axis=0) >= 1).all()
    assert solved.sum(axis=1).max() <= 3
    assert watched.watch.idle.all()


def test_idle_patches_are_published_as_unchanged_with_the_forces_of_their_last_solve():
    found, _ = batches()
    held = {}
    last = {}
    n_unchanged = dict.fromkeys(BATCH["patches"], 0)
    for batch in found:
        for part in batch.split(held):
            if part.unchanged == (True,):
                n_unchanged[part.patch] += 1
                assert part.forces.tobytes() == last[part.patch]
                assert part.iterations == (0,)
                assert part.solve_ns == (0,)
            last[part.patch] = part.forces.tobytes()
    assert min(n_unchanged["back"], n_unchanged["hand"]) > 40
    assert n_unchanged["left"] < n_unchanged["back"]


def test_the_skip_adds_no_error_and_can_be_switched():
    rms = []
    for skip_idle in (True, False):
        held = {}
        for batch, truth in zip(*batches(skip_idle), strict=True):
            assert skip_idle or not any(batch.unchanged)
            forces = [part.forces[0] for part in batch.split(held)]
            rms.append(np.sqrt(np.mean((forces - truth.forces) ** 2, axis=(1, 2))))
    skipping, solving = np.split(np.ravel(rms), 2)
    assert (skipping - solving).max() < 0.2 * 0.0141
    # Ripples of one solved frame stay while a patch is idle: a part of the noise of a reading.
    assert np.mean(skipping - solving) < 0.1 * 0.0141
    context = Context("node", ManualClock(1))
    node = Reconstructor(Reconstructor.Settings(**BATCH, skip_idle=True), context)
    assert node.state()["idle"] == 0
    node.change(node.settings.changed({"skip_idle": False}))
    assert "idle" not in node.state()


NOISE = {"sigma_mid": 0.0628, "sigma_end": 0.0141}
NO_NOISE = {"sigma_mid": 0.0, "sigma_end": 0.0}


def served(frames, sigmas=NOISE, **settings):
    """Reconstructions of the readings of one patch."""
    (_, n_rows, n_cols) = frames.shape
    skin = skin_state(n_rows=n_rows, n_cols=n_cols, mask=None, **sigmas)
    edge = Compressor(Compressor.Settings(), Context("edge", ManualClock(1)))
    host = Reconstructor(
        Reconstructor.Settings(**settings), Context("host", ManualClock(1))
    )
    messages = [skin, *edge.step(skin)]
    for k, forces in enumerate(frames):
        messages += edge.step(Taxels(stamp_ns=k + 1, patch="skin", forces=forces))
    found = [one for message in messages for one in host.step(message)]
    return [one for one in found if isinstance(one, Reconstruction)]


def untouched_readings():
    noise = np.random.default_rng(0).normal(0, 0.0141, (40, 8, 8))
    return noise.clip(0).astype(np.float32)


def test_a_patch_that_is_served_alone_is_skipped_too():
    sent = [len(one.forces) for one in served(untouched_readings(), skip_idle=True)]
    assert len(sent) == 40
    assert sum(sent[:12]) == 12
    assert sum(sent) < 20


def test_a_skin_that_states_no_noise_is_solved_in_each_frame():
    frames = served(untouched_readings(), NO_NOISE, skip_idle=True)
    assert [len(frame.forces) for frame in frames] == [1] * 40


@pytest.mark.parametrize(("peak_n", "reasons"), [(0.02, {"weak"}), (1.0, set())])
def test_a_contact_within_the_noise_is_weak(peak_n, reasons):
    found = served(noisy(sliding_disc((24, 24), 40, peak_n=peak_n)))[20:]
    assert {reason for one in found for reason in one.reason if reason} == reasons


def test_an_idle_patch_whose_board_hangs_is_not_trusted_until_it_changes():
    """No change is no reason to solve it, so that its frames are published as unchanged."""
    names = ("left", "right")
    n = SIDE * SIDE
    rng = np.random.default_rng(0)
    lines = []
    node = Reconstructor(
        Reconstructor.Settings(patch="body", patches=names, skip_idle=True),
        Context("node", ManualClock(1), lines.append),
    )
    phi = make_phi("sbhe", n, n // 3, seed=0)
    sigmas = {"sigma_mid": 0.02, "sigma_end": 0.02}
    state = skin_state("body", n_rows=SIDE, n_cols=SIDE, mask=None, **sigmas)
    phi_state = PhiState(
        stamp_ns=0,
        patch="body",
        fingerprint=phi.fingerprint,
        rows="fixed",
        **phi.describe(),
    )
    for message in (state, phi_state):
        list(node.step(message))

    def frame(hung):
        y = phi.forward(np.maximum(rng.normal(0, 0.02, (2, n)), 0).astype(np.float32))
        y[0] = y[0] if hung is None else hung
        made = list(node.step(Measurements(
            stamp_ns=1, patch="body", names=names, y=y, phi=phi.fingerprint
        )))  # fmt: skip
        found = made[-1]
        assert isinstance(found, Reconstruction)
        return y[0], found

    for _ in range(30):
        hung, found = frame(None)
    assert all(found.unchanged)
    assert all(found.trusted)
    trusted = [frame(hung)[1].trusted for _ in range(REFRESH + 10)]
    assert trusted[: FRAMES - 1] == [(True, True)] * (FRAMES - 1)
    assert trusted[FRAMES - 1 :] == [(False, True)] * (REFRESH + 11 - FRAMES)
    assert lines.count("left: measurements repeat exactly: not trusted") == 1
    assert frame(None)[1].trusted == (True, True)
