"""What a sensor source is: a skin, and the frames it delivers one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

import numpy as np
import numpy.typing as npt

from sparseskin.messages.skin import Mask, Skin

__all__ = ["Forces", "Mask", "Skin", "Source"]

Forces = npt.NDArray[np.float32]


class Source(Protocol):
    """Where frames come from: a simulated scene, a recording, or a driver.

    Attributes
    ----------
    name : str
        Name for summaries, e.g. "drag_wrench_64".
    skin : Skin
        The patch the frames belong to.
    delivers : "truth" or "taxels"
        "truth": noise-free forces, to which the sensor adds its noise model.
        "taxels": readings as a real skin gave them; the truth is not known.
    rate_hz : float or None
        Native frame rate; None where the source has none of its own.
    n_frames : int or None
        Length; None for an endless source.
    """

    name: str
    skin: Skin
    delivers: Literal["truth", "taxels"]
    rate_hz: float | None
    n_frames: int | None

    def __iter__(self) -> Iterator[tuple[int, Forces]]:
        """Yield (stamp_ns, forces): time since the first frame in nanoseconds, and
        float32 forces of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells.
        """
        ...
