"""The reconstructor node of a batch of equal patches: a solver for each, one message each way."""

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

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, SkinState):
            self._skin = message
        elif isinstance(message, PhiState):
            self._phi = message
        yield from super().step(message)
        if isinstance(message, SkinState | PhiState):
            self._watch_again()

    def overtaken(self, message: Message) -> None:
        self._skipped += isinstance(message, MeasurementsBatch)

    def change(self, settings: ReconstructorBatchSettings) -> Iterable[Message]:
        messages = super().change(settings)
        self._watch_again()
        return messages

    def state(self) -> dict[str, Any]:
        idle = 0 if self._watch is None else int(np.count_nonzero(self._watch.idle))
        return {**super().state(), "idle": idle}

    def status(self) -> str:
        idle = 0 if self._watch is None else int(np.count_nonzero(self._watch.idle))
        return "; ".join(filter(None, (super().status(), f"{idle} idle" if idle else "")))

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
        for k, part in enumerate(message.split(self._held)):
            last = self._last.get(part.patch)
            if last is not None and not solve[k]:
                yield [self._unchanged(last, part)]
                continue
            (found,) = self.nodes[part.patch].step(part)
            assert isinstance(found, Reconstruction)
            self._last[part.patch] = found
            if self._watch is not None:
                self._watch.solved(k, found.forces)
            yield [found]

    def _joined(self, answers: Iterable[list[Message]]) -> Iterator[Message]:
        for message in super()._joined(answers):
            if isinstance(message, ReconstructionBatch):
                message.__dict__["skipped"] = self._skipped
                self._skipped = 0
            yield message

    def _unchanged(self, last: Reconstruction, part: Measurements) -> Reconstruction:
        """The last frame of a patch, published again for new measurements."""
        now = {
            "stamp_ns": part.stamp_ns,
            "phi": part.phi,
            "iterations": 0,
            "solve_ns": 0,
            "done_ns": self.context.clock.now_ns(),
            "unchanged": True,
        }
        made: Reconstruction = unchecked(Reconstruction, {**last.__dict__, **now})
        return made
