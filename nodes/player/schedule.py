"""When a recorded message is due: absolute targets, so that no error adds up."""

from __future__ import annotations


class Schedule:
    """Maps stamps of a recording to times on the graph's clock.

    While it plays, a stamp is due at t0 + (stamp - first) / rate. A pause and a change of rate
    move t0, so that neither makes time jump.

    Parameters
    ----------
    first_ns : int
        The stamp that is due at the start.
    rate : float
        Times the recorded speed; 0: everything is due at once.
    paused : bool
        Whether it begins with a pause.
    """

    def __init__(self, first_ns: int, rate: float, paused: bool = False) -> None:
        self.rate = rate
        self.paused = paused
        self._first_ns = first_ns
        self._t0_ns = 0
        self._position_ns = first_ns
        self._steps = 0

    def begin(self, now_ns: int) -> None:
        """Start: the first stamp is due now."""
        self._t0_ns = now_ns

    def due_ns(self, stamp_ns: int) -> int | None:
        """When a stamp is due; None while paused and no step was asked for."""
        if self.paused:
            return 0 if self._steps else None
        if not self.rate:
            return 0
        return self._t0_ns + round((stamp_ns - self._first_ns) / self.rate)

    def stepped(self, stamp_ns: int) -> None:
        """A frame was played: while paused that uses up a step and moves the position on."""
        self._steps = max(0, self._steps - 1)
        if self.paused:
            self._position_ns = max(self._position_ns, stamp_ns)

    def step(self, now_ns: int) -> None:
        """Play one frame more, and pause."""
        if not self.paused:
            self.toggle_pause(now_ns)
        self._steps += 1

    def toggle_pause(self, now_ns: int) -> None:
        """Pause, or go on from where the pause began."""
        if self.paused:
            self._anchor(self._position_ns, now_ns)
            self._steps = 0
        else:
            self._position_ns = self._stamp_at(now_ns)
        self.paused = not self.paused

    def seek(self, stamp_ns: int, now_ns: int) -> None:
        """Go on from another stamp, due now; while paused, once it is played on."""
        self._position_ns = stamp_ns
        self._anchor(stamp_ns, now_ns)

    def change_rate(self, rate: float, now_ns: int) -> None:
        """Go on at another rate from where it is now."""
        if not self.paused:
            position_ns = self._stamp_at(now_ns)
            self.rate = rate
            self._anchor(position_ns, now_ns)
        else:
            self.rate = rate

    def _stamp_at(self, now_ns: int) -> int:
        return self._first_ns + round((now_ns - self._t0_ns) * self.rate)

    def _anchor(self, position_ns: int, now_ns: int) -> None:
        """Make a stamp due now."""
        if self.rate:
            self._t0_ns = now_ns - round((position_ns - self._first_ns) / self.rate)
