"""The reconstructor node, on the host: M measurements of each patch in, N forces out."""

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import compress
from typing import TYPE_CHECKING, Any

import numpy as np

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    ShapeError,
    SkinState,
    SolverState,
    topic_of,
)
from sparseskin.messages.contacts import summary
from sparseskin.nodes.compressor.phi.base import Phi, follow, make_phi, phi_fact
from sparseskin.nodes.compressor.phi.rotation import phis_for
from sparseskin.nodes.errors import (
    PhiError,
    RefusedError,
    SettingsError,
    SolverError,
    SparseskinError,
)
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.numerics.warm_up import compile_loops
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.solvers.base import (
    make_solver,
    solver_fact,
)

from .patch import Patch
from .patch_log import PatchLog
from .settings import PRESETS, ReconstructorSettings, alike_but_for_contacts

if TYPE_CHECKING:
    from .idle import IdleWatch

EVERY_FRAME = 0
NEWEST = 1
"""Depths where the settings state none: of recorded frames, and of a live source."""


class Reconstructor(Node[ReconstructorSettings]):
    """Publishes /PATCH/solver once it knows skin and Phi, then /PATCH/reconstruction and, of each
    of them, /PATCH/contacts.

    Measurements made by another Phi are refused: inverting the wrong matrix would invent forces.
    Each of several patches has a solver of its own, and the results are those of a node a patch.
    """

    Settings = ReconstructorSettings

    def __init__(self, settings: ReconstructorSettings, context: Context) -> None:
        super().__init__(settings, context)
        settings.check()
        has_loops = solver_fact(settings.solver_class, "has_loops")
        if has_loops or settings.contacts:
            compile_loops(settings.fast, context.log, context.count)
        _rehearse(settings)
        self._skin: SkinState | None = None
        self._announced: PhiState | None = None
        self._subsets: dict[str, Phi] = {}
        self._skipped = 0
        self._last_measured: Measurements | None = None
        #: The first message of a solver: those of later frames are like it.
        self._first: Reconstruction | None = None
        self._names = settings.patches or (settings.patch,)
        self._log = PatchLog(self._names, context.log)
        self._patches = [Patch(settings, self._log.of(name)) for name in self._names]
        self._idle: IdleWatch | None = None
        self._touching: Contacts | None = None
        if settings.contacts:
            from .contact_tracks import NOTHING, joined

            self._untouched = Contacts(
                patch=settings.patch,
                names=settings.patches,
                stamp_ns=0,
                done_ns=0,
                **NOTHING,
            )
            self._joined = joined

    @classmethod
    def inputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema)
            for cls in (SkinState, PhiState, Measurements)
        )

    @classmethod
    def outputs(cls, settings: ReconstructorSettings) -> tuple[str, ...]:
        classes: list[type[Message]] = [SolverState, Reconstruction]
        if settings.contacts:
            classes.append(Contacts)
        return tuple(topic_of(settings.patch, cls.schema) for cls in classes)

    @classmethod
    def check_inputs(
        cls, settings: ReconstructorSettings, facts: Mapping[str, Any]
    ) -> None:
        kind = facts.get(topic_of(settings.patch, PhiState.schema))
        if kind is not None:
            settings.check_phi(kind)

    @property
    def depth(self) -> int:
        if self.settings.depth is not None:
            return self.settings.depth
        # A live sensor does not wait: its newest frame is worth more than its oldest.
        if self._skin is not None and self._skin.live:
            return NEWEST
        return EVERY_FRAME

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Measurements):
            yield from self._reconstruct(message)
            return

        previous: Message | None = None
        if isinstance(message, SkinState):
            previous = self._skin
            self._skin = message
        elif isinstance(message, PhiState):
            previous = self._announced
            self._announced = message

        if self._subsets and previous is not None and _is_alike(message, previous):
            self._state_noise()
            return
        if self._skin is None or self._announced is None:
            return
        # A skin that has changed: its Phi is on its way, or the reverse.
        if self._subsets and self._announced.n != self._skin.skin.n_taxels:
            return
        self._subsets = {}
        stamp_ns = max(self._skin.stamp_ns, self._announced.stamp_ns)
        yield self._set_up(self._skin, self._announced, stamp_ns)

    def overtaken(self, message: Message) -> None:
        self._skipped += isinstance(message, Measurements)

    def change(self, settings: ReconstructorSettings) -> Iterable[Message]:
        previous = self.settings
        self.settings = settings
        if alike_but_for_contacts(previous, settings):
            for patch in self._patches:
                patch.set_limits(settings)
            return ()
        if self._skin is None or self._announced is None:
            return ()
        now_ns = self.context.clock.now_ns()
        try:
            return (self._set_up(self._skin, self._announced, now_ns),)
        # A user's own solver may raise anything.
        except Exception:
            self.settings = previous
            raise

    def state(self) -> dict[str, Any]:
        state = self.settings.chosen()
        state["preset"] = self._preset
        state["left_out"] = self._left_out
        state["depth"] = self.depth
        if self.settings.skip_idle:
            state["idle"] = self._n_idle
        if not self._uses_basis:
            state["basis"] = None
        return state

    def status(self) -> str:
        if not self._subsets:
            return ""
        in_force = self.settings.chosen()
        solver = f"solver {in_force['solver']}"
        if self._uses_basis:
            solver += f" in {in_force['basis']}"
        patches = ""
        if len(self._patches) > 1:
            patches = f"{len(self._patches)} patches"
            if self._n_idle:
                patches += f", {self._n_idle} idle"
        parts = (solver, self._left_out, patches, self._touched())
        return "; ".join(filter(None, parts))

    def _touched(self) -> str:
        """Contacts of the newest frame in words; "" if there are none."""
        contacts = self._touching
        if contacts is None or self._skin is None or not contacts.id.size:
            return ""
        total = float(contacts.total.sum())
        return summary(contacts.id.size, total, self._skin.unit)

    @property
    def _preset(self) -> str:
        """The preset; "" if settings replace a part of it."""
        preset = self.settings.preset
        if self.settings.chosen() != PRESETS[preset]:
            return ""
        return preset

    @property
    def _uses_basis(self) -> bool:
        """True if the solver uses the basis."""
        return bool(solver_fact(self.settings.solver_class, "uses_basis"))

    @property
    def _left_out(self) -> str:
        """Measurements that are excluded now."""
        texts = [patch.faults.text for patch in self._patches]
        # What holds for all patches is stated once.
        if len(set(texts)) == 1:
            return texts[0]
        patches = zip(self._names, texts, strict=True)
        return "; ".join(f"{name}: {text}" for name, text in patches if text)

    @property
    def _n_idle(self) -> int:
        if self._idle is None:
            return 0
        return int(np.count_nonzero(self._idle.idle))

    def _set_up(
        self, state: SkinState, announced: PhiState, stamp_ns: int
    ) -> SolverState:
        """Make Phi and solvers for a skin; return the message that announces them."""
        subsets = phis_to_invert(self.settings, state, announced)

        # The patches share what does not depend on their frames with the first one.
        self._log.setting_up = True
        try:
            leader, *other_patches = self._patches
            of_skin = self.settings, subsets, state, self.context.live
            solver = leader.set_up(*of_skin)
            for patch in other_patches:
                patch.set_up(*of_skin, alike=leader)
        finally:
            self._log.setting_up = False
        self._subsets = {phi.fingerprint: phi for phi in subsets}
        self._first = None
        self._state_noise()

        self._idle = None
        chooses = bool(phi_fact(subsets[0], "choice"))
        # Without a stated noise no change is known from it; rows chosen anew have no earlier frame.
        if self.settings.skip_idle and state.sigma_end > 0 and not chooses:
            # With it the sensor's noise is imported.
            from .idle import IdleWatch

            self._idle = IdleWatch(len(self._patches), state, subsets)

        solver["solver"] = self.settings.chosen()["solver"]
        solver["preset"] = self._preset
        if not self._uses_basis:
            solver["basis"] = ""
        return SolverState(stamp_ns=stamp_ns, patch=self.settings.patch, **solver)

    def _state_noise(self) -> None:
        """Hand the noise that the skin states to the solvers."""
        assert self._skin is not None
        for patch in self._patches:
            patch.set_noise(self._skin)

    def _phi_of(self, measurements: Measurements) -> Phi:
        """The row subset that measurements were made by, or RefusedError."""
        if not self._subsets:
            raise RefusedError(f"{measurements.topic}: skin or Phi is not known yet")
        if measurements.names != self.settings.patches:
            raise RefusedError(
                f"{measurements.topic}: of other patches than this node serves"
            )
        phi = self._subsets.get(measurements.phi)
        if phi is None:
            subset, *other_subsets = self._subsets
            inverted = f"Phi {subset}"
            if other_subsets:
                inverted += f" and {len(other_subsets)} other row subsets"
            raise RefusedError(
                f"{measurements.topic}: Phi mismatch: made by Phi {measurements.phi}, "
                f"this reconstructor inverts {inverted}"
            )
        return phi

    def _reconstruct(self, measurements: Measurements) -> Iterator[Message]:
        phi = self._phi_of(measurements)
        try:
            unchanged = self._read(measurements, phi)
            solving = [k for k, same in enumerate(unchanged) if not same]
            for k in solving:
                self._patches[k].solve()
        except (PhiError, ShapeError, SolverError) as error:
            raise RefusedError(f"{measurements.topic}: {error}") from error
        done_ns = self.context.clock.now_ns()

        for k in solving:
            solved = self._patches[k].check()
            if self._idle is not None:
                self._idle.solved(k, solved.forces)

        yield self._reconstruction(measurements, unchanged, done_ns)
        self._skipped = 0
        self._pass_silence(measurements)
        if self.settings.contacts:
            yield self._contacts(measurements)

    def _read(self, measurements: Measurements, phi: Phi) -> list[bool]:
        """Hand the patches their measurements; True for each that keeps its last forces."""
        skin = self._skin
        assert skin is not None
        patches = self._patches
        # Of several patches no message names missing taxels.
        missing = measurements.missing_cells((skin.n_rows, skin.n_cols))
        patches[0].set_missing(missing)
        for patch, reason in zip(patches, measurements.reason, strict=True):
            patch.sensed = reason
        follow(phi, places=measurements.places, nodes=measurements.nodes)

        # An array of a sender in this process, which may write to it again.
        all_y = measurements.y
        if all_y.flags.writeable:
            all_y = all_y.copy()

        sent = list(range(len(patches)))
        if not measurements.all_sent:
            sent = [k for k, same in enumerate(measurements.unchanged) if not same]
            self._rest(measurements)

        # What the compressor sends of a few patches alone has changed: it is solved.
        to_solve = [True] * len(sent)
        if self._idle is not None and measurements.all_sent:
            to_solve = self._idle.to_solve(phi.fingerprint, all_y).tolist()
        unchanged = [True] * len(patches)
        for k, y, solves in zip(sent, all_y, to_solve, strict=True):
            patch = patches[k]
            if solves or patch.solved is None:
                unchanged[k] = False
                patch.read(phi, y)
            else:
                patch.keep(phi, y)
        return unchanged

    def _rest(self, measurements: Measurements) -> None:
        """Keep the last forces of the patches whose measurements were not sent."""
        # All are checked first: a message that is refused changes no patch.
        resting = list(compress(self._patches, measurements.unchanged))
        if any(patch.solved is None for patch in resting):
            raise RefusedError(
                f"{measurements.topic}: a patch is quiet that has sent no measurements yet; "
                "it does once its silence ends"
            )
        for patch in resting:
            patch.rest()

    def _pass_silence(self, measurements: Measurements) -> None:
        """Let the frames that were not sent since the last message pass for the contacts."""
        n_quiet = measurements.quiet
        previous = self._last_measured
        self._last_measured = measurements
        if previous is None:
            return
        # Another run of the compressor counts from 0.
        if previous.run_id == measurements.run_id:
            n_quiet -= previous.quiet
        if n_quiet <= 0:
            return
        # The first frame after a silence came one period after its last one.
        elapsed_ns = measurements.stamp_ns - previous.stamp_ns
        until_ns = previous.stamp_ns + elapsed_ns * n_quiet // (n_quiet + 1)
        for patch in self._patches:
            patch.pass_silence(until_ns)

    def _reconstruction(
        self, measurements: Measurements, unchanged: list[bool], done_ns: int
    ) -> Reconstruction:
        """Solutions of the patches, without the forces of those that are unchanged."""
        solved = [patch.solved for patch in self._patches if patch.solved is not None]
        columns = zip(*solved, strict=True)
        all_forces, sds, iterations, residuals, solve_ns, errors, _, reasons = columns

        # Without a change there is still a shape to state.
        forces = all_forces[0][np.newaxis][:0]
        if not all(unchanged):
            pairs = zip(all_forces, unchanged, strict=True)
            forces = _stacked([image for image, same in pairs if not same])
        sd = None
        if sds[0] is not None:
            sd = _stacked(sds)

        fields: dict[str, Any] = {
            "stamp_ns": measurements.stamp_ns,
            "forces": forces,
            "phi": measurements.phi,
            "missing": measurements.missing,
            "quiet": measurements.quiet,
            "iterations": iterations,
            "residual": residuals,
            "solve_ns": solve_ns,
            "done_ns": done_ns,
            "sd": sd,
            "skipped": self._skipped,
            "error": errors,
            "trusted": tuple([not reason for reason in reasons]),
            "reason": reasons,
            "unchanged": tuple(unchanged),
        }
        if self._first is None:
            self._first = Reconstruction(
                patch=self.settings.patch, names=self.settings.patches, **fields
            )
        return self._first.following(**fields)

    def _contacts(self, measurements: Measurements) -> Contacts:
        """Contacts of the frame that was reconstructed, of all patches."""
        stamp_ns = measurements.stamp_ns
        followed = [patch.contacts(stamp_ns) for patch in self._patches]
        trusted = tuple(
            [not p.solved.reason for p in self._patches if p.solved is not None]
        )
        done_ns = self.context.clock.now_ns()
        fields: dict[str, Any] = {}
        if any(followed):
            fields = self._joined(followed)
        self._touching = self._untouched.at(stamp_ns, done_ns, trusted, **fields)
        return self._touching


