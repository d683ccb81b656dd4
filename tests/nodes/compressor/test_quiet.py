"""Quiet frames: none is sent at rest, none is missed, and losses are counted as ever."""

import math

import numpy as np
import pytest
from bags import PERIOD_NS, chain, launched, skin_state
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2, norm

from sparseskin.messages import Contacts, Measurements, PhiState, Reconstruction, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.change import FALSE_SENDS, ChangeWatch
from sparseskin.nodes.compressor.departures import (
    SquarePyramid,
    Weights,
    energy_bound,
    variance_clipped,
)
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.contact_tracks import ContactTracker
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.noise import CLIPPED, NoiseModel

NOISE = NoiseModel()
SHAPE = (24, 24)
SKIN = {"mask": None, "sigma_mid": NOISE.sigma_mid, "sigma_end": NOISE.sigma_end}


def skin(shape=SHAPE, **changes):
    return skin_state(n_rows=shape[0], n_cols=shape[1], **SKIN | changes)


class Edge:
    """A compressor and the noisy frames that it reads."""

    def __init__(self, shape=SHAPE, state=None, **values):
        self.lines = []
        context = Context("edge", ManualClock(1), self.lines.append)
        self.node = Compressor(Compressor.Settings(**values), context)
        self.state = state or skin(shape)
        self.phi = list(self.node.step(self.state))
        self.names = self.node.settings.patches
        self.rng = np.random.default_rng(0)
        self.n_frames = 0

    def frame(self, truth, **fields):
        """The measurements of the next frame; [] if it is not sent."""
        readings = NOISE.apply(np.asarray(truth, dtype=np.float32), self.rng)
        self.n_frames += 1
        return list(self.node.step(Taxels(
            stamp_ns=self.n_frames * PERIOD_NS, patch=self.node.settings.patch, names=self.names,
            forces=readings, **fields,
        )))  # fmt: skip


@given(st.integers(1, 40), st.integers(1, 40))
def test_squares_sum_all_taxels_at_every_level(n_rows, n_cols):
    grid = np.arange(n_rows * n_cols, dtype=np.float32).reshape(1, n_rows, n_cols)
    pyramid = SquarePyramid((n_rows, n_cols))
    sums = pyramid.sums(grid)[0]
    assert sums.size == pyramid.n
    for side, span in zip(pyramid.sides, pyramid.spans, strict=True):
        assert sums[span].sum() == grid.sum()
        assert sums[span][0] == grid[0, :side, :side].sum()


@given(st.integers(1, 10_000), st.floats(2.0, 8.0))
def test_bounds_lie_between_closed_forms(n, z):
    # One clipped reading exceeds z as often as a normal one; many are nearly normal.
    assert CLIPPED < variance_clipped(Weights(n_inside=n), 1, z) < 1
    quantile = chi2.isf(norm.sf(z), n)
    assert energy_bound(n, 0, z) > 0.99 * quantile
    assert energy_bound(0, n, z) > energy_bound(n, 0, z)


@pytest.mark.parametrize("level", [0.0, 0.5, 1.0, 70.0, None])
def test_false_sends_are_at_most_as_many_as_stated(level, monkeypatch):
    # A thousand times as many as stated, so that a few thousand frames show them.
    monkeypatch.setattr(
        "sparseskin.nodes.compressor.change.FALSE_SENDS", 1e3 * FALSE_SENDS
    )
    truth = np.zeros((16, 12, 20), dtype=np.float32)
    truth[:, 2:6, 2:9] = 0.4
    if level is not None:
        truth[:] = level * NOISE.sigma_end
    watch = ChangeWatch(len(truth), skin(truth.shape[1:]))
    rng = np.random.default_rng(3)
    for _ in range(2 * watch.length):
        watch.to_send(NOISE.apply(truth, rng))
    n_sent = sum(
        np.count_nonzero(watch.to_send(NOISE.apply(truth, rng))) for _ in range(400)
    )
    n_expected = 1e3 * FALSE_SENDS * 400 * len(truth)
    # Each alarm sends a block: the number of alarms has about this deviation.
    deviation = math.sqrt(n_expected * watch.length)
    assert n_sent < n_expected + 3 * deviation


def test_a_skin_at_rest_is_silent_but_for_a_cycle_in_each_period():
    edge = Edge(quiet=0.5, ratio=4)
    rest = np.zeros((1, *SHAPE))
    sent = [bool(edge.frame(rest)) for _ in range(400)]
    assert all(sent[:64])
    # 50 frames a period, and 4 to read all rows.
    assert sum(sent[64:]) <= (400 - 64) // 50 * 4 + 4
    assert edge.node.state()["quiet"] == 1
    truth = rest.copy()
    truth[0, 8:11, 8:11] = 0.3
    first = edge.frame(truth)
    assert len(first) == 1
    assert first[0].quiet == sent.count(False)


@settings(max_examples=5, deadline=None)
@given(
    st.integers(0, 2**31),
    st.floats(0.5, 2.0),
    st.tuples(st.integers(0, 20), st.integers(0, 20)),
    st.sampled_from([3, 4]),
)
def test_a_contact_begins_in_the_same_frame_as_without(seed, force, place, ratio):
    row, col = place
    truth = np.zeros((1, *SHAPE))
    truth[0, row : row + 4, col : col + 4] = force
    begins = []
    for quiet in (None, 10.0):
        edge = Edge(quiet=quiet, ratio=ratio)
        edge.rng = np.random.default_rng(seed)
        host = Reconstructor(
            Reconstructor.Settings(contacts=True), Context("host", ManualClock(1))
        )
        messages = [edge.state, *edge.phi]
        for k in range(110):
            messages += edge.frame(truth if k >= 95 else 0 * truth)
        contacts = [
            m for each in messages for m in host.step(each) if isinstance(m, Contacts)
        ]
        stamps = [
            m.stamp_ns
            for m in contacts
            if "begin" in [name for _, name in m.named_events]
        ]
        begins.append(stamps)
    assert begins[0] == begins[1]
    assert begins[0]


