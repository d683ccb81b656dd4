"""The geometry and range of a patch of taxels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from .errors import FieldError, ShapeError
from .fields import MAX_SIDE
from .ranges import is_real, is_whole

PAPER_F_MAX_N = 2.5
"""Upper end of the range of the paper's taxels, newtons. Source: paper, section V-B."""
CONTACT_FRACTION = 0.004
"""A taxel is touched where its true force is above this part of f_max: 0.01 N of 2.5 N. Chosen:
below the noise of an untouched taxel (0.0141 N), far above the rounding of float32."""


@dataclass(frozen=True, eq=False)
class Skin:
    """The geometry and range of one patch of taxels.

    Attributes
    ----------
    n_rows, n_cols : int
        Size of the grid of taxels, 1..4096 each.
    f_max : float
        Upper end of the range, in `unit`; the peak of PSNR. Readings lie in [0, f_max].
    unit : str
        Unit of the readings: "N" (newtons) or what a recording states, e.g. "raw".
    pitch_m : float or None
        Distance between the centres of neighbouring taxels, in metres; None where not known.
    mask : ndarray of bool, shape (n_rows, n_cols), or None
        True where a taxel exists; None if all exist.

    Raises
    ------
    MessageError
        If a side, the range or the mask is not as stated.
    """

    n_rows: int
    n_cols: int
    f_max: float
    unit: str = "N"
    pitch_m: float | None = None
    mask: npt.NDArray[np.bool_] | None = None

    def __post_init__(self) -> None:
        for name, side in (("n_rows", self.n_rows), ("n_cols", self.n_cols)):
            if not is_whole(side, 1, MAX_SIDE):
                raise FieldError(f"skin: {name} = {side} is outside 1..{MAX_SIDE}")
        if not (is_real(self.f_max, 0.0) and self.f_max > 0):
            raise FieldError(f"skin: f_max = {self.f_max} must be finite and above 0")
        if self.mask is not None:
            if self.mask.shape != self.shape or self.mask.dtype != np.bool_:
                raise ShapeError(
                    f"skin: the mask is {self.mask.dtype} {list(self.mask.shape)}, "
                    f"expected bool {list(self.shape)}"
                )
            if not self.mask.any():
                raise FieldError("skin: the mask leaves no taxel")

    @property
    def shape(self) -> tuple[int, int]:
        """(n_rows, n_cols)."""
        return (self.n_rows, self.n_cols)

    @property
    def exists(self) -> npt.NDArray[np.bool_]:
        """True where a taxel exists, bool (n_rows, n_cols)."""
        return np.ones(self.shape, dtype=np.bool_) if self.mask is None else self.mask

    @property
    def n_taxels(self) -> int:
        """Number of taxels N: those that exist."""
        if self.mask is None:
            return self.n_rows * self.n_cols
        return int(np.count_nonzero(self.mask))
