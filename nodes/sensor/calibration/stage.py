"""The calibration of a sensor node: its chain, tares and notices, by its settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.ranges import is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import RefusedError, SourceError
from sparseskin.nodes.numerics.arrays import Floats

from .chain import Chain
from .description import MAX_NAME, SkinDescription, points_on_grid
from .drift import DRIFT_RATE
from .zero import ZeroWatch

TARE_FRAMES = 30
"""Frames of a tare unless stated otherwise, chosen: their median has a quarter of their noise."""
MAX_TARE_FRAMES = 10_000
MAX_TARE_READINGS = 1 << 26
"""Most readings of a tare, chosen: 256 MiB."""


class Stage(Chain):
    """The chain of a sensor node, which takes tares while frames pass, and logs.

    Parameters
    ----------
    description : SkinDescription
        The skin.
    tare : int
        Frames of a tare at the start, which are not converted; 0: none.
    drift : float or None
        Largest rate of the drift that is followed, parts of f_max a second; None: `DRIFT_RATE`
        where the skin has a calibration or is tared, else 0.
    notice : bool
        True: look for noise around 0.
    log : callable
        Receives one line of text.

    Raises
    ------
    RefusedError
        If the frames of the tare would not fit in memory.
    """

    def __init__(
        self,
        description: SkinDescription,
        tare: int,
        drift: float | None,
        notice: bool,
        log: Callable[[str], None],
    ) -> None:
        super().__init__(description)
        self._calibrated = description.changes_readings or tare > 0
        self.set_drift(drift)
        self._log = log
        self._watch: ZeroWatch | None = None
        if notice and not description.f_min:
            self._watch = ZeroWatch(description.f_max, description.noise or 0.0)
        self.is_starting = tare > 0  # the tare at the start waits for frames
        self.is_news = False  # the calibration has changed since it was published
        self._tared = ""
        self._taring: list[npt.NDArray[Any]] = []
        self._tare_left = 0
        if tare:
            self.start_tare(tare)

    def set_drift(self, drift: float | None) -> None:
        """Change the largest rate of the drift that is followed."""
        default = DRIFT_RATE if self._calibrated else 0.0
        self.drift.rate = default if drift is None else drift

    def process(self, raw: npt.NDArray[Any], stamp_ns: int) -> Floats | None:
        """Return the forces of a frame; None for one of the tare at the start."""
        if self._tare_left:
            self._collect(raw)
        if self.is_starting:
            self.is_starting = self._tare_left > 0
            return None
        if self._watch is not None:
            if notice := self._watch.add(self.unclipped(raw)[self.skin.exists]):
                self._log(notice)
            if self._watch.done:
                self._watch = None
        return self.apply(raw, stamp_ns)

    def start_tare(self, value: Any) -> str:
        """Begin a tare of the next `value` frames, `TARE_FRAMES` if None; one under way is
        forgotten.

        Raises
        ------
        RefusedError
            If that is no number of frames allowed, or they would not fit in memory.
        """
        n_frames = TARE_FRAMES if value is None else value
        if not is_whole(n_frames, 1, MAX_TARE_FRAMES):
            raise RefusedError(
                f"tare: {str(value)[:40]!r} is no number of frames (allowed: 1..{MAX_TARE_FRAMES})"
            )
        most = MAX_TARE_READINGS // (self.description.rows * self.description.cols)
        if n_frames > most:
            raise RefusedError(f"tare: {n_frames} frames of this skin; at most {most}")
        self._taring, self._tare_left = [], n_frames
        return f"the baseline becomes the median of the next {n_frames} frames"

    def state(self) -> dict[str, Any]:
        """State for the operator: frames that a tare waits for, largest drift, last tare."""
        drift = float(np.abs(self.drift.value).max())
        found = {"tare_left": self._tare_left, "drift": float(f"{drift:.3g}")}
        return {**found, "tared": self._tared} if self._tared else found

    def _collect(self, raw: npt.NDArray[Any]) -> None:
        """Add a frame to the tare under way."""
        self._taring.append(np.array(raw, dtype=np.float32))
        self._tare_left -= 1
        if not self._tare_left:
            self._tared = self.tare(self._taring)
            self._taring = []
            self.is_news = self._calibrated = True
            self._log(f"tared: {self._tared}")


def fitted(description: SkinDescription, skin: Skin, where: str) -> SkinDescription:
    """The description for a source: cells that the source masks are masked.

    Raises
    ------
    SourceError
        If the source has another shape.
    """
    if description.shape != skin.shape:
        raise SourceError(
            f"{where}: describes {description.rows} x {description.cols} taxels, but the source "
            f"has {skin.n_rows} x {skin.n_cols}"
        )
    if description.points is None and skin.points is not None:
        description = replace(description, points=points_on_grid(skin))
    if skin.mask is None:
        return description
    return replace(description, mask=skin.exists & description.skin.exists)


def described(name: str, skin: Skin) -> SkinDescription:
    """Description of a source that no file describes: its readings are forces."""
    text = "".join(char for char in name if char.isprintable()).strip()[:MAX_NAME] or "skin"
    return SkinDescription(
        *(text, skin.n_rows, skin.n_cols, float(skin.f_max), skin.unit),
        pitch_mm=None if skin.pitch_m is None else 1000 * skin.pitch_m,
        mask=skin.mask,
        points=points_on_grid(skin),
    )
