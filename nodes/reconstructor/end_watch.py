"""Finds the taxels that stand at an end of their range: dead ones at 0, saturated ones at f_max."""

from __future__ import annotations

import math
from collections.abc import Container
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.reconstructor.solver import Mask

#: Least force of a pressed taxel, in f_max, and how many of the eight neighbours a taxel inside
#: of a contact has pressed.
PRESSED, INSIDE = 0.04, 6
#: Part of its neighbours' mean that a dead taxel is restored with at most, and a living one at
#: least.
LOW, ALIVE = 0.25, 0.5
#: Looks in which a dead taxel has to be low, and what one in which it is alive takes off.
ENOUGH, TAKEN_OFF = 10, 5
#: Places of the contact around it, so many taxels apart, in which it has to be low.
PLACES, APART = 3, 3.0
#: Looks in a row in which a dead taxel has to be alive to be believed again.
BELIEVED = 10
#: A saturated taxel: its force and that of its neighbours, in f_max, and looks.
FULL, BELOW_FULL, BESIDE_FULL, FULL_LOOKS = 0.97, 0.9, 0.25, 200


#: How many pressed taxels there are before and behind one in its column, or row.
Reach: TypeAlias = tuple[int, int]


@dataclass
class _Low:
    """Evidence against one taxel: looks, and where it stood in the contact."""

    looks: int = 0
    places: list[tuple[Reach, Reach]] = field(default_factory=list)


class EndWatch:
    """Looks at restored frames for taxels that stay at 0 or at f_max, whatever presses them.

    A dead taxel is a hole in every contact. A body may have a hole, too, but that moves with it:
    a taxel is dead where the hole stays while the contact around slides, three taxels at least
    and once more, or in as many contacts one after the other. A body that rocks around its hole
    does not slide. One that is pressed meanwhile is
    alive.

    A saturated taxel stands alone at the end of its range, in 200 looks and without ever going
    below. So does one that a peg of its size overloads for as long: that is no measurement
    either.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    f_max : float
        Upper end of the range, newtons.
    """

    def __init__(self, mask: Mask, f_max: float) -> None:
        self._mask = mask
        self._n_cols = mask.shape[1]
        self._pressed = PRESSED * f_max
        self._f_max = f_max
        self._low: dict[int, _Low] = {}
        self._full: dict[int, int] = {}
        self._alive: dict[int, int] = {}

    def look(self, forces: Floats, dead: Container[int]) -> tuple[list[int], list[int], list[int]]:
        """Take in a restored frame.

        Parameters
        ----------
        forces : ndarray of float32, shape (n_rows, n_cols)
            As restored, newtons.
        dead : container of int
            Places in the flat grid of the taxels that are left out already.

        Returns
        -------
        dead, saturated, alive : list of int
            Places of taxels newly found, and of those left out that are pressed again.
        """
        found, believed = self._look_for_holes(forces, dead)
        return found, self._look_for_full(forces), believed

    def _look_for_holes(self, forces: Floats, dead: Container[int]) -> tuple[list[int], list[int]]:
        pressed = forces > np.float32(self._pressed)
        if np.count_nonzero(pressed) < INSIDE:
            return [], []
        inside = self._mask & (_around(pressed.astype(np.int8)) >= INSIDE)
        # Only these may be holes, or are watched: most frames have none.
        watched = [place for place in self._low if inside.flat[place]]
        watched += [place for place in self._alive if inside.flat[place]]
        holes = np.flatnonzero(inside & ~pressed).tolist()
        found, believed = [], []
        for place in dict.fromkeys([*holes, *watched]):
            force, beside = float(forces.flat[place]), self._beside(forces, pressed, place)
            if place in dead:
                self._alive[place] = self._alive.get(place, 0) + 1 if force > ALIVE * beside else 0
                if self._alive[place] >= BELIEVED:
                    del self._alive[place]
                    believed.append(place)
            elif force < LOW * beside:
                if self._is_dead(pressed, place):
                    del self._low[place]
                    self._alive[place] = 0
                    found.append(place)
            elif force > ALIVE * beside and place in self._low:
                low = self._low[place]
                low.looks -= TAKEN_OFF
                if low.looks <= 0:
                    del self._low[place]
        return found, believed

    def _is_dead(self, pressed: Mask, place: int) -> bool:
        """Add a look to the evidence against a taxel; whether it is enough."""
        low = self._low.setdefault(place, _Low())
        low.looks += 1
        row, col = divmod(place, self._n_cols)
        here = _reach(pressed[:, col], row), _reach(pressed[row], col)
        if len(low.places) < PLACES and all(
            math.hypot(*map(_shift, here, there)) >= APART for there in low.places
        ):
            low.places.append(here)
        return low.looks >= ENOUGH and len(low.places) == PLACES

    def _beside(self, forces: Floats, pressed: Mask, place: int) -> float:
        """Mean of the neighbours that are pressed."""
        row, col = divmod(place, self._n_cols)
        around = slice(max(0, row - 1), row + 2), slice(max(0, col - 1), col + 2)
        among = pressed[around].copy()
        among[row - around[0].start, col - around[1].start] = False
        return float(forces[around][among].mean())

    def _look_for_full(self, forces: Floats) -> list[int]:
        full = np.flatnonzero(self._mask & (forces >= np.float32(FULL * self._f_max))).tolist()
        for place in [one for one in self._full if forces.flat[one] < BELOW_FULL * self._f_max]:
            del self._full[place]
        found = []
        for place in full:
            row, col = divmod(place, self._n_cols)
            around = forces[max(0, row - 1) : row + 2, max(0, col - 1) : col + 2]
            # The taxel itself is one of them.
            if np.count_nonzero(around > BESIDE_FULL * self._f_max) == 1:
                self._full[place] = self._full.get(place, 0) + 1
                if self._full[place] >= FULL_LOOKS:
                    del self._full[place]
                    found.append(place)
        return found


def _around(counts: np.ndarray[tuple[int, int], np.dtype[np.int8]]) -> Floats:
    """Sum of the eight neighbours of each taxel; 0 beyond the edge."""
    edged = np.pad(counts, 1)
    three = edged[:-2] + edged[1:-1] + edged[2:]
    sums: Floats = three[:, :-2] + three[:, 1:-1] + three[:, 2:] - counts
    return sums


def _reach(pressed: Mask, place: int) -> Reach:
    """How many taxels in a row are pressed on both sides of a place in a line of taxels."""
    before, behind = pressed[:place][::-1], pressed[place + 1 :]
    to_begin = before.size if before.all() else int(np.argmin(before))
    to_end = behind.size if behind.all() else int(np.argmin(behind))
    return to_begin, to_end


def _shift(here: Reach, there: Reach) -> int:
    """How far a contact has slid along a line: what one side gained, the other has lost. A body
    that rocks or lies down gains or loses at one side alone.
    """
    begin, end = here[0] - there[0], there[1] - here[1]
    return min(abs(begin), abs(end)) if begin * end > 0 else 0
