"""The reconstructor node of a batch of equal patches: a solver for each, one message each way.

A patch of which the past says nothing is estimated by both models of the solver `skin`, and
compared for some frames: tens of times the work of others. Where many patches begin at once, the
node falls behind. As soon as a newer frame waits, one comparison a frame is computed, of the patch
that has waited longest. All others have their Haar estimate, with its error and trust by
measurements held out, and are compared in a later frame. Nothing is put off while no frame waits,
where every frame is to be reconstructed (`depth` 0), and where a source waits for its readers.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparseskin.messages import (
    Measurements,
    MeasurementsBatch,
    Message,
    PhiState,
    Reconstruction,
    ReconstructionBatch,
    SkinState,
    SolverState,
)
from sparseskin.messages.batches import BatchMessage, unchecked
from sparseskin.nodes.batch import BatchNode, check_patches
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor, phis_to_invert
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.settings import setting

from .idle import IdleWatch


@dataclass(frozen=True)
class ReconstructorBatchSettings(ReconstructorSettings):
    """Settings of the reconstructor node of a batch."""

    patches: tuple[str, ...] = setting(
        (), "names of the patches served, all with the same skin; patch is the name of their batch"
    )

    skip_idle: bool = setting(
        True,
        "publish the frame of a patch as unchanged, without solving it, where its measurements "
        "changed by no more than the skin's stated noise explains",
        live=True,
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_patches(self.patches)
        for key in ("uncertainty", "resultant"):
            if getattr(self, key):
                raise SettingsError(f"{key}: is not available for a batch; allowed: false")


class ReconstructorBatch(BatchNode[ReconstructorBatchSettings]):
    """Publishes /BATCH/solver once it knows skin and Phi, then /BATCH/reconstruction_batch."""

    Settings = ReconstructorBatchSettings
    one = Reconstructor

    def __init__(self, settings: ReconstructorBatchSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._skin: SkinState | None = None
        self._phi: PhiState | None = None
        self._watch: IdleWatch | None = None
        self._last: dict[str, Reconstruction] = {}
        self._skipped = 0
        #: Frame since which the comparison of a patch is put off, and the number of the frame.
        self._waiting: dict[str, int] = {}
        self._n_frames = self._n_put_off = 0
        self._spared = True
        for name in self._names:
            self._node(name).may_compare = self._may_compare

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, SkinState):
            self._skin = message
        elif isinstance(message, PhiState):
            self._phi = message
        for answer in super().step(message):
            if isinstance(answer, SolverState):
                self._watch_again()
            yield answer

    def overtaken(self, message: Message) -> None:
        self._skipped += isinstance(message, MeasurementsBatch)

    def change(self, settings: ReconstructorBatchSettings) -> Iterable[Message]:
        messages = super().change(settings)
        self._watch_again()
        return messages

    def state(self) -> dict[str, Any]:
        idle = 0 if self._watch is None else int(np.count_nonzero(self._watch.idle))
        return {**super().state(), "idle": idle, "put_off": self._n_put_off}

    def status(self) -> str:
        idle = 0 if self._watch is None else int(np.count_nonzero(self._watch.idle))
        parts = (
            super().status(),
            f"{idle} idle" if idle else "",
            f"{self._n_put_off} comparisons put off" if self._n_put_off else "",
        )
        return "; ".join(filter(None, parts))

    def _watch_again(self) -> None:
        """Begin to watch for idle patches, where it is wanted and the skin states its noise."""
        self._watch = None
        if self._skin is None or self._phi is None or not self.settings.skip_idle:
            return
        if self._skin.sigma_end > 0:
            phis = phis_to_invert(self.settings, self._skin, self._phi)
            self._watch = IdleWatch(len(self._names), self._skin, phis)

    def _step_all(self, message: BatchMessage) -> Iterator[list[Message]]:
        assert isinstance(message, MeasurementsBatch)
        solve = np.ones(len(self._names), np.bool_)
        if self._watch is not None:
            solve = self._watch.to_solve(message.phi, message.y)
        parts, answers = message.split(self._held), {}
        self._n_frames, self._spared = self._n_frames + 1, True
        for k in sorted(range(len(parts)), key=self._turn_of):
            name = parts[k].patch
            last = self._last.get(name)
            # What is put off is not idle: it would be estimated by the wrong model for long.
            if last is not None and not solve[k] and name not in self._waiting:
                trusted = self._node(name).trusts_again(parts[k])
                answers[k] = self._unchanged(last, parts[k], trusted)
                continue
            (found,) = self.nodes[name].step(parts[k])
            assert isinstance(found, Reconstruction)
            answers[k] = self._last[name] = found
            self._note(name)
            if self._watch is not None:
                self._watch.solved(k, found.forces)
        for k in range(len(parts)):
            yield [answers[k]]

    def _node(self, name: str) -> Reconstructor:
        node = self.nodes[name]
        assert isinstance(node, Reconstructor)
        return node

    def _turn_of(self, k: int) -> int:
        """Key of a patch in the order of a frame: first those that wait longest."""
        return self._waiting.get(self._names[k], self._n_frames)

    def _may_compare(self) -> bool:
        """True while no newer frame waits, and once a frame in any case."""
        spared, self._spared = self._spared, False
        return spared or not self.context.is_behind()

    def _note(self, name: str) -> None:
        """Note whether the comparison of a patch was put off in its frame."""
        if self._node(name).put_off:
            self._waiting.setdefault(name, self._n_frames)
            self._n_put_off += 1
        else:
            self._waiting.pop(name, None)

    def _joined(self, answers: Iterable[list[Message]]) -> Iterator[Message]:
        for message in super()._joined(answers):
            if isinstance(message, ReconstructionBatch):
                message.__dict__["skipped"] = self._skipped
                self._skipped = 0
            yield message

    def _unchanged(self, last: Reconstruction, part: Measurements, trusted: bool) -> Reconstruction:
        """The last frame of a patch, published again for new measurements."""
        now = {
            "stamp_ns": part.stamp_ns,
            "phi": part.phi,
            "iterations": 0,
            "solve_ns": 0,
            "done_ns": self.context.clock.now_ns(),
            "unchanged": True,
            "trusted": trusted,
        }
        made: Reconstruction = unchecked(Reconstruction, {**last.__dict__, **now})
        return made
