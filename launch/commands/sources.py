"""The commands `sparseskin sources`, a list of what a sensor of this host can read, and `scope`,
the frames of a source live in the terminal, without a graph.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import sys
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.launch.attach.heat_map import heat_map
from sparseskin.launch.run.terminal import Terminal
from sparseskin.messages.text import printable
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.settings import SensorSettings
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ, Source
from sparseskin.nodes.sensor.sources import open_source

from .options import add_stated, naming_options, real, show, stated_values, whole

GROUP = "sparseskin.sources"
"""Group of entry points with which an installed package offers drivers, each "module:callable"."""
MAX_FILES = 20
"""Most recordings of the current folder that are listed; chosen."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sources`."""
    parser.description = (
        "List what a sensor of this host can read. sparseskin scope SOURCE shows the frames of a "
        "source; a graph reads it with --set sensor.source=SOURCE."
    )
    parser.add_argument("--json", action="store_true", help="print the list")
    parser.set_defaults(run=_sources)


def _sources(arguments: argparse.Namespace) -> int:
    document = {
        "scenes": scenes(),
        "points": scenes_on_points(),
        "layouts": layouts(),
        "files": recordings(Path()),
        "drivers": drivers(),
        "serial": serial_ports(),
        "can": [{"source": f"can:{name}", "about": "CAN interface"} for name in _channels()],
        "profiles": profiles(),
    }
    return show(arguments, "source-list", document, _lines(document))


TITLES = {
    "scenes": "scenes",
    "points": "scenes that press a skin of points: add --set sensor.points=LAYOUT",
    "layouts": "layouts: for sensor.points; or a file of places, .csv or an iCub's .txt",
    "files": "recordings in this folder",
    "drivers": "drivers of installed packages",
    "serial": "serial ports: add ?profile=NAME",
    "can": "CAN interfaces: add ?ids=FIRST-LAST&rows=R&cols=C",
    "profiles": "profiles of boards: for ?profile=NAME; or the path of a .toml file",
}


def _lines(document: Mapping[str, Any]) -> Iterator[str]:
    for key, title in TITLES.items():
        yield title
        entries = document[key]
        names = [entry.get("source") or entry["name"] for entry in entries]
        width = max(map(len, names), default=0)
        for name, entry in zip(names, entries, strict=True):
            yield f"  {name:<{width}}  {entry['about']}".rstrip()
        if not entries:
            yield "  none"
    yield "packets of a board on the network: udp:PORT?rows=R&cols=C"


def scenes() -> list[dict[str, str]]:
    """Scenes, and one line on each."""
    from sparseskin.nodes.sensor.scenes.scenes import SCENES

    return [{"source": f"scene:{name}", "about": _about(make)} for name, make in SCENES.items()]


def _about(make: Callable[[], object]) -> str:
    """The first line of a docstring, without its end."""
    about = (make.__doc__ or "").partition("\n")[0].rstrip(".").partition(":")[0]
    return about.removeprefix("Return ")


def scenes_on_points() -> list[dict[str, str]]:
    """Scenes on skins of points, and one line on each."""
    from sparseskin.nodes.sensor.layouts.scenes import SCENES

    return [{"source": f"scene:{name}", "about": scene.about()} for name, scene in SCENES.items()]


def layouts() -> list[dict[str, str]]:
    """Layouts that are computed, and one line on each."""
    from sparseskin.nodes.sensor.layouts.examples import EXAMPLES
    from sparseskin.nodes.sensor.layouts.files import EXAMPLE

    return [{"name": f"{EXAMPLE}{name}", "about": _about(make)} for name, make in EXAMPLES.items()]


def recordings(folder: Path) -> list[dict[str, str]]:
    """Recordings in a folder by their suffixes, the newest first, `MAX_FILES` at most."""
    from sparseskin.nodes.sensor.files.recorded import SUFFIXES

    paths = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES]
    files = sorted((p for p in paths if p.is_file()), key=lambda p: -p.stat().st_mtime_ns)
    return [
        {"source": f"file:{printable(path.name)}", "about": SUFFIXES[path.suffix.lower()]}
        for path in files[:MAX_FILES]
    ]


def drivers() -> list[dict[str, str]]:
    """Drivers that installed packages offer as entry points of the group `sparseskin.sources`."""
    return [
        {
            "source": point.value,
            "about": f"{point.name}, of {point.dist.name}" if point.dist else point.name,
        }
        for point in sorted(entry_points(group=GROUP))
    ]


