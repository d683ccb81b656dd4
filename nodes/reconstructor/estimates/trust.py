"""Log lines on frames whose estimated error is a large part of their forces."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Floats

EVERY_NS = 10_000_000_000
"""Least time between two lines, nanoseconds of the frames' stamps. Chosen: readable by a person."""

RUN, WITHIN = 3, 10
"""Frames not to be trusted that make a run, and the number of the last frames that they are among.
Chosen: the first frame or two of a stream or contact, of which the past says nothing, make none."""

LASTING, LASTING_WITHIN, LASTING_SHARE = 50, 100, 0.5
"""Frames in contact from which on a share of the last of them advises other settings, their number
at most, and the share. Chosen: at N/3, where more measurements are not needed, the impact of a
wrench is doubted for 23 of 50 frames, and 0.2 of all frames in contact; at N/20 nearly all are."""

FIRST = 2
"""First frames of a row subset, whose noise no earlier frame has shown."""


class TrustLog:
    """Logs that frames are not to be trusted: once in a run of them, then at most every 10 s.

    A run is 3 of the last 10 frames or more. With P row subsets, the first 2 (P - 1) frames do not
    count: each subset begins with two frames of which the past says nothing. Time is that of the
    stamps, so that a replay logs the same lines at any rate. Other settings are advised where
    doubts last: half of the last 50 to 100 frames in contact.

    Parameters
    ----------
    log : callable
        Receives one line of text.
    """

    def __init__(self, log: Callable[[str], None]) -> None:
        self._log = log
        self._rotating, self._n_early = False, 0
        self._logged_ns: int | None = None
        self._n_frames = self._n_untrusted = 0
        self._advised_ns: int | None = None
        self._latest: deque[bool] = deque(maxlen=WITHIN)
        self._in_contact: deque[bool] = deque(maxlen=LASTING_WITHIN)

    def begin(self, n_subsets: int, could_rotate: bool = True) -> None:
        """Expect the frames of a new solver, measured by this many row subsets; 1: fixed rows.

        `could_rotate` is False for a Phi whose rows cannot rotate.
        """
        self._rotating = n_subsets > 1 or not could_rotate
        self._n_early = FIRST * (n_subsets - 1)
        self._in_contact.clear()

    def update(
        self,
        stamp_ns: int,
        forces: Floats,
        error: float | None,
        trusted: bool,
        *,
        n: int,
        unit: str,
        f_max: float,
    ) -> None:
        """Process a frame: forces, 0 where no taxel exists, and what its solver estimates of them.

        `error` and `trusted` are as in `Solver`; n is the number of taxels, f_max the upper end of
        their range in `unit`.
        """
        self._n_frames += 1
        self._n_untrusted += not trusted
        if self._n_early:
            self._n_early -= 1
            return
        self._latest.append(not trusted)
        if not trusted or forces.max(initial=0.0) > CONTACT_FRACTION * f_max:
            self._in_contact.append(not trusted)
        if trusted or sum(self._latest) < RUN:
            return
        lasts = self._lasts and _is_due(self._advised_ns, stamp_ns)
        if not (lasts or _is_due(self._logged_ns, stamp_ns)):
            return
        count = "" if self._logged_ns is None else self._count()
        advice = ""
        if lasts:
            more = "more measurements" + ("" if self._rotating else ' or rows = "rotating"')
            advice = f"; {more} may help, see docs/method.md"
            self._advised_ns = stamp_ns
        self._log(f"frames not to be trusted: {_described(error, forces, n, unit)}{count}{advice}")
        self._logged_ns = stamp_ns
        self._n_frames = self._n_untrusted = 0

    @property
    def _lasts(self) -> bool:
        """True if doubts last beyond the begin or change of a contact."""
        n = len(self._in_contact)
        return n >= LASTING and sum(self._in_contact) >= LASTING_SHARE * n

    def _count(self) -> str:
        return f" ({self._n_untrusted} of the last {self._n_frames} frames)"


def _is_due(last_ns: int | None, stamp_ns: int) -> bool:
    """True if a line may follow that of another frame."""
    # Stamps go back where a recording is played again.
    return last_ns is None or abs(stamp_ns - last_ns) >= EVERY_NS


def _described(error: float | None, forces: Floats, n: int, unit: str) -> str:
    """Return the estimate in words."""
    if error is None:
        return "the solver doubts its estimate"
    rms = math.sqrt(float(np.sum(np.square(forces, dtype=np.float64))) / n)
    if error >= 10 * rms:
        return f"estimated error {error:.2g} {unit} a taxel, more than the forces"
    return f"estimated error {100 * error / rms:.0f} % of the forces"
