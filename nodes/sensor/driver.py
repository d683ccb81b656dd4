"""A user's own sensor driver, named `module:callable`; each frame is checked before it is used."""

import itertools
import math
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import numpy as np

from sparseskin.messages.ranges import INT64_MAX, is_whole
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable, one_line
from sparseskin.nodes.numerics.arrays import AnyArray, Floats

from .device_clock import DeviceClock
from .layout.arrangement import (
    Arrangement,
    Axis,
    arrange,
    check_grid,
    check_stated_shape,
)
from .layout.checks import ADD, COUNTS, NAN_HINT, check_number, check_unit, shown
from .source import Address, LiveSource

RESTART_NS = 1_000_000_000
"""A stamp that is earlier than the one before by so much is of a clock that was set or started
again; by less, of a frame in the wrong place."""
_END = object()
"""A mark that no driver can yield."""


class DriverSource(LiveSource):
    """The frames of a user's driver, each checked as it is yielded; raises as `open_callable`.

    Readings are clipped to [0, f_max], as a sensor saturates; with `raw`, none is: a calibration
    converts them. Attributes are the driver's own where it has them, or else the name
    `module:callable`, a skin of the first frame's shape, and "taxels" to deliver. Readings that are
    not finite are NaN, unless `nan` refuses them.
    """

    def __init__(self, address: Address, driver: Iterable[object]) -> None:
        super().__init__()
        layout = address.layout

        self._target = address.source
        self._driver = driver
        self._layout = layout
        self._missing_numbers = layout.missing_numbers
        self._raw = address.raw
        self._arrangement: Arrangement | None = None
        self._shape: tuple[int, ...] = ()  # of the frames as they come

        # Without any statement readings are those of the paper's taxels, in newtons.
        self._f_max = PAPER_F_MAX_N
        if layout.f_max is not None:
            self._f_max = float(layout.f_max)
        is_without_range = layout.unit is None and layout.f_max is None
        self._is_in_newtons = is_without_range and not address.raw

        self._skin: Skin | None = None
        self._first: tuple[int, Floats] | None = None  # pulled to learn the shape
        self._checked: Generator[tuple[int, Floats]] | None = None
        self._is_one_shot = False

        # While `_skin` is None, the first frame may have any shape.
        driver_skin = self._read_attributes()
        if driver_skin is not None:
            self.skin: Skin = self._checked_skin(driver_skin)
        else:
            self.skin = self._skin_of_first_frame()
        self._skin = self.skin

        self.clock = DeviceClock(self.name, self._lines.append)
        try:
            check_stated_shape(
                *self.skin.shape, layout.n_rows, layout.n_cols, self._target
            )
        except SourceError:
            self.close()
            raise

    def _read_attributes(self) -> object:
        """Set name, kind, rate and length to those of the driver; return its skin, None if it has
        none.
        """
        target = self._target
        driver = self._driver
        # Each may be a property of the user's, which may raise anything.
        with _running(target):
            skin: object = getattr(driver, "skin", None)
            name = getattr(driver, "name", None)
            delivers = getattr(driver, "delivers", None)
            rate_hz = getattr(driver, "rate_hz", None)
            n_frames = getattr(driver, "n_frames", None)

        if delivers not in (None, "truth", "taxels"):
            raise SourceError(
                f"{target}: delivers = {shown(delivers)}; allowed are truth, taxels"
            )
        if n_frames is not None and not is_whole(n_frames, 0):
            raise SourceError(
                f"{target}: n_frames = {shown(n_frames)}; expected a whole number, or "
                "None if endless"
            )
        check_number(target, "rate_hz", rate_hz)

        self.name: str = target
        self.delivers: Literal["truth", "taxels"] = "taxels"
        self.rate_hz: float | None = None
        self.n_frames: int | None = None
        if isinstance(name, str) and name:
            self.name = name
        if delivers == "truth":
            self.delivers = "truth"
        if rate_hz is not None:
            self.rate_hz = float(rate_hz)
        if n_frames is not None:
            self.n_frames = int(n_frames)
        return skin

    def _skin_of_first_frame(self) -> Skin:
        """A skin of the shape of the first frame, which is pulled for it."""
        self._checked = self._check_frames()
        self._first = next(self._checked, None)
        if self._first is None:
            raise SourceError(f"{self._target}: ended before its first frame")
        _, forces = self._first
        n_rows, n_cols = forces.shape
        unit = self._layout.unit
        if unit is None:
            unit = "N"
        return Skin(n_rows, n_cols, self._f_max, unit)

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """As of `Source`; the driver is closed at the end. Raises SourceError if it raises, yields
        a bad frame, or is a generator that was read before.
        """
        self._checked = self._checked or self._check_frames()
        try:
            if self._first is not None:
                frame = self._first
                self._first = None
                yield frame
            yield from self._checked
        finally:
            self.close()

    def close(self) -> None:
        """Close the driver, so that its `finally` blocks run; raises SourceError if it raises
        then.
        """
        # Forgotten first: a second call, as after an error in it, closes nothing twice.
        checked = self._checked
        self._checked = None
        self._first = None
        if checked is not None:
            with _running(self._target):
                checked.close()

    def _check_frames(self) -> Generator[tuple[int, Floats]]:
        """Yield the frames of the driver, each checked, and close it in the end."""
        target = self._target
        if self._is_one_shot:
            raise SourceError(
                f"{target}: is a generator and was read before; open it anew"
            )

        with _running(target):
            # An iterator of its own, as a generator is, cannot be read twice.
            iterator = iter(self._driver)
        self._is_one_shot = iterator is self._driver

        passed_ns = 0
        previous_ns: int | None = None
        try:
            for n in itertools.count():
                item = self._next_item(iterator)
                if item is _END:
                    return

                where = f"{target}, frame {n}"
                stamp_ns, forces = _checked_pair(item, previous_ns, where)
                if previous_ns is not None:
                    # After a restart of its clock time goes on by a nanosecond.
                    passed_ns += max(1, stamp_ns - previous_ns)
                previous_ns = stamp_ns
                self.stamp = stamp_ns
                if passed_ns > INT64_MAX:
                    raise SourceError(
                        f"{where}: stamp_ns is more than 2**63 ns after the first"
                    )
                yield passed_ns, self._checked_forces(forces, where)
        finally:
            with _running(target):
                getattr(iterator, "close", lambda: None)()

    def _next_item(self, iterator: Iterator[object]) -> object:
        """What the driver yields next, `_END` at its end."""
        # As `_running`, which would take longer than the driver in each frame.
        try:
            return next(iterator, _END)
        except SourceError:
            raise
        except Exception as error:
            raise _failure(self._target, error) from error

    def _array_of(self, forces: object, where: str) -> AnyArray:
        """The numbers of a frame, as the driver returned them."""
        try:
            # A driver may return anything that NumPy reads.
            array = np.asarray(forces)
        except Exception as error:
            raise SourceError(
                f"{where}: forces are no array of numbers ({shown(error, 120)})"
            ) from error

        if array.dtype.kind not in "iuf":
            raise SourceError(
                f"{where}: forces have dtype {shown(array.dtype)}; allowed are "
                "integers and floating point"
            )
        # Counts of a converter would be read as newtons.
        if self._is_in_newtons and array.dtype.kind in "iu" and self._skin is None:
            raise SourceError(
                f"{where}: whole numbers, of which the driver states neither unit nor "
                f"range{ADD}unit={COUNTS} f_max=4095"
            )
        return array

    def _checked_forces(self, forces: object, where: str) -> Floats:
        # The first frame makes the skin; all later ones have its shape.
        array = self._arranged(self._array_of(forces, where), where)
        skin = self._skin
        if skin is not None and array.shape != skin.shape:
            raise SourceError(
                f"{where}: forces have shape {array.shape}, but the skin has "
                f"{skin.shape}"
            )

        # A copy: a driver may fill the same array again.
        if array.dtype == np.float32:
            values = array.copy()
        else:
            with np.errstate(all="ignore"):
                # Compared below with numbers as they are stated, so without rounding.
                values = array.astype(_exact(array.dtype))
        for number in self._missing_numbers:
            values[values == number] = np.nan
        if skin is not None and skin.mask is not None:
            values[~skin.mask] = 0

        # The sum of squares is finite if all readings are, unless they are huge.
        if not math.isfinite(np.vdot(values, values)):
            self._mark_missing(values, where)

        # Raw readings are clipped once a calibration has made forces of them.
        if self._raw:
            return values.astype(np.float32, copy=False)
        if self.clipped.add(values, 0.0, self._f_max):
            np.clip(values, 0, self._f_max, out=values)
        return values.astype(np.float32, copy=False)

    def _mark_missing(self, values: AnyArray, where: str) -> None:
        """Set readings that are not finite to NaN. Raises SourceError where none may be missing."""
        is_number = np.isfinite(values)
        if is_number.all():
            return
        if not self._layout.accepts_missing:
            row, col = np.argwhere(~is_number)[0]
            raise SourceError(
                f"{where}, row {row}, column {col}: {values[row, col]} is no force; a "
                f"fault of the sensor or its driver; {NAN_HINT}"
            )
        values[~is_number] = np.nan

    def _arranged(self, array: AnyArray, where: str) -> AnyArray:
        """The readings of a frame (rows, cols), by the layout; all frames have one shape."""
        if self._arrangement is None or array.shape != self._shape:
            axes = [Axis(size) for size in array.shape]
            self._arrangement = arrange(self._layout, axes, where)
            self._shape = array.shape
        frame: AnyArray = self._arrangement.frames(array[None])[0]
        return frame

    def _checked_skin(self, skin: object) -> Skin:
        """The driver's own skin. Raises SourceError if a setting contradicts it."""
        target = self._target
        if not isinstance(skin, Skin):
            raise SourceError(
                f"{target}: its skin is {type(skin).__name__}; expected "
                "sparseskin.nodes.sensor.source.Skin"
            )
        check_grid(skin.n_rows, skin.n_cols, target)
        # Which of the two is right, nobody knows: forces would be wrong by a factor.
        for key in ("f_max", "unit"):
            setting = getattr(self._layout, key)
            value = getattr(skin, key)
            if setting is not None and setting != value:
                raise SourceError(
                    f"{target}: {key} = {setting} is stated, but the driver's skin has "
                    f"{value}"
                )
        self._f_max = float(skin.f_max)
        return skin


