"""Where the nodes and links of a graph are drawn: ranks from left to right, links between them."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

from sparseskin.messages.topics import split_topic

from .launchspec import LaunchFile

CHAR = 6.6
"""Width of a character of a label or box, in pixels, at 11 px."""
LINE = 15.0
BOX_H, LANE_H, GAP_Y = 58.0, 18.0, 26.0
PORT = 17.0
"""The least from one link to the next on a side of a box."""
RISE = 4.0
"""How far a label stands above its link: with its letters it is lower than the next port."""
PAD = 14.0
BEND, BEND_PER_RISE = 70.0, 0.35
"""Room for links to change their height: the least, and the part of the most they rise by."""
MARGIN = 24.0
SWEEPS = 4
_TELLING = {"sensor": "source", "reconstructor": "preset", "player": "file", "recorder": "out"}


@dataclass(frozen=True)
class Box:
    """A node: its upper left corner, size, lines of text, and the number of its host."""

    x: float
    y: float
    width: float
    height: float
    lines: tuple[str, ...]
    host: int


@dataclass(frozen=True)
class Curve:
    """A link: its points, joined by curves that leave and arrive level; its last is an arrow. The
    label begins at the writer, on the first piece, which is level as those of all links are there:
    none runs through the label of another.
    """

    points: tuple[tuple[float, float], ...]
    label: str
    label_start: tuple[float, float]


@dataclass(frozen=True)
class Layout:
    """A drawing, in pixels, y downwards."""

    width: float
    height: float
    title: str
    boxes: tuple[Box, ...]
    curves: tuple[Curve, ...]
    hosts: tuple[str, ...]


@dataclass(eq=False)
class _Slot:
    """A place in a rank: of a node, or of a link that passes by."""

    name: str
    rank: int
    height: float
    width: float
    y: float = 0.0


def layout_of(launch: LaunchFile) -> Layout:
    """Lay out the nodes of all hosts of a graph.

    A node's rank is one more than the highest of those it reads. A link that passes by a rank has
    a slot there as a node has, so that no link crosses a box.
    """
    nodes = {**launch.nodes, **launch.elsewhere}
    texts = {name: _lines(launch, name) for name in nodes}
    ranks = _ranks(list(nodes), [(link.writer, link.reader) for link in launch.links])
    slots = {
        name: _Slot(name, rank, _height(launch, name), max(map(len, texts[name])) * CHAR + 2 * PAD)
        for name, rank in ranks.items()
    }
    columns: list[list[_Slot]] = [[] for _ in range(max(ranks.values(), default=0) + 1)]
    for slot in slots.values():
        columns[slot.rank].append(slot)
    ways: dict[tuple[str, str], list[_Slot]] = {}
    for pair in _topics(launch):
        ways[pair] = [slots[pair[0]], *_lanes(*pair, ranks, columns), slots[pair[1]]]
    _place(columns, list(ways.values()))
    labels = {pair: _label(topics) for pair, topics in _topics(launch).items()}
    lefts, bends = _columns_x(columns, ways, labels)
    boxes = tuple(
        Box(lefts[s.rank], s.y - s.height / 2, s.width, s.height, texts[s.name], _host(launch, s))
        for s in slots.values()
    )
    curves = tuple(
        _curve(pair, way, ways, labels[pair], lefts, bends) for pair, way in ways.items()
    )
    bottom = max((slot.y + slot.height / 2 for slot in _all(columns)), default=0.0)
    right = max((box.x + box.width for box in boxes), default=0.0)
    title = f"{launch.name}: {launch.description}" if launch.description else launch.name
    width = max(right + MARGIN, 2 * MARGIN + len(title) * CHAR)
    return Layout(width, bottom + MARGIN, title, boxes, curves, tuple(launch.hosts))


def _lines(launch: LaunchFile, name: str) -> tuple[str, ...]:
    """What stands in a node's box: its name, its type, its host, and what tells it from others."""
    spec = {**launch.nodes, **launch.elsewhere}[name]
    about = str(spec.values.get(_TELLING.get(spec.type_name, ""), ""))
    lines = [name, spec.type_name if spec.type_name != name else "", about[:40]]
    if spec.host:
        lines[1:] = [f"{spec.type_name} on {spec.host}", about[:40]]
    return tuple(filter(None, lines))


def _height(launch: LaunchFile, name: str) -> float:
    n_out = sum(name == writer for writer, _ in _topics(launch))
    n_in = sum(name == reader for _, reader in _topics(launch))
    return max(BOX_H, PORT * (max(n_out, n_in) + 1))


def _host(launch: LaunchFile, slot: _Slot) -> int:
    host = {**launch.nodes, **launch.elsewhere}[slot.name].host
    return list(launch.hosts).index(host) if host in launch.hosts else 0


