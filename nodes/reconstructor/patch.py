"""One patch of the reconstructor node: its solver, and what it learns from frame to frame."""

import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from sparseskin.messages import Reason, SkinState
from sparseskin.messages.quantised import step_of
from sparseskin.messages.reasons import first_reason
from sparseskin.messages.skin import Skin
from sparseskin.nodes.compressor.phi.base import Phi, phi_fact
from sparseskin.nodes.numerics.arrays import Floats, Mask, of_nine
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.estimates.uncertainty import Uncertainty
from sparseskin.nodes.reconstructor.faults.watch import FaultWatch, Noise
from sparseskin.nodes.reconstructor.solvers.base import (
    CountsTiles,
    Solver,
    estimated_error,
    make_rotating_solver,
    measured,
    solver_fact,
)
from sparseskin.nodes.sensor.noise import NoiseModel

from .budget import SHARE, steps_within
from .limits import (
    OTHER_ROWS,
    check_phi,
    has_rows_of_paper,
    options_for_range,
    reconstruction_warnings,
)
from .settings import PRESETS, ReconstructorSettings

if TYPE_CHECKING:
    from .contact_tracks import ContactTracker, Followed
    from .first_touch import TouchWatch

USUAL_PART = 0.25
"""Part of a skin that is pressed, for a warning: 10 to 25 % in scenes, more in recordings."""


class Solved(NamedTuple):
    """What a `Reconstruction` states of one patch; forces and sd are float32 (n_rows, n_cols).
    `reason` is why the frame is not to be trusted, "" if it is.
    """

    forces: Floats
    sd: Floats | None
    iterations: int
    residual: float
    solve_ns: int
    error: float | None
    common_error: float
    reason: str


