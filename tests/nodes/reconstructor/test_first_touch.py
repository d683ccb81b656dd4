"""First touch from measurements: it starts contacts, none is false, none is lost."""

import numpy as np
import pytest
from bags import PERIOD_NS, skin_state
from hypothesis import given, settings
from hypothesis import strategies as st

from sparseskin.messages import Contacts, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.first_touch import (
    ALONE,
    LEARNT,
    TouchTest,
    TouchWatch,
)
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.noise import NoiseModel

NOISE = NoiseModel()
SHAPE = (16, 16)
SIGMAS = {"sigma_mid": NOISE.sigma_mid, "sigma_end": NOISE.sigma_end}


def skin(**changes):
    values = {"n_rows": SHAPE[0], "n_cols": SHAPE[1], "mask": None, **SIGMAS}
    return skin_state(**values | changes)


class Watched:
    """One patch, its noise and rotating rows."""

    def __init__(self, ratio=3, seed=0):
        n = SHAPE[0] * SHAPE[1]
        self.phis = row_subsets(make_phi("sbhe", n, -(-n // ratio), seed=0), None)
        self.watch = TouchWatch(TouchTest(skin(), self.phis))
        self.rng = np.random.default_rng(seed)
        self.k = 0

    def frame(self, truth, offset=0.0, step=0.0):
        """The touch of the next frame."""
        phi = self.phis[self.k % len(self.phis)]
        self.k += 1
        readings = NOISE.apply(np.asarray(truth, dtype=np.float32), self.rng)
        y = phi.forward(readings.reshape(-1) + np.float32(offset))
        if step:
            y = (np.rint(y / step) * step).astype(np.float32)
        self.watch.read(phi, y, step)
        return self.watch.touch


def contacts_of(truths, seed, state=None, **values):
    """Names of the events of each frame of some true forces."""
    state = state or skin()
    edge = Compressor(Compressor.Settings(**values), Context("edge", ManualClock(1)))
    host = Reconstructor(
        Reconstructor.Settings(contacts=True, fast="off"),
        Context("host", ManualClock(1)),
    )
    for message in (state, *edge.step(state)):
        list(host.step(message))
    rng = np.random.default_rng(seed)
    events = []
    for k, truth in enumerate(truths):
        forces = NOISE.apply(np.asarray(truth, dtype=np.float32)[np.newaxis], rng)
        taxels = Taxels(stamp_ns=(k + 1) * PERIOD_NS, patch="skin", forces=forces)
        answers = [a for m in edge.step(taxels) for a in host.step(m)]
        (found,) = (each for each in answers if isinstance(each, Contacts))
        events.append(found.named_events)
    return events


def square(row, col, side, force):
    truth = np.zeros(SHAPE)
    truth[row : row + side, col : col + side] = force
    return truth


@settings(max_examples=6, deadline=None)
@given(
    st.integers(0, 12), st.integers(0, 12), st.integers(1, 4), st.floats(0.1, 1.0),
    st.sampled_from([3, 4]), st.integers(0, 2**31),
)  # fmt: skip
def test_no_contact_begins_before_its_touch(row, col, side, force, ratio, seed):
    rest = [np.zeros(SHAPE)] * 16
    pressed = [square(row, col, side, force)] * 12
    events = contacts_of([*rest, *pressed], seed, ratio=ratio)
    assert not any(events[:16])
    names = [[name for _, name in frame] for frame in events]
    touches = [k for k, frame in enumerate(names) if "touch" in frame]
    begins = [k for k, frame in enumerate(names) if "begin" in frame]
    assert len(touches) == 1
    assert touches[0] <= min(begins, default=len(names))
    assert all(
        number == 0 for frame in events for number, name in frame if name == "touch"
    )
    if force >= 0.3:
        # Far out of the noise, both are in the first frame.
        assert touches[0] == 16
        assert begins[0] == 16


def test_a_skin_without_stated_noise_has_contacts_and_no_touch():
    bare = skin(sigma_mid=0.0, sigma_end=0.0)
    truths = [np.zeros(SHAPE)] * 16 + [square(4, 4, 3, 1.0)] * 4
    events = contacts_of(truths, 0, bare)
    names = [name for frame in events for _, name in frame]
    assert "begin" in names
    assert "touch" not in names


@pytest.mark.parametrize("step", [0.0, 0.004])
def test_false_touches_are_at_most_as_many_as_stated(step, monkeypatch):
    # Ten thousand times as many as stated.
    monkeypatch.setattr(
        "sparseskin.nodes.reconstructor.first_touch.FALSE_TOUCHES", 1e-3
    )
    watched = Watched()
    n_frames = 3000
    begins = [watched.frame(np.zeros(SHAPE), step=step).begins for _ in range(n_frames)]
    expected = 1e-3 * n_frames
    assert sum(begins) <= expected + 4 * np.sqrt(expected)


@given(st.floats(0.15, 2.0), st.integers(0, 15), st.integers(0, 15), st.integers(1, 9))
@settings(max_examples=10, deadline=None)
def test_a_touch_begins_once_and_is_over_once_it_no_longer_shows(force, row, col, n):
    watched = Watched(seed=n)
    span = watched.watch.test.span
    calm = [watched.frame(np.zeros(SHAPE)) for _ in range(span)]
    assert not any(each.touched for each in calm)
    truth = square(row, col, 1, force)
    touches = [watched.frame(truth) for _ in range(span + n)]
    assert [each.begins for each in touches].count(True) == 1
    assert touches[-1].touched
    after = [watched.frame(np.zeros(SHAPE)) for _ in range(3 * span)]
    assert not any(each.begins for each in after)
    assert after[-1].touched is False


def test_an_offset_is_learnt_and_excludes_no_contact():
    watched = Watched()
    span = watched.watch.test.span
    n_frames = ALONE * span + LEARNT * len(watched.phis) + 2
    rest = np.zeros(SHAPE)
    touches = [watched.frame(rest, offset=0.02) for _ in range(n_frames)]
    assert [each.begins for each in touches].count(True) == 1
    later = [watched.frame(rest, offset=0.02) for _ in range(4 * span)]
    # Of a learnt reference, no touch is not known: contacts begin as without.
    assert {each.touched for each in later} == {None}
    assert watched.frame(square(3, 3, 2, 0.5), offset=0.02).begins
    back = [watched.frame(rest) for _ in range(4 * span)]
    assert back[-1].touched is False


@pytest.mark.parametrize("given_y", ["none", "other", "coarse"])
def test_what_cannot_be_compared_is_not_known(given_y):
    watched = Watched()
    watched.frame(np.zeros(SHAPE))
    phi = watched.phis[0]
    y = np.zeros(phi.m, dtype=np.float32)
    step = 0.0
    if given_y == "none":
        y = None
    elif given_y == "other":
        phi = make_phi("sbhe", phi.n, phi.m, seed=9)
    else:
        step = 2 * NOISE.sigma_end
    watched.watch.read(phi, y, step)
    assert watched.watch.touch.touched is None
