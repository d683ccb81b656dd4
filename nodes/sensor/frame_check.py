"""The check of a frame that came from code which is not ours."""

from __future__ import annotations

import numpy as np

from sparseskin.nodes.errors import SourceError

from .parsed import check_grid, shown
from .source import Forces, Skin

_MAX_STAMP_NS = (1 << 63) - 1
_FLOATS = (np.float32, np.float64)


class FrameCheck:
    """Turns what a driver delivers into a stamp and forces, or refuses it.

    Attributes
    ----------
    f_max : float
        Upper end of the range. Readings outside [0, f_max] are clipped, as a sensor saturates.
    skin : Skin or None
        Once set, gives the shape that each frame must have, and the mask.
    n_clipped : int
        How many readings have been clipped; 1 a taxel and frame.
    """

    def __init__(self, target: str, f_max: float) -> None:
        self.f_max = f_max
        self.skin: Skin | None = None
        self.n_clipped = 0
        self._target = target
        self.restart()

    def restart(self) -> None:
        """Count frames and time from 0 again."""
        self._n_frames = 0
        self._first_stamp_ns = 0
        self._last_stamp_ns: int | None = None

    def __call__(self, item: object) -> tuple[int, Forces]:
        """Check what a driver delivered.

        Returns
        -------
        stamp_ns : int
            Time since the first frame, in nanoseconds.
        forces : ndarray of float32, shape (n_rows, n_cols), range [0, f_max]
            A new array; 0 in masked cells.

        Raises
        ------
        SourceError
            If it is not a pair (stamp_ns, forces), the stamp is no int or not after the one
            before it, or the forces are not 2-D, of another shape than the skin, of no real
            numeric dtype or not finite.
        """
        where = f"{self._target}, frame {self._n_frames}"
        if not isinstance(item, tuple | list) or len(item) != 2:
            raise SourceError(
                f"{where}: delivered {type(item).__name__}; expected a pair (stamp_ns, forces)"
            )
        stamp_ns = self._checked_stamp(item[0], where)
        forces = self._checked_forces(item[1], where)
        self._n_frames += 1
        return stamp_ns, forces

    def _checked_stamp(self, stamp: object, where: str) -> int:
        if isinstance(stamp, bool) or not isinstance(stamp, int | np.integer):
            raise SourceError(
                f"{where}: stamp_ns is {type(stamp).__name__}; expected whole nanoseconds"
            )
        stamp = int(stamp)
        if self._last_stamp_ns is None:
            self._first_stamp_ns = stamp
        elif stamp <= self._last_stamp_ns:
            raise SourceError(
                f"{where}: stamp_ns {stamp} is not after the one before it, {self._last_stamp_ns}"
            )
        if stamp - self._first_stamp_ns > _MAX_STAMP_NS:
            raise SourceError(f"{where}: stamp_ns is more than 2**63 ns after the first")
        self._last_stamp_ns = stamp
        return stamp - self._first_stamp_ns

    def _checked_forces(self, forces: object, where: str) -> Forces:
        try:
            array = np.asarray(forces)
        except Exception as error:
            raise SourceError(
                f"{where}: forces are no array of numbers ({shown(error, 120)})"
            ) from error
        if array.dtype.kind not in "iuf":
            raise SourceError(
                f"{where}: forces have dtype {shown(array.dtype)}; allowed are integers and "
                "floating point"
            )
        if array.ndim != 2:
            raise SourceError(
                f"{where}: forces have shape {array.shape}; expected two dimensions: (rows, cols)"
            )
        check_grid(array.shape[0], array.shape[1], where)
        mask = None
        if self.skin is not None:
            mask = self.skin.mask
            shape = (self.skin.n_rows, self.skin.n_cols)
            if array.shape != shape:
                raise SourceError(
                    f"{where}: forces have shape {array.shape}, but the skin has {shape}"
                )
        if (
            mask is None
            and array.dtype in _FLOATS
            and 0 <= array.min() <= array.max() <= self.f_max
        ):
            return array.astype(np.float32)  # nothing to clip; a NaN would be no number in between
        with np.errstate(all="ignore"):
            values = array.astype(np.float64)
        if mask is not None:
            values[~mask] = 0
        bad = ~np.isfinite(values)
        if bad.any():
            row, col = np.argwhere(bad)[0]
            raise SourceError(
                f"{where}, row {row}, column {col}: {values[row, col]} is no force; "
                "a fault of the sensor or its driver"
            )
        self.n_clipped += int(np.count_nonzero((values < 0) | (values > self.f_max)))
        return np.clip(values, 0, self.f_max).astype(np.float32)