class Patch:
    """Reconstructs the frames of one patch: `read`, `solve` and `check` for each."""

    def __init__(
        self, settings: ReconstructorSettings, log: Callable[[str], None]
    ) -> None:
        self.settings = settings
        self.log = log
        self.solver: Solver | None = None
        #: The solver where it counts the tiles of its steps, else None.
        self._tiles: CountsTiles | None = None
        self.faults = FaultWatch(Noise(1.0), (1, 1))  # until `set_up`
        self.solved: Solved | None = None
        #: Steps of a frame that the budget allows.
        self.most_steps = 0
        self._error: float | None = None
        self._common_error = 0.0
        self._believed: Floats | None = None
        self._found = ""
        self._f_max = 0.0
        #: Why the sensor does not trust the readings of the next frame; "" if it does.
        self.sensed = ""
        self._missing: Mask | None = None
        self._blind = False  # a reading is missing whose neighbours are missing, too
        self._subsets: list[Phi] = []
        self._last: Floats | None = None
        self._warm: Floats | None = None
        self._uncertainty: Uncertainty | None = None
        self._tracker: ContactTracker | None = None
        self._touch: TouchWatch | None = None

    def set_up(
        self,
        settings: ReconstructorSettings,
        subsets: list[Phi],
        state: SkinState,
        live: bool,
        alike: "Patch | None" = None,
    ) -> dict[str, Any]:
        """Make the solver for a skin and the row subsets of its Phi; return what a `SolverState`
        states of it. What raises an error changes nothing. `live` is False where frames wait for
        each other; `alike` is the first patch of the node, which was set up for the same skin: its
        frames take as long.
        """
        phi = subsets[0]
        # Of rows that rotate, a solver may be one of several, without what its class states.
        cls = settings.solver_class
        solver, basis, options = self._make_solver(settings, subsets, state.skin)
        frame_ms = 0.0
        most_steps = sys.maxsize
        budget_ms = settings.budget_ms
        if budget_ms is None and live and "iterations" not in options:
            budget_ms = _budget_of_rate(solver, state, settings.n_patches)
        if alike is not None:
            most_steps = alike.most_steps
            _use_times_of(alike, solver)
        elif budget_ms is not None:
            n_least = solver_fact(cls, "least_iterations")
            most_steps, frame_ms = self._fit(
                solver, phi, state.f_max, budget_ms, n_least
            )

        # From here on nothing raises: what raised has changed nothing.
        self.settings = settings
        self.solver = solver
        self._tiles = solver if isinstance(solver, CountsTiles) else None
        self._subsets = subsets
        self.most_steps = most_steps
        noise = Noise(state.f_max, state.least_sd)
        self.faults = FaultWatch(
            noise, solver.mask.shape, self.log, watch_rows=settings.watch_rows
        )
        if settings.uncertainty:
            table = solver_fact(cls, "calibrated")
            self._uncertainty = Uncertainty(solver.mask, phi.ratio, table)
        self._track(state, alike)

        # Another Phi or solver in the middle of a stream starts from the last estimate.
        if self._last is not None and self._last.shape != state.skin.shape:
            self._last = None
        self._warm = self._last
        noise_sum = 0.0
        if not solver_fact(cls, "subtracts_bias"):
            noise_sum = state.skin.n_taxels * state.clip_bias
        return {
            "basis": basis,
            "lambda_n": options.get("lambda_n", 0.0),
            "frame_ms": frame_ms,
            "noise_sum": noise_sum,
            **self._stated_steps(options.get("iterations", solver.n_steps)),
        }

    def _make_solver(
        self, settings: ReconstructorSettings, subsets: list[Phi], skin: Skin
    ) -> tuple[Solver, str, dict[str, Any]]:
        """Make the solver, and log what is known to fail: with the name of its basis, and its
        options as it takes them.
        """
        phi = subsets[0]
        options = dict(settings.chosen())
        name = options.pop("solver")
        basis_name = options.pop("basis")
        warnings = reconstruction_warnings(name, basis_name, phi.n, phi.m, options)
        options = options_for_range(name, options, skin.f_max, phi)
        basis = make_basis(basis_name, skin.n_rows, skin.n_cols)
        solver = make_rotating_solver(
            name, subsets, basis, skin.mask, fast=settings.fast, **options
        )

        if settings.chosen() == PRESETS["paper"] and not has_rows_of_paper(subsets):
            warnings.append(OTHER_ROWS)
        warning_of_samples = solver_fact(settings.solver_class, "warning_of_samples")
        if phi_fact(phi, "samples") and warning_of_samples:
            warnings.append(warning_of_samples)
        # A Phi of the user's own, or of a file, may not be what it states.
        if ":" in settings.phi:
            for subset in subsets:
                warnings += check_phi(subset, solver.mask)
        for warning in dict.fromkeys(warnings):
            self.log(warning)
        return solver, basis_name, options

    def _fit(
        self, solver: Solver, phi: Phi, f_max: float, budget_ms: float, n_least: int
    ) -> tuple[int, float]:
        """Number of steps of a frame that fit into a budget, with a warning if they are fewer than
        `n_least`; and its time, milliseconds.
        """
        # A solver with paces has fewer steps from then on.
        n_steps = solver.n_steps
        most_steps, frame_s = steps_within(solver, phi, f_max, budget_ms / 1e3)
        usual, where = _usual_steps(solver, most_steps)
        if usual < min(n_least, n_steps):
            self.log(
                f"{usual} of {n_steps} iterations{where}, for a budget of {budget_ms:.2g} ms: "
                "a sudden contact takes several frames; advised: a larger budget_ms, a lower "
                "rate, or fewer taxels a node"
            )
        return most_steps, round(1e3 * frame_s, 3)

    def _track(self, skin: SkinState, alike: "Patch | None") -> None:
        """Follow the contacts of a skin from now on, if the settings ask for it."""
        tracker = self._tracker
        if self.settings.contacts and not (tracker and tracker.fits(skin)):
            # It imports scipy.ndimage: only where contacts are looked for.
            from .contact_tracks import ContactTracker

            self._tracker = ContactTracker(skin, self.settings.fast)
        if self._tracker is not None:
            self._tracker.settle(len(self._subsets))
            self._watch_touches(skin, alike)
        self.set_limits(self.settings)

    def _stated_steps(self, iterations: int) -> dict[str, int]:
        """Numbers of steps as a `SolverState` has them; `iterations` where no budget is set."""
        tiles = self._tiles
        if tiles is None or not tiles.times[0]:
            return {"iterations": min(iterations, self.most_steps)}
        frame_tiles, step_tiles = tiles.times
        _, iterations = tiles.steps_for(tiles.most_tiles)
        return {
            "iterations": iterations,
            "max_iterations": tiles.n_steps,
            "frame_tiles": frame_tiles,
            "step_tiles": step_tiles,
        }

    def _watch_touches(self, skin: SkinState, alike: "Patch | None") -> None:
        """Watch the measurements of a skin for touches from now on, if it states its noise."""
        self._touch = None
        if not skin.sigma_end or phi_fact(self._subsets[0], "choice"):
            return
        from .first_touch import TouchTest, TouchWatch

        # Its tables depend on skin and Phi alone.
        shared = alike and alike._touch
        test = shared.test if shared else TouchTest(skin, self._subsets)
        self._touch = TouchWatch(test)

    def set_noise(self, skin: SkinState) -> None:
        """Hand the noise that the skin states to the solver."""
        self._f_max = skin.f_max
        if isinstance(self.solver, Solver):
            self.solver.noise_sd = skin.least_sd
            self.solver.noise_model = _noise_model(skin)
        if self._tracker is not None:
            self._tracker.set_noise(skin)

    def set_limits(self, settings: ReconstructorSettings) -> None:
        """Take over what counts as a contact."""
        self.settings = settings
        if self._tracker is not None:
            self._tracker.limits = settings.limits

    def set_missing(self, missing: Mask | None) -> None:
        """State the taxels whose readings are missing in the next frame, bool (n_rows, n_cols)."""
        self._missing = missing
        self._blind = False
        if missing is not None and self.solver is not None:
            # A reading without a neighbour that gave one was filled in by nothing.
            has_reading = self.solver.mask & ~missing
            near_reading = of_nine(has_reading, np.logical_or)
            self._blind = bool((missing & ~near_reading).any())

    def read(self, phi: Phi, y: Floats) -> None:
        """Begin a frame: its measurements, float32 (m,), newtons."""
        assert self.solver is not None
        if len(self._subsets) > 1:
            self.solver.use(phi)
        # The residual is that of what is solved: without an offset that was subtracted.
        self._phi = phi
        self._believed = self.faults.receive(self.solver, phi, y)
        self._y = y if self._believed is None else self._believed
        if self._touch is not None:
            is_whole = self._missing is None and not self.sensed
            whole_y = self._believed if is_whole else None
            self._touch.read(phi, whole_y, step_of(y))

    def solve(self) -> None:
        """Reconstruct the frame within its budget. Raises SolverError if the solver cannot."""
        assert self.solver is not None
        self._n_steps = 0
        self._solve_ns = 0
        # The measurements hold nothing of the skin.
        if self._believed is None:
            self._error = None
            self._common_error = 0.0
            return

        begin_ns = time.perf_counter_ns()
        self.solver.setup(self._believed, self._warm)
        # One that counts tiles ends its steps by itself.
        n_steps = self.solver.n_steps
        if self._tiles is None:
            n_steps = min(self.most_steps, n_steps)
        for _ in range(n_steps):
            self.solver.step()
        self._last = self.solver.finish()
        self._n_steps = n_steps
        if self._tiles is not None:
            self._n_steps = self._tiles.n_done
        self._error, _ = estimated_error(self.solver)
        self._common_error = self.solver.common_error
        self._solve_ns = time.perf_counter_ns() - begin_ns
        # From now on the solver starts from a state of its own.
        self._warm = None

    def check(self) -> Solved:
        """Look at the frame that was solved, and compare it with its measurements."""
        assert self.solver is not None
        if self._believed is None:
            verdict = self.faults.nothing()
        else:
            assert self._last is not None
            verdict = self.faults.look(self.solver, self._phi, self._last)
        fitted = measured(self.solver, verdict.forces, self._phi)
        residuals = np.subtract(self._y, fitted, dtype=np.float64)
        energy = float(np.dot(residuals, residuals))
        residual = math.sqrt(energy / residuals.size)

        sd = None
        if self._uncertainty is not None:
            sd = self._uncertainty.of(verdict.forces, residual, self._error)
            # Of a taxel without a reading nothing is known but the range.
            if self._missing is not None:
                sd[self._missing] = self._f_max
        self._found = verdict.reason
        self.solved = Solved(
            forces=verdict.forces,
            sd=sd,
            iterations=self._n_steps,
            residual=residual,
            solve_ns=self._solve_ns,
            error=self._error,
            common_error=self._common_error,
            reason=self._reason(verdict.reason),
        )
        return self.solved

    def _reason(self, of_frame: str) -> str:
        """Why the frame is not to be trusted; "" if it is. `of_frame` is what was found of it."""
        of_readings = self.sensed
        if self._blind and not of_readings:
            of_readings = Reason.MISSING
        return first_reason(of_frame, of_readings)

    def keep(self, phi: Phi, y: Floats) -> None:
        """Take the last frame for measurements, float32 (m,), that are not solved."""
        # Of a frame that held nothing of the skin no more is known than of this one.
        of_frame = "" if self._believed is None else self._found
        reason = self.faults.glance(phi, y) or self._reason(of_frame)
        self._repeat(reason)

    def rest(self) -> None:
        """Take the last frame for one whose measurements were not sent, as nothing changed."""
        self._repeat(self._reason(self._found))

    def _repeat(self, reason: str) -> None:
        """Take the last frame again, which is not to be trusted for a reason; "" if it is."""
        assert self.solved is not None
        self.solved = self.solved._replace(iterations=0, solve_ns=0, reason=reason)
        if self._touch is not None:
            self._touch.skip()

    def pass_silence(self, until_ns: int) -> None:
        """Let the time until a stamp pass in which nothing was sent, as nothing changed."""
        if self._tracker is not None:
            self._tracker.rest(until_ns)

    def contacts(self, stamp_ns: int) -> "Followed | None":
        """Contacts of the frame that was published last; None: there are none."""
        if self._tracker is None or self.solved is None:
            return None
        solved = self.solved
        errors = solved.error, stamp_ns, solved.sd, solved.common_error
        if self._touch is None:
            return self._tracker.update(solved.forces, *errors)
        contacts = self._tracker.update(solved.forces, *errors, self._touch.touch)
        self._touch.follow(self._tracker.in_contact)
        return contacts


