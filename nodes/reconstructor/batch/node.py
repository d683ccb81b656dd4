"""The reconstructor node of a batch of equal patches: a solver for each, one message each way."""

from __future__ import annotations

from dataclasses import dataclass

from sparseskin.nodes.batch import BatchNode, check_patches
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.settings import setting


@dataclass(frozen=True)
class ReconstructorBatchSettings(ReconstructorSettings):
    """Settings of the reconstructor node of a batch."""

    patches: tuple[str, ...] = setting(
        (), "names of the patches served, all with the same skin; patch is the name of their batch"
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
