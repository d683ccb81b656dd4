"""Restarts of a node that failed: the policy, and the count within a window."""

from collections import deque
from dataclasses import dataclass

from sparseskin.nodes.settings import Settings, setting

NEVER = "never"
ON_FAILURE = "on-failure"
POLICIES = (NEVER, ON_FAILURE)
MAX_FAILURES = 10


@dataclass(frozen=True)
class RestartPolicy(Settings):
    """Supervision of a node: keys of [graph], for all nodes, and of [nodes.NAME]."""

    restart: str = setting(
        NEVER,
        "on-failure: a node that dies or hangs is started again",
        choices=POLICIES,
    )
    max_restarts: int = setting(
        5,
        "most restarts within restart_window_s; one more failure ends it",
        low=1,
        high=1000,
    )
    restart_window_s: float = setting(
        60.0, "span of max_restarts, s", low=1.0, high=86400.0
    )
    restart_delay_s: float = setting(
        0.25,
        "wait before the first restart, s; each further one doubles it",
        low=0.0,
        high=60.0,
    )
    restart_max_delay_s: float = setting(
        5.0, "most of that wait, s", low=0.0, high=3600.0
    )
    hang_s: float = setting(
        10.0,
        "silence after which a node counts as hung, s; 0: never",
        low=0.0,
        high=3600.0,
    )

    @property
    def restarts(self) -> bool:
        """True if a node that fails is restarted."""
        return self.restart == ON_FAILURE


class Restarts:
    """The restarts of one node, counted within a sliding window: `total` so far, why it failed the
    last `MAX_FAILURES` times, and the time of the next one, None while none is due.
    """

    def __init__(self, policy: RestartPolicy) -> None:
        self._policy = policy
        self._times_s: deque[float] = deque()
        self.total = 0
        self.failures: deque[str] = deque(maxlen=MAX_FAILURES)
        self.due_s: float | None = None

    def failed(self, now_s: float, why: str) -> str | None:
        """Count a failure, and set the time of the restart; where there is none, return the reason,
        "" of a node that is never restarted.
        """
        policy = self._policy
        times_s = self._times_s
        if not policy.restarts:
            return ""

        # A node that fails once an hour is restarted for ever; one that fails at once is not.
        while times_s and times_s[0] <= now_s - policy.restart_window_s:
            times_s.popleft()
        if len(times_s) >= policy.max_restarts:
            return f" ({len(times_s)} restarts within {policy.restart_window_s:g} s: given up)"

        # Longer each time: a device that was unplugged may need a while.
        delay_s = policy.restart_delay_s * 2.0 ** len(times_s)
        times_s.append(now_s)
        self.total += 1
        self.failures.append(why)
        self.due_s = now_s + min(policy.restart_max_delay_s, delay_s)
        return None
