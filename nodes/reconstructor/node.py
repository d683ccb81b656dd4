"""The reconstructor, on the host: M measurements in, N restored forces out."""

from __future__ import annotations

import math
import time
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparseskin.messages import (
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    SkinState,
    SolverState,
    topic_of,
)
from sparseskin.nodes.compressor.calls import Floats
from sparseskin.nodes.compressor.phi import KINDS, Phi, make_phi
from sparseskin.nodes.errors import (
    PhiError,
    RefusedError,
    SettingsError,
    SolverError,
)
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .basis import BASES, make_basis
from .limits import check_lambda, check_phi, reconstruction_warnings
from .presets import PRESETS
from .solver import SOLVERS, Solver, make_solver

ANNOUNCED = "announced"
PAPER_F_MAX_N = 2.5


@dataclass(frozen=True)
class ReconstructorSettings(PatchSettings):
    """What a reconstructor can be told."""

    preset: str = setting(
        "paper",
        f"named set of the settings below: {', '.join(PRESETS)}",
        known=PRESETS,
        live=True,
    )
    solver: str | None = setting(
        None, "solver, in place of the preset's; or module:Class", known=SOLVERS, live=True
    )
    basis: str | None = setting(
        None, "basis Psi, in place of the preset's; or module:Class", known=BASES, live=True
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
    phi: str = setting(
        ANNOUNCED,
        "measurement matrix: announced (what the compressor says), a kind or module:Class",
    )
    phi_m: int | None = setting(None, "M of a stated phi; N // 3 by default", low=1, high=2**20)
    phi_block: int = setting(32, "block size of a stated phi", low=1, high=2**20)
    phi_seed: int = setting(0, "seed of a stated phi", low=0, high=2**32 - 1)

    def check(self) -> None:
        if self.preset not in PRESETS:
            raise SettingsError(
                f"preset: '{self.preset}' is not known{did_you_mean(self.preset, PRESETS)}"
            )
        chosen = self.chosen()
        with naming("solver"):
            find_class("solver", chosen["solver"], SOLVERS, SolverError)
        with naming("basis"):
            find_class("basis", chosen["basis"], BASES, SolverError)
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
        self._skin: SkinState | None = None
        self._announced: PhiState | None = None
        self._phi: Phi | None = None
        self._solver: Solver | None = None
        self._last: Floats | None = None
        self._warm: Floats | None = None

    @classmethod
    def inputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (SkinState, PhiState, Measurements)
        )

    @classmethod
    def outputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        return tuple(topic_of(settings.patch, cls.schema) for cls in (SolverState, Reconstruction))

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Measurements):
            yield self._reconstruct(message)
            return
        if isinstance(message, SkinState):
            self._skin = message
        elif isinstance(message, PhiState):
            self._announced = message
        if self._skin is not None and self._announced is not None:
            self._phi = self._solver = None
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
        return {**chosen, "preset": preset if chosen == PRESETS[preset] else ""}

    def status(self) -> str:
        chosen = self.settings.chosen()
        return f"{chosen['solver']} in {chosen['basis']}" if self._solver else ""

    def _set_up(self, state: SkinState, announced: PhiState, stamp_ns: int) -> SolverState:
        """Make Phi and solver for a skin, and say which; they hold from `stamp_ns` on."""
        skin = state.skin
        phi = self._make_phi(skin.n_taxels, announced)
        chosen = dict(self.settings.chosen())
        options = {k: v for k, v in chosen.items() if k not in ("solver", "basis")}
        warnings = reconstruction_warnings(chosen["solver"], chosen["basis"], phi.n, phi.m, options)
        if "lambda_n" in options:
            options["lambda_n"] *= skin.f_max / PAPER_F_MAX_N
            check_lambda(chosen["solver"], options["lambda_n"], skin.f_max, phi)
        basis = make_basis(chosen["basis"], skin.n_rows, skin.n_cols)
        solver = make_solver(chosen["solver"], phi, basis, skin.mask, **options)
        if ":" in self.settings.phi:
            warnings += check_phi(phi, solver.mask)
        for warning in warnings:
            self.context.log(warning)
        self._solver = solver
        self._phi = phi
        # Another Phi or solver in the middle of a stream starts from what the last one found.
        if self._last is not None and self._last.shape != skin.shape:
            self._last = None
        self._warm = self._last
        return SolverState(
            stamp_ns=stamp_ns,
            patch=self.settings.patch,
            solver=chosen["solver"],
            basis=chosen["basis"],
            preset=self.settings.preset if chosen == PRESETS[self.settings.preset] else "",
            iterations=options.get("iterations", 0),
            lambda_n=options.get("lambda_n", 0.0),
        )

    def _make_phi(self, n: int, announced: PhiState) -> Phi:
        s = self.settings
        if s.phi != ANNOUNCED:
            return make_phi(
                s.phi, n=n, m=s.phi_m or max(1, n // 3), seed=s.phi_seed, block=s.phi_block
            )
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
        except PhiError as error:
            raise RefusedError(f"{announced.topic}: {error}") from error
        if phi.fingerprint != announced.fingerprint:
            raise RefusedError(
                f"{announced.topic}: seed {announced.seed} gives Phi {phi.fingerprint} here, "
                f"not {announced.fingerprint}: the random generators differ"
            )
        return phi

    def _reconstruct(self, measurements: Measurements) -> Reconstruction:
        if self._phi is None or self._solver is None:
            raise RefusedError(f"{measurements.topic}: skin or Phi is not known yet")
        if measurements.phi != self._phi.fingerprint:
            raise RefusedError(
                f"{measurements.topic}: Phi mismatch: made by Phi {measurements.phi}, "
                f"this reconstructor inverts Phi {self._phi.fingerprint}"
            )
        begin_ns = time.perf_counter_ns()
        try:
            forces, n_steps = self._solve(self._solver, measurements.y)
        except SolverError as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        solve_ns = time.perf_counter_ns() - begin_ns
        self._last, self._warm = forces, None
        done_ns = self.context.clock.now_ns()
        misfit = self._phi.forward(forces.reshape(-1)[self._solver.taxels]) - measurements.y
        return Reconstruction(
            stamp_ns=measurements.stamp_ns,
            patch=self.settings.patch,
            forces=forces,
            phi=self._phi.fingerprint,
            iterations=n_steps,
            residual=math.sqrt(float(np.mean(np.square(misfit, dtype=np.float64)))),
            solve_ns=solve_ns,
            done_ns=done_ns,
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
