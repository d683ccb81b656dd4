"""The virtual grid of a skin of points, as a plug-in makes it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Mask


class Placement(Protocol):
    """The virtual grid of a skin of points."""

    @property
    def layout(self) -> str:
        """Absolute path of the file with the points, or `example:NAME`."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""

    @property
    def pitch_m(self) -> float:
        """Median distance of neighbours, metres."""

    def skin(self, f_max: float, unit: str) -> Skin:
        """The skin of this grid with a range."""

    def point_rows(self, exists: Mask) -> npt.NDArray[np.int32]:
        """Row of each taxel of a mask of the grid among those of the file, int32 (n_taxels,)."""

    def summary(self) -> Sequence[str]:
        """Lines for a log: number of taxels, grid and distance; what was estimated or left out."""

    def check_size(self, n_readings: int) -> None:
        """Raise SourceError unless a frame of so many readings has one for each taxel."""

    def on_grid(self, values: npt.NDArray[Any], unused: float = 0.0) -> npt.NDArray[Any]:
        """Readings in the order of the file on the grid, of the same dtype; `unused` in cells
        without a taxel. Raises SourceError as `check_size`.
        """
