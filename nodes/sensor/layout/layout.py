"""What a user states of a source of readings, and a file, topic or array does not state itself."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sparseskin.messages.fields import MAX_SIDE
from sparseskin.messages.ranges import is_real
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.settings import Settings, setting

REFUSE = "refuse"
ZERO = "zero"
HOLD = "hold"
OFFSET = "offset"
MASK = "mask"
KEEP = "keep"
NAN_WAYS = (REFUSE, ZERO, HOLD, MASK)
"""Ways to treat readings that are NaN or infinite. They are refused; or, as `MissingReadings`, they
become 0, the last reading of their taxel, or the mean of its neighbours."""
NEGATIVE_WAYS = (REFUSE, KEEP, ZERO, OFFSET, MASK)
"""Ways to treat readings below 0. The file is refused; they are kept; they become 0; the lowest
reading is subtracted from all; or their taxels are masked."""
ORDERS = ("rows", "columns")
TIME_UNITS = ("", "ns", "us", "ms", "s", "d", "clock")
"""Units of times; clock: hours, minutes and seconds of a day, which begins again at midnight; d:
days, as a spreadsheet or MATLAB counts them."""
AXES = ("frames", "rows", "cols", "taxels", "channel", "-", "value")
"""Names of the axes of an array; -: an axis of one entry; value: a column of a table."""
ENDS = ("first", "last")
"""Columns of times, beside numbers."""
NUMBERS_AS_TEXTS = ("columns", "channel", "time", "missing")
"""Keys of texts that may be stated as a number, too: time=1, missing=-1."""
MAX_WAYS = 8
"""Most values that an error lists."""
CHANNEL = re.compile(r"\d{1,4}|[A-Za-z_]\w{0,31}")


class UnstatedError(SourceError):
    """Something that a source does not state, and that can be read in more than one way.

    `options` are the settings that may be meant, each a mapping of key to value. Whoever knows the
    whole source tries them, and proposes the one that reads it.
    """

    def __init__(self, text: str, *options: Mapping[str, Any]) -> None:
        super().__init__(text)
        self.options = options

    @classmethod
    def between(
        cls, fault: str, key: str, values: Sequence[Any], otherwise: str = ""
    ) -> UnstatedError:
        """The error that one of several values of a key is to be stated, and what else can be."""
        # In quotes where a name has spaces, as the shell and `add` have it.
        texts = [shlex.quote(printable(str(value))) for value in values]
        settings = [f"{key}={text}" for text in texts]
        ways = listed([*settings, *filter(None, [otherwise])], " or ")
        return cls(f"{fault}: state {ways}", *({key: value} for value in values))


def listed(texts: Sequence[str], separator: str = ", ") -> str:
    """The first of some texts, at most `MAX_WAYS`: a file may have thousands of columns."""
    shortened = list(texts[:MAX_WAYS])
    if len(texts) > MAX_WAYS:
        shortened.append("...")
    return separator.join(shortened)


@dataclass(frozen=True)
class GridLayout(Settings):
    """What is stated of the grid of taxels, of a board as of any other source."""

    n_rows: int | None = setting(
        None,
        "rows of a frame where the source does not state them, or those that it must have",
        low=1,
        high=MAX_SIDE,
    )
    n_cols: int | None = setting(
        None, "columns of a frame, as n_rows", low=1, high=MAX_SIDE
    )
    order: str = setting(
        "rows", "readings come row after row, or column after column", choices=ORDERS
    )
    row_order: str = setting(
        "forward", "rows as they come: forward, reversed, or 2,0,1"
    )
    col_order: str = setting("forward", "the same of the columns")
    unit: str | None = setting(
        None, "unit of a file's or driver's readings: N, kPa, counts or another text"
    )
    f_max: float | None = setting(
        None,
        "upper end of a file's or driver's range, in its unit",
        low=1e-9,
        high=1e30,
    )

    @property
    def n_stated(self) -> int | None:
        """Number of taxels, where both sides are stated."""
        if not (self.n_rows and self.n_cols):
            return None
        return self.n_rows * self.n_cols


@dataclass(frozen=True)
class Layout(GridLayout):
    """What is stated of a source; each key is a setting of the sensor, an argument of
    `read_recording` and an option of the commands that read files.
    """

    axes: str = setting(
        "",
        "axes of an array in their order, as rows,cols,frames; of frames, rows, cols, taxels, "
        "channel, and - for an axis of one entry; of a table with a line for each taxel: "
        "taxels,frames; with a line for each taxel of each frame: frames,rows,cols,value",
    )
    columns: str = setting(
        "",
        "taxels of a table: names as s*, or numbers from 1 as 2-65, separated by commas",
    )
    channel: str = setting(
        "",
        "of several numbers per taxel the one that is read: a name as z, or a number from 0",
    )
    field: str = setting(
        "", "field of a message that holds the readings, as sensors[0].taxels[].z"
    )
    time: str = setting(
        "",
        "column, array or field of the times: its name or number; first; last; none; log, of "
        "messages, the time of recording",
    )
    time_unit: str = setting(
        "",
        "unit of the times; d: days, as of a spreadsheet; clock: time of day, as 10:15:02.120",
        choices=TIME_UNITS,
    )
    time_wrap: int | None = setting(
        None,
        "units of time until the times are 0 again: 4294967296 of micros() and millis()",
        low=2,
        high=1 << 64,
    )
    rate_hz: float | None = setting(
        None, "frames per second, in place of the times of the file", low=1e-9, high=1e9
    )
    missing: str = setting(
        "", "numbers or texts that stand for no reading, as -1,OVR, separated by commas"
    )
    nan: str = setting(
        REFUSE,
        "readings that are not finite, which are counted, and marked in their frame: refuse the "
        "file, end the driver, drop the board's frame; mask: mask taxels that give no number, and "
        "fill in the mean of the neighbours where one gives none for a while; hold: the last "
        "reading; zero",
        choices=NAN_WAYS,
    )
    negative: str = setting(
        REFUSE,
        "readings of a file below 0; with a calibration, they are kept by default",
        choices=NEGATIVE_WAYS,
    )
    topic: str = setting(
        "",
        "topic of a recording (ROS, sparseskin), or name or path of the array in a file",
    )
    frame_id: str = setting(
        "",
        "of the messages of a topic those whose header names this frame; of a table the lines "
        "whose column of sensors has it",
    )
    skip: int = setting(
        0,
        "lines of a table, or messages, before the first that is read",
        low=0,
        high=2**31 - 1,
    )

    def __post_init__(self) -> None:
        if isinstance(self.time_wrap, str) and self.time_wrap.isdecimal():
            # As it stands behind "add" in an error.
            object.__setattr__(self, "time_wrap", int(self.time_wrap[:24]))
        # In Python a column or a marker is a number, on a command line its text.
        for key in NUMBERS_AS_TEXTS:
            value = getattr(self, key)
            if is_real(value):
                object.__setattr__(self, key, f"{value:g}")
        super().__post_init__()
        unknown = [name for name in self.axis_names if name not in AXES]
        if unknown:
            allowed = f"allowed: {', '.join(AXES)}, separated by commas"
            raise SettingsError(f"axes: {unknown[0]!r} is no axis; {allowed}")
        if self.channel and not CHANNEL.fullmatch(self.channel):
            raise SettingsError(
                f"channel: {self.channel!r}; allowed: a name as z, or a number"
            )

    @property
    def axis_names(self) -> tuple[str, ...]:
        """Names of the axes, () where none are stated."""
        if not self.axes.strip():
            return ()
        return tuple(name.strip() for name in self.axes.split(","))

    @property
    def has_time_column(self) -> bool:
        """True if the times are stated to be a column of the readings."""
        return self.time in ENDS or self.time.isdecimal()

    @property
    def accepts_missing(self) -> bool:
        """True if a reading may be missing."""
        return self.nan != REFUSE or bool(self.missing)

    @property
    def missing_way(self) -> str:
        """The way to fill readings that are missing, of `NAN_WAYS`."""
        # Whoever states a marker expects it: the file is not refused for it.
        if self.missing and self.nan == REFUSE:
            return MASK
        return self.nan

    @property
    def missing_texts(self) -> frozenset[str]:
        """Texts that stand for no reading, in small letters."""
        return frozenset(
            text.strip().lower() for text in self.missing.split(",") if text.strip()
        )

    @property
    def missing_numbers(self) -> tuple[float, ...]:
        """Numbers that stand for no reading."""
        numbers = []
        for text in self.missing_texts:
            try:
                numbers.append(float(text))
            except ValueError:
                continue
        return tuple(numbers)

    def stating(self, changes: Mapping[str, Any]) -> Layout:
        """A copy with further keys stated. Raises SettingsError if a value is not allowed."""
        # Not replace(): it would skip the conversions of texts above.
        values = {key: getattr(self, key) for key in KEYS}
        return Layout(**{**values, **changes})


KEYS = tuple(Layout.__dataclass_fields__)
"""Names of all that can be stated."""
EMPTY = Layout()
"""Nothing is stated."""
