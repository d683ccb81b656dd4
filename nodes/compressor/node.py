"""The compressor node, at the edge: N taxels in, M linear combinations of them out."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from sparseskin.messages import (
    Measurements,
    Message,
    PhiState,
    SkinState,
    Taxels,
    topic_of,
)
from sparseskin.messages.skin import Skin
from sparseskin.nodes.compressor.phi.base import (
    KINDS,
    RANDOM,
    STORED,
    SUMS,
    Phi,
    block_of,
    check_parameters,
    phi_class,
    phi_fact,
)
from sparseskin.nodes.compressor.phi.rotation import (
    FIXED,
    PAPER,
    PAPER_BLOCK,
    RATIO,
    ROTATING,
    ROWS,
    check_rotates,
    check_subsets,
    default_rows,
    m_of,
    phis_for,
)
from sparseskin.nodes.errors import PhiError, RefusedError, SettingsError
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.numerics.arrays import Floats, Indices, Mask
from sparseskin.nodes.numerics.compiled import use_compiled
from sparseskin.nodes.settings import PatchesSettings, naming, setting

from .quantiser import quantised
from .silence import Silence

# Measured on the six scenes by the study `stability`.
MAX_RATIO = 16.0
"""Largest ratio N / M: beyond it no solver reconstructs a frame with more than one small pad."""
MIN_BLOCK = 8
"""Least block size: smaller ones lose more than 3 dB on the touched taxels against blocks of 32."""
COMPILED_HZ = 300.0
"""Rate from which on frames are measured by compiled loops: to load these takes half a second of
processor time, which they save in a minute. Chosen."""
MIN_BITS = 5
"""Least bits of a measurement: with fewer, the quantiser's step exceeds the small measurements."""