def _stacked(arrays: Sequence[Floats]) -> Floats:
    """Arrays of the patches as one, without a copy of the array of one."""
    if len(arrays) == 1:
        return arrays[0][np.newaxis]
    return np.stack(arrays)


def _is_alike(message: Message, before: Message) -> bool:
    """True if a state differs from the one of the same run before in its rate or time at most."""
    return all(
        name in ("stamp_ns", "seq", "rate_hz")
        or np.array_equal(value, getattr(before, name))
        for name, value in vars(message).items()
    )


def _rehearse(settings: ReconstructorSettings) -> None:
    """Reconstruct one empty frame of a small skin: no frame of the graph waits for an import."""
    options = settings.chosen()
    solver_name = options.pop("solver")
    basis_name = options.pop("basis")
    # One of the user's own is not called before its skin is known.
    if ":" in solver_name + basis_name:
        return
    phi = make_phi("sbhe", n=64, m=21, seed=0)
    # Settings may fit another size alone; those that are wrong are reported by `_set_up`.
    with contextlib.suppress(SparseskinError):
        basis = make_basis(basis_name, 8, 8)
        solver = make_solver(solver_name, phi, basis, fast=settings.fast, **options)
        solver.solve(np.zeros(phi.m, dtype=np.float32))


def phis_to_invert(
    settings: ReconstructorSettings, state: SkinState, announced: PhiState
) -> list[Phi]:
    """Return the matrices of the measurements: one Phi of a skin, or one for each row subset.

    A kind that is stated in the settings replaces the announced one, which is never imported.

    Raises
    ------
    RefusedError
        If the announced Phi is not built in and not stated, is of another skin, cannot be made, or
        comes out as another matrix here.
    """
    n = state.skin.n_taxels
    if announced.n != n:
        raise RefusedError(
            f"{announced.topic}: for {announced.n} taxels; the skin has {n}"
        )
    try:
        settings.check_phi(announced.kind)
        subsets = phis_for(
            state.skin,
            state.sigma_end,
            state.clips_noise,
            announced.rows,
            kind=settings.kind_of(announced.kind),
            m=announced.m,
            seed=announced.seed,
            block=announced.block,
            rule=announced.rule,
        )
    except (PhiError, SettingsError) as error:
        raise RefusedError(f"{announced.topic}: {error}") from error
    if subsets[0].fingerprint != announced.fingerprint:
        raise RefusedError(
            f"{announced.topic}: seed {announced.seed} gives Phi {subsets[0].fingerprint} here, "
            f"not {announced.fingerprint}: its program differs"
        )
    return subsets
