"""A node of several patches that is late puts comparisons of models off to later frames."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest

from sparseskin.messages import Measurements, PhiState, Reconstruction, SkinState
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.rotation import m_of
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.presses import press_frames

NAMES = ("left", "right", "back", "hand")
SHAPE = (16, 20)
FIRST = 18
"""First frame that is solved, with its contact: the past says nothing of any patch."""


class Stream(NamedTuple):
    """Measurements of one patch and its true forces, newtons, frame by frame."""

    phi: Phi
    y: list[Floats]
    truth: list[Floats]


def behind() -> bool:
    return True


def on_time() -> bool:
    return False


@pytest.fixture(scope="module")
def presses() -> list[Stream]:
    """Smooth presses that begin at once on all patches: they need both models."""
    n, noise = SHAPE[0] * SHAPE[1], NoiseModel.for_range(2.5)
    phi = make_phi("sbhe", n, m_of(n, 3), 0)
    found = []
    for seed in range(len(NAMES)):
        frames = list(press_frames("gaussian", SHAPE, 24, seed, active=0.5, noise=noise))[FIRST:]
        y = [phi.forward(readings.reshape(-1).astype(np.float32)).copy() for _, readings in frames]
        found.append(Stream(phi, y, [truth.reshape(SHAPE) for truth, _ in frames]))
    return found


def states(patch: str, known: Stream) -> tuple[SkinState, PhiState]:
    skin = SkinState(
        stamp_ns=0, patch=patch, n_rows=SHAPE[0], n_cols=SHAPE[1], f_max=2.5, unit="N",
        pitch_m=None, mask=None, source="", seed=0, rate_hz=0.0, has_truth=False, sigma_mid=0.0,
        sigma_end=0.0,
    )  # fmt: skip
    phi = known.phi
    return skin, PhiState(
        stamp_ns=0, patch=patch, fingerprint=phi.fingerprint, **phi.describe(), rows="fixed"
    )


class Body:
    """A node of four patches, and whether it is behind."""

    def __init__(self, presses: list[Stream], is_behind: Callable[[], bool]) -> None:
        self.presses, self.is_behind = presses, is_behind
        context = Context("node", ManualClock(1), is_behind=lambda: self.is_behind())
        settings = Reconstructor.Settings(patch="body", patches=NAMES, skip_idle=True)
        self.node = Reconstructor(settings, context)
        for state in states("body", presses[0]):
            list(self.node.step(state))

    def frame(self, k: int) -> list[Reconstruction]:
        y = np.stack([one.y[k] for one in self.presses])
        phi = self.presses[0].phi.fingerprint
        message = Measurements(stamp_ns=k + 1, patch="body", names=NAMES, y=y, phi=phi)
        (found,) = self.node.step(message)
        assert isinstance(found, Reconstruction)
        return found.split()

    @property
    def n_put_off(self) -> int:
        """Number of comparisons that were put off so far."""
        return int(self.node.state()["put_off"])


def alone(known: Stream, n_frames: int) -> list[Reconstruction]:
    """Frames of one patch, by a node of its own."""
    node = Reconstructor(Reconstructor.Settings(patch="alone"), Context("node", ManualClock(1)))
    for state in states("alone", known):
        list(node.step(state))
    made = []
    for k, y in enumerate(known.y[:n_frames]):
        measured = Measurements(stamp_ns=k + 1, patch="alone", y=y, phi=known.phi.fingerprint)
        made += [m for m in node.step(measured) if isinstance(m, Reconstruction)]
    return made


def assert_same(mine: Reconstruction, other: Reconstruction) -> None:
    assert mine.forces.tobytes() == other.forces.tobytes()
    assert mine.trusted == other.trusted
    assert mine.error == other.error


def test_on_time_all_patches_are_compared_at_once_as_alone(presses: list[Stream]) -> None:
    body = Body(presses, on_time)
    found = [body.frame(k) for k in range(3)]
    assert body.n_put_off == 0
    assert body.node.status() == "solver skin; 4 patches"
    for place, known in enumerate(presses):
        for mine, other in zip(found, alone(known, 3), strict=True):
            assert_same(mine[place], other)


def test_behind_one_patch_a_frame_is_compared_those_that_wait_longest_first(
    presses: list[Stream],
) -> None:
    body = Body(presses, behind)
    frames, put_off = [], []
    for k in range(5):
        frames.append(body.frame(k))
        put_off.append(body.n_put_off)
    assert put_off == [3, 3 + 2, 3 + 2 + 1, 6, 6]
    assert "6 comparisons put off" in body.node.status()
    # A patch that was compared has fewer iterations in the frame after: of the smooth model alone.
    most = frames[0][0].iterations
    known = [[one.patch for one in found if one.iterations < most] for found in frames]
    assert known == [[], ["left"], ["left", "right"], ["left", "right", "back"], list(NAMES)]


def test_a_patch_that_is_put_off_has_its_haar_estimate_with_its_own_error_and_trust(
    presses: list[Stream],
) -> None:
    first, *others = Body(presses, behind).frame(0)
    assert_same(first, alone(presses[0], 1)[0])
    for mine, known in zip(others, presses[1:], strict=True):
        haar = make_solver("skin", known.phi, make_basis("haar", *SHAPE))
        haar.may_compare = lambda: False
        assert mine.forces.tobytes() == haar.solve(known.y[0]).tobytes()
        assert (mine.error, mine.trusted) == ((haar.error,), (haar.trusted,))
    # The press on the last patch is beyond what Haar can do.
    assert [one.trusted for one in others] == [(True,), (True,), (False,)]


def test_spread_over_frames_the_forces_are_soon_as_good_as_on_time(presses: list[Stream]) -> None:
    found = []
    for is_behind in (behind, on_time):
        body = Body(presses, is_behind)
        frames = [body.frame(k) for k in range(6)][-1]
        wrong = [one.forces[0] - known.truth[5] for one, known in zip(frames, presses, strict=True)]
        found.append(np.sqrt(np.mean(np.square(wrong), axis=(1, 2))))
    np.testing.assert_allclose(found[0], found[1], rtol=0.1)


def test_what_was_put_off_is_computed_as_soon_as_no_frame_waits(presses: list[Stream]) -> None:
    body = Body(presses, behind)
    body.frame(0)
    body.is_behind = on_time
    body.frame(1)
    assert body.n_put_off == 3


def test_a_frame_that_comes_in_the_middle_of_another_puts_off_the_rest_of_it(
    presses: list[Stream],
) -> None:
    asked = iter([False, True, True])
    body = Body(presses, lambda: next(asked))
    body.frame(0)
    # The first is compared in any case.
    assert body.n_put_off == 2


def test_another_rate_of_the_sensor_sets_no_solver_up_anew(presses: list[Stream]) -> None:
    body = Body(presses, on_time)
    body.frame(0)
    skin, phi = states("body", presses[0])
    assert list(body.node.step(dataclasses.replace(skin, stamp_ns=2, seq=1, rate_hz=50.0))) == []
    assert list(body.node.step(dataclasses.replace(phi, stamp_ns=2, seq=1))) == []
    found = body.frame(1)
    for place, known in enumerate(presses):
        assert_same(found[place], alone(known, 2)[1])
    assert list(body.node.step(dataclasses.replace(skin, f_max=2.0)))
