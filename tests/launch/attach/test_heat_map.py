"""A map of readings as lines of a terminal."""

import re

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.attach.heat_map import COLOURS, LETTERS, UPPER_HALF, heat_map

CODE = re.compile(r"\x1b\[[0-9;]*m")


def pixels(lines):
    """Levels of the places that coloured lines show, two rows a line."""
    rows = []
    for line in lines:
        upper, lower, colours = [], [], (0, 0)
        for token in re.findall(r"\x1b\[[0-9;]*m|.", line):
            if found := re.fullmatch(r"\x1b\[38;5;(\d+);48;5;(\d+)m", token):
                colours = COLOURS.index(int(found[1])), COLOURS.index(int(found[2]))
            elif token == UPPER_HALF:
                upper.append(colours[0])
                lower.append(colours[1])
        rows += [upper, lower]
    return np.array(rows)


def test_a_taxel_is_as_large_a_square_as_fits_and_the_brightest_is_the_top():
    forces = np.zeros((2, 3), np.float32)
    forces[0, 2], forces[1, 0] = 1.0, 0.5
    shown = pixels(heat_map(forces, 1.0, 12, 5))
    assert shown.shape == (8, 12)  # four places a taxel
    expected = np.zeros((2, 3))
    expected[0, 2], expected[1, 0] = len(COLOURS) - 1, len(COLOURS) // 2
    np.testing.assert_array_equal(shown, np.kron(expected, np.ones((4, 4))))


def test_of_more_taxels_than_places_the_largest_is_shown():
    forces = np.zeros((64, 64), np.float32)
    forces[37, 61] = 1.0
    shown = pixels(heat_map(forces, 1.0, 16, 8))
    assert shown.shape == (16, 16)
    assert list(np.argwhere(shown)[0]) == [37 // 4, 61 // 4]


@given(
    rows=st.integers(1, 70),
    cols=st.integers(1, 70),
    width=st.integers(1, 90),
    height=st.integers(1, 40),
    coloured=st.booleans(),
)
def test_the_map_fits(rows, cols, width, height, coloured):
    lines = heat_map(np.ones((rows, cols), np.float32), 1.0, width, height, coloured)
    assert 1 <= len(lines) <= height
    widths = {len(CODE.sub("", line)) for line in lines}
    assert len(widths) == 1
    assert 1 <= widths.pop() <= max(width, 1 if coloured else 2)


def test_without_colours_letters_stand_for_the_readings():
    forces = np.linspace(0, 1, len(LETTERS), dtype=np.float32)[None]
    (line,) = heat_map(forces, 1.0, 2 * len(LETTERS), 1, coloured=False)
    assert line == "".join(2 * letter for letter in LETTERS)
