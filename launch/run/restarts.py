"""Restarts of a node that failed: the policy, and the count within a window."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.nodes.errors import SettingsError

NEVER = "never"
ON_FAILURE = "on-failure"
POLICIES = (NEVER, ON_FAILURE)


@dataclass(frozen=True)
class RestartPolicy:
    """Supervision of a node.

    Attributes
    ----------
    policy : str
        "never": the graph ends with a node that it needs. "on-failure": a node that dies or hangs
        is started again.
    max_restarts : int
        Most restarts within `window_s`; one more failure counts as "never".
    delay_s : float
        Wait before the first restart; each further one within the window doubles it, to
        `max_delay_s` at most.
    hang_s : float
        How long a node may be silent before it counts as hung and is killed; 0: for ever.
    """

    policy: str = NEVER
    max_restarts: int = 5
    window_s: float = 60.0
    delay_s: float = 0.25
    max_delay_s: float = 5.0
    hang_s: float = 10.0

    def stated(self, key: str, value: Any) -> RestartPolicy:
        """The policy with one key of a launch file.
        Raises SettingsError if the value is not allowed.
        """
        if key == "restart":
            if value not in POLICIES:
                raise SettingsError(f"{value!r} is not allowed (allowed: {', '.join(POLICIES)})")
            return replace(self, policy=value)
        low, high, whole = _LIMITS[key]
        if not (is_whole if whole else is_real)(value, low, high):
            kind = "a whole number" if whole else "a number"
            raise SettingsError(f"{value!r} is not allowed (allowed: {kind}, {low:g}..{high:g})")
        return replace(self, **{_FIELDS[key]: value})

    @property
    def restarts(self) -> bool:
        """True if a node that fails is restarted."""
        return self.policy == ON_FAILURE


_LIMITS = {
    "max_restarts": (1, 1000, True),
    "restart_window_s": (1.0, 86400.0, False),
    "restart_delay_s": (0.0, 60.0, False),
    "restart_max_delay_s": (0.0, 3600.0, False),
    "hang_s": (0.0, 3600.0, False),
}
_FIELDS = {key: key.removeprefix("restart_") for key in _LIMITS}
RESTART_KEYS = ("restart", *_LIMITS)
"""Keys of [graph], for all nodes, and of [nodes.NAME]."""


class Restarts:
    """The restarts of one node, counted within a sliding window."""

    def __init__(self, policy: RestartPolicy) -> None:
        self.policy = policy
        self.total = 0
        self._times_s: deque[float] = deque()

    def next_s(self, now_s: float) -> float | None:
        """Count a failure; return the time of the restart, None for no restart."""
        policy = self.policy
        while self._times_s and self._times_s[0] <= now_s - policy.window_s:
            self._times_s.popleft()
        if not policy.restarts or len(self._times_s) >= policy.max_restarts:
            return None
        delay_s = min(policy.max_delay_s, policy.delay_s * 2.0 ** len(self._times_s))
        self._times_s.append(now_s)
        self.total += 1
        return now_s + delay_s

    @property
    def spent(self) -> str:
        """Reason why there is no further restart, where the policy allows some."""
        if not self.policy.restarts:
            return ""
        return f" ({len(self._times_s)} restarts within {self.policy.window_s:g} s: given up)"
