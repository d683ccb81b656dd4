"""The interface of sensor sources: an address, which settings state, and the source it opens."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.arrays import Floats

from .device_clock import DeviceClock
from .layout.layout import EMPTY, KEYS, Layout
from .saturation import Clipped

if TYPE_CHECKING:
    from .calibration.description import SkinDescription

__all__ = ["Address", "Listing", "LiveSource", "Skin", "Source", "about"]

DEFAULT_RATE_HZ = 100.0
"""Frame rate of scenes and of recordings without a rate of their own."""
MAX_LINES = 100
"""Most lines for the log that wait, chosen: the newest ones tell what goes on."""


class Source:
    """A source of frames: a simulated scene, a recording, a board, or a driver."""

    name: str  # for summaries, e.g. "drag_wrench_64"
    skin: Skin  # that the frames belong to
    #: "truth": noise-free forces, to which the sensor adds noise. "taxels": readings of a real
    #: skin, whose truth is not known, and which a calibration may convert to forces.
    delivers: Literal["truth", "taxels"] = "taxels"
    rate_hz: float | None = None  # native frame rate; None: it has none of its own
    n_frames: int | None = None  # None: endless
    #: A frame is of the time at which it is read; others are read ahead.
    is_live: bool = False
    #: Frames arrive whether or not they are read; `next_frame` states when.
    arrives: bool = False
    #: Frames are made for the time at which they are sent, as by a scene.
    simulates: bool = False
    #: Frames of a skin of points are on its virtual grid already.
    on_points: bool = False
    ended: bool = False  # `next_frame` has found that there is no frame any more
    f_min: float = 0.0  # lower end of the range, 0 or less, in the unit of the skin
    #: Counts of the readings that were clipped to the range.
    clipped: Clipped = Clipped()
    #: Noise of a taxel at half the range, and untouched, in the unit of the skin, that the sensor
    #: adds to a truth; None: that of the paper's skin.
    sigmas: tuple[float, float] | None = None
    #: Of the stamps of its frames; None: they have none.
    clock: DeviceClock | None = None
    stamp: int = 0  # of the last frame on that clock
    # The sensor sets these:
    period_s: float = 1 / DEFAULT_RATE_HZ  # time between the frames that it reads
    loops: bool = False  # a scene or recording begins again at its end
    _began_ns = _last_ns = 0
    _frames: Iterator[tuple[int, Floats]] | None = None

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        """Yield (stamp_ns, forces): nanoseconds since the first frame, and float32 (n_rows, n_cols)
        in [0, f_max], or (n_patches, n_rows, n_cols); 0 in masked cells, NaN where a reading is
        missing and that is allowed.
        """
        raise NotImplementedError

    @property
    def pace_hz(self) -> float:
        """Frames a second that a sensor reads where its settings state no rate; 0: as they come."""
        if self.rate_hz is not None:
            return self.rate_hz
        if self.is_live:
            return 0.0
        return DEFAULT_RATE_HZ

    @property
    def is_there(self) -> bool:
        """False while the device is gone."""
        return True

    def next_frame(
        self, wait_s: float, newest: bool = False
    ) -> tuple[int, Floats] | None:
        """The next frame, as `__iter__` yields it; None if there is none. One that arrives is
        waited for at most `wait_s` seconds; with `newest`, those that arrived before it are not
        used.
        """
        self._frames = self._frames or iter(self)
        frame = next(self._frames, None)

        # The next round begins one period after the last frame.
        if frame is None and self.loops:
            self._began_ns = self._last_ns + round(1e9 * self.period_s)
            self._frames = iter(self)
            frame = next(self._frames, None)
        self.ended = frame is None
        if frame is None:
            return None

        stamp_ns, forces = frame
        self._last_ns = self._began_ns + stamp_ns
        return self._last_ns, forces

    def read_part(self, first: int, every: int) -> None:
        """Read every `every`-th frame alone, from the one of number `first` on.
        Raises SourceError if the source is live, or has no such frame.
        """
        if self.is_live:
            raise SourceError(f"{self.name}: first, every: are of scenes and files")
        if self.n_frames is not None:
            if first >= self.n_frames:
                raise SourceError(
                    f"{self.name}: first: {first}: allowed: 0..{self.n_frames - 1}"
                )
            self.n_frames = len(range(first, self.n_frames, every))
        # A simulation that need not compute the others overrides this.
        self._frames = islice(iter(self), first, None, every)

    def age_ns(self, arrived_ns: int) -> int:
        """Time since a frame arrived, nanoseconds."""
        return 0

    def receive(self, wait_s: float) -> None:
        """Read the frames that have arrived, waiting for them at most `wait_s` seconds."""

    def discard(self) -> None:
        """Use none of the frames that have arrived: nobody asks for frames now."""

    def take_lines(self) -> list[str]:
        """Lines for the log since the last call."""
        return []

    def dropped(self) -> str | None:
        """What was dropped, in words, "" for nothing; None of a source that drops nothing."""
        return None

    def report(self) -> dict[str, Any]:
        """Counters for the summary of a run; `lines`: lines for the terminal at its end."""
        return {}

    def close(self) -> None:
        """Close the source; may be called more than once."""


class LiveSource(Source):
    """A source of readings of now, which may be clipped."""

    is_live = True

    def __init__(self) -> None:
        self.clipped = Clipped()
        self._lines: deque[str] = deque(maxlen=MAX_LINES)

    def take_lines(self) -> list[str]:
        lines = list(self._lines)
        self._lines.clear()
        return lines


@dataclass(frozen=True)
class Listing:
    """Sources of one kind that there are, for `sparseskin sources`; `key` is that in its JSON."""

    key: str
    title: str
    #: `about`, a few words on each, and `source`, its address; or `name`, for a part of one.
    entries: Sequence[Mapping[str, str]]


def about(make: Callable[..., object]) -> str:
    """A few words for a `Listing` on what a function makes: the first line of its docstring, to a
    colon, without "Return".
    """
    first_line = (make.__doc__ or "").partition("\n")[0]
    words = first_line.rstrip(".").partition(":")[0]
    return words.removeprefix("Return ")


@dataclass(frozen=True, eq=False)
class Address(ABC):
    """What settings state of a source that is not open; a subclass for each kind."""

    source: str  # the address itself, e.g. "file:press.npy"
    #: What the source does not state itself, or must agree with.
    layout: Layout = EMPTY
    seed: int = 0  # of a scene
    raw: bool = False  # readings have any sign and size, as a calibration converts them
    #: File with the places of the taxels of a skin of points; "": a grid.
    points: str = ""
    described: "SkinDescription | None" = None  # what the file of the skin states
    # Number of patches, their skin, and the part that is pressed, for a scene of a body:
    n_patches: int = 1
    simulated: Mapping[str, Any] | None = None
    active: float | None = None
    form: ClassVar[str] = "module:callable"  # of such addresses, for help and errors
    #: As of the source it opens; None: only that shows it.
    delivers: ClassVar[Literal["truth", "taxels"] | None] = None
    #: Settings that such a source has itself: not to be stated.
    own: ClassVar[tuple[str, ...]] = ()
    #: Keys of `Layout` that such a source uses; no other may be stated.
    keys: ClassVar[tuple[str, ...]] = KEYS

    @classmethod
    def listings(cls) -> Sequence[Listing]:
        """What this host has of such sources; called by `sparseskin sources`."""
        return ()

    @classmethod
    def completions(cls, prefix: str) -> Mapping[str, str]:
        """Addresses that begin with what has been typed, kind and colon included, and a few words
        on each; "" if the address is enough.
        """
        return {}

    @property
    def kind(self) -> str:
        """What stands before the colon."""
        return self.source.partition(":")[0]

    @property
    def rest(self) -> str:
        """What stands behind the colon."""
        return self.source.partition(":")[2]

    @abstractmethod
    def check(self) -> None:
        """Raise SourceError if the source cannot be opened, as far as shows without opening it."""

    def n_taxels(self) -> int | None:
        """Number of taxels, without opening the source; None where only the open one shows it.
        May raise SourceError as `check`.
        """
        return self.layout.n_stated

    @abstractmethod
    def open(self) -> Source:
        """Open the source; SourceError if it is missing, or contradicts what is stated."""
