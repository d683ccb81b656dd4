"""The calibration of a sensor node: its chain, tares and notices, by its settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Calibration
from sparseskin.messages.ranges import is_whole
from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import RefusedError, SourceError
from sparseskin.nodes.numerics.arrays import Floats

from .carried import message_of
from .chain import MAX_TARE_FRAMES, MOVED, TARE_FRAMES, Chain, Tared
from .description import SkinDescription, points_on_grid
from .drift import DRIFT_RATE
from .zero import ZeroWatch


class Stage:
    """Converts the readings of a node's source to forces, and takes tares.

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
    """

    def __init__(
        self,
        description: SkinDescription,
        tare: int,
        drift: float | None,
        notice: bool,
        log: Callable[[str], None],
    ) -> None:
        self._calibrated = description.changes_readings
        self.chain = Chain(description, self._rate(drift, tare > 0))
        self._log = log
        self._watch = None
        if notice and not description.f_min:
            self._watch = ZeroWatch(description.f_max, description.noise or 0.0)
        self._starting = tare > 0
        self.is_news = False
        self._tared = ""
        if tare:
            self._begin(tare)

    @property
    def description(self) -> SkinDescription:
        """The skin, with the baseline in use."""
        return self.chain.description

    @property
    def is_starting(self) -> bool:
        """True while the tare at the start waits for frames."""
        return self._starting

    def set_drift(self, drift: float | None) -> None:
        """Change the largest rate of the drift that is followed."""
        self.chain.drift.rate = self._rate(drift, self._calibrated)

    def process(self, raw: npt.NDArray[Any], stamp_ns: int) -> Floats | None:
        """Return the forces of a frame; None for one of the tare at the start."""
        if tared := self.chain.collect(raw):
            self._report(tared)
        if self._starting:
            self._starting = self.chain.tare_left > 0
            return None
        if self._watch is not None:
            self._look(raw)
        return self.chain.apply(raw, stamp_ns)

    def tare(self, value: Any) -> str:
        """Begin a tare of `value` frames, `TARE_FRAMES` if None.

        Raises
        ------
        RefusedError
            If that is no number of frames allowed.
        """
        n_frames = TARE_FRAMES if value is None else value
        if not is_whole(n_frames, 1, MAX_TARE_FRAMES):
            raise RefusedError(
                f"tare: {str(value)[:40]!r} is no number of frames (allowed: 1..{MAX_TARE_FRAMES})"
            )
        try:
            self._begin(n_frames)
        except SourceError as error:
            raise RefusedError(str(error)) from error
        return f"the baseline becomes the median of the next {n_frames} frames"

    def state(self) -> dict[str, Any]:
        """State for the operator: frames that a tare waits for, largest drift, last tare."""
        drift = float(np.abs(self.chain.drift.value).max())
        found = {"tare_left": self.chain.tare_left, "drift": float(f"{drift:.3g}")}
        return {**found, "tared": self._tared} if self._tared else found

    def message(self, stamp_ns: int, patch: str) -> Calibration:
        """The calibration in use, as a message."""
        return message_of(self.description, stamp_ns, patch)

    def _rate(self, stated: float | None, calibrated: bool) -> float:
        if stated is not None:
            return stated
        return DRIFT_RATE if calibrated or self._calibrated else 0.0

    def _begin(self, n_frames: int) -> None:
        self.chain.begin_tare(n_frames)

    def _report(self, tared: Tared) -> None:
        self.is_news = self._calibrated = True
        skin = self.chain.skin
        line = f"forces changed by at most {tared.largest:.3g} {skin.unit}"
        if tared.n_moved:
            line += f", of {tared.n_moved} taxels by more than {100 * MOVED:g} % of the range"
            line += ": a touch while taring, or a baseline that was old"
        self._tared = line
        self._log(f"tared: {line}")

    def _look(self, raw: npt.NDArray[Any]) -> None:
        """Look for noise around 0, once."""
        assert self._watch is not None
        forces = self.chain.unclipped(raw)[self.chain.skin.exists]
        if notice := self._watch.add(forces):
            self._log(notice)
        if self._watch.done:
            self._watch = None


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
    pitch_mm = None if skin.pitch_m is None else 1000 * skin.pitch_m
    text = "".join(char for char in name if char.isprintable()).strip()[:64] or "skin"
    return SkinDescription(
        *(text, skin.n_rows, skin.n_cols, float(skin.f_max)),
        unit=skin.unit,
        pitch_mm=pitch_mm,
        mask=skin.mask,
        points=points_on_grid(skin),
    )
