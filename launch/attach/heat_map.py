"""A map of readings as lines of a terminal: two taxels a character, one above the other."""

import math

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats

COLOURS = (234, 17, 18, 54, 55, 91, 127, 163, 161, 197, 203, 209, 215, 221, 228, 230)
"""Colours of a palette of 256 from dark to bright, chosen: brightness rises with the reading, so
that it shows without colours too."""
LETTERS = " .:-=+*#%@"
"""Marks of the same, where there are no colours."""
UPPER_HALF = "▀"
RESET = "\x1b[0m"


def heat_map(
    forces: Floats, top: float, width: int, height: int, coloured: bool = True
) -> list[str]:
    """Lines that show a frame of readings, float32 (n_rows, n_cols), 0 or more: at most `height` of
    `width` characters beside codes of colours, both 1 or more; letters where not `coloured`.

    `top`, above 0, is the reading of the brightest colour. A taxel becomes a square as large as
    fits; where there are more taxels than places, a place shows the largest of its taxels.
    """
    # A character is about twice as high as wide: with colours it holds two places, with letters a
    # place has two characters.
    if not coloured:
        n_wide = max(1, width // 2)
        places = _places(forces, height, n_wide)
        lines = []
        for row in _levels(places, top, len(LETTERS)):
            letters = [LETTERS[level] * 2 for level in row]
            lines.append("".join(letters))
        return lines

    places = _places(forces, 2 * height, width)
    if len(places) % 2:
        # The last line has an empty lower half.
        empty_row = np.zeros((1, places.shape[1]), places.dtype)
        places = np.vstack([places, empty_row])
    levels = _levels(places, top, len(COLOURS))
    pairs = zip(levels[::2], levels[1::2], strict=True)
    return [_line(upper, lower) for upper, lower in pairs]


def _places(forces: Floats, n_high: int, n_wide: int) -> Floats:
    """Readings of at most so many places: taxels as squares, or the largest taxel of a place."""
    n_rows, n_cols = forces.shape
    side = min(n_high // n_rows, n_wide // n_cols)
    if side >= 1:
        high = np.repeat(forces, side, axis=0)
        return np.repeat(high, side, axis=1)

    # A place shows the largest of k x k taxels, so that no contact is lost.
    k_high = math.ceil(n_rows / n_high)
    k_wide = math.ceil(n_cols / n_wide)
    k = max(k_high, k_wide)
    # Empty cells fill the last squares of each side.
    below = (0, -n_rows % k)
    right = (0, -n_cols % k)
    padded = np.pad(forces, (below, right))
    squares = padded.reshape(len(padded) // k, k, -1, k)
    places: Floats = squares.max((1, 3))
    return places


def _levels(places: Floats, top: float, n: int) -> list[list[int]]:
    share = np.clip(places / top, 0, 1)
    # The top itself belongs to the last level.
    levels = (share * n).astype(int)
    rows: list[list[int]] = np.minimum(levels, n - 1).tolist()
    return rows


def _line(upper: list[int], lower: list[int]) -> str:
    parts = []
    colours = (-1, -1)
    for pair in zip(upper, lower, strict=True):
        if pair != colours:
            colours = pair
            front = COLOURS[pair[0]]
            back = COLOURS[pair[1]]
            parts.append(f"\x1b[38;5;{front};48;5;{back}m")
        parts.append(UPPER_HALF)
    return "".join(parts) + RESET
