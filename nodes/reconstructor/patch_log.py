"""Log lines of several patches: a kind of line for a few of them, what holds for all once."""

import re
from collections import Counter
from collections.abc import Callable

from sparseskin.nodes.node_host import is_due

LOGGED = 3
LOGGED_ALONE = 10
"""Lines of one kind that are logged for single patches, and where there is one patch; then the
10th, 100th ... of them."""


class PatchLog:
    """Log of the patches `names`; while `setting_up`, lines of the first one stand for all."""

    def __init__(self, names: tuple[str, ...], log: Callable[[str], None]) -> None:
        self.setting_up = False
        self._names = names
        self._log = log
        self._logged: Counter[str] = Counter()

    def of(self, name: str) -> Callable[[str], None]:
        """Log of one patch."""
        return lambda line: self._add(name, line)

    def _add(self, name: str, line: str) -> None:
        if self.setting_up:
            if name == self._names[0]:
                self._log(line)
            return
        alone = len(self._names) == 1
        place = "" if alone else f"{name}: "
        kind = re.sub(r"[0-9.]+", "#", line)
        self._logged[kind] += 1
        n = self._logged[kind]
        if n <= (LOGGED_ALONE if alone else LOGGED):
            self._log(f"{place}{line}")
        elif is_due(n):
            self._log(f"{place}{line} ({n} such lines)")