def _topics(launch: LaunchFile) -> dict[tuple[str, str], list[str]]:
    """The topics from each writer to each reader, in the order of the links."""
    found: dict[tuple[str, str], list[str]] = {}
    for link in launch.links:
        found.setdefault((link.writer, link.reader), []).append(link.topic)
    return found


def _label(topics: Sequence[str]) -> str:
    """Topics of one patch, its name said once: "/skin/ taxels, truth"."""
    patches = {split_topic(topic)[0] for topic in topics}
    if len(patches) != 1:
        return ", ".join(topics)
    return f"/{patches.pop()}/ " + ", ".join(split_topic(topic)[1] for topic in topics)


def _ranks(names: Sequence[str], pairs: Sequence[tuple[str, str]]) -> dict[str, int]:
    ranks = dict.fromkeys(names, 0)
    for _ in names:  # a ring of nodes would rise for ever
        for writer, reader in pairs:
            ranks[reader] = min(max(ranks[reader], ranks[writer] + 1), len(names) - 1)
    return ranks


def _lanes(
    writer: str, reader: str, ranks: dict[str, int], columns: list[list[_Slot]]
) -> list[_Slot]:
    """Slots for a link in the ranks that it passes by."""
    lanes = []
    for rank in range(ranks[writer] + 1, ranks[reader]):
        lanes.append(_Slot(f"{writer}-{reader}", rank, LANE_H, 0.0))
        columns[rank].append(lanes[-1])
    return lanes


def _all(columns: list[list[_Slot]]) -> list[_Slot]:
    return [slot for column in columns for slot in column]


def _place(columns: list[list[_Slot]], ways: list[list[_Slot]]) -> None:
    """Order the slots of each rank by where their neighbours are, and give each its height."""
    beside: dict[_Slot, list[_Slot]] = {slot: [] for slot in _all(columns)}
    for way in ways:
        for a, b in itertools.pairwise(way):
            beside[a].append(b)
            beside[b].append(a)
    for column in columns:
        _stack(column)
    tallest = max((sum(s.height + GAP_Y for s in column) for column in columns), default=0.0)
    for sweep in range(SWEEPS):
        for column in columns if sweep % 2 == 0 else columns[::-1]:
            column.sort(key=lambda slot: _mean_y(slot, beside[slot]))
            _stack(column)
    top = 2 * MARGIN + LINE
    for column in columns:
        for slot in column:
            slot.y += top + tallest / 2


def _mean_y(slot: _Slot, others: list[_Slot]) -> float:
    return sum(other.y for other in others) / len(others) if others else slot.y


def _stack(column: list[_Slot]) -> None:
    y = 0.0
    total = sum(slot.height + GAP_Y for slot in column)
    for slot in column:
        slot.y = y + slot.height / 2 - total / 2
        y += slot.height + GAP_Y


def _columns_x(
    columns: list[list[_Slot]],
    ways: dict[tuple[str, str], list[_Slot]],
    labels: dict[tuple[str, str], str],
) -> tuple[list[float], list[float]]:
    """Of each rank, where its boxes begin, and where its links begin to bend: behind the widest
    box and the longest label.
    """
    lefts, bends, x = [], [], MARGIN
    for rank, column in enumerate(columns):
        longest = max((len(labels[p]) for p, way in ways.items() if way[0].rank == rank), default=0)
        lefts.append(x)
        bends.append(x + max((s.width for s in column), default=0.0) + longest * CHAR + 2 * PAD)
        rises = (
            abs(a.y - b.y)
            for way in ways.values()
            for a, b in itertools.pairwise(way)
            if a.rank == rank
        )
        x = bends[-1] + max(BEND, BEND_PER_RISE * max(rises, default=0.0)) + PAD
    return lefts, bends


def _curve(
    pair: tuple[str, str],
    way: list[_Slot],
    ways: dict[tuple[str, str], list[_Slot]],
    label: str,
    lefts: list[float],
    bends: list[float],
) -> Curve:
    """A link from its own place on the writer's right side to its own on the reader's left."""
    out = sorted((w[1].y, p) for p, w in ways.items() if p[0] == pair[0])
    into = sorted((w[-2].y, p) for p, w in ways.items() if p[1] == pair[1])
    first, last = way[0], way[-1]
    y0 = _port(first, [p for _, p in out].index(pair), len(out))
    y1 = _port(last, [p for _, p in into].index(pair), len(into))
    x0 = lefts[first.rank] + first.width
    points = [(x0, y0), (bends[first.rank], y0)]
    for lane in way[1:-1]:
        points += [(lefts[lane.rank] - PAD, lane.y), (bends[lane.rank], lane.y)]
    points.append((lefts[last.rank], y1))
    return Curve(tuple(points), label, (x0 + PAD / 2, y0 - RISE))


def _port(slot: _Slot, k: int, n: int) -> float:
    return slot.y - slot.height / 2 + slot.height * (k + 1) / (n + 1)
