"""Treatment of readings of a file that are not finite or below 0, and their counts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .recording import FILLED, MASK, OFFSET, REFUSE, ZERO, Parsed, Policy


@dataclass(frozen=True)
class Treated:
    """Counts of invalid readings of a file."""

    not_finite: int = 0
    negative: int = 0
    masked_taxels: int = 0  # for them
    offset: float = 0.0  # subtracted from all readings, in their unit; 0 or less

    def lines(self, policy: Policy, unit: str) -> list[str]:
        """One line for a log on each kind of invalid reading; none where there was none."""
        found = []
        if self.not_finite:
            way = FILLED[policy.nan]
            found.append(f"{self.not_finite} readings of the file are not finite: {way}")
        if self.negative:
            done = {ZERO: "set to 0", MASK: "masked"}
            way = done.get(policy.negative, f"{self.offset:g} {unit} subtracted from all readings")
            found.append(f"{self.negative} readings of the file are below 0: {way}")
        if self.masked_taxels:
            found[-1] += f" ({self.masked_taxels} taxels masked)"
        return found

    def counts(self) -> dict[str, Any]:
        """Counts for a summary; none where all readings were valid."""
        return vars(self).copy() if self.not_finite or self.negative else {}


def treat(parsed: Parsed, policy: Policy) -> tuple[Parsed, Treated]:
    """Return a recording whose invalid readings are treated, and their counts.

    Those of a kind that is refused remain, for `check_readings` to name. Those that are not finite
    become NaN, for `MissingReadings`; a taxel of which all are is masked with `nan` "mask". Cells
    without a taxel are not looked at.
    """
    allowed = policy.nan == policy.negative == REFUSE
    if allowed or not len(parsed.forces):
        return parsed, Treated()
    forces = np.array(parsed.forces, dtype=np.result_type(parsed.forces.dtype, np.float32))
    finite = np.isfinite(forces)
    is_nan = ~finite & (policy.nan != REFUSE)
    is_negative = finite & (forces < 0) & (policy.negative != REFUSE)
    exists = np.ones(forces.shape[1:], np.bool_) if parsed.mask is None else parsed.mask
    gone = np.zeros_like(exists)
    if policy.nan == MASK:
        gone |= is_nan.all(axis=0)
    if policy.negative == MASK:
        gone |= is_negative.any(axis=0)
    forces[is_nan] = np.nan
    forces[:, gone] = 0
    offset = 0.0
    if policy.negative == ZERO:
        forces[is_negative] = 0
    elif policy.negative == OFFSET:
        offset = float(forces.min(initial=0.0, where=np.isfinite(forces)))
        forces[:, exists & ~gone] -= forces.dtype.type(offset)
    mask = exists & ~gone if gone.any() else parsed.mask
    n_bad = (int(np.count_nonzero(is_nan)), int(np.count_nonzero(is_negative)))
    f_max = None if parsed.f_max is None else parsed.f_max - offset
    treated = Treated(*n_bad, int((gone & exists).sum()), offset)
    return replace(parsed, forces=forces, mask=mask, f_max=f_max), treated
