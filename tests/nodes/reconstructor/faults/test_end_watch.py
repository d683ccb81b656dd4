"""Dead and saturated taxels are found by what stays while contacts move; holes are not."""

import numpy as np
import pytest
from watched import SKIN_SHAPE as SHAPE
from watched import Skin, pad

from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.reconstructor.faults.taxels import (
    BELIEVED,
    ENOUGH,
    EVERY,
    FULL_LOOKS,
    EndWatch,
)


@pytest.fixture(scope="module")
def phi():
    return make_phi("sbhe", 784, 784 // 3, seed=0)


def watch():
    return EndWatch(np.ones(SHAPE, np.bool_), 2.5)


def block(row, col):
    """A square of 9 x 9 taxels around a place."""
    return pad((slice(row - 4, row + 5), slice(col - 4, col + 5)))


def holed(row, col):
    frame = block(row, col)
    frame[10, 14] = 0
    return frame


#: A square that passes over the dead taxel, three taxels and once more.
PASSED = [holed(10, col) for col in (11, 14, 17)]


def ring(col):
    """A square with a hole in its middle."""
    frame = block(10, col)
    frame[10, col] = 0
    return frame


def lying(end):
    """Pressed around the hole from column 10 up to this one."""
    frame = pad((slice(6, 15), slice(10, end)))
    frame[10, 14] = 0
    return frame


@pytest.mark.parametrize(
    ("frames", "n_looks"),
    [
        ([ring(col) for col in range(10, 18)], ENOUGH),  # the hole moves with its body
        ([holed(10, 13), holed(10, 14)] * 10 * ENOUGH, 1),  # it rests or rocks by a taxel
        ([lying(end) for end in (17, 23, 30)], 2 * ENOUGH),  # a body lies down around it
        ([2.5 * block(10, 14)], 2 * FULL_LOOKS),  # a contact at the end of the range
    ],
)
def test_what_a_body_may_do_is_no_fault(frames, n_looks):
    one = watch()
    for frame in frames:
        for _ in range(n_looks):
            assert one.look(frame, {}) == ([], [], [])


def test_a_taxel_that_is_pressed_between_is_alive():
    one = watch()
    for frame in PASSED:
        for _ in range(ENOUGH - 1):
            assert one.look(frame, {}) == ([], [], [])
        for _ in range(2):
            assert one.look(block(10, 14), {}) == ([], [], [])


def test_a_dead_taxel_is_logged_filled_in_and_used_again(phi):
    skin = Skin(phi)
    for col in (11, 14, 17):
        for _ in range(8 * EVERY):
            forces = skin.read(block(10, col), {(10, 14): 0.0})
    assert skin.watch.text == "dead taxels left out: (10, 14)"
    assert skin.lines == ["taxel (10, 14) reads 0 in every contact: left out"]
    assert forces[10, 14] == pytest.approx(1.0, abs=0.15)
    for _ in range((BELIEVED + 5) * EVERY):
        skin.read(block(10, 14))
    assert skin.watch.text == ""
    assert skin.lines[1:] == ["taxel (10, 14) works again: used"]


def test_with_few_measurements_holes_in_reconstructions_are_no_evidence():
    skin = Skin(make_phi("sbhe", 784, 784 // 8, seed=0))
    for frame in PASSED:
        for _ in range(ENOUGH * EVERY):
            skin.watch.update(skin.phi, frame, np.zeros(skin.phi.m, np.float32))
    assert skin.lines == []


def test_a_saturated_taxel_is_found_on_an_untouched_skin(phi):
    skin = Skin(phi)
    for _ in range((FULL_LOOKS + 10) * EVERY):
        forces = skin.read(pad(), {(10, 14): 2.5})
    assert skin.lines == ["taxel (10, 14) is stuck at 2.5: left out"]
    assert forces[10, 14] < 0.05
