"""The reconstructor, on the host: M measurements in, N restored forces out."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from sparseskin.messages import (
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    Resultant,
    SkinState,
    SolverState,
    topic_of,
)
from sparseskin.nodes.compressor.acts import follow
from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import Phi
from sparseskin.nodes.errors import PhiError, RefusedError, SolverError
from sparseskin.nodes.fast import compile_loops
from sparseskin.nodes.node import Context, Node

from .basis import make_basis
from .fault_watch import FaultWatch
from .limits import OWN_BASIS, check_lambda, check_phi, reconstruction_warnings
from .phases import make_phases
from .presets import PRESETS
from .resultant import Estimate, ResultantEstimator
from .rotating import make_rotating_solver
from .settings import ReconstructorSettings
from .solver import Solver
from .uncertainty import CALIBRATED, Uncertainty

PAPER_F_MAX_N = 2.5


class Reconstructor(Node[ReconstructorSettings]):
    """Publishes /PATCH/solver once it knows skin and Phi, then /PATCH/reconstruction.

    Measurements made by another Phi than its own are refused: to invert the wrong matrix would
    invent forces.
    """

    Settings = ReconstructorSettings

    def __init__(self, settings: ReconstructorSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        compile_loops(settings.chosen()["solver"], settings.fast, context.log)
        self._skin: SkinState | None = None
        self._announced: PhiState | None = None
        self._phases: dict[str, Phi] = {}
        self._solver: Solver | None = None
        self._last: Floats | None = None
        self._warm: Floats | None = None
        self._skipped = 0
        self._watch = FaultWatch(settings.watch_rows, settings.watch_taxels, context.log)
        self._uncertainty: Uncertainty | None = None
        self._resultant: ResultantEstimator | None = None

    @classmethod
    def inputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (SkinState, PhiState, Measurements)
        )

    @classmethod
    def outputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        told = (Resultant,) if settings.resultant else ()
        written = (SolverState, *told, Reconstruction)
        return tuple(topic_of(settings.patch, cls.schema) for cls in written)

    @property
    def depth(self) -> int:
        return self.settings.depth

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Measurements):
            yield from self._reconstruct(message)
            return
        if isinstance(message, SkinState):
            self._skin = message
        elif isinstance(message, PhiState):
            self._announced = message
        if self._skin is not None and self._announced is not None:
            self._phases, self._solver = {}, None
            stamp_ns = max(self._skin.stamp_ns, self._announced.stamp_ns)
            yield self._set_up(self._skin, self._announced, stamp_ns)

    def overtaken(self, message: Message) -> None:
        self._skipped += isinstance(message, Measurements)

    def change(self, settings: ReconstructorSettings) -> Iterable[Message]:
        before, self.settings = self.settings, settings
        if self._skin is None or self._announced is None:
            return ()
        try:
            return (self._set_up(self._skin, self._announced, self.context.clock.now_ns()),)
        except Exception:  # a user's own solver may raise anything
            self.settings = before
            raise

    def state(self) -> dict[str, Any]:
        chosen, preset = self.settings.chosen(), self.settings.preset
        told: dict[str, Any] = {
            "left_out": self._watch.text,
            "swamped": self._watch.swamped,
        }
        if chosen["solver"] in OWN_BASIS:
            told["basis"] = None
        return {**chosen, "preset": preset if chosen == PRESETS[preset] else "", **told}

    def status(self) -> str:
        chosen = self.settings.chosen()
        if self._solver is None:
            return ""
        basis = "" if chosen["solver"] in OWN_BASIS else f" in {chosen['basis']}"
        return "; ".join(filter(None, (f"solver {chosen['solver']}{basis}", self._watch.text)))

    def _set_up(self, state: SkinState, announced: PhiState, stamp_ns: int) -> SolverState:
        """Make Phi and solver for a skin, and say which; they hold from `stamp_ns` on."""
        skin = state.skin
        phases = make_phases(self.settings, skin.n_taxels, announced)
        phi = phases[0]
        chosen = dict(self.settings.chosen())
        options = {k: v for k, v in chosen.items() if k not in ("solver", "basis")}
        warnings = reconstruction_warnings(chosen["solver"], chosen["basis"], phi.n, phi.m, options)
        if "lambda_n" in options:
            options["lambda_n"] *= skin.f_max / PAPER_F_MAX_N
            check_lambda(chosen["solver"], options["lambda_n"], skin.f_max, phi)
        basis = make_basis(chosen["basis"], skin.n_rows, skin.n_cols)
        solver = make_rotating_solver(
            chosen["solver"], phases, basis, skin.mask, fast=self.settings.fast, **options
        )
        if ":" in self.settings.phi:
            for one in phases:
                warnings += check_phi(one, solver.mask)
        for warning in dict.fromkeys(warnings):
            self.context.log(warning)
        self._solver = solver
        self._phases = {one.fingerprint: one for one in phases}
        self._watch.set_up(self._phases, state, solver.mask)
        self._uncertainty = self._make_uncertainty(solver, phi.ratio, announced.rows)
        if self.settings.resultant:
            self._resultant = ResultantEstimator(phi, solver.taxels, skin.shape)
        # Another Phi or solver in the middle of a stream starts from what the last one found.
        if self._last is not None and self._last.shape != skin.shape:
            self._last = None
        self._warm = self._last
        return SolverState(
            stamp_ns=stamp_ns,
            patch=self.settings.patch,
            solver=chosen["solver"],
            basis="" if chosen["solver"] in OWN_BASIS else getattr(basis, "label", chosen["basis"]),
            preset=self.settings.preset if chosen == PRESETS[self.settings.preset] else "",
            iterations=options.get("iterations", solver.n_steps),
            lambda_n=options.get("lambda_n", 0.0),
            max_iterations=getattr(solver, "max_iterations", 0),
        )

    def _make_uncertainty(self, solver: Solver, ratio: float, rows: str) -> Uncertainty | None:
        if not self.settings.uncertainty:
            return None
        name = self.settings.chosen()["solver"]
        if name in CALIBRATED:
            return Uncertainty(solver.mask, ratio, name, rows)
        self.context.log(
            f"uncertainty: how far solver {name} is off is not known, and none is published; "
            f"known: {', '.join(CALIBRATED)}"
        )
        return None

    def _reconstruct(self, measurements: Measurements) -> Iterator[Message]:
        if self._solver is None:
            raise RefusedError(f"{measurements.topic}: skin or Phi is not known yet")
        phi = self._phases.get(measurements.phi)
        if phi is None:
            first, *others = self._phases
            rotating = f" and {len(others)} others in turn" if others else ""
            raise RefusedError(
                f"{measurements.topic}: Phi mismatch: made by Phi {measurements.phi}, "
                f"this reconstructor inverts Phi {first}{rotating}"
            )
        try:
            follow(phi, measurements.places)
            if len(self._phases) > 1:
                self._solver.use(phi)
            given = y = measurements.y
            # Where each frame chooses anew what it reads, there are no rows to watch.
            watched = measurements.places is None
            if watched:
                given, y = self._watch.cleaned(phi, given, self._last)
        except (PhiError, SolverError) as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        if self._resultant is not None:
            yield self._told(self._resultant.estimate(phi, y), measurements.stamp_ns)
        begin_ns = time.perf_counter_ns()
        try:
            forces, n_steps = self._solve(self._solver, y)
        except SolverError as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        solve_ns = time.perf_counter_ns() - begin_ns
        self._last, self._warm = forces, None
        filled = self._watch.filled(forces)
        done_ns = self.context.clock.now_ns()
        fitted = phi.forward(forces.reshape(-1)[self._solver.taxels])
        residual = math.sqrt(float(np.mean(np.square(fitted - y, dtype=np.float64))))
        yield Reconstruction(
            stamp_ns=measurements.stamp_ns,
            patch=self.settings.patch,
            forces=filled,
            phi=phi.fingerprint,
            iterations=n_steps,
            residual=residual,
            solve_ns=solve_ns,
            done_ns=done_ns,
            sd=None if self._uncertainty is None else self._uncertainty.update(forces, residual),
            skipped=self._skipped,
        )
        self._skipped = 0
        if watched and self._watch.update(phi, given, y, forces, fitted):
            # What the false rows have left in the estimate would stand for long.
            self._warm, self._last = np.zeros_like(forces), None
        if self._resultant is not None:
            fingerprints = list(self._phases)
            following = fingerprints[(fingerprints.index(phi.fingerprint) + 1) % len(fingerprints)]
            self._resultant.learn(phi, y, forces.reshape(-1)[self._solver.taxels], fitted)
            self._resultant.prepare(self._phases[following])

    def _told(self, found: Estimate, stamp_ns: int) -> Resultant:
        row, col = found.centre or (None, None)
        row_sd, col_sd = found.centre_sd or (None, None)
        return Resultant(
            stamp_ns=stamp_ns,
            patch=self.settings.patch,
            total=found.total,
            total_sd=found.total_sd,
            row=row,
            col=col,
            row_sd=row_sd,
            col_sd=col_sd,
            done_ns=self.context.clock.now_ns(),
        )

    def _solve(self, solver: Solver, y: Floats) -> tuple[Floats, int]:
        """Restore one frame within the budget; the forces and how many steps they took."""
        budget_ms = self.settings.budget_ms
        if budget_ms is None:
            return solver.solve(y, self._warm), solver.n_steps
        deadline_ns = time.perf_counter_ns() + round(1e6 * budget_ms)
        solver.setup(y, self._warm)
        done, longest_ns, before_ns = 0, 0, time.perf_counter_ns()
        # A step is begun only where one like the longest so far would end in time; the first is
        # always done, for without it there is no estimate of this frame.
        while done < solver.n_steps and (not done or before_ns + longest_ns <= deadline_ns):
            solver.step()
            now_ns = time.perf_counter_ns()
            longest_ns, before_ns = max(longest_ns, now_ns - before_ns), now_ns
            done += 1
        return solver.finish(), done
