"""Export of a bag to .csv: a file a topic, a frame a line, below its description and a header."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Measurements, Message, Reconstruction, SkinState
from sparseskin.messages.fields import Array
from sparseskin.messages.frames import kinds_alone, values_alone
from sparseskin.messages.topics import split_topic, topic_of
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.frames import (
    STATES,
    last_states,
    patch_of,
    stream_topics,
    streams,
    values_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader

STAMPS = "stamps.csv"
_SD = "sd"


def export_csv(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with PATCH_SCHEMA.csv for each topic, and stamps.csv; their paths.

    Each PATCH_SCHEMA.csv has, below lines that begin with `#`, a header line with the names of
    its columns, and then a frame a line: `stamp_ns`, the figures of the message, and the taxels
    r0c0, r0c1, ... row after row (or the measurements y0, y1, ...), in the shortest decimals that
    give the same float32 again. The second line is a comment with the states of the patch as JSON:
    shape, range, unit, pitch, mask, calibration, Phi, solver. Of a skin of points, a third one has
    the row of the points file that each column is of. Standard deviations are in
    PATCH_reconstruction_sd.csv. stamps.csv lists topic, frame (from 0) and stamp_ns, below a line
    with these names.

    Raises BagError if the bag has no such frames, OutputError if the folder exists or cannot be
    written.
    """
    wanted = stream_topics(bag, topics)
    states = last_states(bag, wanted)
    longest: dict[str, int] = {}
    for message, _ in streams(bag, [t for t in wanted if _is_measured(bag, t)], "measure"):
        longest[message.topic] = max(longest.get(message.topic, 0), len(_cells(message)))
    files: dict[Path, TextIO] = {}
    with whole_folder(out), ExitStack() as stack:

        def writer(topic: str, suffix: str, names: Iterable[str]) -> TextIO:
            path = out / f"{'_'.join(split_topic(topic))}{suffix}.csv"
            if path not in files:
                files[path] = stack.enter_context(open(path, "x", encoding="ascii"))
                files[path].write(_head(topic, suffix, states, names))
            return files[path]

        stamps = stack.enter_context(open(out / STAMPS, "x", encoding="ascii"))
        stamps.write("topic,frame,stamp_ns\n")
        n_lines = dict.fromkeys(wanted, 0)
        for message, _ in streams(bag, wanted, "export"):
            topic, cells = message.topic, _cells(message)
            figures = _figures(message)
            columns = [*figures, *_cell_names(cells, longest.get(topic, 0))]
            writer(topic, "", columns).write(_line([*figures.values(), *_texts(cells)]))
            sd = values_alone(message).get(_SD)
            if isinstance(message, Reconstruction) and sd is not None:
                columns = ["stamp_ns", *_cell_names(sd, 0)]
                writer(topic, f"_{_SD}", columns).write(_line([message.stamp_ns, *_texts(sd)]))
            stamps.write(f"{topic},{n_lines[topic]},{message.stamp_ns}\n")
            n_lines[topic] += 1
    return [*files, out / STAMPS]


def _is_measured(bag: BagReader, topic: str) -> bool:
    return bag.topics[topic].schema == Measurements.schema


def _head(
    topic: str, suffix: str, states: Mapping[str, dict[str, Any]], names: Iterable[str]
) -> str:
    """Comments with the description, and the header line."""
    patch = patch_of(topic)
    described = {
        schema: states[topic_of(patch, schema)]
        for schema in (cls.schema for cls in STATES)
        if topic_of(patch, schema) in states
    }
    columns = list(names)
    rows = _point_rows(described.get(SkinState.schema, {}), columns)
    title = f"# sparseskin frames of {topic}{suffix}\n# {json.dumps(described)}\n"
    return f"{title}{rows}{','.join(columns)}\n"


def _point_rows(skin: Mapping[str, Any], columns: list[str]) -> str:
    """Comment with the row of the file of points in each column of a taxel; "" without one."""
    rows = skin.get("point_rows")
    if rows is None or "r0c0" not in columns:
        return ""
    cells = columns[columns.index("r0c0") :]
    exists = "".join(skin["mask"] or ["1" * len(cells)])
    left = iter(rows)
    found = [str(next(left)) if one == "1" else "" for one in exists]
    before = [""] * (len(columns) - len(cells) - 1)
    return ",".join(["# point_rows", *before, *found]) + "\n"


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


def _cells(message: Message) -> npt.NDArray[np.float32]:
    values = values_of(message)
    return np.empty(0, np.float32) if values is None else np.asarray(values)


def _cell_names(cells: npt.NDArray[np.float32], longest: int) -> list[str]:
    if cells.ndim == 2:
        return [f"r{row}c{col}" for row in range(cells.shape[0]) for col in range(cells.shape[1])]
    return [f"y{k}" for k in range(longest)]


def _texts(cells: npt.NDArray[np.float32]) -> list[str]:
    texts: list[str] = cells.ravel().astype(str).tolist()
    return texts


def _line(values: Iterable[Any]) -> str:
    texts = ("" if value is None else str(value).replace(",", ";") for value in values)
    return ",".join(texts) + "\n"
