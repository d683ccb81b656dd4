"""Faults of frames: found in measurements, innovations and forces, marked, and kept from them."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from sparseskin.messages import Reason
from sparseskin.nodes.compressor.phi.base import Phi, phi_fact
from sparseskin.nodes.numerics.arrays import TINY, Floats, Indices, Mask
from sparseskin.nodes.reconstructor.solvers.base import Solver, checked_measurements
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.touch import in_contact

from .noise import NoiseWatch, PressedNoise
from .offset import OffsetWatch
from .repeats import RepeatWatch
from .stuck import PRESSED, Evidence, NewChanges, StuckTaxels

LEAST_MIXED = 8.0
"""Least number of taxels that most measurements sum, where measurements are compared."""
N_PROBED = 8
"""Rows that are probed for it."""
BEYOND = 0.1
"""Part of f_max by which the error of a reconstruction may exceed it: such forces are f_max."""
SWAMPED = 0.25
"""Largest part of the measurements that may be faulty; with more, something else is wrong."""
DOUBTED = 0.5
DOUBT_RATE = 0.2
"""Mean doubt of a measurement from which on it is named, and its rate per frame."""
MOST_NAMED = 8
"""Most measurements or taxels that a line names."""
MAX_CELLS = 256
"""Most stuck taxels whose cells are published: more are no single faults."""


class Noise(NamedTuple):
    """Noise of the readings of a skin, in the unit of the forces, as far as it states it."""

    f_max: float
    least_sd: float = 0.0  # least standard deviation; 0: not stated
    model: NoiseModel | None = None


class Verdict(NamedTuple):
    """What is found of a frame: forces with stuck taxels filled in, float32 (n_rows, n_cols); why
    they are not to be trusted, "" if they are; faulty measurements by number; stuck taxels by cell.
    """

    forces: Floats
    reason: str
    rows: tuple[int, ...] = ()
    taxels: tuple[int, ...] = ()
    is_solved: bool = True  # False: the measurements hold nothing, the forces are the last ones


class FaultWatch:
    """Looks at the frames of one patch, for a solver that reconstructs them.

    `receive` looks at the measurements before they are solved, `look` at the result: the graph,
    `Stream` and `reconstruct` call both through `solve_watched`. No measurement is ever replaced.
    Those that no force explains have a larger variance in the solver; of a fault that is known, a
    constant reading or offset, that constant is subtracted; all others are marked.

    Parameters
    ----------
    noise : Noise
    exists : ndarray of bool, shape (n_rows, n_cols)
        True where a taxel exists.
    log : callable
        Receives one line of text.
    watch_rows, watch_taxels : bool
        Search for faulty measurements; for stuck taxels.
    """

    def __init__(
        self,
        noise: Noise,
        exists: Mask,
        log: Callable[[str], None] | None = None,
        *,
        watch_rows: bool = True,
        watch_taxels: bool = True,
    ) -> None:
        self._noise = noise
        self._exists = exists
        self._cells = np.flatnonzero(exists)
        #: Index of the taxels among the cells: of all of them a view is enough.
        self._taxels: Any = slice(None) if exists.all() else self._cells
        self._log = log or _no_log
        self._watch_rows = watch_rows
        self._watch_taxels = watch_taxels
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        noise = self._noise
        self._repeats = RepeatWatch(noise.least_sd)
        self._measured_noise = NoiseWatch()
        self._offset: OffsetWatch | None = None
        if noise.least_sd > 0:
            self._offset = OffsetWatch(noise.least_sd)
        self._pressed_noise = PressedNoise()
        self._new_changes = NewChanges()
        self._stuck = StuckTaxels(self._exists)
        self._subtracted: dict[str, Floats] = {}
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
            parts.append(f"offset of all measurements subtracted: {self._offset.value:.2g}")
        if self._rows_doubted:
            parts.append(f"measurements doubted: {listed(self._rows_doubted)}")
        if self._stuck.is_any_stuck:
            parts.append(f"stuck taxels left out: {self._names(self._stuck.is_stuck.nonzero()[0])}")
        return "; ".join(parts)

    @property
    def taxels(self) -> list[int]:
        """Flat cells of the stuck taxels, in order; of many the first `MAX_CELLS`."""
        if not self._stuck.is_any_stuck:
            return []
        cells = self._cells[self._stuck.is_stuck]
        return [int(cell) for cell in cells[:MAX_CELLS]]

    @property
    def swamped(self) -> bool:
        """True if so many measurements are doubted that something else is wrong."""
        if len(self._rows_doubted) == 0:
            return False
        return any(float(doubt.mean()) > SWAMPED for doubt in self._doubts.values())

    @property
    def last_forces(self) -> Floats:
        """The last frame, float32 (n_rows, n_cols); zeros if there is none."""
        if self._last_forces is None:
            return np.zeros(self._exists.shape, dtype=np.float32)
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
        if self._stuck.is_any_stuck:
            believed = np.subtract(y, self._stuck_readings(phi))
        if self._watch_rows and hasattr(solver, "expected") and self._mixes(phi):
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

    def _stuck_readings(self, phi: Phi) -> Floats:
        """What a phi measures of the readings of stuck taxels."""
        if phi.fingerprint not in self._subtracted:
            self._subtracted[phi.fingerprint] = phi.forward(self._stuck.value)
        return self._subtracted[phi.fingerprint]

    def _without_offset(self, solver: Any, phi: Phi, y: Floats) -> Floats:
        # What is expected takes a transform.
        if self._offset is None or not self._offset.rows_of(phi).is_told_apart:
            return y
        offset = self._offset.look(phi, np.asarray(y - solver.expected(phi)))
        if bool(offset) != self._was_offset:
            self._was_offset = bool(offset)
            change = f"an offset of {offset:.2g}, which is subtracted" if offset else "no offset"
            self._note("offset", f"all measurements have {change}")
        return np.asarray(y - np.float32(offset)) if offset else y

    def look(self, solver: Solver, phi: Phi, forces: Floats) -> Verdict:
        """Look at the frame that a solver reconstructed of what `receive` returned, float32
        (n_rows, n_cols), by phi.
        """
        innovation = getattr(solver, "innovation", None)
        if innovation is not None:
            self._follow_noise(innovation)
            self._follow_doubt(solver, phi)
            # Of forces that have not converged, the errors are no noise; but a taxel that is left
            # out and works again makes them so.
            is_evidence = solver.trusted or self._stuck.is_any_stuck
            if self._watch_taxels and self._received is None and is_evidence:
                self._look_for_stuck(solver, forces.reshape(-1)[self._taxels])
        if self._stuck.is_any_stuck:
            forces = self._stuck.filled(forces, self._exists)
        forces, is_beyond = self._within_range(forces)
        self._last_forces = forces
        return self._verdict(forces, self._reason(solver, forces, is_beyond=is_beyond))

    def nothing(self) -> Verdict:
        """The verdict of a frame that holds nothing: the last forces, not trusted."""
        assert self._received is not None
        return self._verdict(self.last_forces, self._received)._replace(is_solved=False)

    def _mixes(self, phi: Phi) -> bool:
        """True if each measurement sums several taxels: single ones repeat where they are 0."""
        if phi.fingerprint not in self._mixing:
            chooses = bool(phi_fact(phi, "choice"))
            self._mixing[phi.fingerprint] = not chooses and mixed_taxels(phi) >= LEAST_MIXED
        return self._mixing[phi.fingerprint]

    def _verdict(self, forces: Floats, reason: str) -> Verdict:
        return Verdict(forces, reason, self._rows_doubted, tuple(self.taxels))

    def _follow_noise(self, innovation: Floats) -> None:
        """Compare the innovation with the noise that the skin states of untouched taxels: pressed
        ones have more, but those that are stuck have none.
        """
        if self._noise.model is not None and self._noise.least_sd > 0:
            innovation2 = float(innovation @ innovation) / len(innovation)
            self._measured_noise.look(innovation2, self._noise.least_sd**2)

    def _follow_doubt(self, solver: Solver, phi: Phi) -> None:
        """Follow the doubt of each measurement of a row subset."""
        doubt = getattr(solver, "doubt", None)
        if doubt is None:
            return
        mean = self._doubts.get(phi.fingerprint)
        if mean is None:
            mean = np.zeros(phi.m, dtype=np.float32)
            self._doubts[phi.fingerprint] = mean
        last_mean = mean
        mean = last_mean + np.float32(DOUBT_RATE) * (doubt - last_mean)
        self._doubts[phi.fingerprint] = mean
        if not self._rows_doubted and mean.max() <= DOUBTED:
            return
        was_doubted = last_mean > DOUBTED
        is_doubted = mean > DOUBTED
        if np.array_equal(is_doubted, was_doubted):
            return
        self._rows_doubted = self._doubted_rows()
        new = np.flatnonzero(is_doubted & ~was_doubted)
        if len(new):
            self._note("rows", f"measurements doubted, no force explains them: {listed(new)}")

    def _doubted_rows(self) -> tuple[int, ...]:
        rows = {
            int(row) for mean in self._doubts.values() for row in np.flatnonzero(mean > DOUBTED)
        }
        return tuple(sorted(rows))

    def _look_for_stuck(self, solver: Any, forces: Floats) -> None:
        untouched = self._untouched_noise(solver)
        if not untouched:
            return
        stuck = self._stuck
        watched = stuck.watched(forces, PRESSED * (self._noise.least_sd or math.sqrt(untouched)))
        if not len(watched):
            self._new_changes.forget()
            return
        evidence = self._evidence(solver, watched, forces, untouched)
        if evidence is None:
            return
        last_value = stuck.value
        new = stuck.look(watched, forces, evidence)
        if stuck.value is last_value:
            return
        change = stuck.value - last_value
        self._subtracted.clear()
        self._new_changes.forget()
        if len(new):
            values = stuck.value[new]
            self._note("stuck", f"taxels {self._names(new)} are stuck at {values.mean():.3g}")
        image = np.zeros(self._exists.shape, dtype=np.float32)
        image[self._exists] = change
        solver.subtract(image)

    def _evidence(
        self, solver: Any, watched: Indices, forces: Floats, untouched: float
    ) -> Evidence | None:
        """What a frame shows of the watched taxels; None if nothing."""
        new = self._new_changes.look(solver.phi.fingerprint, solver.change)
        if new is None:
            return None
        model = self._noise.model
        of_watched = forces[watched]
        if model is not None:
            noise = model.variance(of_watched).astype(np.float64)
        else:
            if not self._stuck.is_doubted:
                pressed = of_watched[self._stuck.seem_to_work()]
                self._pressed_noise.look(pressed, len(forces) * solver.excess_noise2)
            noise = self._pressed_noise.variance(of_watched, untouched)
        projection = solver.projection(new, watched)
        return Evidence(projection.projected, projection.background, projection.own * noise)

    def _untouched_noise(self, solver: Any) -> float:
        """Noise variance of an untouched taxel; 0: measurements lack it, or nothing is known."""
        if not hasattr(solver, "projection") or phi_fact(solver.phi, "samples"):
            return 0.0
        if self._noise.model is None:
            return self._least_noise(solver)
        # Without the noise of the skin, all taxels seem to be stuck.
        return self._noise.least_sd**2 if self._measured_noise.is_present else 0.0

    def _least_noise(self, solver: Solver) -> float:
        """Noise variance of an untouched taxel, as far as measurements show it; 0: not known."""
        if not self._repeats.is_lively:
            return 0.0
        return float(getattr(solver, "least_noise2", 0.0))

    def _within_range(self, forces: Floats) -> tuple[Floats, bool]:
        """Forces of at most f_max; True if one is beyond it by more than an error."""
        f_max = self._noise.f_max
        largest = float(forces.max(initial=0))
        if largest <= f_max:
            return forces, False
        if largest > (1 + BEYOND) * f_max:
            return forces, True
        return np.minimum(forces, np.float32(f_max)), False

    def _reason(self, solver: Solver, forces: Floats, *, is_beyond: bool) -> str:
        """Why a frame is not to be trusted; "" if it is."""
        if self._received is not None:
            return self._received
        if is_beyond:
            return Reason.RANGE
        if not getattr(solver, "trusted", True):
            return Reason.WEAK if self._is_weak(solver, forces) else Reason.ERROR
        if self._watch_rows and self.swamped:
            return Reason.ROWS
        if self._stuck.is_doubted or self._stuck.is_blind(self._exists):
            return Reason.STUCK
        if self._measured_noise.is_quiet:
            return Reason.QUIET
        return ""

    def _is_weak(self, solver: Solver, forces: Floats) -> bool:
        """True if neither the forces nor the estimated error stand out of the stated noise."""
        error = getattr(solver, "error", None)
        noise_sd = self._noise.least_sd
        if error is None or error > noise_sd:
            return False
        return not in_contact(forces, self._noise.f_max, noise_sd)

    def _names(self, taxels: Indices) -> str:
        n_cols = self._exists.shape[1]
        cells = self._cells[taxels].tolist()
        return listed([f"({cell // n_cols}, {cell % n_cols})" for cell in cells])

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
    for row in np.linspace(0, phi.m - 1, min(N_PROBED, phi.m)).astype(np.intp):
        unit = np.zeros(phi.m, dtype=np.float32)
        unit[row] = 1
        weights = np.square(phi.adjoint(unit), dtype=np.float64)
        ratios.append(weights.sum() ** 2 / max(np.square(weights).sum(), TINY))
    return float(sorted(ratios)[len(ratios) // 2])


def listed(names: Sequence[object] | Indices) -> str:
    """The first `MOST_NAMED` of some names, and how many more there are."""
    text = ", ".join(str(name) for name in names[:MOST_NAMED])
    if len(names) > MOST_NAMED:
        text += f" and {len(names) - MOST_NAMED} more"
    return text


def watch_of(solver: Solver) -> FaultWatch:
    """The watch of a solver that is used by itself, by the noise that it was told; made once."""
    if solver.watch is None:
        model = solver.noise_model
        f_max = math.inf if model is None else model.f_max
        solver.watch = FaultWatch(Noise(f_max, solver.noise_sd, model), solver.mask)
    watch: FaultWatch = solver.watch
    return watch


def _no_log(_: str) -> None:
    """Log nothing."""