def _budget_of_rate(solver: Solver, skin: SkinState, n_patches: int) -> float | None:
    """Time of a frame of one patch at the rate of the frames, milliseconds; None where the rate is
    not known, or the solver has only one number of steps.
    """
    if not skin.rate_hz or not solver_fact(solver, "paces"):
        return None
    return 1e3 * SHARE / skin.rate_hz / n_patches


def _usual_steps(solver: Solver, most_steps: int) -> tuple[int, str]:
    """Number of steps that a budget allows in most frames; and which these are, in words."""
    if isinstance(solver, CountsTiles) and solver.times[0]:
        n_tiles = int(USUAL_PART * solver.most_tiles)
        _, n_steps = solver.steps_for(n_tiles)
        return n_steps, f" where {USUAL_PART:.0%} of the skin is pressed"
    return most_steps, ""


def _use_times_of(patch: Patch, solver: Solver) -> None:
    """Let a solver do as many steps as that of a patch like its own: a frame takes as long."""
    if isinstance(solver, CountsTiles) and patch._tiles is not None:
        solver.use_times(*patch._tiles.times)
    elif patch.most_steps in solver_fact(solver, "paces"):
        solver.use_pace(patch.most_steps)


def _noise_model(skin: SkinState) -> NoiseModel | None:
    """The noise that a skin states; None if it states none."""
    if not skin.sigma_mid:
        return None
    sigmas = skin.sigma_mid, skin.sigma_end
    return NoiseModel(skin.f_max, *sigmas, clips=skin.clips_noise)