@dataclass(frozen=True)
class CompressorSettings(PatchesSettings):
    """Settings of the compressor node."""

    phi: str = setting(
        "sbhe",
        "measurement matrix: sbhe, full, subsample, gaussian, row_local (columns of a row summed), "
        "local:SIDE (sbhe within neighbourhoods of SIDE x SIDE taxels), file:PHI.npz (a sparse "
        "matrix, or a stack of matrices that measure frames in turn) or module:Class; of a "
        "plug-in, acts (taxels chosen anew in each frame, for the solver interpolation) and "
        "adaptive (rows where forces changed, chosen anew in each frame, for the solver skin)",
        known=KINDS,
        decides=True,
    )
    ratio: float = setting(
        RATIO,
        "compression ratio N / M; M is N / ratio, rounded down, and up where rows rotate",
        low=1.0,
        high=1e6,
        live=True,
    )
    m: int | None = setting(
        None,
        "number of measurements M, in place of ratio",
        low=1,
        high=2**20,
        live=True,
    )
    bits: int | None = setting(
        None, "bits of a measurement; float32 if not stated", low=4, high=16, live=True
    )
    rows: str | None = setting(
        None,
        "rows of the measurement matrix: fixed, the same M in every frame; rotating, another "
        "subset of M in each of N / M frames, rounded up, which together read all rows; or paper, "
        "fixed and drawn at random from blocks of 32; by default rotating where they can (phi sbhe "
        "or subsample, M in N / 64 .. N - 1; a file with a stack of matrices), else fixed",
        choices=(*ROWS, PAPER),
        live=True,
    )
    block: int | None = setting(
        None,
        "size of the Hadamard blocks, a power of two; by default 256, for phi local:SIDE and rows "
        "paper 32",
        low=1,
        high=2**20,
    )
    seed: int = setting(0, "seed of the measurement matrix", low=0, high=2**32 - 1)
    quiet: float | None = setting(
        None,
        "longest silence, in seconds of the frames' stamps: while the readings of a patch depart "
        "from those sent last by no more than the noise that the skin states, no more of its "
        "frames are sent; not stated: every frame is sent",
        low=1e-3,
        high=3600.0,
        live=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.n_patches > 1 and self.bits is not None:
            raise SettingsError(
                "bits: are not available for several patches; leave them out"
            )

    def check(self) -> None:
        if self.block is not None and self.block & (self.block - 1):
            raise SettingsError(
                f"block: {self.block} is not a power of two (1, 2, 4 ...)"
            )
        with naming("phi"):
            made_by = phi_class(self.phi)
        if self.n_patches > 1 and phi_fact(made_by, "choice"):
            raise SettingsError(
                f"phi: {self.phi} chooses other rows for each patch; "
                "allowed for several patches: a Phi that all patches share, as sbhe"
            )
        # A function that makes a Phi shows its rows only once it is called.
        if self.rows == ROTATING and isinstance(made_by, type):
            check_rotates(made_by, self.phi)

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """As in `Settings`; a newly stated ratio replaces an earlier M."""
        if "ratio" in changes:
            changes = {"m": None, **changes}
        return super().changed(changes)

    def rows_and_m(self, n: int) -> tuple[str, int]:
        """Return rows ("fixed" or "rotating") and M for a skin of `n` taxels: "full" has M = N
        whatever is stated, "file:PATH" that of its file. Raises PhiError if M would be 0, or the
        kind is not known.
        """
        kind = self.phi
        rows = FIXED if self.rows == PAPER else self.rows
        if kind == "full":
            return rows or FIXED, n
        if self.m is None and self.ratio > n:
            raise PhiError(
                f"ratio: {self.ratio:g} leaves no measurement of {n} taxels; allowed: "
                f"1..{n}"
            )

        m = self.m
        if m is None and kind.startswith(STORED):
            from .phi.stored import load_matrices  # needs scipy

            matrices = load_matrices(kind.removeprefix(STORED))
            m = matrices[0].shape[0]
        # Whether rows can rotate follows from M, and M is rounded by whether they do.
        if rows is None:
            made_by = phi_class(kind)
            cls = made_by if isinstance(made_by, type) else None
            rows = default_rows(cls, kind, n, m or m_of(n, self.ratio, ROTATING))
        return rows, m or m_of(n, self.ratio, rows)

    def block_and_rule(self) -> tuple[int, int]:
        """Return size of the Hadamard blocks and rule of the rows, as of `make_phi`: rows "paper"
        are drawn at random, from blocks of 32 where no size is stated.
        """
        if self.rows == PAPER:
            return self.block or PAPER_BLOCK, RANDOM
        return block_of(self.phi, self.block), SUMS

    def phis(
        self, skin: Skin, sigma_end: float = 0.0, clips_noise: bool = True
    ) -> list[Phi]:
        """Return the matrices that measure frames of a skin in turn: one where rows are fixed.

        `sigma_end` and `clips_noise` state the skin's noise, as in `SkinState`.
        Raises PhiError if they cannot be made.
        """
        rows, m = self.rows_and_m(skin.n_taxels)
        block, rule = self.block_and_rule()
        return phis_for(
            skin,
            sigma_end,
            clips_noise,
            rows,
            kind=self.phi,
            m=m,
            seed=self.seed,
            block=block,
            rule=rule,
        )


def compression_warnings(
    kind: str, n: int, m: int, block: int, bits: int | None = None
) -> list[str]:
    """Warnings about a valid measurement matrix, with arguments of `make_phi`, that is known to
    reconstruct badly: a line each with the setting, its effect, the advised value.
    """
    warnings = []
    if n > MAX_RATIO * m:
        warnings.append(
            f"m = {m} of n = {n} taxels: more than one small contact is not reconstructed; "
            f"advised: m of {-(-n // int(MAX_RATIO))} or more (N/{MAX_RATIO:g})"
        )
    if kind == "subsample" and m < n:
        warnings.append(
            f"phi = subsample: a contact of fewer than {n / m:.3g} taxels may touch none that is "
            "read; advised: sbhe"
        )
    if kind == "sbhe" and block < MIN_BLOCK <= n:
        warnings.append(
            f"block = {block}: most measurements see no pressed taxel, which loses 3 to 10 dB on "
            f"those that are; advised: {MIN_BLOCK} or more"
        )
    if bits is not None and bits < MIN_BITS:
        warnings.append(
            f"bits = {bits}: the steps of the quantiser lose 2 to 5 dB; advised: {MIN_BITS} or more"
        )
    return warnings


class Compressor(Node[CompressorSettings]):
    """Publishes /PATCH/phi once the skin is known, then /PATCH/measurements."""

    Settings = CompressorSettings

    def __init__(self, settings: CompressorSettings, context: Context) -> None:
        super().__init__(settings, context)

        # A compressor may be made without a launch, which checks before.
        settings.check()
        self._state: SkinState | None = None
        self._subsets: list[Phi] = []  # one matrix a row subset
        self._subset = 0  # the one that measures the next frame
        self._rows = settings.rows  # in use: resolved once the skin is known
        #: The first message by a matrix: those of later frames are like it.
        self._first: Measurements | None = None
        #: Flat numbers of the cells that have a taxel; None: all have.
        self._cells: Indices | None = None
        self._silence = Silence(settings.n_patches)

    @classmethod
    def inputs(cls, settings: CompressorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (SkinState, Taxels)
        )

    @classmethod
    def outputs(cls, settings: CompressorSettings) -> tuple[str, ...]:
        return tuple(
            topic_of(settings.patch, cls.schema) for cls in (PhiState, Measurements)
        )

    @classmethod
    def facts(cls, settings: CompressorSettings) -> Mapping[str, Any]:
        return {topic_of(settings.patch, PhiState.schema): settings.phi}

    @classmethod
    def check_inputs(
        cls, settings: CompressorSettings, facts: Mapping[str, Any]
    ) -> None:
        # The number of taxels may not be known before the graph runs.
        n = facts.get(topic_of(settings.patch, SkinState.schema))
        if n is None:
            return
        rows, m = settings.rows_and_m(n)
        made_by = phi_class(settings.phi)
        # A fault of M is one of the setting that states it.
        key = "ratio" if settings.m is None else "m"
        with naming(key):
            block, _ = settings.block_and_rule()
            check_parameters(n, m, settings.seed, block)
            if isinstance(made_by, type) and issubclass(made_by, Phi):
                made_by.check_size(n, m, settings.seed, block)
        if rows == ROTATING:
            check_subsets(n, m)

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, SkinState):
            yield self._learn_skin(message, message.stamp_ns)
        elif isinstance(message, Taxels):
            self._check_frame(message)
            # Row subsets take turns, frame by frame, of those that are not sent, too.
            phi = self._subsets[self._subset]
            self._subset = (self._subset + 1) % len(self._subsets)
            patches = self._silence.to_send(message)
            if patches is not None:
                yield self._compress(message, phi, patches)

    def ended(self, topic: str, n_messages: int) -> Iterable[Message]:
        # Readers cannot count the frames of a silence that nothing ends.
        unsent = self._silence.end()
        if unsent is not None:
            # The subset of that frame: the present one is of the next.
            phi = self._subsets[self._subset - 1]
            patches = np.ones(self.settings.n_patches, dtype=np.bool_)
            yield self._compress(unsent, phi, patches)

    def change(self, settings: CompressorSettings) -> Iterable[Message]:
        old_settings = self.settings
        self.settings = settings
        if self._state is None:
            return ()

        # Neither changes Phi: readers need no new one, and the row subsets go on.
        of_old_phi = replace(settings, bits=old_settings.bits, quiet=old_settings.quiet)
        if of_old_phi == old_settings and self._subsets:
            self._warn(self._subsets[0])
            if settings.quiet != old_settings.quiet:
                self._listen()
            return ()

        try:
            return (self._learn_skin(self._state, self.context.clock.now_ns()),)
        # A user's own Phi may raise anything.
        except Exception:
            self.settings = old_settings
            raise

    def state(self) -> dict[str, Any]:
        state: dict[str, Any] = {}
        if self._subsets:
            state["m"] = self._subsets[0].m
            state["n"] = self._subsets[0].n
        state["bits"] = self.settings.bits
        state["rows"] = self._rows
        state["quiet"] = self._silence.n_quiet
        return state

    def status(self) -> str:
        if not self._subsets:
            return ""
        phi = self._subsets[0]
        text = f"{phi.kind} {phi.m} x {phi.n}"
        if len(self._subsets) > 1:
            text += ", rotating rows"
        if self._silence.n_quiet:
            text += f", {self._silence.n_quiet} quiet"
        return text

    def _learn_skin(self, state: SkinState, stamp_ns: int) -> PhiState:
        """Make Phi for a skin; return its description, valid from `stamp_ns` on."""
        settings = self.settings
        subsets = settings.phis(state.skin, state.sigma_end, state.clips_noise)
        if state.rate_hz >= COMPILED_HZ and use_compiled("auto"):
            for subset in subsets:
                # A user's own need not be one.
                if isinstance(subset, Phi):
                    subset.compile_loops()
        phi = subsets[0]
        self._warn(phi)

        # Only a Phi that could be made replaces the one before.
        self._state = state
        self._subsets = subsets
        self._subset = 0
        self._rows = ROTATING if len(subsets) > 1 else FIXED
        self._first = None
        self._cells = None
        if state.mask is not None:
            self._cells = np.flatnonzero(state.mask)
        self._listen()

        block, rule = settings.block_and_rule()
        return PhiState(
            stamp_ns=stamp_ns,
            patch=settings.patch,
            kind=settings.phi,
            n=phi.n,
            m=phi.m,
            block=block,
            seed=settings.seed,
            fingerprint=phi.fingerprint,
            rows=self._rows,
            rule=rule,
        )

    def _listen(self) -> None:
        """Begin to look for changes, if the settings ask for it and the skin states its noise."""
        period_s = self.settings.quiet
        assert self._state is not None
        # Without a stated noise, no change could be told from it.
        if period_s is not None and not self._state.sigma_end:
            self.context.log(
                "quiet: every frame is sent, as the skin states no noise to tell changes from; "
                "allowed: to state the sensor's noise, or to leave quiet out"
            )
            period_s = None
        self._silence.begin(self._state, len(self._subsets), period_s)

    def _warn(self, phi: Phi) -> None:
        kind = self.settings.phi
        bits = self.settings.bits
        for warning in compression_warnings(kind, phi.n, phi.m, phi.block, bits):
            self.context.log(warning)

    def _check_frame(self, taxels: Taxels) -> None:
        """Raise RefusedError unless a frame is one of the skin that is known."""
        if self._state is None:
            raise RefusedError(f"{taxels.topic}: the skin is not known yet")
        # Row k of the arrays is patch k, here and there.
        if taxels.names != self.settings.patches:
            raise RefusedError(
                f"{taxels.topic}: of other patches than this node serves"
            )

        skin_shape = (self._state.n_rows, self._state.n_cols)
        frame_shape = taxels.forces.shape[1:]
        if frame_shape != skin_shape:
            raise RefusedError(
                f"{taxels.topic}: forces of shape {frame_shape}, but the skin has "
                f"{skin_shape}"
            )

    def _existing(self, forces: Floats) -> Floats:
        """Readings of the taxels that exist: float32, (k, n_rows, n_cols) to (k, n)."""
        x = forces.reshape(len(forces), -1)
        if self._cells is None:
            return x
        return x[:, self._cells]

    def _compress(self, taxels: Taxels, phi: Phi, patches: Mask) -> Measurements:
        """Measurements of some patches of a frame, bool (n_patches,), one of them at least."""
        # All of them are not copied.
        forces = taxels.forces
        if not patches.all():
            forces = forces[patches]
        x = self._existing(forces)
        fields: dict[str, Any] = {
            "stamp_ns": taxels.stamp_ns,
            "phi": phi.fingerprint,
            "missing": taxels.missing,
            "reason": taxels.reason,
            "quiet": self._silence.n_frames,
            "unchanged": tuple((~patches).tolist()),
        }

        # A Phi that chooses its rows for each frame sends the choice along.
        choice = phi_fact(phi, "choice")
        if choice:
            y, fields[choice] = phi.measure(x[0])
        elif len(x) > 1:
            y = phi.forward(x)
        else:
            y = phi.forward(x[0])
        if self.settings.bits is not None:
            y = quantised(y, self.settings.bits)
        fields["y"] = y

        # All its fields are checked; those of later frames are made in the same way.
        if self._first is None:
            self._first = Measurements(
                patch=self.settings.patch, names=self.settings.patches, **fields
            )
        return self._first.following(**fields)
