"""Export of a bag to .csv: a file a topic, a frame a line, below its description and a header."""

from __future__ import annotations

import json
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from sparseskin.messages import Contacts, Measurements, Message
from sparseskin.messages.fields import Array
from sparseskin.messages.frames import Floats, kinds_alone, values_alone
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.frames import (
    last_states,
    patch_of,
    stream_topics,
    streams,
    values_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader


def export_csv(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with PATCH_SCHEMA.csv for each topic; their paths.

    Each file has, below lines that begin with `#`, a header line with the names of its columns, and
    then a frame a line: `stamp_ns`, the figures of the message, and the taxels r0c0, r0c1, ... row
    after row (or the measurements y0, y1, ...), in the shortest decimals that give the same float32
    again; nan where a reading is missing. The second line is a comment with the states of the patch
    as JSON: shape, range, unit, pitch, mask, points, calibration, Phi, solver. Standard deviations
    are in PATCH_reconstruction_sd.csv. PATCH_contacts.csv has a line a contact of each frame, by
    the columns of `Contacts`, PATCH_contacts_events.csv a line an event: `stamp_ns`, `id`, `event`.

    Raises BagError if the bag has no such frames, OutputError if the folder exists or cannot be
    written.
    """
    wanted = stream_topics(bag, topics)
    states = last_states(bag, wanted)
    longest: dict[str, int] = {}
    measured = [topic for topic in wanted if bag.topics[topic].schema == Measurements.schema]
    for message, _ in streams(bag, measured, "measure"):
        longest[message.topic] = max(longest.get(message.topic, 0), len(_cells(message)))
    files: dict[Path, TextIO] = {}
    with whole_folder(out), ExitStack() as stack:

        def write(topic: str, suffix: str, figures: dict[str, Any], cells: Floats) -> None:
            patch, schema = split_topic(topic)
            path = out / f"{patch}_{schema}{suffix}.csv"
            if path not in files:
                files[path] = stack.enter_context(open(path, "x", encoding="ascii"))
                ours = {t.rpartition("/")[2]: s for t, s in states.items() if patch_of(t) == patch}
                names = ",".join([*figures, *_cell_names(cells, longest.get(topic, 0))])
                title = f"# sparseskin frames of {topic}{suffix}"
                files[path].write(f"{title}\n# {json.dumps(ours)}\n{names}\n")
            values = [*figures.values(), *cells.ravel().astype(str).tolist()]
            texts = ("" if value is None else str(value).replace(",", ";") for value in values)
            files[path].write(",".join(texts) + "\n")

        for message, _ in streams(bag, wanted, "export"):
            if isinstance(message, Contacts):
                for suffix, rows in (("", _contacts(message)), ("_events", _events(message))):
                    for row in rows:
                        write(message.topic, suffix, row, np.empty(0, np.float32))
                continue
            write(message.topic, "", _figures(message), _cells(message))
            if (sd := values_alone(message).get("sd")) is not None:
                write(message.topic, "_sd", {"stamp_ns": message.stamp_ns}, sd)
    return list(files)


def _contacts(message: Contacts) -> list[dict[str, Any]]:
    columns = message.columns()
    cells = zip(*(column.astype(str).tolist() for column in columns.values()), strict=True)
    return [dict(zip(columns, row, strict=True)) for row in cells]


def _events(message: Contacts) -> list[dict[str, Any]]:
    return [
        {"stamp_ns": message.stamp_ns, "id": number, "event": event}
        for number, event in message.named_events
    ]


def _figures(message: Message) -> dict[str, Any]:
    """All fields but arrays and the publisher's run; the bits of rows and tree as hexadecimals."""
    found: dict[str, Any] = {"stamp_ns": message.stamp_ns}
    values = values_alone(message)
    for name, kind in kinds_alone(type(message)).items():
        value = values[name]
        if isinstance(kind, Array):
            if name in ("places", "nodes") and value is not None:
                found[name] = value.tobytes().hex()
        elif name not in ("patch", "run_id", "stamp_ns"):
            found[name] = value
    return found


def _cells(message: Message) -> Floats:
    values = values_of(message)
    return np.empty(0, np.float32) if values is None else np.asarray(values)


def _cell_names(cells: Floats, longest: int) -> list[str]:
    if cells.ndim == 2:
        return [f"r{row}c{col}" for row in range(cells.shape[0]) for col in range(cells.shape[1])]
    return [f"y{k}" for k in range(longest)]
