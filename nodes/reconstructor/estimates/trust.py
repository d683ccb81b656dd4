"""Log lines on frames that are not to be trusted."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats

EVERY_NS = 10_000_000_000
"""Least time between two lines, nanoseconds of the frames' stamps. Chosen: readable by a person."""

RUN, WITHIN = 3, 10
"""Frames not to be trusted that make a run, and the number of the last frames that they are among.
Chosen: the first frame or two of a stream or contact, of which the past says nothing, make none."""

_ADVICE = "; if that lasts, more measurements{} may help, see docs/explanation/skin.md"
ADVICE, FIXED_ADVICE = _ADVICE.format(""), _ADVICE.format(" or rotating rows")
"""What may help; where rows are fixed, that they rotate, too."""

LOGGED = {
    "error": "",
    "missing": "readings are missing over an area",
    "stuck": "a row, column or square of taxels stands alone, pressed alike: is it stuck?",
    "range": "forces exceed the range of the skin",
    "uniform": "all taxels rose together: drift, hum, or a pressure on the whole skin",
}
"""What is logged of a reason; "": the estimated error. `FaultWatch` logs the other reasons."""

FIRST = 2
"""First frames of a row subset, whose noise no earlier frame has shown."""


class TrustLog:
    """Logs that frames are not to be trusted: once in a run of them, then at most every 10 s.

    A run is 3 of the last 10 frames or more. With P row subsets, the first 2 (P - 1) frames do not
    count: each subset begins with two frames of which the past says nothing. Time is that of the
    stamps, so that a replay logs the same lines at any rate.

    Parameters
    ----------
    log : callable
        Receives one line of text.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._n_early = 0
        self._advice = FIXED_ADVICE
        self._logged_ns: int | None = None
        self._n_frames = self._n_untrusted = 0
        self._latest: deque[bool] = deque(maxlen=WITHIN)

    def begin(self, n_subsets: int) -> None:
        """Expect the frames of a new solver, measured by this many row subsets; 1: fixed rows."""
        self._n_early = FIRST * (n_subsets - 1)
        self._advice = ADVICE if n_subsets > 1 else FIXED_ADVICE

    def update(
        self,
        stamp_ns: int,
        forces: Floats,
        error: float | None,
        reason: str,
        *,
        n: int,
        unit: str,
    ) -> None:
        """Process a frame: forces, 0 where no taxel exists, and what its solver estimates of them.

        `error` and `reason` are as in `Reconstruction`; n is the number of taxels, `unit` that of
        forces.
        """
        trusted = reason not in LOGGED
        self._n_frames += 1
        self._n_untrusted += not trusted
        if self._n_early:
            self._n_early -= 1
            return
        self._latest.append(not trusted)
        # Stamps go back where a recording is played again.
        is_due = self._logged_ns is None or abs(stamp_ns - self._logged_ns) >= EVERY_NS
        if trusted or sum(self._latest) < RUN or not is_due:
            return
        count = f" ({self._n_untrusted} of the last {self._n_frames} frames)"
        of_run = "" if self._logged_ns is None else count
        estimate = LOGGED[reason] or _described(error, forces, n, unit)
        advice = "" if LOGGED[reason] else self._advice
        self._log(f"frames not to be trusted: {estimate}{of_run}{advice}")
        self._logged_ns = stamp_ns
        self._n_frames = self._n_untrusted = 0


def _described(error: float | None, forces: Floats, n: int, unit: str) -> str:
    """Return the estimate in words."""
    if error is None:
        return "the solver doubts its estimate"
    rms = math.sqrt(float(np.sum(np.square(forces, dtype=np.float64))) / n)
    if error >= 10 * rms:
        return f"estimated error {error:.2g} {unit} a taxel, more than the forces"
    return f"estimated error {100 * error / rms:.0f} % of the forces"
