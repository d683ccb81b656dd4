"""A user's own sensor: `module:callable`, each frame checked before it is passed on."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator
from typing import Any, Literal

import numpy as np

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable, one_line

from .frame_check import FrameCheck
from .parsed import MAX_READING, check_grid, shown
from .source import Forces, Skin

DEFAULT_F_MAX = 2.5


class DriverSource:
    """The frames of a user's driver, checked one by one as they come.

    Readings outside [0, f_max] are clipped, as a sensor saturates at the ends of its range.

    Attributes
    ----------
    name : str
        The driver's own `name`, or `module:callable`.
    skin : Skin
        The driver's own `skin`, or one of the first frame's shape.
    delivers : "truth" or "taxels"
        The driver's own `delivers`, or "taxels".
    rate_hz : float or None
        The rate that was stated, or the driver's own.
    n_frames : int or None
        The driver's own, or None.
    """

    def __init__(
        self,
        target: str,
        driver: Iterable[object],
        *,
        f_max: float | None,
        unit: str | None,
        rate_hz: float | None,
    ) -> None:
        self._target = target
        self._driver = driver
        self._check = FrameCheck(target, DEFAULT_F_MAX if f_max is None else float(f_max))
        self._pending: tuple[int, Forces] | None = None
        self._is_one_shot = False
        self._iterator: Iterator[object] | None = None
        try:
            own_skin = getattr(driver, "skin", None)
            own_name = getattr(driver, "name", None)
            own_delivers = getattr(driver, "delivers", "taxels")
            own_rate = getattr(driver, "rate_hz", None)
            own_length = getattr(driver, "n_frames", None)
        except Exception as error:
            raise self._fault(error) from error
        self.name: str = own_name if isinstance(own_name, str) and own_name else target
        self.delivers: Literal["truth", "taxels"] = _delivers(own_delivers, target)
        self.rate_hz: float | None = rate_hz if rate_hz is not None else _rate(own_rate, target)
        self.n_frames: int | None = _length(own_length, target)
        if own_skin is not None:
            self.skin: Skin = self._own_skin(own_skin, f_max, unit)
        else:
            self._pending = self._take_first()
            n_rows, n_cols = self._pending[1].shape
            self.skin = Skin(n_rows, n_cols, self._check.f_max, "N" if unit is None else unit)
        self._check.skin = self.skin

    def __iter__(self) -> Iterator[tuple[int, Forces]]:
        """Yield (stamp_ns, forces): nanoseconds since the first frame, and float32 forces of
        shape (n_rows, n_cols) in [0, f_max], 0 in masked cells. The driver is closed at the end.

        Raises
        ------
        SourceError
            If the driver raises, delivers a bad frame, or is a generator and was read before.
        """
        try:
            if self._pending is None:
                self._start()
            while True:
                taken = self._pending or self._take()
                self._pending = None
                if taken is None:
                    return
                yield taken
        finally:
            self.close()

    @property
    def n_clipped(self) -> int:
        """How many readings have been clipped to [0, f_max] so far; 1 a taxel and frame."""
        return self._check.n_clipped

    def close(self) -> None:
        """Close the driver, so that its `finally` blocks run; more than once does no harm.

        Raises
        ------
        SourceError
            If the driver raises as it closes.
        """
        iterator, self._iterator = self._iterator, None
        self._pending = None
        close = getattr(iterator, "close", None)
        if callable(close):
            try:
                close()
            except Exception as error:
                raise self._fault(error) from error

    def _start(self) -> None:
        if self._is_one_shot:
            raise SourceError(f"{self._target}: is a generator and was read before; open it anew")
        try:
            self._iterator = iter(self._driver)
        except Exception as error:
            raise self._fault(error) from error
        self._is_one_shot = self._iterator is self._driver
        self._check.restart()

    def _take_first(self) -> tuple[int, Forces]:
        """The first frame, pulled to learn the shape; the driver is closed where there is none."""
        try:
            self._start()
            taken = self._take()
            if taken is None:
                raise SourceError(f"{self._target}: ended before its first frame")
        except SourceError:
            with contextlib.suppress(SourceError):
                self.close()
            raise
        return taken

    def _take(self) -> tuple[int, Forces] | None:
        """The next frame, checked; None at the end."""
        assert self._iterator is not None
        try:
            item = next(self._iterator)
        except StopIteration:
            return None
        except Exception as error:
            raise self._fault(error) from error
        return self._check(item)

    def _own_skin(self, skin: object, f_max: float | None, unit: str | None) -> Skin:
        if not isinstance(skin, Skin):
            raise SourceError(
                f"{self._target}: its skin is {type(skin).__name__}; expected "
                "sparseskin.nodes.sensor.source.Skin"
            )
        check_grid(skin.n_rows, skin.n_cols, self._target)
        for what, stated, own in (("f_max", f_max, skin.f_max), ("unit", unit, skin.unit)):
            if stated is not None and stated != own:
                raise SourceError(
                    f"{self._target}: {what} = {stated} is stated, but the driver's skin has {own}"
                )
        self._check.f_max = float(skin.f_max)
        return skin

    def _fault(self, error: Exception) -> SourceError:
        return SourceError(f"{self._target}: the driver failed: {one_line(error)}")


def open_callable(
    target: str,
    *,
    f_max: float | None = None,
    unit: str | None = None,
    rate_hz: float | None = None,
) -> DriverSource:
    """Open a user's sensor driver.

    Parameters
    ----------
    target : str
        "module:callable"; the module is looked for in the current directory too. It is called
        without arguments and returns an iterable (a generator, mostly) of pairs (stamp_ns,
        forces): an int that rises from frame to frame, and an array of shape (n_rows, n_cols),
        integer or float. It may have the attributes of a `Source`; one with a `skin` is asked
        for no frame before iteration starts, any other for its first one, to learn its shape.
    f_max : float, optional
        Upper end of the range, in `unit`; 2.5 by default, or what the driver's skin states.
    unit : str, optional
        Unit of the readings; "N" by default, or what the driver's skin states.
    rate_hz : float, optional
        Frame rate, where the driver does not state its own.

    Returns
    -------
    DriverSource
        Frames float32 of shape (n_rows, n_cols) in [0, f_max], stamps since the first frame.

    Raises
    ------
    SourceError
        If the module or callable is not there or fails, its first frame is bad, or a setting is
        out of range or contradicts the driver's skin. Iteration raises it for later frames.
    """
    for what, value in (("f_max", f_max), ("rate_hz", rate_hz)):
        if value is not None and not _is_positive(value):
            raise SourceError(f"{target}: {what} = {shown(value)}; expected a number in 0..1e30")
    if unit is not None and not (isinstance(unit, str) and unit.strip()):
        raise SourceError(f"{target}: unit = {shown(unit)}; expected a text such as N")
    make = find_callable(target, SourceError)
    try:
        driver = make()
    except Exception as error:
        raise SourceError(f"{target}: the driver failed: {one_line(error)}") from error
    if not hasattr(type(driver), "__iter__"):
        raise SourceError(
            f"{target}: returned {type(driver).__name__}; expected a generator or an iterable of "
            "(stamp_ns, forces)"
        )
    return DriverSource(target, driver, f_max=f_max, unit=unit, rate_hz=rate_hz)


def _is_positive(value: Any) -> bool:
    is_number = isinstance(value, int | float | np.integer | np.floating)
    return is_number and not isinstance(value, bool) and bool(0 < value <= MAX_READING)


def _delivers(value: object, target: str) -> Literal["truth", "taxels"]:
    if value == "truth":
        return "truth"
    if value == "taxels":
        return "taxels"
    raise SourceError(f"{target}: delivers = {shown(value)}; allowed are truth, taxels")


def _rate(value: Any, target: str) -> float | None:
    if value is None:
        return None
    if not _is_positive(value):
        raise SourceError(f"{target}: rate_hz = {shown(value)}; expected a number above 0 or None")
    return float(value)


def _length(value: Any, target: str) -> int | None:
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
        raise SourceError(
            f"{target}: n_frames = {shown(value)}; expected a whole number, or None if endless"
        )
    return int(value)
