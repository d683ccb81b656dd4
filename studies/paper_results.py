"""What `paper-tables` has computed, as its page and its charts take it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

#: Highest PSNR of an untouched skin in dB, by (side, few_levels, ratio), for each lambda.
Highest: TypeAlias = Mapping[tuple[int, bool, int], Sequence[float]]


@dataclass(frozen=True)
class Results:
    """What was computed.

    Attributes
    ----------
    quick : bool
        Whether only frames around the first contact were looked at.
    scenes : dict
        By scene: what `scene_figures` gives.
    psnr : dict
        By (scene, ratio, iterations, few_levels): PSNR of each frame in dB. With few levels
        lambda is the fitted one, else the one of preset `paper`.
    times : dict
        By (scene, iterations): what `solve_times` gives.
    """

    quick: bool
    scenes: dict[str, dict[str, Any]]
    psnr: dict[tuple[str, int, int, bool], list[float]]
    times: dict[tuple[str, int], dict[str, float]]

    def contact(self, scene: str) -> npt.NDArray[np.bool_]:
        """Which frames of a scene are in contact."""
        return np.array(self.scenes[scene]["contact"], dtype=np.bool_)
