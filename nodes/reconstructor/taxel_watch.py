"""Watches the taxels: which of them read a constant, whatever presses them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.reconstructor.end_watch import EndWatch
from sparseskin.nodes.reconstructor.solver import Mask

#: Frames between two looks for taxels that stand alone, with at least this part of the range and
#: next to neighbours of at most this part of their own force.
EVERY, LEAST_FORCE, ALONE = 10, 0.08, 0.25
#: Frames in which a taxel's noise is measured, part of what a living taxel has, and how far its
#: force may change meanwhile.
MEASURED, QUIET, CHANGE = 200, 0.2, 0.1
#: Part of the noise that the skin says it has, which the measurements have at least: a skin
#: that is quieter than it says has no stuck taxels. Of noise cut off at 0 this part is left.
REAL, CUT_OFF = 0.5, 0.34
MEDIAN_SQUARE = 0.455
#: With fewer measurements than this part of the taxels, restored frames have holes of their own.
LEAST_SEEN = 0.2
#: Most taxels whose noise is measured at a time, and that a line names.
MOST, MOST_NAMED = 64, 8
#: Part of its value by which a stuck taxel has to be off, on average, to be believed again.
MOVED, MOVED_RATE = 0.3, 0.02


@dataclass
class _Suspect:
    """A taxel that stands alone: its force, and its noise in each frame so far."""

    force: float
    noise: list[float] = field(default_factory=list)


class TaxelWatch:
    """Finds taxels that are stuck, keeps them out of the frames, and tells a log.

    A stuck taxel stands alone, as one under a peg does; but a living taxel is noisy, and the more
    so the harder it is pressed. The noise of one taxel is seen along its column of Phi, in what
    changes of the residual from frame to frame. Less than a fifth of the variance that the skin
    says of its noise, over 200 frames: the taxel is stuck. What it reads is taken off the
    measurements, and its force is the mean of its neighbours'. It is believed again where the
    measurements disagree.

    Dead taxels, which always read 0, and saturated ones are found by `EndWatch`: by what stays
    while contacts move. A dead one takes nothing off the measurements; with M < N / 5 none is told.

    Parameters
    ----------
    mask : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    f_max, sigma_mid, sigma_end : float
        Range of the skin, and the deviation of its noise at mid-range and at both ends; between
        them it is linear. Newtons.
    log : callable
        Takes one line of text.

    Attributes
    ----------
    stuck : dict of int to float
        What stuck taxels read, newtons, by place in the flat grid; dead ones 0.
    """

    def __init__(
        self,
        mask: Mask,
        f_max: float,
        sigma_mid: float,
        sigma_end: float,
        log: Callable[[str], None],
    ) -> None:
        self._mask, self._log = mask, log
        self._middle = f_max / 2
        self._sigma_mid, self._sigma_end = sigma_mid, sigma_end
        self._taxels = np.flatnonzero(mask)
        self._number = np.cumsum(mask.reshape(-1)) - 1
        self._least = LEAST_FORCE * f_max
        self._suspects: dict[int, _Suspect] = {}
        self._last: dict[str, Floats] = {}
        self._columns: dict[tuple[str, int], Floats] = {}
        self._n_frames = 0
        self.stuck: dict[int, float] = {}
        self._off: dict[int, float] = {}
        self._taken: dict[str, Floats] = {}
        self._ends = EndWatch(mask, f_max)

    @property
    def text(self) -> str:
        """Which taxels are left out now, by row and column; "" where none is."""
        stuck = [place for place, value in self.stuck.items() if value]
        named = (("stuck", stuck), ("dead", self.stuck.keys() - stuck))
        return "; ".join(f"{kind} taxels left out: {self._names(of)}" for kind, of in named if of)

    def cleaned(self, phi: Phi, y: Floats) -> Floats:
        """Measurements without what stuck taxels read; y, float32 (m,), is not modified."""
        if not self.stuck:
            return y
        if phi.fingerprint not in self._taken:
            x = np.zeros(self._mask.size, dtype=np.float32)
            x[list(self.stuck)] = list(self.stuck.values())
            self._taken[phi.fingerprint] = phi.forward(x[self._taxels])
        return np.subtract(y, self._taken[phi.fingerprint])

    def filled(self, forces: Floats) -> Floats:
        """Forces, float32 (n_rows, n_cols), with means of the neighbours in place of faults."""
        if not self.stuck:
            return forces
        filled = forces.copy()
        good = self._mask.copy()
        good.reshape(-1)[list(self.stuck)] = False
        for place in self.stuck:
            row, col = divmod(place, forces.shape[1])
            around = (slice(max(0, row - 1), row + 2), slice(max(0, col - 1), col + 2))
            beside = forces[around][good[around]]
            filled[row, col] = beside.mean() if beside.size else 0
        return filled

    def update(self, phi: Phi, forces: Floats, residual: Floats) -> None:
        """Take in a restored frame.

        Parameters
        ----------
        phi : Phi
            That made its measurements.
        forces : ndarray of float32, shape (n_rows, n_cols)
            As restored, not filled, newtons.
        residual : ndarray of float32, shape (m,)
            What it leaves of the measurements, those of stuck taxels taken off.
        """
        last = self._last.get(phi.fingerprint)
        self._last[phi.fingerprint] = residual
        if last is not None:
            self._measure(phi, forces, residual, residual - last)
        if self._n_frames % EVERY == 0:
            self._look(forces)
            self._look_at_ends(forces, phi.m >= LEAST_SEEN * phi.n)
        self._n_frames += 1

    def _measure(self, phi: Phi, forces: Floats, residual: Floats, change: Floats) -> None:
        """Add up the noise of suspects; doubt stuck taxels that are off."""
        seen = phi.m / phi.n
        for place, suspect in list(self._suspects.items()):
            column = self._column(phi, place)
            suspect.noise.append(float(np.dot(column, change)) ** 2 / 2)
            if len(suspect.noise) < MEASURED:
                continue
            # The median: a contact that moves elsewhere is no noise.
            variance = float(np.median(suspect.noise)) / MEDIAN_SQUARE
            expected = seen * float(self._sigma(np.array(suspect.force, np.float32)))
            suspect.noise.clear()
            if variance < QUIET * expected**2 and self._as_noisy_as_said(forces, change):
                self._stick(place, suspect.force)
        for place, value in list(self.stuck.items()):
            if not value:
                continue
            off = float(np.dot(self._column(phi, place), residual)) / seen
            self._off[place] += MOVED_RATE * (off - self._off[place])
            if abs(self._off[place]) > MOVED * value:
                self._believe(place)

    def _as_noisy_as_said(self, forces: Floats, change: Floats) -> bool:
        """Whether the measurements have the noise that the skin says it has."""
        variances = np.square(self._sigma(forces))
        # Half of what an untouched taxel reads is cut off at 0.
        variances[forces < self._sigma_end] *= CUT_OFF
        said = float(variances[self._mask].mean())
        return float(np.median(np.square(change))) / MEDIAN_SQUARE / 2 > REAL * said

    def _sigma(self, forces: Floats) -> Floats:
        """Deviation of the noise on forces, as the skin says."""
        apart = np.minimum(np.abs(forces - self._middle) / self._middle, 1)
        sigma: Floats = self._sigma_mid + (self._sigma_end - self._sigma_mid) * apart
        return sigma

    def _stick(self, place: int, value: float) -> None:
        self._suspects.pop(place, None)
        self.stuck[place], self._off[place] = value, 0.0
        self._taken.clear()
        said = f"is stuck at {value:.3g}" if value else "reads 0 in every contact"
        self._log(f"taxel {self._names([place])} {said}: left out")

    def _believe(self, place: int) -> None:
        del self.stuck[place]
        self._taken.clear()
        self._log(f"taxel {self._names([place])} moves again")

    def _look_at_ends(self, forces: Floats, holes_tell: bool) -> None:
        """Leave out taxels that stay at an end of their range; believe dead ones that do not."""
        dead, saturated, alive = self._ends.look(forces, self.stuck)
        for place in dead if holes_tell else ():
            self._stick(place, 0.0)
        for place in saturated:
            self._stick(place, float(forces.flat[place]))
        for place in alive:
            if not self.stuck[place]:
                self._believe(place)

    def _look(self, forces: Floats) -> None:
        """Suspect the taxels that stand alone; no longer those that do not, or have changed."""
        edged = np.pad(forces, 1)
        beside = np.maximum(edged[:-2], edged[2:])
        three = np.maximum(beside, edged[1:-1])
        most = np.maximum(np.maximum(three[:, :-2], three[:, 2:]), beside[:, 1:-1])
        alone = self._mask & (forces > self._least) & (most < ALONE * forces)
        places = set(np.flatnonzero(alone).tolist()) - self.stuck.keys()
        flat = forces.reshape(-1)
        if not places and not self._suspects and not self.stuck:
            self._columns.clear()
        for place, suspect in list(self._suspects.items()):
            if place not in places or abs(flat[place] - suspect.force) > CHANGE * suspect.force:
                del self._suspects[place]
        for place in sorted(places - self._suspects.keys())[: MOST - len(self._suspects)]:
            self._suspects[place] = _Suspect(float(flat[place]))

    def _column(self, phi: Phi, place: int) -> Floats:
        key = phi.fingerprint, place
        if key not in self._columns:
            unit = np.zeros(phi.n, dtype=np.float32)
            unit[self._number[place]] = 1
            self._columns[key] = phi.forward(unit)
        return self._columns[key]

    def _names(self, places: Iterable[int]) -> str:
        n_cols = self._mask.shape[1]
        named = [f"({place // n_cols}, {place % n_cols})" for place in sorted(places)]
        more = f" and {len(named) - MOST_NAMED} more" if len(named) > MOST_NAMED else ""
        return ", ".join(named[:MOST_NAMED]) + more