def serial_ports() -> list[dict[str, str]]:
    """Serial ports: those that pyserial describes, or where it is not installed those in /dev."""
    from sparseskin.nodes.sensor.boards.serial_port import serial_devices

    try:
        from serial.tools.list_ports import comports
    except ImportError:
        missing = "pyserial is not installed: pip install 'sparseskin[serial]'"
        return [{"source": f"serial:{path}", "about": missing} for path in serial_devices()]
    known = {port.device: port.description for port in comports() if port.hwid != "n/a"}
    paths = {**dict.fromkeys(serial_devices(), ""), **known}
    return [
        {"source": f"serial:{path}", "about": "" if about == "n/a" else printable(about)}
        for path, about in sorted(paths.items())
    ]


def profiles() -> list[dict[str, str]]:
    """Profiles of boards that come with the package."""
    from sparseskin.nodes.sensor.boards.settings import PROFILES, profile_names, read_toml

    return [
        {"name": name, "about": str(read_toml(PROFILES / f"{name}.toml").get("about", ""))}
        for name in profile_names()
    ]


def _channels() -> list[str]:
    from sparseskin.nodes.sensor.boards.can_port import can_channels

    return can_channels()


WAIT_S = 0.05
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
KEYS = ("n_rows", "n_cols", "unit", "f_max")


