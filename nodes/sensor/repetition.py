"""Repetition: how often noise lets a taxel read the same number again."""

import math
from collections.abc import Sequence

import numpy as np

from sparseskin.nodes.numerics.arrays import AnyArray, Mask
from sparseskin.nodes.sensor.layout.layout import listed

CHANCE = 1e-12
"""Probability at which the noise of a taxel repeats one reading so often. Chosen: at 1 kHz one in
10 years on 4096 taxels."""
QUIETER = 4.0
"""Largest ratio of the probabilities of a repetition, of a pressed taxel and an untouched one.
Chosen: its noise may be a quarter."""
USUAL = 0.9
"""Probability of a repetition from which on nothing is concluded. Chosen: readings of so coarse a
converter stand still under a load that does."""
MOST_STILL = 0.5
"""Part of a skin from which on taxels that do not move are no single faults. Chosen."""
CLIPPED = 0.25
"""Part of the readings of a taxel that its noise does not make equal, where it shows. Chosen."""


def needed_repetitions(n_repeated: int, n_pairs: int) -> float:
    """Number of repetitions in a row that noise does not explain, where so many of all pairs of
    successive readings were repetitions; infinite where noise explains any number.
    """
    # One more of each: before the first repetition none is ruled out.
    probability = QUIETER * (n_repeated + 1) / (n_pairs + 1)
    if probability >= USUAL:
        return math.inf
    return math.ceil(math.log(CHANCE) / math.log(probability))


def still_taxels(readings: AnyArray, works: Mask) -> Mask:
    """Taxels that read one number in all frames, as the noise of the others does not explain: bool
    (n_rows, n_cols). `readings`: (n, n_rows, n_cols), of the untouched skin, NaN where they are
    missing; `works`: taxels that are looked at.
    """
    still: Mask = works & (readings == readings[0]).all(axis=0)
    moving = works & ~still
    if not moving.any() or still.sum() >= MOST_STILL * works.sum():
        return np.zeros_like(works)

    of_moving = readings[:, moving]
    repeated = of_moving[1:] == of_moving[:-1]
    n_repetitions = len(readings) - 1
    if n_repetitions < needed_repetitions(int(repeated.sum()), repeated.size):
        return np.zeros_like(works)

    # A converter that ends at what taxels read at rest clips the noise of all of them.
    for end in (np.nanmin(of_moving), np.nanmax(of_moving)):
        share_at_end = (of_moving == end).mean(axis=0)
        if share_at_end.max() > CLIPPED:
            still &= readings[0] != end
    return still


def names_of(cells: Sequence[int], n_cols: int) -> str:
    """Row and column of flat cells of a grid; of many, the first ones."""
    return listed([str(divmod(cell, n_cols)) for cell in cells])


def line_on_still(readings: AnyArray, works: Mask) -> str:
    """The taxels of `still_taxels` in words, as they are after a tare with these frames; "" if
    there are none.
    """
    still = still_taxels(readings, works)
    if not still.any():
        return ""
    # Their baseline is what they read whatever presses: nothing else shows them from then on.
    cells = np.flatnonzero(still).tolist()
    return f"stuck taxels, whose force stays 0: {names_of(cells, still.shape[1])}"