def test_what_the_sensor_states_of_its_readings_is_sent_at_once():
    edge = Edge(quiet=10.0)
    rest = np.zeros((1, *SHAPE))
    for _ in range(100):
        sent = edge.frame(rest)
    assert not sent
    assert edge.frame(rest, reason=("saturated",))
    assert not edge.frame(rest, reason=("saturated",))[1:]
    for _ in range(10):
        sent = edge.frame(rest, reason=("saturated",))
    assert not sent
    assert edge.frame(rest)


def test_a_skin_without_stated_noise_is_never_quiet():
    edge = Edge(state=skin(sigma_mid=0.0, sigma_end=0.0), quiet=1.0)
    assert all(edge.frame(np.zeros((1, *SHAPE))) for _ in range(100))
    (line,) = edge.lines
    assert line.startswith("quiet: every frame is sent, as the skin states no noise")


def test_of_several_patches_only_those_that_change_are_sent():
    names = ("left", "right", "back")
    edge = Edge(patch="body", patches=names, quiet=10.0, state=skin(patch="body"))
    host = Reconstructor(
        Reconstructor.Settings(patch="body", patches=names, fast="off", skip_idle=True),
        Context("host", ManualClock(1)),
    )
    truth = np.zeros((3, *SHAPE))
    messages = [edge.state, *edge.phi]
    for _ in range(120):
        messages += edge.frame(truth)
    truth[1, 5:9, 5:9] = 0.5
    messages += edge.frame(truth)
    last = messages[-1]
    assert last.unchanged == (True, False, True)
    assert last.y.shape[0] == 1
    assert [part.patch for part in last.split()] == ["right"]
    found = [
        m for each in messages for m in host.step(each) if isinstance(m, Reconstruction)
    ][-1]
    assert found.unchanged == (True, False, True)
    assert found.forces.shape == (1, *SHAPE)


@pytest.mark.parametrize("n_lost", [0, 3])
def test_frames_and_losses_are_counted_exactly(n_lost):
    # By a clock of its own: heartbeats do not depend on the load of the host.
    bus = chain(
        ManualClock(1),
        sensor={"source": "scene:path_40"},
        compressor={"quiet": 0.05},
        monitor={},
    )
    monitor = bus.hosts["monitor"]
    node = bus.hosts["reconstructor"].node
    step = node.step
    dropped = []

    def lossy(message):
        if (
            isinstance(message, Measurements)
            and message.seq >= 100
            and len(dropped) < n_lost
        ):
            dropped.append(message)
            return ()
        return step(message)

    node.step = lossy
    bus.run(360)
    frames = monitor.node.report()["patches"]["skin"]["frames"]
    assert frames["quiet"] > 100
    assert frames["lost"] == n_lost
    assert frames["sensed"] == 360


@given(st.floats(0.01, 2.0), st.integers(1, 50))
def test_a_silence_is_for_contacts_as_frames_that_do_not_change(force, n_silent):
    forces = np.zeros(SHAPE, dtype=np.float32)
    forces[4:7, 4:7] = 1.0
    moved = np.roll(forces, 1, axis=1)
    followed = []
    for rests in (True, False):
        tracker = ContactTracker(skin(), "off")
        tracker.update(forces, 0.01, 0)
        tracker.update(moved, 0.01, PERIOD_NS)
        stamps = [(2 + k) * PERIOD_NS for k in range(n_silent)]
        if rests:
            tracker.rest(stamps[-1])
        else:
            for stamp_ns in stamps:
                tracker.update(moved, 0.01, stamp_ns)
        followed.append(tracker.update(forces, 0.01, stamps[-1] + PERIOD_NS).fields)
    for name in ("age_s", "velocity"):
        assert followed[0][name] == pytest.approx(followed[1][name], rel=1e-4, abs=1e-6)


def test_a_replay_sends_the_same_frames():
    sent = []
    for _ in range(2):
        edge = Edge(quiet=0.3)
        truth = np.zeros((1, *SHAPE))
        found = [each for k in range(200) for each in edge.frame(truth + (k > 150))]
        assert all(isinstance(each, Measurements) for each in found)
        assert isinstance(edge.phi[0], PhiState)
        sent.append([(each.stamp_ns, each.quiet, each.y.tobytes()) for each in found])
    assert sent[0] == sent[1]


def test_a_recording_of_a_quiet_skin_plays_back_to_the_same_forces(tmp_path):
    path = tmp_path / "quiet.mcap"
    bus = chain(
        ManualClock(1),
        sensor={"source": "scene:path_40"},
        compressor={"quiet": 0.05},
        reconstructor={"iterations": 4, "fast": "off"},
        recorder={"out": str(path)},
    )
    recorded = [m for messages in bus.frames(240) for m in messages]
    bus.close()
    bus.check()
    changes = ("reconstructor.iterations=4", "reconstructor.fast=off")
    replay = launched("replay_measurements", f"player.file={path}", *changes)
    replayed = [m for messages in replay.frames() for m in messages]
    replay.check()
    frames = [
        [(m.forces.tobytes(), m.quiet) for m in run if isinstance(m, Reconstruction)]
        for run in (recorded, replayed)
    ]
    # What is quiet at the end is sent after all, as the bus closes.
    assert 64 <= len(frames[0]) < 200
    assert frames[1][: len(frames[0])] == frames[0]
    assert len(frames[1]) <= len(frames[0]) + 1
