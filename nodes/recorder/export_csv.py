"""A bag as .csv: numbers, one frame a line, one file a topic, and their stamps."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import TextIO

from sparseskin.messages.topics import split_topic

from .bag_frames import frame_topics, frames
from .bag_reader import BagReader
from .output import new_folder, os_errors

STAMPS = "stamps.csv"


def export_csv(bag: BagReader, out: Path, topics: Iterable[str] | None = None) -> list[Path]:
    """Write a folder with PATCH_SCHEMA.csv for each topic, and stamps.csv.

    Each line of PATCH_SCHEMA.csv is a frame, row after row, in the shortest decimals that give
    the same float32 again: what the sensor's `file:` source reads with n_rows, n_cols and unit
    stated. stamps.csv lists topic, frame (from 0) and stamp_ns, below a line with these names.

    Parameters
    ----------
    out : Path
        The folder; it must not exist.
    topics : iterable of str, optional
        Only these topics.

    Returns
    -------
    list of Path
        The files written.

    Raises
    ------
    BagError
        If the bag has no such frames, or the folder exists or cannot be written.
    """
    wanted = frame_topics(bag, topics)
    paths = {topic: out / f"{'_'.join(split_topic(topic))}.csv" for topic in wanted}
    with new_folder(out), os_errors(out), ExitStack() as stack:

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
