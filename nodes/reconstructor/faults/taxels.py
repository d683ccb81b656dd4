"""Detection of faulty taxels: stuck ones, dead ones (always 0), saturated ones (always f_max)."""

from __future__ import annotations

import math
from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TypeAlias

import numpy as np

from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask, edged, of_nine, shared
from sparseskin.nodes.sensor.noise import NoiseModel

#: Frames between two searches for dead or saturated taxels, and for taxels that stand alone: with
#: at least this part of the range, next to neighbours of at most this part of their own force.
EVERY, LOOK_EVERY, LEAST_FORCE, ALONE = 10, 5, 0.08, 0.25
#: Side of a square of taxels that share a part, as a multiplexer, and least number of taxels of a
#: group: a peg may cover fewer. Least part of the taxels beside a group that are low, and least
#: force of one of its taxels, in their median. Chosen.
SQUARE, LEAST_GROUP, MOSTLY, EVEN = 8, 8, 0.75, 0.5
#: Least number of taxels of a group that is not trusted until its noise is known: no body covers
#: a whole row, column or square of the grid alone, but by chance. Chosen.
LEAST_DOUBTED = 16
#: Samples, and least frames, in which the noise of suspects is measured; stuck ones have less than
#: this part of the stated variance; the force may change by this part meanwhile.
MEASURED, MEASURED_FRAMES, QUIET, CHANGE = 200, 40, 0.2, 0.1
#: Least part of the stated noise variance in measurements: quieter skins have no stuck taxels.
REAL = 0.5
#: Median of the square of a standard normal number.
MEDIAN_SQUARE = 0.455
#: With fewer measurements than this part of the taxels, reconstructions have holes of their own.
LEAST_SEEN = 0.2
#: Most taxels whose noise is measured at a time, and that a line names.
MOST, MOST_NAMED = 64, 8
#: Mean residual, in its value, beyond which a stuck taxel is used again; rate of the mean.
MOVED, MOVED_RATE = 0.3, 0.02

#: Least force of a pressed taxel, in f_max; pressed ones among the eight neighbours of a taxel
#: inside a contact.
PRESSED, INSIDE = 0.04, 6
#: Force in the mean of its neighbours: of a dead taxel at most, of a working one at least.
LOW, ALIVE = 0.25, 0.5
#: Searches in which a dead taxel must be low; what one in which it works subtracts.
ENOUGH, SUBTRACTED = 10, 5
#: Positions in the surrounding contact in which it must be low; their distance, taxels.
PLACES, APART = 3, 3.0
#: Consecutive searches in which a dead taxel must work to be used again.
BELIEVED = 10
#: A saturated taxel, which stands alone: least force, force below which it is none, both in f_max;
#: number of searches.
FULL, BELOW_FULL, FULL_LOOKS = 0.97, 0.9, 200
#: Most faulty taxels whose cells are published; chosen: more are no single faults.
MAX_CELLS = 256

#: Number of pressed taxels before and behind one in its column, or row.
Reach: TypeAlias = tuple[int, int]


@dataclass
class _Low:
    """Evidence against one taxel: searches, and its positions in the contact."""

    looks: int = 0
    places: list[tuple[Reach, Reach]] = field(default_factory=list)


