"""The commands `sparseskin sources`, what a sensor of this host can read, and `scope`, the frames
of a source live in the terminal, without a graph.
"""

import argparse
import contextlib
import os
import shutil
import sys
import time
from collections import deque
from collections.abc import Iterable, Iterator

import numpy as np

from sparseskin.launch.attach.heat_map import heat_map
from sparseskin.launch.attach.text import table
from sparseskin.launch.launchfile.stated import as_words
from sparseskin.launch.run.terminal import Terminal
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.extensions import ADDRESSES, DRIVERS, failures, loaded, offered
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.layout.layout import KEYS, Layout
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ, Listing, Source
from sparseskin.nodes.sensor.sources import KINDS, find_kind, open_source

from .options import add_set, naming_options, real, show, stated_values, whole

WAIT_S = 0.05
"""Longest wait for a frame before keys are looked at, seconds."""
DRAW_S = 1 / 15
"""Time between two pictures, seconds; chosen: it looks live, and leaves the terminal time."""
TEXT_S = 1.0
"""The same where the output is no terminal: one line a second."""
RATE_S = 2.0
"""Span over which the rate is measured, seconds."""
LEAST_TOP = 0.02
"""Least share of the range that the brightest colour stands for; chosen: noise alone stays dark."""
PEAK_S = 5.0
"""Time in which the scale of the colours follows a falling peak, seconds; chosen."""


def configure_sources(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List what a sensor of this host can read. sparseskin scope SOURCE shows the frames of a "
        "source; a graph reads it with --set sensor.source=SOURCE."
    )
    parser.add_argument("--json", action="store_true", help="print the list")
    parser.set_defaults(run=_sources)


def _sources(arguments: argparse.Namespace) -> int:
    listings = [listing for kind in KINDS for listing in find_kind(kind).listings()]
    # Drivers of other packages are named by their entry points.
    listings.append(Listing("drivers", "drivers of installed packages", drivers()))
    for kind, plugin in loaded(ADDRESSES).items():
        if kind in KINDS:
            continue
        try:
            listings += plugin.listings()
        except Exception as error:
            # The plug-in of any package may raise anything.
            listings.append(
                Listing(kind, f"{kind}: cannot be listed: {one_line(error)}", ())
            )
    document = {listing.key: list(listing.entries) for listing in listings}
    return show(arguments, "source-list", document, _lines(listings))


def _lines(listings: Iterable[Listing]) -> Iterator[str]:
    for listing in listings:
        yield listing.title
        rows = []
        for entry in listing.entries:
            rows.append([entry.get("source") or entry["name"], entry["about"]])
        if rows:
            yield from table(["SOURCE", "ABOUT"], rows, "  ")
        else:
            yield "  none"
    absent = failures(ADDRESSES)
    if absent:
        yield absent.removeprefix("; ")


def drivers() -> list[dict[str, str]]:
    """Drivers that installed packages offer as entry points."""
    entries = []
    for driver in offered(DRIVERS).values():
        about = driver.name
        if driver.dist:
            about += f", of {driver.dist.name}"
        entries.append({"source": driver.value, "about": about})
    return entries


def configure_scope(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Show the frames of a source as they come, before anything else is configured: a map, the "
        "rate, least and largest reading, and what was dropped. q or Ctrl-C ends it. Where the "
        "output is no terminal, one line a second."
    )
    parser.add_argument("source", metavar="SOURCE", help="one of sparseskin sources")
    parser.add_argument(
        "--frames",
        type=whole(1),
        metavar="N",
        help="end after so many frames",
    )
    parser.add_argument(
        "--seconds",
        type=real(True),
        metavar="S",
        help="end after so long",
    )
    add_set(parser, f"state what the source does not: {', '.join(KEYS)}")
    parser.set_defaults(run=_scope)


def _scope(arguments: argparse.Namespace) -> int:
    try:
        source = open_source(arguments.source, layout=_stated(arguments.set))
    except SourceError as error:
        line = as_words(str(error), lambda key: f"--set {key}=")
        raise SourceError(line) from error

    # The last picture goes with the other screen of the terminal: figures are printed after it.
    view = View(source)
    lively = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    try:
        with contextlib.suppress(KeyboardInterrupt):
            _show_frames(arguments, source, view, lively)
    finally:
        if lively:
            # Colours off, the cursor and the screen of before.
            sys.stdout.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        source.close()
    print(view.summary())
    return 0 if view.n_frames else 1


def _show_frames(
    arguments: argparse.Namespace, source: Source, view: "View", lively: bool
) -> None:
    """Show frames until their number, the time, or a person ends it."""
    terminal = Terminal()
    # A log would be flooded by what a person can watch.
    begin_s = time.monotonic()
    period_s = DRAW_S
    next_s = begin_s
    if not lively:
        period_s = TEXT_S
        next_s += period_s
    end_s = np.inf
    if arguments.seconds is not None:
        end_s = begin_s + arguments.seconds

    with terminal.keyboard(lively):
        if lively:
            sys.stdout.write("\x1b[?1049h\x1b[?25l")
        for frame in _frames(source):
            now_s = time.monotonic()
            if frame is not None:
                view.add(frame, now_s)
            if not lively:
                for line in view.take_lines():
                    print(line, flush=True)
            if now_s >= next_s:
                next_s = now_s + period_s
                print(_shown_text(view, now_s, lively), end="", flush=True)
            is_over = view.n_frames == arguments.frames or now_s >= end_s
            if is_over or "q" in terminal.pressed():
                break


