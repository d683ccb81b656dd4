"""The command `sparseskin sources`: what a sensor of this host can read."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Mapping
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from .options import show

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
    from sparseskin.messages.text import printable
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
    from sparseskin.messages.text import printable
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