def open_callable(address: Address) -> DriverSource:
    """Open a user's sensor driver, module:callable, of the current directory too.

    It is called without arguments and returns an iterable (a generator, mostly) of pairs (stamp_ns,
    forces): an int that rises from frame to frame, and an array of shape (n_rows, n_cols), integer
    or float. It may have the attributes of a `Source`. Without a `skin`, its first frame is pulled
    at once, to learn the shape. Raises SourceError if the module or callable is missing or fails,
    its first frame is bad, or a setting is out of range or contradicts the driver's skin.
    """
    target = address.source
    check_unit(target, address.layout.unit)
    make = find_callable(target, SourceError)
    with _running(target):
        driver = make()
    # Of the type, as `iter` looks it up.
    if not hasattr(type(driver), "__iter__"):
        raise SourceError(
            f"{target}: returned {type(driver).__name__}; expected a generator or an "
            "iterable of (stamp_ns, forces)"
        )
    return DriverSource(address, driver)


def _checked_pair(
    item: object, previous_ns: int | None, where: str
) -> tuple[int, object]:
    """Stamp and forces of what a driver yielded. Raises SourceError unless the stamp is a whole
    number after the one before, or of a clock that has begun again.
    """
    if not isinstance(item, tuple | list) or len(item) != 2:
        raise SourceError(
            f"{where}: delivered {type(item).__name__}; expected a pair (stamp_ns, "
            "forces)"
        )
    stamp, forces = item
    if not is_whole(stamp):
        raise SourceError(
            f"{where}: stamp_ns is {type(stamp).__name__}; expected whole nanoseconds"
        )
    if previous_ns is not None and previous_ns - RESTART_NS < stamp <= previous_ns:
        raise SourceError(
            f"{where}: stamp_ns {stamp} is not after the one before it, {previous_ns}"
        )
    return int(stamp), forces


def _exact(dtype: np.dtype[Any]) -> type[np.floating[Any]]:
    """Float type that holds all numbers of a dtype: float32 where that is enough."""
    if np.can_cast(dtype, np.float32):
        return np.float32
    return np.float64


@contextmanager
def _running(target: str) -> Iterator[None]:
    """Name what a driver raises."""
    try:
        yield
    except SourceError:
        raise
    except Exception as error:
        raise _failure(target, error) from error


def _failure(target: str, error: Exception) -> SourceError:
    return SourceError(f"{target}: the driver failed: {one_line(error)}")