class EndWatch:
    """Searches reconstructed frames for taxels that stay at 0 or at f_max.

    A dead taxel is a hole in every contact. A body may have a hole, too, but that moves with it:
    a taxel is dead if the hole stays while the contact around it slides by three taxels, twice,
    or in as many successive contacts. A body that rocks around its hole does not slide. A taxel
    that is pressed meanwhile works.

    A saturated taxel stands alone at the end of its range, in 200 searches without ever going
    below. So does one that a peg of its size overloads for as long, which is no measurement
    either.
    """

    def __init__(self, mask: Mask, f_max: float) -> None:
        self._mask = mask
        self._n_cols = mask.shape[1]
        self._f_max = f_max
        self._low: dict[int, _Low] = {}
        self._full: dict[int, int] = {}
        self._alive: dict[int, int] = {}

    def look(self, forces: Floats, dead: Container[int]) -> tuple[list[int], list[int], list[int]]:
        """Search a reconstructed frame, float32 (n_rows, n_cols), newtons.

        `dead` and the results are places in the flat grid: of taxels excluded already; of dead and
        saturated ones newly found, and of excluded ones that work again.
        """
        holes, believed = self._look_for_holes(forces, dead)
        return holes, self._look_for_full(forces), believed

    def _look_for_holes(self, forces: Floats, dead: Container[int]) -> tuple[list[int], list[int]]:
        pressed = forces > np.float32(PRESSED * self._f_max)
        if np.count_nonzero(pressed) < INSIDE:
            return [], []
        around = of_nine(pressed.astype(np.int8), np.add) - pressed
        inside = self._mask & (around >= INSIDE)
        holes = np.flatnonzero(inside & ~pressed).tolist()
        watched = [place for place in (*self._low, *self._alive) if inside.flat[place]]
        looked_at = dict.fromkeys([*holes, *watched])
        if not looked_at:  # as in most frames
            return [], []
        found, believed = [], []
        held = np.where(pressed, forces, 0)
        for place in looked_at:
            row, col = divmod(place, self._n_cols)
            nine = held[max(0, row - 1) : row + 2, max(0, col - 1) : col + 2]
            force = float(forces[row, col])
            beside = float(nine.sum() - held[row, col]) / int(around[row, col])
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
                low.looks -= SUBTRACTED
                if low.looks <= 0:
                    del self._low[place]
        return found, believed

    def _is_dead(self, pressed: Mask, place: int) -> bool:
        """Add to the evidence against a taxel; return True if it is enough."""
        low = self._low.setdefault(place, _Low())
        low.looks += 1
        row, col = divmod(place, self._n_cols)
        here = _reach(pressed[:, col], row), _reach(pressed[row], col)
        if len(low.places) < PLACES and all(
            math.hypot(*map(_shift, here, there)) >= APART for there in low.places
        ):
            low.places.append(here)
        return low.looks >= ENOUGH and len(low.places) == PLACES

    def _look_for_full(self, forces: Floats) -> list[int]:
        full = {k: n for k, n in self._full.items() if forces.flat[k] >= BELOW_FULL * self._f_max}
        for place in np.flatnonzero(alone(forces, self._mask, FULL * self._f_max)).tolist():
            full[place] = full.get(place, 0) + 1
        found = [place for place, n_looks in full.items() if n_looks >= FULL_LOOKS]
        self._full = {place: n for place, n in full.items() if n < FULL_LOOKS}
        return found


def _reach(pressed: Mask, place: int) -> Reach:
    """Return how many successive taxels are pressed on both sides of a place in a line."""
    before, behind = (np.append(x, False) for x in (pressed[:place][::-1], pressed[place + 1 :]))
    return int(np.argmin(before)), int(np.argmin(behind))


def _shift(here: Reach, there: Reach) -> int:
    """Return the slide of a contact along a line, taxels: one side gains what the other loses."""
    begin, end = here[0] - there[0], there[1] - here[1]
    return min(abs(begin), abs(end)) if begin * end > 0 else 0


@dataclass
class _Suspect:
    """Taxels that stand alone: forces, and squared noise of each frame; True if it is as stated."""

    forces: Floats
    noise: list[Floats] = field(default_factory=list)
    works: bool = False


