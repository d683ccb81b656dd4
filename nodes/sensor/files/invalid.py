"""Treatment of readings of a file that are not finite or below 0, and their counts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages.fields import MAX_ELEMENTS

from .parsed import HOLD, KEEP, MASK, OFFSET, REFUSE, ZERO, Parsed, Policy


@dataclass(frozen=True)
class Treated:
    """Counts of invalid readings of a file.

    Attributes
    ----------
    n_nan, n_negative : int
        Readings that were not finite, and below 0.
    n_masked : int
        Taxels that were masked for them.
    offset : float
        What was subtracted from all readings, in their unit; 0 or less.
    """

    n_nan: int = 0
    n_negative: int = 0
    n_masked: int = 0
    offset: float = 0.0

    def lines(self, policy: Policy, unit: str) -> list[str]:
        """One line for a log on each kind of invalid reading; none where there was none."""
        found = []
        done = {ZERO: "set to 0", HOLD: "replaced by the last finite one", MASK: "masked"}
        if self.n_nan:
            found.append(f"{self.n_nan} readings of the file are not finite: {done[policy.nan]}")
        if self.n_negative:
            way = done.get(policy.negative, f"{self.offset:g} {unit} subtracted from all readings")
            found.append(f"{self.n_negative} readings of the file are below 0: {way}")
        if self.n_masked:
            found[-1] += f" ({self.n_masked} taxels masked)"
        return found

    def counts(self) -> dict[str, Any]:
        """Counts for a summary; none where all readings were valid."""
        if not (self.n_nan or self.n_negative):
            return {}
        return {
            "not_finite": self.n_nan,
            "negative": self.n_negative,
            "masked_taxels": self.n_masked,
            "offset": self.offset,
        }


def treat(parsed: Parsed, policy: Policy) -> tuple[Parsed, Treated]:
    """Return a recording whose invalid readings are treated, and their counts.

    Those of a kind that is refused remain, for `check_readings` to name. Cells without a taxel are
    not looked at.
    """
    if policy.refuses or not len(parsed.forces):
        return parsed, Treated()
    bad_nan, n_nan = _counted(parsed.forces, _not_finite)
    bad_negative, n_negative = _counted(parsed.forces, _below_zero)
    n_nan *= policy.nan != REFUSE
    n_negative *= policy.negative not in (REFUSE, KEEP)
    if not (n_nan or n_negative):
        return parsed, Treated()
    exists = np.ones(bad_nan.shape, np.bool_) if parsed.mask is None else parsed.mask
    forces = np.array(parsed.forces, dtype=np.result_type(parsed.forces.dtype, np.float32))
    gone = np.zeros_like(exists)
    if n_nan and policy.nan == MASK:
        gone |= bad_nan
    if n_negative and policy.negative == MASK:
        gone |= bad_negative
    forces[:, gone] = 0
    if n_nan and policy.nan in (ZERO, HOLD):
        held = np.zeros(exists.shape, forces.dtype)
        for frame in forces:
            finite = np.isfinite(frame)
            frame[~finite] = held[~finite]
            if policy.nan == HOLD:
                held = frame.copy()
    offset = 0.0
    if n_negative and policy.negative == ZERO:
        np.maximum(forces, 0, out=forces, where=np.isfinite(forces))
    if n_negative and policy.negative == OFFSET:
        offset = float(forces.min(initial=0.0, where=np.isfinite(forces)))
        forces[:, exists & ~gone] -= forces.dtype.type(offset)
    mask = parsed.mask if not gone.any() else exists & ~gone
    n_masked = int((gone & exists).sum())
    f_max = None if parsed.f_max is None else parsed.f_max - offset
    treated = Treated(n_nan, n_negative, n_masked, offset)
    return replace(parsed, forces=forces, mask=mask, f_max=f_max), treated


def _not_finite(values: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    bad: npt.NDArray[np.bool_] = ~np.isfinite(values)
    return bad


def _below_zero(values: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    bad: npt.NDArray[np.bool_] = np.isfinite(values) & (values < 0)
    return bad


def _counted(forces: npt.NDArray[Any], is_bad: Any) -> tuple[npt.NDArray[np.bool_], int]:
    """Cells that are bad in some frame, bool (n_rows, n_cols), and the number of bad readings."""
    cells, count = np.zeros(forces.shape[1:], np.bool_), 0
    step = max(1, MAX_ELEMENTS // max(1, forces[0].size))
    for first in range(0, len(forces), step):
        bad = is_bad(forces[first : first + step])
        cells |= bad.any(axis=0)
        count += int(np.count_nonzero(bad))
    return cells, count
