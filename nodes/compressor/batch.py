"""The compressor node of a batch of equal patches: one Phi for all."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from sparseskin.messages import Message
from sparseskin.messages.batches import BatchMessage, MeasurementsBatch, TaxelsBatch
from sparseskin.nodes.batch import BatchNode, check_patches
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import setting

from .node import Compressor, CompressorSettings

CHOSEN_ANEW = ("acts", "adaptive")
"""Kinds of Phi that choose other taxels or rows for each patch."""


@dataclass(frozen=True)
class CompressorBatchSettings(CompressorSettings):
    """Settings of the compressor node of a batch."""

    patches: tuple[str, ...] = setting(
        (), "names of the patches served, all with the same skin; patch is the name of their batch"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_patches(self.patches)
        if self.phi in CHOSEN_ANEW:
            raise SettingsError(
                f"phi: {self.phi} chooses other rows for each patch; allowed for a batch: a Phi "
                "that all patches share, as sbhe"
            )
        if self.bits is not None:
            raise SettingsError("bits: are not available for a batch; allowed: to leave it out")


class CompressorBatch(BatchNode[CompressorBatchSettings]):
    """Publishes /BATCH/phi once the skin is known, then /BATCH/measurements_batch.

    The node of the first patch measures all of them: they have the same Phi.
    """

    Settings = CompressorBatchSettings
    one: ClassVar[type[Compressor]] = Compressor

    def _step_batch(self, message: BatchMessage) -> Iterator[Message]:
        assert isinstance(message, TaxelsBatch)
        first = self._first
        assert isinstance(first, Compressor)
        y, phi = first.measure(message.forces, message.topic)
        yield MeasurementsBatch(
            stamp_ns=message.stamp_ns,
            patch=self.settings.patch,
            names=self._names,
            y=y,
            phi=phi.fingerprint,
        )