def _shown_text(view: "View", now_s: float, lively: bool) -> str:
    if lively:
        return _picture(view, now_s, shutil.get_terminal_size())
    return f"{view.text(now_s)}\n"


def _stated(words: list[str]) -> Layout:
    """What is stated of a source by KEY=VALUE."""
    with naming_options({key: f"--set {key}" for key in KEYS}):
        return Layout.from_mapping(stated_values(words, Layout.described()))


def _frames(source: Source) -> Iterator[Floats | None]:
    """Frames in the time of the source, None while there is none."""
    if source.arrives:
        while True:
            arrival = source.next_frame(WAIT_S)
            if arrival is None:
                yield None
                continue
            _, forces = arrival
            yield forces

    period_s = 1 / (source.rate_hz or DEFAULT_RATE_HZ)
    begin_s = time.monotonic()
    for k, (_, forces) in enumerate(source):
        if not source.is_live:
            # A live driver has its own pace.
            yield from _pauses(begin_s + k * period_s)
        yield forces


def _pauses(until_s: float) -> Iterator[None]:
    """Wait until a time, with a None after each longer wait."""
    wait_s = until_s - time.monotonic()
    while wait_s > 0:
        time.sleep(min(wait_s, WAIT_S))
        if wait_s > WAIT_S:
            yield None
        wait_s = until_s - time.monotonic()


class View:
    """What is shown of a source: the last frame and its figures."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.n_frames = 0
        self.forces: Floats | None = None
        self.lowest = np.inf
        self.highest = -np.inf
        self._times: deque[float] = deque()
        self._begin_s = time.monotonic()
        self._peak = 0.0
        self._peak_s = self._begin_s
        self._last_line = ""

    def add(self, forces: Floats, now_s: float) -> None:
        """Add a frame."""
        self.forces = forces
        self.n_frames += 1
        self._times.append(now_s)
        low = float(forces.min())
        high = float(forces.max())
        self.lowest = min(self.lowest, low)
        self.highest = max(self.highest, high)
        # The brightest colour follows a peak that falls, slowly, so that a map does not flicker.
        elapsed_s = now_s - self._peak_s
        decay = float(np.exp(-elapsed_s / PEAK_S))
        self._peak = max(high, self._peak * decay)
        self._peak_s = now_s

    def take_lines(self) -> list[str]:
        """Lines that the source has logged since the last call."""
        lines = [printable(line) for line in self._source.take_lines()]
        if lines:
            self._last_line = lines[-1]
        return lines

    @property
    def top(self) -> float:
        """Reading of the brightest colour."""
        return max(self._peak, LEAST_TOP * self._source.skin.f_max)

    def _line(self, *figures: str) -> str:
        """Figures in one line, with what was dropped."""
        parts = list(filter(None, figures))
        n_dropped = self._source.dropped()
        if n_dropped is not None:
            parts.append(f"dropped: {n_dropped or 'nothing'}")
        return "; ".join(parts)

    def head(self, now_s: float) -> list[str]:
        """Name, figures, what was dropped, and the last line of the source."""
        self.take_lines()
        skin = self._source.skin
        size = f"{skin.n_rows} x {skin.n_cols} taxels"
        extent = f"0..{skin.f_max:g} {printable(skin.unit)}"
        lines = [
            f"{printable(self._source.name)}   {size}, {extent}   (q: quit)",
            self.text(now_s),
        ]
        if self.forces is not None:
            lines.append(f"mean {self.forces.mean():.4g}, brightest {self.top:.4g}")
        if self._last_line:
            lines.append(self._last_line)
        return lines

    def text(self, now_s: float) -> str:
        """Figures of the last frame."""
        elapsed_s = now_s - self._begin_s
        since = f"{elapsed_s:.0f} s: "
        forces = self.forces
        if forces is None:
            return f"{since}no frame yet"
        # The rate is that of the last seconds.
        while self._times and self._times[0] < now_s - RATE_S:
            self._times.popleft()
        span_s = min(RATE_S, max(elapsed_s, 1e-3))
        rate_hz = len(self._times) / span_s
        extent = self._extent(forces.min(), forces.max())
        return self._line(f"{since}{rate_hz:.1f} Hz", f"frame {self.n_frames}", extent)

    def summary(self) -> str:
        """Figures of all frames, in one line."""
        name = printable(self._source.name)
        if not self.n_frames:
            return self._line(f"{name}: no frame came")
        extent = self._extent(self.lowest, self.highest)
        return self._line(f"{name}: {self.n_frames} frames", extent)

    def _extent(self, low: float, high: float) -> str:
        return f"min {low:.4g}, max {high:.4g} {printable(self._source.skin.unit)}"


def _picture(view: View, now_s: float, size: os.terminal_size) -> str:
    """All that is shown, as it is written to a terminal of a size."""
    # The map has the room that the lines of text leave.
    head = [line[: size.columns - 1] for line in view.head(now_s)]
    lines = head[: max(1, size.lines - 1)]
    room = size.lines - len(lines) - 1
    if view.forces is not None and room > 0:
        coloured = "NO_COLOR" not in os.environ
        lines += heat_map(view.forces, view.top, size.columns - 1, room, coloured)
    # Each line is written over the one before it, and the rest of the screen is cleared.
    written = [f"{line}\x1b[K\n" for line in lines]
    return "".join(["\x1b[H", *written, "\x1b[J"])
