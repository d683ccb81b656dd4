"""The command `sparseskin sources`: what a sensor of this host can read."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator

from sparseskin.nodes.extensions import ADDRESSES, DRIVERS, failures, loaded, offered
from sparseskin.nodes.sensor.source import Listing
from sparseskin.nodes.sensor.sources import KINDS, find_kind

from .options import show


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `sources`."""
    parser.description = (
        "List what a sensor of this host can read. sparseskin scope SOURCE shows the frames of a "
        "source; a graph reads it with --set sensor.source=SOURCE."
    )
    parser.add_argument("--json", action="store_true", help="print the list")
    parser.set_defaults(run=_sources)


def _sources(arguments: argparse.Namespace) -> int:
    found = [listing for kind in KINDS for listing in find_kind(kind).listings()]
    found.append(Listing("drivers", "drivers of installed packages", drivers()))
    for kind, made in loaded(ADDRESSES).items():
        found += made.listings() if kind not in KINDS else ()
    document = {one.key: list(one.entries) for one in found}
    return show(arguments, "source-list", document, _lines(found))


def _lines(found: Iterable[Listing]) -> Iterator[str]:
    for one in found:
        yield one.title
        names = [entry.get("source") or entry["name"] for entry in one.entries]
        width = max(map(len, names), default=0)
        for name, entry in zip(names, one.entries, strict=True):
            yield f"  {name:<{width}}  {entry['about']}".rstrip()
        if not names:
            yield "  none"
    if absent := failures(ADDRESSES):
        yield absent.removeprefix("; ")


def drivers() -> list[dict[str, str]]:
    """Drivers that installed packages offer as entry points."""
    return [
        {
            "source": point.value,
            "about": f"{point.name}, of {point.dist.name}" if point.dist else point.name,
        }
        for point in offered(DRIVERS).values()
    ]
