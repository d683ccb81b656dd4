"""Faults drawn at random, of any shape and size: of taxels, and of measurements on their way."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats, Mask

HUM_PHASE = 2 * math.pi * 0.485
"""Phase that hum of 50 Hz gains per frame at 103 Hz."""


class Moment(NamedTuple):
    """A frame with a fault: number of frames since it began; values of the frame before, and of the
    last frame without the fault; a random generator of this frame alone.
    """

    k: int
    previous: Floats
    healthy: Floats
    rng: np.random.Generator


Change: TypeAlias = Callable[[Floats, Moment], Any]
"""Returns the faulty values of a frame; None if the frame is lost."""


class Skin(NamedTuple):
    """What a fault is drawn for: taxels that exist, upper end of their range, newtons."""

    exists: Mask
    f_max: float


class Drawn(NamedTuple):
    """A fault as it was drawn: its size in words, and what it does."""

    text: str
    change: Change


def _size(rng: np.random.Generator, low: float, high: float) -> float:
    """A size of any order of magnitude in a range."""
    return math.exp(rng.uniform(math.log(low), math.log(high)))


def _newtons(rng: np.random.Generator, skin: Skin, low: float, high: float) -> float:
    """A force of either sign, newtons, between two multiples of the range."""
    sign = float(rng.choice([-1.0, 1.0]))
    return sign * _size(rng, low, high) * skin.f_max


# Stuck taxels.


def _blob(rng: np.random.Generator, skin: Skin) -> Mask:
    """A connected blob, grown taxel by taxel: compact or ragged as it comes."""
    n_rows, n_cols = skin.exists.shape
    largest = max(3.0, 0.3 * skin.exists.sum())
    n_wanted = round(_size(rng, 2, largest))
    cells = np.zeros(skin.exists.shape, dtype=np.bool_)
    row = int(rng.integers(n_rows))
    col = int(rng.integers(n_cols))
    border = [(row, col)]
    while border and np.count_nonzero(cells) < n_wanted:
        place = int(rng.integers(len(border)))
        row, col = border.pop(place)
        is_on_skin = 0 <= row < n_rows and 0 <= col < n_cols
        if not is_on_skin or cells[row, col]:
            continue
        cells[row, col] = True
        border += [(row - 1, col), (row + 1, col)]
        border += [(row, col - 1), (row, col + 1)]
    return cells


def _line(rng: np.random.Generator, skin: Skin) -> Mask:
    """A straight line of any direction and length, as of a crack or a cable."""
    rows, cols = np.indices(skin.exists.shape)
    start_row, start_col = rng.uniform(0, 1, 2) * skin.exists.shape
    angle = rng.uniform(0, 2 * math.pi)
    length = _size(rng, 3, max(skin.exists.shape))

    # Distances from the start, along the line and aside of it.
    down = rows - start_row
    across = cols - start_col
    along = down * math.cos(angle) + across * math.sin(angle)
    aside = across * math.cos(angle) - down * math.sin(angle)
    half_width = rng.uniform(0.5, 1.2)
    is_beside = (along >= 0) & (along <= length)
    cells: Mask = is_beside & (np.abs(aside) <= half_width)
    return cells


def _scattered(rng: np.random.Generator, skin: Skin) -> Mask:
    """Single taxels anywhere."""
    count = round(_size(rng, 1, 0.1 * skin.exists.size))
    cells = np.zeros(skin.exists.size, dtype=np.bool_)
    places = rng.choice(cells.size, count, replace=False)
    cells[places] = True
    return cells.reshape(skin.exists.shape)


def _strips(rng: np.random.Generator, skin: Skin) -> Mask:
    """Whole rows or columns, next to each other or not."""
    axis = int(rng.integers(2))
    n_lines = skin.exists.shape[axis]
    # Up to four, but no large part of a small skin.
    n_most = max(2, min(5, n_lines // 3))
    count = int(rng.integers(1, n_most))
    lines = rng.choice(n_lines, count, replace=False)
    if rng.random() < 0.5:
        lines = (lines[0] + np.arange(count)) % n_lines
    is_stuck = np.isin(np.arange(n_lines), lines)
    one_line = np.expand_dims(is_stuck, 1 - axis)
    return np.broadcast_to(one_line, skin.exists.shape)


def _stuck(rng: np.random.Generator, skin: Skin, shape: Callable[..., Mask]) -> Drawn:
    """Taxels that read one value: the ends of the range as often as any other."""
    cells = np.zeros(skin.exists.shape, dtype=np.bool_)
    # A small shape may lie on a hole of the skin alone.
    while not cells.any():
        cells = shape(rng, skin) & skin.exists
    values = [0.0, rng.uniform(0, skin.f_max), skin.f_max]
    value = float(rng.choice(values, p=[0.2, 0.6, 0.2]))
    n_stuck = np.count_nonzero(cells)
    text = f"{n_stuck} taxels at {value:.2f} N"
    return Drawn(text, lambda x, moment: np.where(cells, value, x))


# All readings.


def _readings_hum(rng: np.random.Generator, skin: Skin) -> Drawn:
    height = _size(rng, 0.02, 0.4) * skin.f_max

    def change(x: Floats, moment: Moment) -> Floats:
        hum = height * math.sin(HUM_PHASE * moment.k)
        # What is outside the range is clipped; a hole of the mask reads nothing.
        readings = (x + hum).clip(0, skin.f_max)
        return readings * skin.exists

    return Drawn(f"{height:.2f} N", change)


def _readings_drift(rng: np.random.Generator, skin: Skin) -> Drawn:
    per_frame = _size(rng, 0.0005, 0.01) * skin.f_max

    def change(x: Floats, moment: Moment) -> Floats:
        drift = per_frame * moment.k
        readings = (x + drift).clip(0, skin.f_max)
        return readings * skin.exists

    per_frame_mn = 1000 * per_frame
    return Drawn(f"{per_frame_mn:.2f} mN per frame", change)


def _readings_frozen(rng: np.random.Generator, skin: Skin) -> Drawn:
    return Drawn("", lambda x, moment: moment.healthy)


# Single measurements.


def _rows(rng: np.random.Generator, y: Floats, share: float) -> Any:
    """Rows that are a share of all, one at least."""
    n_rows = max(1, round(share * y.size))
    return rng.permutation(y.size)[:n_rows]


def _share_of_rows(rng: np.random.Generator) -> float:
    """One row as often as several, up to an eighth."""
    if rng.random() < 0.5:
        return 0.0
    return _size(rng, 0.01, 0.125)


def _of_rows(share: float) -> str:
    if share == 0:
        return "one row"
    return f"{share:.1%} of the rows"


def _garbage_at_times(rng: np.random.Generator, skin: Skin) -> Drawn:
    """Other rows each time, as of bit errors on a line."""
    share = _share_of_rows(rng)
    height = _size(rng, 1, 30) * skin.f_max
    interval = int(rng.integers(2, 20))

    def change(y: Floats, moment: Moment) -> Floats:
        if moment.k % interval:
            return y
        garbage = y.copy()
        rows = _rows(moment.rng, y, share)
        garbage[rows] = moment.rng.uniform(-height, height, rows.size)
        return garbage

    text = f"{_of_rows(share)} up to {height:.1f} N, every {interval} frames"
    return Drawn(text, change)


def _garbage(rng: np.random.Generator, skin: Skin) -> Drawn:
    share = _share_of_rows(rng)
    height = _size(rng, 1, 30) * skin.f_max
    seed = int(rng.integers(2**32))

    def change(y: Floats, moment: Moment) -> Floats:
        garbage = y.copy()
        # The same rows in each frame: the number of rows is known only here.
        rows = _rows(np.random.default_rng(seed), y, share)
        garbage[rows] = moment.rng.uniform(-height, height, rows.size)
        return garbage

    return Drawn(f"{_of_rows(share)} up to {height:.1f} N", change)


def _stuck_rows(rng: np.random.Generator, skin: Skin) -> Drawn:
    share = _share_of_rows(rng)
    values = [0.0, _newtons(rng, skin, 0.1, 30)]
    value = float(rng.choice(values, p=[0.2, 0.8]))
    seed = int(rng.integers(2**32))

    def change(y: Floats, moment: Moment) -> Floats:
        stuck = y.copy()
        # The same rows in each frame, as of `_garbage`.
        rows = _rows(np.random.default_rng(seed), y, share)
        stuck[rows] = value
        return stuck

    return Drawn(f"{_of_rows(share)} at {value:.2f} N", change)


# All measurements.


def _offset(rng: np.random.Generator, skin: Skin) -> Drawn:
    value = _newtons(rng, skin, 0.02, 1)
    return Drawn(f"{value:+.2f} N", lambda y, moment: y + value)


def _hum(rng: np.random.Generator, skin: Skin) -> Drawn:
    height = _size(rng, 0.02, 1) * skin.f_max

    def change(y: Floats, moment: Moment) -> Floats:
        hum = height * math.sin(HUM_PHASE * moment.k)
        return y + hum

    return Drawn(f"{height:.2f} N", change)


def _zeros(rng: np.random.Generator, skin: Skin) -> Drawn:
    return Drawn("", lambda y, moment: 0 * y)


def _equal(rng: np.random.Generator, skin: Skin) -> Drawn:
    value = _newtons(rng, skin, 0.02, 2)
    return Drawn(f"at {value:.2f} N", lambda y, moment: 0 * y + value)


def _one_sided(rng: np.random.Generator, skin: Skin) -> Drawn:
    return Drawn("", lambda y, moment: y.clip(0))


def _clipped(rng: np.random.Generator, skin: Skin) -> Drawn:
    bound = _size(rng, 0.04, 2) * skin.f_max
    return Drawn(f"at {bound:.2f} N", lambda y, moment: y.clip(-bound, bound))


def _frozen(rng: np.random.Generator, skin: Skin) -> Drawn:
    return Drawn("", lambda y, moment: moment.healthy)


def _late(rng: np.random.Generator, skin: Skin) -> Drawn:
    return Drawn("", lambda y, moment: moment.previous)


def _scaled_up(rng: np.random.Generator, skin: Skin) -> Drawn:
    factor = _size(rng, 2, 100)
    return Drawn(f"by {factor:.1f}", lambda y, moment: factor * y)


def _scaled_down(rng: np.random.Generator, skin: Skin) -> Drawn:
    factor = _size(rng, 0.01, 0.4)
    return Drawn(f"by {factor:.2f}", lambda y, moment: factor * y)


def _loud(rng: np.random.Generator, skin: Skin) -> Drawn:
    deviation = _size(rng, 0.04, 1) * skin.f_max

    def change(y: Floats, moment: Moment) -> Any:
        noise = deviation * moment.rng.standard_normal(y.size)
        return y + noise

    return Drawn(f"deviation {deviation:.2f} N", change)


def _out_of_order(rng: np.random.Generator, skin: Skin) -> Drawn:
    order = str(rng.choice(["pairs", "backwards", "shifted", "shuffled"]))
    seed = int(rng.integers(2**32))

    def change(y: Floats, moment: Moment) -> Floats:
        places = np.arange(y.size)
        if order == "pairs":
            places = np.minimum(places ^ 1, y.size - 1)
        elif order == "backwards":
            places = places[::-1]
        elif order == "shifted":
            places = np.roll(places, 1)
        else:
            places = np.random.default_rng(seed).permutation(y.size)
        return y[places]

    return Drawn(order, change)


def _dropouts(rng: np.random.Generator, skin: Skin) -> Drawn:
    share = rng.uniform(0.05, 0.6)

    def change(y: Floats, moment: Moment) -> Floats:
        if moment.rng.random() < share:
            return 0 * y
        return y

    return Drawn(f"{share:.0%} of the frames", change)


def _lost(rng: np.random.Generator, skin: Skin) -> Drawn:
    share = rng.uniform(0.05, 0.6)
    burst = int(rng.integers(1, 12))
    seed = int(rng.integers(2**32))

    def change(y: Floats, moment: Moment) -> Floats | None:
        # All frames of a burst draw the same number.
        number = moment.k // burst
        rng_of_burst = np.random.default_rng((seed, number))
        if rng_of_burst.random() < share:
            return None
        return y

    return Drawn(f"{share:.0%} of the frames, {burst} at a time", change)


Builder: TypeAlias = Callable[[np.random.Generator, Skin], Drawn]

OF_TAXELS: dict[str, Builder] = {
    "stuck blob": partial(_stuck, shape=_blob),
    "stuck line": partial(_stuck, shape=_line),
    "stuck taxels": partial(_stuck, shape=_scattered),
    "stuck rows or columns": partial(_stuck, shape=_strips),
    "hum of taxels": _readings_hum,
    "drift of taxels": _readings_drift,
    "frozen readings": _readings_frozen,
}
"""Faults of readings by kind."""
OF_MEASUREMENTS: dict[str, Builder] = {
    "garbage at times": _garbage_at_times,
    "garbage for ever": _garbage,
    "stuck measurements": _stuck_rows,
    "offset": _offset,
    "hum of measurements": _hum,
    "zeros": _zeros,
    "all equal": _equal,
    "one-sided converter": _one_sided,
    "clipped": _clipped,
    "frozen measurements": _frozen,
    "one frame late": _late,
    "scaled up": _scaled_up,
    "scaled down": _scaled_down,
    "loud noise": _loud,
    "out of order": _out_of_order,
    "frames of zeros": _dropouts,
    "lost frames": _lost,
}
"""Faults of measurements by kind."""
KINDS = OF_TAXELS | OF_MEASUREMENTS


@dataclass(frozen=True, eq=False)
class Fault:
    """A fault from frame `begins` on; `seed`: of what it draws anew in each frame."""

    kind: str
    text: str
    change: Change
    begins: int
    seed: int

    @property
    def of_taxels(self) -> bool:
        """True if readings are faulty, False if measurements are."""
        return self.kind in OF_TAXELS

    def describe(self) -> str:
        """Kind, size and first frame."""
        size = f" ({self.text})" if self.text else ""
        return f"{self.kind}{size} from frame {self.begins} on"


class Spoiler:
    """Values of one stream, each frame in turn, with a fault; None: without. `is_empty`: True if
    those of the last frame hold nothing of the skin, so that no alarm is a false one.
    """

    def __init__(self, fault: Fault | None) -> None:
        self.is_empty = False
        self._fault = fault
        self._n_frames = 0
        self._previous: Floats | None = None
        self._healthy: Floats | None = None

    def spoil(self, values: Floats) -> Floats | None:
        """Return the values of the next frame as they arrive; None if it is lost."""
        fault = self._fault
        k = self._n_frames
        self._n_frames += 1
        if fault is None:
            return values
        # The first frame is always healthy: a frozen one repeats it.
        is_first = self._previous is None
        if k < fault.begins or is_first:
            self._previous = values
            self._healthy = values
            return values
        assert self._previous is not None
        assert self._healthy is not None

        # A generator a frame: what a lost frame drew does not change the next one.
        rng = np.random.default_rng((fault.seed, k))
        moment = Moment(k - fault.begins, self._previous, self._healthy, rng)
        self._previous = values
        changed = fault.change(values, moment)
        if changed is None:
            return None
        has_one_value = bool(np.ptp(changed) == 0)
        self.is_empty = has_one_value or changed is self._healthy
        return np.ascontiguousarray(changed, dtype=np.float32)


def draw_fault(
    rng: np.random.Generator, skin: Skin, begins: int, kind: str = ""
) -> Fault:
    """Draw a fault of a skin. A stated kind replaces the drawn one."""
    # A stated kind is drawn, too: all else of a seed stays the same.
    drawn_kind = str(rng.choice(list(KINDS)))
    seed = int(rng.integers(2**32))
    kind = kind or drawn_kind
    text, change = KINDS[kind](rng, skin)
    return Fault(kind, text, change, begins, seed)