class TaxelWatch:
    """Finds faulty taxels, excludes them from the frames, and logs them.

    A stuck taxel stands alone, as one under a peg does; but a working taxel is noisy, and the more
    so the harder it is pressed. The noise of one taxel shows along its column of Phi, in the change
    of the residual from frame to frame. With less than a fifth of the stated variance over 200
    frames it is stuck: its reading is subtracted from the measurements, and its force is the mean
    of its neighbours. It is used again once the measurements contradict it. The taxels of a whole
    row or column, or of a square of 8 x 8, that stand alone together are judged together, in 40
    frames.

    Dead and saturated taxels are found by `EndWatch`. A dead one subtracts nothing from the
    measurements; with M < N / 5 none is searched for.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    noise : NoiseModel
        The stated one.
    log : callable
        Receives one line of text.

    Attributes
    ----------
    stuck : dict of int to float
        Readings of faulty taxels, newtons, by place in the flat grid; 0 for dead ones.
    """

    def __init__(self, mask: Mask, noise: NoiseModel, log: Callable[[str], None]) -> None:
        self._mask, self._noise, self._log = mask, noise, log
        self._taxels = shared(np.flatnonzero(mask))
        self._number = shared(np.cumsum(mask.reshape(-1)) - 1)
        self._least = LEAST_FORCE * noise.f_max
        self._suspects: dict[tuple[int, ...], _Suspect] = {}
        self._groups = _groups(mask.shape, mask.tobytes())
        probes = [places[:: places.size // 4][:4] for places, _ in self._groups]
        self._probes = shared(np.array(probes))
        self._last: dict[str, Floats] = {}
        self._columns: dict[tuple[str, int], Floats] = {}
        self._n_frames = 0
        self.stuck: dict[int, float] = {}
        self._off: dict[int, float] = {}
        self._subtracted: dict[str, Floats] = {}
        self._ends = EndWatch(mask, noise.f_max)

    @property
    def text(self) -> str:
        """The taxels excluded now, by row and column; "" if there are none."""
        stuck = [place for place, value in self.stuck.items() if value]
        named = (("stuck", stuck), ("dead", self.stuck.keys() - stuck))
        return "; ".join(f"{kind} taxels left out: {self._names(of)}" for kind, of in named if of)

    @property
    def cells(self) -> list[int]:
        """Flat cells of the taxels excluded now, in order; of many the first `MAX_CELLS`."""
        return [int(cell) for cell in sorted(self.stuck)[:MAX_CELLS]]

    @property
    def doubts(self) -> bool:
        """True while a large group stands alone, and may be stuck."""
        groups = self._suspects.values()
        return any(one.forces.size >= LEAST_DOUBTED and not one.works for one in groups)

    def cleaned(self, phi: Phi, y: Floats) -> Floats:
        """Return y, float32 (m,), without the readings of stuck taxels; y is not modified."""
        if not self.stuck:
            return y
        if phi.fingerprint not in self._subtracted:
            x = np.zeros(self._mask.size, dtype=np.float32)
            x[list(self.stuck)] = list(self.stuck.values())
            self._subtracted[phi.fingerprint] = phi.forward(x[self._taxels])
        return np.subtract(y, self._subtracted[phi.fingerprint])

    def filled(self, forces: Floats) -> Floats:
        """Return forces, float32 (n_rows, n_cols), with faulty taxels as the mean of neighbours."""
        if not self.stuck:
            return forces
        good = self._mask.copy()
        good.reshape(-1)[list(self.stuck)] = False
        n_good = of_nine(good.astype(np.float32), np.add)
        means = of_nine(np.where(good, forces, 0), np.add) / np.maximum(n_good, 1)
        filled: Floats = np.where(self._mask & ~good, means, forces)
        return filled

    def update(self, phi: Phi, forces: Floats, residual: Floats) -> None:
        """Process a frame as reconstructed by phi, not filled: float32 (n_rows, n_cols), newtons.

        `residual`, float32 (m,), is the `cleaned` measurements less Phi times the forces.
        """
        last = self._last.get(phi.fingerprint)
        self._last[phi.fingerprint] = residual
        if last is not None and (self._suspects or self.stuck):
            self._measure(phi, forces, residual, residual - last)
        self.search(forces)
        if self._n_frames % EVERY == 1:
            self._look_at_ends(forces, phi.m >= LEAST_SEEN * phi.n)

    def search(self, forces: Floats) -> None:
        """Suspect taxels that stand alone in a frame, float32 (n_rows, n_cols), whatever they
        measure: that alone is done for frames whose rows are chosen at the edge.
        """
        if self._n_frames % LOOK_EVERY == 0:
            self._look(forces)
        self._n_frames += 1

    def _measure(self, phi: Phi, forces: Floats, residual: Floats, change: Floats) -> None:
        """Collect the noise of suspects; use stuck taxels again that the residual contradicts."""
        seen = phi.m / phi.n
        for places, suspect in list(self._suspects.items()):
            columns = np.stack([self._column(phi, place) for place in places[:MOST]])
            suspect.noise.append(np.square(columns @ change) / 2)
            if len(suspect.noise) < max(MEASURED_FRAMES, MEASURED / suspect.forces.size):
                continue
            # The median: a contact that moves elsewhere is no noise.
            variance = float(np.median(suspect.noise)) / MEDIAN_SQUARE
            expected2 = seen**2 * float(self._noise.variance(suspect.forces).mean())
            suspect.noise.clear()
            suspect.works = variance >= QUIET * expected2
            if not suspect.works and self._as_noisy_as_stated(forces, change, places):
                self._exclude(places, suspect.forces)
        for place, value in list(self.stuck.items()):
            if not value:
                continue
            off = float(np.dot(self._column(phi, place), residual)) / seen
            self._off[place] += MOVED_RATE * (off - self._off[place])
            if abs(self._off[place]) > MOVED * value:
                self._use_again(place)

    def _as_noisy_as_stated(self, forces: Floats, change: Floats, quiet: Sequence[int]) -> bool:
        """True if the measurements have the stated noise of all taxels but the quiet ones."""
        variances = self._noise.variance(forces)
        variances.flat[list(quiet)] = 0
        stated = float(variances[self._mask].mean())
        return float(np.median(np.square(change))) / MEDIAN_SQUARE / 2 > REAL * stated

    def _exclude(self, places: Sequence[int], values: Floats | Sequence[float]) -> None:
        self._suspects.pop(tuple(places), None)
        for place, value in zip(places, values, strict=True):
            self.stuck[place], self._off[place] = float(value), 0.0
        self._subtracted.clear()
        alike = np.mean(values)
        verb, taxels = ("are", "taxels") if len(places) > 1 else ("is", "taxel")
        fault = f"{verb} stuck at {alike:.3g}" if alike else "reads 0 in every contact"
        self._log(f"{taxels} {self._names(places)} {fault}: left out")

    def _use_again(self, place: int) -> None:
        del self.stuck[place]
        self._subtracted.clear()
        self._log(f"taxel {self._names([place])} works again: used")

    def _look_at_ends(self, forces: Floats, search_dead: bool) -> None:
        """Exclude taxels that stay at an end of the range; use dead ones again that do not."""
        dead, saturated, alive = self._ends.look(forces, self.stuck)
        for place in dead if search_dead else ():
            self._exclude([place], [0.0])
        for place in saturated:
            self._exclude([place], [float(forces.flat[place])])
        for place in alive:
            if not self.stuck[place]:
                self._use_again(place)

    def _look(self, forces: Floats) -> None:
        """Suspect the taxels that stand alone; drop those that do not any more, or have changed."""
        found = self._together(forces)
        lone = np.flatnonzero(alone(forces, self._mask, self._least))
        found += [(place,) for place in lone.tolist()]
        found = [places for places in found if not self.stuck.keys() & places]
        flat = forces.reshape(-1)
        if not found and not self._suspects and not self.stuck:
            self._columns.clear()
        for places, suspect in list(self._suspects.items()):
            change = np.abs(flat[list(places)] - suspect.forces)
            moved = np.count_nonzero(change > CHANGE * suspect.forces)
            if places not in found or moved > (1 - MOSTLY) * len(places):
                del self._suspects[places]
        room = MOST - sum(map(len, self._suspects))
        for places in found:
            if places not in self._suspects and room > 0:
                self._suspects[places] = _Suspect(flat[list(places)])
                room -= len(places)

    def _together(self, forces: Floats) -> list[tuple[int, ...]]:
        """Return the groups whose taxels are pressed alike, and stand alone together."""
        if not self._groups:
            return []
        flat, bound = forces.reshape(-1), np.float32(self._least)
        found = []
        for group in np.flatnonzero((flat[self._probes] > bound).all(axis=1)).tolist():
            places, beside = self._groups[group]
            least, around, most = flat[places].min(), flat[beside], MOSTLY * beside.size
            # The median, which takes longest, is below least / EVEN in a group that is found.
            if least > bound and np.count_nonzero(around < ALONE / EVEN * least) >= most:
                middle = float(np.median(flat[places]))
                if least > EVEN * middle and np.count_nonzero(around < ALONE * middle) >= most:
                    found.append(tuple(places.tolist()))
        return found

    def _column(self, phi: Phi, place: int) -> Floats:
        key = phi.fingerprint, place
        if key not in self._columns:
            unit = np.zeros(phi.n, dtype=np.float32)
            unit[self._number[place]] = 1
            self._columns[key] = phi.forward(unit)
        return self._columns[key]

    def _names(self, places: Iterable[int]) -> str:
        n_cols = self._mask.shape[1]
        return listed([f"({place // n_cols}, {place % n_cols})" for place in sorted(places)])


def alone(forces: Floats, mask: Mask, least: float) -> Mask:
    """Return the taxels above a force whose eight neighbours have at most `ALONE` of their own.

    forces, float32, mask and result, bool, have shape (n_rows, n_cols).
    """
    found: Mask = mask & (forces > np.float32(least))
    if found.any():
        padded = edged(forces)
        beside = np.maximum(padded[:-2], padded[2:])
        three = np.maximum(beside, padded[1:-1])
        most = np.maximum(np.maximum(three[:, :-2], three[:, 2:]), beside[:, 1:-1])
        found &= most < ALONE * forces
    return found


@lru_cache(maxsize=8)
def _groups(shape: tuple[int, int], exists: bytes) -> list[tuple[Indices, Indices]]:
    """Return rows, columns and squares of taxels, and those beside each, as places in the grid;
    `exists` are the bytes of the mask.
    """
    n_rows, n_cols = shape
    mask = np.frombuffer(exists, dtype=np.bool_).reshape(shape)
    cells = np.arange(mask.size).reshape(mask.shape)
    boxes = [(row, row + 1, 0, n_cols) for row in range(n_rows)]
    boxes += [(0, n_rows, col, col + 1) for col in range(n_cols)]
    boxes += [
        (row, row + SQUARE, col, col + SQUARE)
        for row in range(0, n_rows, SQUARE)
        for col in range(0, n_cols, SQUARE)
    ]
    groups = []
    for top, bottom, left, right in boxes:
        inside = np.zeros_like(mask)
        inside[top:bottom, left:right] = True
        around = np.zeros_like(mask)
        around[max(0, top - 1) : bottom + 1, max(0, left - 1) : right + 1] = True
        places, beside = cells[inside & mask], cells[around & ~inside & mask]
        if places.size >= LEAST_GROUP and beside.size:
            groups.append((places, beside))
    return groups


def listed(names: Sequence[object]) -> str:
    """The first `MOST_NAMED` of some names, and how many more there are."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(map(str, names[:MOST_NAMED])) + more
