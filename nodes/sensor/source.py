"""The interface of a sensor source: a skin, and its frames one after the other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal, Protocol

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Floats

__all__ = ["Skin", "Source"]


class Source(Protocol):
    """A source of frames: a simulated scene, a recording, or a driver.

    Attributes
    ----------
    name : str
        Name for summaries, e.g. "drag_wrench_64".
    skin : Skin
        The patch the frames belong to.
    delivers : "truth" or "taxels"
        "truth": noise-free forces, to which the sensor adds noise. "taxels": readings of a real
        skin, whose truth is not known.
    rate_hz : float or None
        Native frame rate; None if the source has none of its own.
    n_frames : int or None
        Number of frames; None for an endless source.
    """

    name: str
    skin: Skin
    delivers: Literal["truth", "taxels"]
    rate_hz: float | None
    n_frames: int | None

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces): time since the first frame in nanoseconds, and
        float32 forces of shape (n_rows, n_cols) in [0, f_max]; 0 in masked cells.
        """
        ...
