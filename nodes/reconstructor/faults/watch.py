"""Faults of frames: found in measurements, innovations and forces, marked, and kept from them."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages import Reason
from sparseskin.nodes.compressor.phi.base import Phi, phi_fact
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices
from sparseskin.nodes.reconstructor.solvers.base import Solver, checked_measurements
from sparseskin.nodes.touch import in_contact

from .offset import OffsetWatch
from .repeats import RepeatWatch

LEAST_MIXED = 8.0
"""Least number of taxels that most measurements sum, where measurements are compared."""
N_PROBED = 8
"""Rows that are probed for it."""
BEYOND = 0.1
"""Part of f_max by which the error of a reconstruction may exceed it: such forces are f_max."""
DOUBTED = 0.5
DOUBT_RATE = 0.2
"""Mean doubt of a measurement from which on it is named, and its rate per frame."""
MOST_NAMED = 8
"""Most measurements that a line names."""


class Noise(NamedTuple):
    """Range and noise of the readings of a skin, in the unit of the forces."""

    f_max: float
    least_sd: float = 0.0  # least standard deviation of the noise; 0: not stated


class Verdict(NamedTuple):
    """What is found of a frame: forces, float32 (n_rows, n_cols); why they are not to be trusted,
    "" if they are; faulty measurements by number.
    """

    forces: Floats
    reason: str
    rows: tuple[int, ...] = ()
    is_solved: bool = True
    """False: the measurements hold nothing, the forces are the last ones."""


class FaultWatch:
    """Looks at the frames of one patch, for a solver that reconstructs them.

    `receive` looks at the measurements before they are solved, `look` at the result: the graph,
    `Stream` and `reconstruct` call both through `solve_watched`. No measurement is ever replaced.
    Those that no force explains have a larger variance in the solver; an offset that is known is
    subtracted; all others are marked.

    Parameters
    ----------
    noise : Noise
    shape : (int, int)
        Rows and columns of the skin.
    log : callable
        Receives one line of text.
    watch_rows : bool
        Search for faulty measurements and for an offset.
    """

    def __init__(
        self,
        noise: Noise,
        shape: tuple[int, int],
        log: Callable[[str], None] | None = None,
        *,
        watch_rows: bool = True,
    ) -> None:
        self._noise = noise
        self._shape = shape
        self._log = log or _no_log
        self._watch_rows = watch_rows
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        noise = self._noise
        self._repeats = RepeatWatch(noise.least_sd)
        self._offset: OffsetWatch | None = None
        if noise.least_sd > 0:
            self._offset = OffsetWatch(noise.least_sd)
        self._doubts: dict[str, Floats] = {}
        self._rows_doubted: tuple[int, ...] = ()
        self._last_forces: Floats | None = None
        self._received: Reason | None = None
        self._n_logged: dict[str, int] = {}
        self._mixing: dict[str, bool] = {}
        self._was_offset = False

    @property
    def text(self) -> str:
        """What is subtracted or doubted now; "" if nothing is."""
        parts = []
        if self._received is Reason.FROZEN:
            parts.append(Reason.FROZEN.phrase)
        if self._offset is not None and self._offset.value:
            parts.append(
                f"offset of all measurements subtracted: {self._offset.value:.2g}"
            )
        if self._rows_doubted:
            parts.append(f"measurements doubted: {listed(self._rows_doubted)}")
        return "; ".join(parts)

    @property
    def last_forces(self) -> Floats:
        """The last frame, float32 (n_rows, n_cols); zeros if there is none."""
        if self._last_forces is None:
            return np.zeros(self._shape, dtype=np.float32)
        return self._last_forces

    def receive(self, solver: Solver, phi: Phi, y: Floats) -> Floats | None:
        """Look at measurements as received, float32 (m,), newtons; return those to be solved, or
        None if they hold nothing of the skin. y is kept, not copied.

        Raises SolverError where the solver would, and looks at none of y then.
        """
        checked_measurements(y, phi.m, getattr(solver, "y_max", Solver.y_max))
        if self.glance(phi, y) in (Reason.CONSTANT, Reason.FROZEN):
            return None

        believed = y
        predicts = hasattr(solver, "expected")
        if self._watch_rows and predicts and self._mixes(phi):
            believed = self._without_offset(solver, phi, believed)
            solver.faulty = self._repeats.faulty
        return believed

    def glance(self, phi: Phi, y: Floats) -> str:
        """Look at measurements as they are received; return why they cannot be right, or none."""
        reason = None
        if self._mixes(phi):
            reason = self._repeats.look(phi.fingerprint, y)
        if reason is not self._received and reason is not None:
            self._note(reason, f"{reason.phrase}: not trusted")
        self._received = reason
        return reason or ""

    def _without_offset(self, solver: Any, phi: Phi, y: Floats) -> Floats:
        # What is expected takes a transform: it is not computed where no offset can be seen.
        if self._offset is None or not self._offset.rows_of(phi).is_told_apart:
            return y
        innovation = np.asarray(y - solver.expected(phi))
        offset = self._offset.look(phi, innovation)
        has_offset = offset != 0
        # Only its begin and its end are worth a line.
        if has_offset != self._was_offset:
            self._was_offset = has_offset
            offset_text = "no offset"
            if has_offset:
                offset_text = f"an offset of {offset:.2g}, which is subtracted"
            self._note("offset", f"all measurements have {offset_text}")
        if not has_offset:
            return y
        return np.asarray(y - np.float32(offset))

    def look(self, solver: Solver, phi: Phi, forces: Floats) -> Verdict:
        """Look at the frame that a solver reconstructed of what `receive` returned, float32
        (n_rows, n_cols), by phi.
        """
        self._follow_doubt(solver, phi)
        forces, is_beyond = self._within_range(forces)
        self._last_forces = forces
        reason = self._reason(solver, forces, is_beyond=is_beyond)
        return Verdict(forces, reason, self._rows_doubted)

    def nothing(self) -> Verdict:
        """The verdict of a frame that holds nothing: the last forces, not trusted."""
        assert self._received is not None
        forces = self.last_forces
        return Verdict(forces, self._received, self._rows_doubted, is_solved=False)

    def _mixes(self, phi: Phi) -> bool:
        """True if each measurement sums several taxels: single ones repeat where they are 0."""
        mixes = self._mixing.get(phi.fingerprint)
        if mixes is None:
            # Of rows that are chosen anew, no measurement is of the same taxels as before.
            chooses = bool(phi_fact(phi, "choice"))
            mixes = not chooses and mixed_taxels(phi) >= LEAST_MIXED
            self._mixing[phi.fingerprint] = mixes
        return mixes

    def _follow_doubt(self, solver: Solver, phi: Phi) -> None:
        """Follow the doubt of each measurement of a row subset."""
        doubt = getattr(solver, "doubt", None)
        if doubt is None:
            return
        last_mean = self._doubts.get(phi.fingerprint)
        if last_mean is None:
            last_mean = np.zeros(phi.m, dtype=np.float32)
        mean = last_mean + np.float32(DOUBT_RATE) * (doubt - last_mean)
        self._doubts[phi.fingerprint] = mean

        # As in nearly all frames.
        if not self._rows_doubted and mean.max() <= DOUBTED:
            return
        was_doubted = last_mean > DOUBTED
        is_doubted = mean > DOUBTED
        if np.array_equal(is_doubted, was_doubted):
            return

        # Only what has changed is worth a line.
        self._rows_doubted = self._doubted_rows()
        new = np.flatnonzero(is_doubted & ~was_doubted)
        if len(new):
            self._note(
                "rows", f"measurements doubted, no force explains them: {listed(new)}"
            )

    def _doubted_rows(self) -> tuple[int, ...]:
        # Those of any row subset.
        rows: set[int] = set()
        for mean in self._doubts.values():
            doubted = np.flatnonzero(mean > DOUBTED)
            rows.update(doubted.tolist())
        return tuple(sorted(rows))

    def _within_range(self, forces: Floats) -> tuple[Floats, bool]:
        """Forces of at most f_max; True if one is beyond it by more than an error."""
        f_max = self._noise.f_max
        largest = float(forces.max(initial=0))
        if largest <= f_max:
            return forces, False
        # An error of the estimate may exceed the range; a force that does is none of this skin.
        if largest > (1 + BEYOND) * f_max:
            return forces, True
        return np.minimum(forces, np.float32(f_max)), False

    def _reason(self, solver: Solver, forces: Floats, *, is_beyond: bool) -> str:
        """Why a frame is not to be trusted; "" if it is."""
        if self._received is not None:
            return self._received
        if is_beyond:
            return Reason.RANGE
        if getattr(solver, "trusted", True):
            return ""
        if self._is_weak(solver, forces):
            return Reason.WEAK
        return Reason.ERROR

    def _is_weak(self, solver: Solver, forces: Floats) -> bool:
        """True if neither the forces nor the estimated error stand out of the stated noise."""
        error = getattr(solver, "error", None)
        noise_sd = self._noise.least_sd
        if error is None or error > noise_sd:
            return False
        return not in_contact(forces, self._noise.f_max, noise_sd)

    def _note(self, kind: str, line: str) -> None:
        """Log a line; of one kind the first ones, then each tenth, hundredth ..."""
        count = self._n_logged.get(kind, 0) + 1
        self._n_logged[kind] = count
        if count <= 3 or math.log10(count).is_integer():
            self._log(line)


def solve_watched(solver: Solver, watch: FaultWatch, phi: Phi, y: Floats) -> Verdict:
    """Reconstruct a frame of measurements y, float32 (m,), of a row subset, and look at it.

    Raises SolverError as `Solver.solve` does.
    """
    believed = watch.receive(solver, phi, y)
    if believed is None:
        return watch.nothing()
    return watch.look(solver, phi, solver.solve(believed))


def mixed_taxels(phi: Phi) -> float:
    """Return the median participation ratio of some rows: how many taxels a row sums."""
    ratios = []
    rows = np.linspace(0, phi.m - 1, min(N_PROBED, phi.m))
    for row in rows.astype(np.intp):
        unit = np.zeros(phi.m, dtype=np.float32)
        unit[row] = 1
        weights = np.square(phi.adjoint(unit), dtype=np.float64)
        # It is the number of taxels where all of them have the same weight.
        squares = np.square(weights).sum()
        ratios.append(weights.sum() ** 2 / max(squares, TINY))
    ratios.sort()
    return float(ratios[len(ratios) // 2])


def listed(names: Sequence[object] | Indices) -> str:
    """The first `MOST_NAMED` of some names, and how many more there are."""
    text = ", ".join(str(name) for name in names[:MOST_NAMED])
    if len(names) > MOST_NAMED:
        text += f" and {len(names) - MOST_NAMED} more"
    return text


def watch_of(solver: Solver) -> FaultWatch:
    """The watch of a solver that is used by itself, by the noise that it was told; made once."""
    if solver.watch is None:
        # The range of the skin is known by its noise alone.
        f_max = math.inf
        if solver.noise_model is not None:
            f_max = solver.noise_model.f_max
        noise = Noise(f_max, solver.noise_sd)
        solver.watch = FaultWatch(noise, solver.mask.shape)
    watch: FaultWatch = solver.watch
    return watch


def _no_log(_: str) -> None:
    """Log nothing."""
