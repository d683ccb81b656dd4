"""Export of a bag to .csv: a file a topic, a frame a line, below its description and a header."""

import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from sparseskin.messages import Contacts, Measurements, Message
from sparseskin.messages.arrays import Floats
from sparseskin.messages.fields import Array
from sparseskin.messages.frames import kinds_alone, values_alone
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

_NO_CELLS: Floats = np.empty(0, np.float32)


def export_csv(
    bag: BagReader, out: Path, topics: Iterable[str] | None = None
) -> list[Path]:
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
    topics = stream_topics(bag, topics)
    states = last_states(bag, topics)

    # A header needs the most measurements of a message, so these are counted first.
    n_measurements: dict[str, int] = {}
    measured = [t for t in topics if bag.topics[t].schema == Measurements.schema]
    for message, _ in streams(bag, measured, "measure"):
        longest = n_measurements.get(message.topic, 0)
        n_measurements[message.topic] = max(longest, len(_cells(message)))

    with whole_folder(out), ExitStack() as stack:
        tables = _Tables(out, stack, states, n_measurements)
        for message, _ in streams(bag, topics, "export"):
            if isinstance(message, Contacts):
                for row in _contacts(message):
                    tables.write(message.topic, "", row)
                for row in _events(message):
                    tables.write(message.topic, "_events", row)
                continue
            tables.write(message.topic, "", _figures(message), _cells(message))
            # In a file of its own: as wide as the forces.
            sd = values_alone(message).get("sd")
            if sd is not None:
                tables.write(message.topic, "_sd", {"stamp_ns": message.stamp_ns}, sd)
    return list(tables.files)


class _Tables:
    """The files of an export, each opened at its first line.

    `states` are those of the patches by topic, `n_measurements` the most measurements of a message
    on each topic.
    """

    def __init__(
        self,
        folder: Path,
        stack: ExitStack,
        states: Mapping[str, dict[str, Any]],
        n_measurements: Mapping[str, int],
    ) -> None:
        self.files: dict[Path, TextIO] = {}
        self._folder = folder
        self._stack = stack
        self._states = states
        self._n_measurements = n_measurements

    def write(
        self,
        topic: str,
        suffix: str,
        figures: Mapping[str, Any],
        cells: Floats = _NO_CELLS,
    ) -> None:
        """Write a line of figures by the names of their columns, and of the cells of a frame."""
        patch, schema = split_topic(topic)
        path = self._folder / f"{patch}_{schema}{suffix}.csv"
        if path not in self.files:
            file = open(path, "x", encoding="ascii")  # noqa: SIM115 - the stack closes it
            self.files[path] = self._stack.enter_context(file)
            cell_names = _cell_names(cells, self._n_measurements.get(topic, 0))
            names = ",".join([*figures, *cell_names])
            states = json.dumps(self._states_of(patch))
            title = f"# sparseskin frames of {topic}{suffix}"
            self.files[path].write(f"{title}\n# {states}\n{names}\n")

        # Of float32 as text: the shortest decimals that give the same number again.
        texts = [_text(value) for value in figures.values()]
        texts += cells.ravel().astype(str).tolist()
        self.files[path].write(",".join(texts) + "\n")

    def _states_of(self, patch: str) -> dict[str, Any]:
        """The states of a patch by their schemas."""
        by_schema = {}
        for topic, state in self._states.items():
            if patch_of(topic) == patch:
                by_schema[split_topic(topic)[1]] = state
        return by_schema


def _text(value: object) -> str:
    """A figure as a cell of a table: a comma would begin another one."""
    return "" if value is None else str(value).replace(",", ";")


def _contacts(message: Contacts) -> list[dict[str, Any]]:
    # Converted by column, which is much faster than by cell.
    columns = message.columns()
    texts = [column.astype(str).tolist() for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*texts, strict=True)]


def _events(message: Contacts) -> list[dict[str, Any]]:
    return [
        {
            "stamp_ns": message.stamp_ns,
            "id": number,
            "event": event,
        }
        for number, event in message.named_events
    ]


def _figures(message: Message) -> dict[str, Any]:
    """All fields but arrays and the publisher's run; the bits of rows and tree as hexadecimals."""
    figures: dict[str, Any] = {"stamp_ns": message.stamp_ns}
    values = values_alone(message)
    for name, kind in kinds_alone(type(message)).items():
        value = values[name]
        if isinstance(kind, Array):
            # Forces and measurements are the cells of the line.
            if name in ("places", "nodes") and value is not None:
                figures[name] = value.tobytes().hex()
        elif name not in ("patch", "run_id", "stamp_ns"):
            figures[name] = value
    return figures


def _cells(message: Message) -> Floats:
    values = values_of(message)
    return _NO_CELLS if values is None else np.asarray(values)


def _cell_names(cells: Floats, longest: int) -> list[str]:
    if cells.ndim == 2:
        return [f"r{row}c{col}" for row, col in np.ndindex(cells.shape)]
    return [f"y{k}" for k in range(longest)]
