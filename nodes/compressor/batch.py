"""The compressor node of a batch of equal patches: one Phi for all."""

from __future__ import annotations

from dataclasses import dataclass

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
    """Publishes /BATCH/phi once the skin is known, then /BATCH/measurements_batch."""

    Settings = CompressorBatchSettings
    one = Compressor
