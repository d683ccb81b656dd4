"""Times at which recorded messages are due: absolute targets, so that no error accumulates."""

import sys


class Schedule:
    """Maps stamps of a recording to times on the graph's clock, from `first_ns` on, at `rate` times
    the recorded speed; 0: everything is due at once.

    While it plays, a stamp is due at t0 + (stamp - first) / rate. A pause, a seek and a change of
    rate move t0.
    """

    def __init__(self, first_ns: int, rate: float, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self._first_ns = first_ns
        # Nothing is due before it begins.
        self._t0_ns = sys.maxsize
        self._position_ns = first_ns
        self._steps = 0

    def begin(self, now_ns: int) -> None:
        """Start: the first stamp, or the one that was sought, is due now."""
        self._anchor(self._position_ns, now_ns)

    def due_ns(self, stamp_ns: int) -> int | None:
        """Time at which a stamp is due; None while paused without a requested step."""
        if self.paused and not self._steps:
            return None
        if self.paused or not self.rate:
            return 0
        # Each target follows from t0 alone, so that no rounding adds up.
        since_first_ns = stamp_ns - self._first_ns
        return self._t0_ns + round(since_first_ns / self.rate)

    def stepped(self, stamp_ns: int) -> None:
        """Note that a frame was played; while paused, this consumes a step and moves on."""
        self._steps = max(0, self._steps - 1)
        if self.paused:
            self._position_ns = max(self._position_ns, stamp_ns)

    def step(self, now_ns: int) -> None:
        """Play one more frame, and pause."""
        if not self.paused:
            self.toggle_pause(now_ns)
        self._steps += 1

    def toggle_pause(self, now_ns: int) -> None:
        """Pause, or resume from the position of the pause."""
        if self.paused:
            self._anchor(self._position_ns, now_ns)
            self._steps = 0
        else:
            self._position_ns = self._stamp_at(now_ns)
        self.paused = not self.paused

    def seek(self, stamp_ns: int, now_ns: int) -> None:
        """Continue from another stamp, due now; if paused, once it is resumed."""
        self._position_ns = stamp_ns
        self._anchor(stamp_ns, now_ns)

    def change_rate(self, rate: float, now_ns: int) -> None:
        """Continue from the current position at another rate."""
        position_ns = self._stamp_at(now_ns)
        self.rate = rate
        if not self.paused:
            self._anchor(position_ns, now_ns)

    def _stamp_at(self, now_ns: int) -> int:
        # Before it begins, t0 lies ahead.
        played_ns = max(0, now_ns - self._t0_ns)
        return self._first_ns + round(played_ns * self.rate)

    def _anchor(self, position_ns: int, now_ns: int) -> None:
        """Make a stamp due now."""
        if self.rate:
            since_first_ns = position_ns - self._first_ns
            self._t0_ns = now_ns - round(since_first_ns / self.rate)
