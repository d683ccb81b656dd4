"""Export of a bag to .csv: one file a topic, one frame a line, and a file of stamps."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import whole_folder
from sparseskin.nodes.recorder.bag.frames import frame_topics, frames
from sparseskin.nodes.recorder.bag.reader import BagReader

STAMPS = "stamps.csv"


def export_csv(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder `out` with PATCH_SCHEMA.csv for each topic, and stamps.csv; their paths.

    Each line of PATCH_SCHEMA.csv is a frame, row after row, in the shortest decimals that give
    the same float32 again; the sensor's `file:` source reads it, with n_rows, n_cols and unit
    given. stamps.csv lists topic, frame (from 0) and stamp_ns, below a line with these names.

    Raises BagError if the bag has no such frames, OutputError if the folder exists or cannot be
    written.
    """
    wanted = frame_topics(bag, topics)
    paths = {topic: out / f"{'_'.join(split_topic(topic))}.csv" for topic in wanted}
    with whole_folder(out), ExitStack() as stack:

        def create(path: Path) -> TextIO:
            return stack.enter_context(open(path, "x", encoding="ascii"))

        files = {topic: create(path) for topic, path in paths.items()}
        stamps = create(out / STAMPS)
        stamps.write("topic,frame,stamp_ns\n")
        n_lines = dict.fromkeys(wanted, 0)
        for frame in frames(bag, wanted, "export"):
            topic = frame.message.topic
            files[topic].write(",".join(frame.array.ravel().astype(str).tolist()) + "\n")
            stamps.write(f"{topic},{n_lines[topic]},{frame.message.stamp_ns}\n")
            n_lines[topic] += 1
    return [*paths.values(), out / STAMPS]
