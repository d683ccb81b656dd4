"""The reconstructor, on the host: M measurements in, N restored forces out."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
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
from sparseskin.nodes.compressor.phi import KINDS, Phi, make_phi
from sparseskin.nodes.compressor.rotation import FIXED, ROWS, phases_of
from sparseskin.nodes.errors import (
    PhiError,
    RefusedError,
    SettingsError,
    SolverError,
)
from sparseskin.nodes.fast import FAST, check_fast, compile_loops
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .basis import BASES, find_basis, make_basis
from .faulty_rows import FaultyRows
from .limits import check_lambda, check_phi, reconstruction_warnings
from .presets import PRESETS
from .resultant import RESULTANT_SOLVERS, Estimate, ResultantEstimator
from .rotating import make_rotating_solver
from .solver import SOLVERS, Solver
from .taxel_watch import TaxelWatch
from .uncertainty import CALIBRATED, Uncertainty

ANNOUNCED = "announced"
PAPER_F_MAX_N = 2.5


@dataclass(frozen=True)
class ReconstructorSettings(PatchSettings):
    """What a reconstructor can be told."""

    preset: str = setting(
        "skin",
        f"named set of the settings below: {', '.join(PRESETS)}",
        known=PRESETS,
        live=True,
    )
    solver: str | None = setting(
        None, "solver, in place of the preset's; or module:Class", known=SOLVERS, live=True
    )
    basis: str | None = setting(
        None,
        "basis Psi, in place of the preset's; or learned:FILE.npz, or module:Class",
        known=BASES,
        live=True,
    )
    iterations: int | None = setting(
        None, "iterations a frame, in place of the preset's", low=1, high=1000, live=True
    )
    lambda_n: float | None = setting(
        None,
        "weight of the l1 norm in place of the preset's, in newtons for orthonormal rows and a "
        "range of 2.5 N; scaled with the range of the skin",
        low=0.0,
        high=1e6,
        live=True,
    )
    budget_ms: float | None = setting(
        None,
        "most time for a frame's iterations, in milliseconds: when it is over, the best "
        "estimate so far is published",
        low=0.05,
        high=60_000.0,
        live=True,
    )
    uncertainty: bool = setting(
        False, "publish a standard deviation with each force; twice as many bytes"
    )
    resultant: bool = setting(
        False, "publish total force and centre of pressure before the frame is restored"
    )
    watch_rows: bool = setting(True, "leave out measurements that read 0, a constant or garbage")
    fast: str = setting(
        "auto",
        "compiled loops: auto (where numba is installed), on or off; but for rounding the same",
        choices=FAST,
    )
    watch_taxels: bool = setting(
        True, "leave out taxels that are stuck, on a skin that states its noise"
    )
    phi: str = setting(
        ANNOUNCED,
        "measurement matrix: announced (what the compressor says), a kind or module:Class",
    )
    phi_m: int | None = setting(None, "M of a stated phi; N // 3 by default", low=1, high=2**20)
    phi_block: int = setting(32, "block size of a stated phi", low=1, high=2**20)
    phi_seed: int = setting(0, "seed of a stated phi", low=0, high=2**32 - 1)
    phi_rows: str = setting(FIXED, "rows of a stated phi: fixed or rotating", choices=ROWS)

    def check(self) -> None:
        if self.preset not in PRESETS:
            raise SettingsError(
                f"preset: '{self.preset}' is not known{did_you_mean(self.preset, PRESETS)}"
            )
        check_fast(self.fast)
        chosen = self.chosen()
        with naming("solver"):
            find_class("solver", chosen["solver"], SOLVERS, SolverError)
        with naming("basis"):
            find_basis(chosen["basis"])
        if self.resultant and chosen["solver"] not in RESULTANT_SOLVERS:
            raise SettingsError(
                f"resultant: is not told with solver {chosen['solver']}, whose frames are biased; "
                f"allowed: {', '.join(RESULTANT_SOLVERS)}"
            )
        if self.phi != ANNOUNCED:
            with naming("phi"):
                find_class("phi", self.phi, KINDS, PhiError)

    def chosen(self) -> dict[str, Any]:
        """The preset with what is stated beside it."""
        stated = {
            "solver": self.solver,
            "basis": self.basis,
            "iterations": self.iterations,
            "lambda_n": self.lambda_n,
        }
        preset = PRESETS[self.preset]
        if self.solver not in (None, preset["solver"]):
            # A preset's numbers belong to its solver; another one has settings of its own.
            preset = {"basis": preset["basis"]}
        return preset | {k: v for k, v in stated.items() if v is not None}


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
        self._faulty_rows = FaultyRows(context.log)
        self._uncertainty: Uncertainty | None = None
        self._resultant: ResultantEstimator | None = None
        self._taxel_watch: TaxelWatch | None = None

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
        told = {"left_out": self._left_out(), "swamped": self._faulty_rows.swamped}
        return {**chosen, "preset": preset if chosen == PRESETS[preset] else "", **told}

    def status(self) -> str:
        chosen = self.settings.chosen()
        if self._solver is None:
            return ""
        left_out = self._left_out()
        return f"{chosen['solver']} in {chosen['basis']}" + (f"; {left_out}" if left_out else "")

    def _left_out(self) -> str:
        taxels = "" if self._taxel_watch is None else self._taxel_watch.text
        return "; ".join(filter(None, (self._faulty_rows.text, taxels)))

    def _set_up(self, state: SkinState, announced: PhiState, stamp_ns: int) -> SolverState:
        """Make Phi and solver for a skin, and say which; they hold from `stamp_ns` on."""
        skin = state.skin
        phases = self._make_phases(skin.n_taxels, announced)
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
        self._faulty_rows.keep(self._phases)
        self._uncertainty = self._make_uncertainty(solver, phi.ratio)
        self._taxel_watch = None
        if self.settings.watch_taxels and state.sigma_mid > 0:
            sigmas = state.sigma_mid, state.sigma_end
            self._taxel_watch = TaxelWatch(solver.mask, skin.f_max, *sigmas, self.context.log)
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
            basis=getattr(basis, "label", chosen["basis"]),
            preset=self.settings.preset if chosen == PRESETS[self.settings.preset] else "",
            iterations=options.get("iterations", solver.n_steps),
            lambda_n=options.get("lambda_n", 0.0),
            max_iterations=getattr(solver, "max_iterations", 0),
        )

    def _make_uncertainty(self, solver: Solver, ratio: float) -> Uncertainty | None:
        if not self.settings.uncertainty:
            return None
        name = self.settings.chosen()["solver"]
        if name in CALIBRATED:
            return Uncertainty(solver.mask, ratio, name)
        self.context.log(
            f"uncertainty: how far solver {name} is off is not known, and none is published; "
            f"known: {', '.join(CALIBRATED)}"
        )
        return None

    def _make_phases(self, n: int, announced: PhiState) -> list[Phi]:
        """Phi, or where its rows rotate the several of it; the first is what is announced."""
        s = self.settings
        if s.phi != ANNOUNCED:
            phi = make_phi(
                s.phi, n=n, m=s.phi_m or max(1, n // 3), seed=s.phi_seed, block=s.phi_block
            )
            return phases_of(phi, s.phi_rows)
        # What comes over the wire is never imported: a Phi of the user's own has to be stated.
        if announced.kind not in KINDS:
            raise RefusedError(
                f"{announced.topic}: phi '{announced.kind}' is not built in; "
                "state it as the reconstructor's phi"
            )
        if announced.n != n:
            raise RefusedError(f"{announced.topic}: for {announced.n} taxels; the skin has {n}")
        try:
            phi = make_phi(
                announced.kind, n=n, m=announced.m, seed=announced.seed, block=announced.block
            )
            phases = phases_of(phi, announced.rows)
        except PhiError as error:
            raise RefusedError(f"{announced.topic}: {error}") from error
        if phi.fingerprint != announced.fingerprint:
            raise RefusedError(
                f"{announced.topic}: seed {announced.seed} gives Phi {phi.fingerprint} here, "
                f"not {announced.fingerprint}: the random generators differ"
            )
        return phases

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
            given = measurements.y
            if self._taxel_watch is not None and measurements.places is None:
                given = self._taxel_watch.cleaned(phi, given)
            y = self._believed(phi, given) if self._watches_rows(measurements) else given
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
        filled = forces if self._taxel_watch is None else self._taxel_watch.filled(forces)
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
        )
        if self._watches_rows(measurements) and self._faulty_rows.update(phi, given, fitted):
            # What the false rows have left in the estimate would stand for long.
            self._warm, self._last = np.zeros_like(forces), None

        if self._taxel_watch is not None and measurements.places is None:
            self._taxel_watch.update(phi, forces, y - fitted)
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

    def _watches_rows(self, measurements: Measurements) -> bool:
        """Whether rows are told apart: not where each frame chooses anew what it reads."""
        return self.settings.watch_rows and measurements.places is None

    def _believed(self, phi: Phi, y: Floats) -> Floats:
        """The measurements, false rows replaced by what the last frame says."""
        assert self._solver is not None
        last = None if self._last is None else self._last.reshape(-1)[self._solver.taxels]
        return self._faulty_rows.cleaned(phi, y, last)

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
