"""The reconstructor node, on the host: M measurements in, N reconstructed forces out."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.compressor.phi.acts import follow
from sparseskin.nodes.compressor.phi.adaptive import AdaptivePhi, follow_nodes, layout
from sparseskin.nodes.compressor.phi.base import Phi, is_built_in, make_phi
from sparseskin.nodes.compressor.phi.rotation import block_and_rule, row_subsets
from sparseskin.nodes.compressor.phi.sbhe import is_sbhe
from sparseskin.nodes.errors import (
    PhiError,
    RefusedError,
    SettingsError,
    SolverError,
    SparseskinError,
)
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.compiled import SOLVERS, use_compiled
from sparseskin.nodes.numerics.warm_up import compile_loops
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.estimates.resultant import Estimate, ResultantEstimator
from sparseskin.nodes.reconstructor.estimates.trust import TrustLog
from sparseskin.nodes.reconstructor.estimates.uncertainty import CALIBRATED, Uncertainty
from sparseskin.nodes.reconstructor.faults.watch import FaultWatch
from sparseskin.nodes.reconstructor.solvers.base import (
    Solver,
    estimated_error,
    make_rotating_solver,
    make_solver,
)

from .limits import (
    OTHER_ROWS,
    OWN_BASIS,
    check_lambda,
    check_phi,
    has_rows_of_paper,
    reconstruction_warnings,
)
from .settings import PRESETS, ReconstructorSettings


class Reconstructor(Node[ReconstructorSettings]):
    """Publishes /PATCH/solver once it knows skin and Phi, then /PATCH/reconstruction.

    Measurements made by another Phi are refused: inverting the wrong matrix would invent forces.
    """

    Settings = ReconstructorSettings

    def __init__(self, settings: ReconstructorSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        compile_loops(settings.chosen()["solver"], settings.fast, context.log, "phi")
        _rehearse(settings)
        self._skin: SkinState | None = None
        self._announced: PhiState | None = None
        self._subsets: dict[str, Phi] = {}
        self._solver: Solver | None = None
        self._last: Floats | None = None
        self._warm: Floats | None = None
        self._skipped = 0
        self._watch = FaultWatch(settings.watch_rows, settings.watch_taxels, context.log)
        self._trust_log = TrustLog(context.log)
        self._uncertainty: Uncertainty | None = None
        self._resultant: ResultantEstimator | None = None
        #: As in `Solver`, of any solver that this node makes.
        self.may_compare: Callable[[], bool] = lambda: True

    @classmethod
    def inputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (SkinState, PhiState, Measurements)
        )

    @classmethod
    def outputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        written = (SolverState, *((Resultant,) if settings.resultant else ()), Reconstruction)
        return tuple(topic_of(settings.patch, cls.schema) for cls in written)

    @classmethod
    def check_inputs(cls, settings: ReconstructorSettings, facts: Mapping[str, Any]) -> None:
        kind = facts.get(topic_of(settings.patch, PhiState.schema))
        if kind is not None:
            settings.check_phi(kind)
        n = facts.get(topic_of(settings.patch, SkinState.schema))
        rows_and_m = facts.get(topic_of(settings.patch, Measurements.schema))
        if n is None or rows_and_m is None:
            return
        with contextlib.suppress(PhiError):  # of the compressor, which reports it
            stated = settings.stated_rows_and_m(n)
            if stated is None:
                return
            keys = (("phi_rows", "rows are"), ("phi_m", "M is"))
            for (key, made), mine, theirs in zip(keys, stated, rows_and_m(n), strict=True):
                if mine != theirs:
                    raise SettingsError(
                        f"{key}: {mine}, but the compressor's {made} {theirs}; "
                        f"state {key} = {theirs}"
                    )

    @property
    def depth(self) -> int:
        return self.settings.depth

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Measurements):
            yield from self._reconstruct(message)
            return
        known: Message | None = None
        if isinstance(message, SkinState):
            known, self._skin = self._skin, message
        elif isinstance(message, PhiState):
            known, self._announced = self._announced, message
        if self._solver is not None and known is not None and _is_alike(message, known):
            self._state_period_and_noise()
            return
        if self._skin is not None and self._announced is not None:
            self._subsets, self._solver = {}, None
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

    @property
    def put_off(self) -> bool:
        """True if a comparison that the last frame needs was put off."""
        return bool(getattr(self._solver, "put_off", False))

    def trusts_again(self, measurements: Measurements) -> bool:
        """Process measurements that are not solved; True if the last frame is trusted for them."""
        assert self._solver is not None
        self._watch.watch_repeats(measurements.phi, measurements.y)
        return estimated_error(self._solver)[1] and not self._watch.frozen

    def state(self) -> dict[str, Any]:
        chosen, preset = self.settings.chosen(), self.settings.preset
        watch = self._watch
        state: dict[str, Any] = {
            "left_out": watch.text,
            "swamped": watch.swamped,
            "faulty_taxels": watch.taxels,
        }
        if chosen["solver"] in OWN_BASIS:
            state["basis"] = None
        return {**chosen, "preset": preset if chosen == PRESETS[preset] else "", **state}

    def status(self) -> str:
        chosen = self.settings.chosen()
        if self._solver is None:
            return ""
        basis = "" if chosen["solver"] in OWN_BASIS else f" in {chosen['basis']}"
        return "; ".join(filter(None, (f"solver {chosen['solver']}{basis}", self._watch.text)))

    def _set_up(self, state: SkinState, announced: PhiState, stamp_ns: int) -> SolverState:
        """Make Phi and solver for a skin; return the message that announces them."""
        skin = state.skin
        subsets = phis_to_invert(self.settings, state, announced)
        phi = subsets[0]
        chosen = dict(self.settings.chosen())
        options = {k: v for k, v in chosen.items() if k not in ("solver", "basis")}
        warnings = reconstruction_warnings(chosen["solver"], chosen["basis"], phi.n, phi.m, options)
        if "lambda_n" in options:
            options["lambda_n"] *= skin.f_max / PAPER_F_MAX_N
            check_lambda(chosen["solver"], options["lambda_n"], skin.f_max, phi)
        basis = make_basis(chosen["basis"], skin.n_rows, skin.n_cols)
        solver = make_rotating_solver(
            chosen["solver"], subsets, basis, skin.mask, fast=self.settings.fast, **options
        )
        if chosen == PRESETS["paper"] and not has_rows_of_paper(subsets):
            warnings.append(OTHER_ROWS)
        if ":" in self.settings.phi:
            for one in subsets:
                warnings += check_phi(one, solver.mask)
        for warning in dict.fromkeys(warnings):
            self.context.log(warning)
        if isinstance(solver, Solver):
            solver.may_compare = lambda: self.may_compare()
        self._solver = solver
        self._state_period_and_noise()
        if chosen["solver"] in SOLVERS and use_compiled(self.settings.fast):
            for one in subsets:
                if is_sbhe(one):
                    one.compile()
        self._subsets = {one.fingerprint: one for one in subsets}
        self._watch.set_up(self._subsets, state, solver.mask)
        self._trust_log.begin(len(self._subsets))
        self._uncertainty = self._make_uncertainty(solver, phi, announced.rows)
        if self.settings.resultant:
            self._resultant = ResultantEstimator(phi, solver.taxels, skin.shape)
        # Another Phi or solver in the middle of a stream starts from the last estimate.
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

    def _state_period_and_noise(self) -> None:
        """Hand the time between frames, and the noise, that the skin states to the solver."""
        if isinstance(self._solver, Solver) and self._skin is not None:
            self._solver.period_s = 1 / self._skin.rate_hz if self._skin.rate_hz else math.inf
            self._solver.noise_sd = self._skin.least_sd

    def _make_uncertainty(self, solver: Solver, phi: Phi, rows: str) -> Uncertainty | None:
        if not self.settings.uncertainty:
            return None
        name = self.settings.chosen()["solver"]
        adaptive = isinstance(phi, AdaptivePhi)
        if name in CALIBRATED and not adaptive:
            return Uncertainty(solver.mask, phi.ratio, name, rows, phi.rule)
        what = f"{name} with phi adaptive" if adaptive else name
        self.context.log(
            f"uncertainty: the error of solver {what} is not known, and none is published; "
            f"known: {', '.join(CALIBRATED)}"
        )
        return None

    def _differences(self, announced: PhiState) -> str:
        """Rows and M of a stated Phi and of the announced one, where they differ; else ""."""
        stated = self.settings.stated_rows_and_m(announced.n)
        if stated is None:
            return ""
        pairs = (("phi_rows", "rows", announced.rows), ("phi_m", "M", announced.m))
        return "".join(
            f"; {key} is {mine}, {name} of the announced Phi {theirs}"
            for (key, name, theirs), mine in zip(pairs, stated, strict=True)
            if mine != theirs
        )

    def _reconstruct(self, measurements: Measurements) -> Iterator[Message]:
        if self._solver is None or self._announced is None:
            raise RefusedError(f"{measurements.topic}: skin or Phi is not known yet")
        phi = self._subsets.get(measurements.phi)
        if phi is None:
            first, *others = self._subsets
            rotating = f" and {len(others)} other row subsets" if others else ""
            raise RefusedError(
                f"{measurements.topic}: Phi mismatch: made by Phi {measurements.phi}, "
                f"this reconstructor inverts Phi {first}{rotating}"
                f"{self._differences(self._announced)}"
            )
        try:
            follow(phi, measurements.places)
            follow_nodes(phi, measurements.nodes)
            if len(self._subsets) > 1:
                self._solver.use(phi)
            given = y = measurements.y
            # If each frame chooses its taxels or rows anew, there are no rows to watch.
            watched = measurements.places is None and measurements.nodes is None
            self._watch.watch_repeats(phi.fingerprint, y)
            if watched:
                given, y = self._watch.cleaned(phi, given, self._last)
        except (PhiError, SolverError) as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        if self._resultant is not None:
            yield self._resultant_of(self._resultant.estimate(phi, y), measurements.stamp_ns)
        begin_ns = time.perf_counter_ns()
        try:
            forces, n_steps = self._solve(self._solver, y)
            estimated, trusted = estimated_error(self._solver)
        except SolverError as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        solve_ns = time.perf_counter_ns() - begin_ns
        self._last, self._warm = forces, None
        filled = self._watch.filled(forces)
        done_ns = self.context.clock.now_ns()
        fitted = phi.forward(forces.reshape(-1)[self._solver.taxels])
        left = np.subtract(fitted, y, dtype=np.float64)
        residual = math.sqrt(float(np.dot(left, left)) / left.size)
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
            error=estimated,
            trusted=trusted and not self._watch.frozen,
        )
        self._skipped = 0
        self._log_trust(measurements.stamp_ns, forces, estimated, trusted)
        if watched and self._watch.update(
            phi, given, y, forces, fitted, getattr(self._solver, "unfitted", None)
        ):
            # The effect of faulty measurements on the estimate would last for long.
            self._warm, self._last = np.zeros_like(forces), None
        if self._resultant is not None:
            fingerprints = list(self._subsets)
            following = fingerprints[(fingerprints.index(phi.fingerprint) + 1) % len(fingerprints)]
            self._resultant.learn(phi, y, forces.reshape(-1)[self._solver.taxels], fitted)
            self._resultant.prepare(self._subsets[following])

    def _log_trust(self, stamp_ns: int, forces: Floats, error: float | None, trusted: bool) -> None:
        assert self._skin is not None
        assert self._solver is not None
        self._trust_log.update(
            stamp_ns,
            forces,
            error,
            trusted,
            n=self._solver.taxels.size,
            unit=self._skin.unit,
        )

    def _resultant_of(self, found: Estimate, stamp_ns: int) -> Resultant:
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
        """Reconstruct one frame within the budget; return the forces and the number of steps."""
        budget_ms = self.settings.budget_ms
        if budget_ms is None:
            return solver.solve(y, self._warm), solver.n_steps
        deadline_ns = time.perf_counter_ns() + round(1e6 * budget_ms)
        solver.setup(y, self._warm)
        done, longest_ns, before_ns = 0, 0, time.perf_counter_ns()
        # A step is begun only if one like the longest so far would end in time; the first is always
        # done, as without it there is no estimate of this frame.
        while done < solver.n_steps and (not done or before_ns + longest_ns <= deadline_ns):
            solver.step()
            now_ns = time.perf_counter_ns()
            longest_ns, before_ns = max(longest_ns, now_ns - before_ns), now_ns
            done += 1
        return solver.finish(), done


def _is_alike(message: Message, known: Message) -> bool:
    """True if a state differs from the one of the same run before in its rate or time at most."""
    return all(
        name in ("stamp_ns", "seq", "rate_hz") or np.array_equal(value, getattr(known, name))
        for name, value in vars(message).items()
    )


def _rehearse(settings: ReconstructorSettings) -> None:
    """Reconstruct one empty frame of a small skin, and discard the solver: the first frame of the
    graph then waits for no import. Parts of the user's own are left alone.
    """
    chosen = dict(settings.chosen())
    names = chosen.pop("solver"), chosen.pop("basis")
    if any(":" in name for name in names):
        return
    phi = make_phi("sbhe", n=64, m=21, seed=0)
    with contextlib.suppress(SparseskinError):  # settings for another size; `_set_up` reports them
        solver = make_solver(
            names[0], phi, make_basis(names[1], 8, 8), fast=settings.fast, **chosen
        )
        solver.solve(np.zeros(phi.m, dtype=np.float32))


def phis_to_invert(
    settings: ReconstructorSettings, state: SkinState, announced: PhiState
) -> list[Phi]:
    """Return the matrices of the measurements: one Phi of a skin, or one for each row subset.

    A Phi that is stated in the settings replaces the announced one.

    Raises
    ------
    RefusedError
        If the announced Phi is not built in, is of another skin, cannot be made, or comes out as
        another matrix here.
    PhiError
        If a stated Phi cannot be made.
    """
    s, n = settings, state.skin.n_taxels
    exists = state.skin.exists
    stated = s.stated_rows_and_m(n)
    if stated is not None:
        rows, m = stated
        chosen = block_and_rule(s.phi_rows, s.phi_block)
        phi = make_phi(s.phi, n=n, m=m, seed=s.phi_seed, **chosen)
        layout(phi, exists, state.sigma_end, state.f_max, state.clips_noise)
        return row_subsets(phi, rows)
    # Nothing named over the wire is ever imported: a Phi of the user's own has to be stated.
    if not is_built_in(announced.kind):
        raise RefusedError(
            f"{announced.topic}: phi '{announced.kind}' is not built in; "
            "state it as the reconstructor's phi"
        )
    if announced.n != n:
        raise RefusedError(f"{announced.topic}: for {announced.n} taxels; the skin has {n}")
    try:
        phi = make_phi(
            *(announced.kind, n, announced.m, announced.seed, announced.block, announced.rule)
        )
        layout(phi, exists, state.sigma_end, state.f_max, state.clips_noise)
        subsets = row_subsets(phi, announced.rows)
    except PhiError as error:
        raise RefusedError(f"{announced.topic}: {error}") from error
    if subsets[0].fingerprint != announced.fingerprint:
        raise RefusedError(
            f"{announced.topic}: seed {announced.seed} gives Phi {subsets[0].fingerprint} here, "
            f"not {announced.fingerprint}: the random generators differ"
        )
    return subsets