def configure_scope(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `scope`."""
    parser.description = (
        "Show the frames of a source as they come, before anything else is configured: a map, the "
        "rate, least and largest reading, and what was dropped. q or Ctrl-C ends it. Where the "
        "output is no terminal, one line a second."
    )
    parser.add_argument("source", metavar="SOURCE", help="one of sparseskin sources")
    parser.add_argument("--frames", type=whole(1), metavar="N", help="end after so many frames")
    parser.add_argument("--seconds", type=real(True), metavar="S", help="end after so long")
    add_stated(parser, f"state what the source does not: {', '.join(KEYS)}")
    parser.set_defaults(run=_scope)


def _scope(arguments: argparse.Namespace) -> int:
    source = open_source(arguments.source, seed=0, **_stated(arguments.set))
    view = View(source)
    terminal = Terminal()
    lively = sys.stdout.isatty() and os.environ.get("TERM") != "dumb"
    end_s = None if arguments.seconds is None else time.monotonic() + arguments.seconds
    next_s, drawn = time.monotonic(), False
    interrupted = False

    def interrupt(*_: object) -> None:
        nonlocal interrupted
        interrupted = True

    before = [signal.signal(one, interrupt) for one in (signal.SIGINT, signal.SIGTERM)]
    try:
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
                if now_s >= next_s and (lively or drawn):
                    size = shutil.get_terminal_size()
                    text = _picture(view, now_s, size) if lively else view.text(now_s)
                    print(text, end="" if lively else "\n", flush=True)
                if now_s >= next_s:
                    next_s, drawn = now_s + (DRAW_S if lively else TEXT_S), True
                ended = view.n_frames == arguments.frames or (end_s and now_s >= end_s)
                if ended or interrupted or "q" in terminal.pressed():
                    break
    finally:
        if lively:
            sys.stdout.write("\x1b[0m\x1b[?25h\x1b[?1049l")
        for one, handler in zip((signal.SIGINT, signal.SIGTERM), before, strict=True):
            signal.signal(one, handler)
        source.close()
    print(view.summary())
    return 0 if view.n_frames else 1


def _stated(words: list[str]) -> dict[str, Any]:
    """Properties of a source from KEY=VALUE."""
    entries = [entry for entry in SensorSettings.described() if entry["key"] in KEYS]
    values = stated_values(words, entries)
    with naming_options({key: f"--set {key}" for key in KEYS}):
        SensorSettings.from_mapping(values)  # checks types and ranges
    return values


def _frames(source: Source) -> Iterator[Floats | None]:
    """Frames in the time of the source, None while there is none."""
    if source.arrives:
        while True:
            frame = source.next_frame(WAIT_S)
            yield None if frame is None else frame[1]
    period_s = 1 / (source.rate_hz or DEFAULT_RATE_HZ)
    paced = source.n_frames is not None  # a driver has its own pace
    begin_s = time.monotonic()
    for k, (_, forces) in enumerate(source):
        while paced and (left_s := begin_s + k * period_s - time.monotonic()) > 0:
            time.sleep(min(left_s, WAIT_S))
            if left_s > WAIT_S:
                yield None
        yield forces


class View:
    """What is shown of a source: the last frame and its figures."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self.n_frames = 0
        self.forces: Floats | None = None
        self.lowest, self.highest = np.inf, -np.inf
        self._times: deque[float] = deque()
        self._begin_s = time.monotonic()
        self._peak, self._peak_s = 0.0, self._begin_s
        self._last_line = ""

    def add(self, forces: Floats, now_s: float) -> None:
        """Add a frame."""
        self.forces = forces
        self.n_frames += 1
        self._times.append(now_s)
        low, high = float(forces.min()), float(forces.max())
        self.lowest, self.highest = min(self.lowest, low), max(self.highest, high)
        self._peak = max(high, self._peak * float(np.exp((self._peak_s - now_s) / PEAK_S)))
        self._peak_s = now_s

    def take_lines(self) -> list[str]:
        """Lines that the source has logged since the last call."""
        found = [printable(line) for line in self._source.take_lines()]
        self._last_line = found[-1] if found else self._last_line
        return found

    @property
    def top(self) -> float:
        """Reading of the brightest colour."""
        return max(self._peak, LEAST_TOP * self._source.skin.f_max)

    def rate_hz(self, now_s: float) -> float:
        """Frames a second of late."""
        span_s = min(RATE_S, max(now_s - self._begin_s, 1e-3))
        while self._times and self._times[0] < now_s - RATE_S:
            self._times.popleft()
        return len(self._times) / span_s

    def dropped(self) -> str:
        """What was dropped, in words; "" of a source that drops nothing."""
        dropped = self._source.dropped()
        return "" if dropped is None else f"dropped: {dropped or 'nothing'}"

    def head(self, now_s: float) -> list[str]:
        """Name, figures, what was dropped, and the last line of the source."""
        skin, forces = self._source.skin, self.forces
        self.take_lines()
        lines = [
            f"{printable(self._source.name)}   {skin.n_rows} x {skin.n_cols} taxels, "
            f"0..{skin.f_max:g} {printable(skin.unit)}   (q: quit)"
        ]
        if forces is None:
            lines.append("no frame yet")
        else:
            lines.append(
                f"{self.rate_hz(now_s):.1f} Hz   frame {self.n_frames}   min {forces.min():.4g}   "
                f"max {forces.max():.4g}   mean {forces.mean():.4g}   brightest {self.top:.4g}"
            )
        return [*lines, *filter(None, (self.dropped(), self._last_line))]

    def text(self, now_s: float) -> str:
        """Figures in one line."""
        forces = self.forces
        since_s = now_s - self._begin_s
        if forces is None:
            return f"{since_s:.0f} s: no frame yet"
        parts = [
            f"{since_s:.0f} s: {self.rate_hz(now_s):.1f} Hz",
            f"frame {self.n_frames}",
            f"min {forces.min():.4g}, max {forces.max():.4g} {printable(self._source.skin.unit)}",
            self.dropped(),
        ]
        return "; ".join(filter(None, parts))

    def summary(self) -> str:
        """Figures of all frames, in one line."""
        name = printable(self._source.name)
        if not self.n_frames:
            return "; ".join(filter(None, (f"{name}: no frame came", self.dropped())))
        parts = [
            f"{name}: {self.n_frames} frames",
            f"min {self.lowest:.4g}, max {self.highest:.4g} {printable(self._source.skin.unit)}",
            self.dropped(),
        ]
        return "; ".join(filter(None, parts))


def _picture(view: View, now_s: float, size: os.terminal_size) -> str:
    """All that is shown, as it is written to a terminal of a size."""
    head = [line[: size.columns - 1] for line in view.head(now_s)]
    lines = head[: max(1, size.lines - 1)]
    room = size.lines - len(lines) - 1
    if view.forces is not None and room > 0:
        coloured = "NO_COLOR" not in os.environ
        lines += heat_map(view.forces, view.top, size.columns - 1, room, coloured)
    # Each line is written over the one before it, and the rest of the screen is cleared.
    return "\x1b[H" + "".join(f"{line}\x1b[K\n" for line in lines) + "\x1b[J"
