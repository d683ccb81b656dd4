"""Bags made of other files: recordings in other formats, and broken bags."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from sparseskin.messages import MessageError, SkinState, Taxels
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import progress
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter, removing
from sparseskin.nodes.recorder.node import metadata_of
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import EMPTY, Layout
from sparseskin.nodes.sensor.source import DEFAULT_RATE_HZ

_RUN_ID_BYTES = 8


def import_file(
    source: Path,
    out: Path,
    *,
    patch: str = "skin",
    layout: Layout = EMPTY,
    log: Callable[[str], None] = lambda _: None,
) -> int:
    """Write a recording, in any format that the sensor reads, as a bag.

    The bag holds what a sensor would have published from the file: /PATCH/skin, then
    /PATCH/taxels, with stamps from 0. The run id is a hash of the frames, so the same file gives
    the same bag.

    `layout` is what the file does not state. `log` is called with lines on how the file was read,
    on what was assumed, and on readings that were not valid. Returns the number of frames.

    Raises SourceError if the recording is missing or malformed or a setting contradicts it,
    BagError if the bag exists or cannot be written.
    """
    frames = open_file(source, layout)
    for line in frames.take_lines():
        log(line)
    content = hashlib.blake2b(digest_size=_RUN_ID_BYTES)
    for _, part in frames.blocks():
        content.update(part.tobytes())
    run_id = content.hexdigest()
    try:
        state = SkinState(
            stamp_ns=0,
            patch=patch,
            **vars(frames.skin),
            source=frames.name,
            seed=0,
            rate_hz=frames.rate_hz if frames.rate_hz is not None else DEFAULT_RATE_HZ,
            has_truth=False,
            sigma_mid=0.0,
            sigma_end=0.0,
            f_min=frames.f_min,
        )
    except MessageError as error:
        raise BagError(f"{str(source)!r}: {error}") from error
    metadata = metadata_of(launch="", graph="") | {"imported_from": source.name}
    with _whole_bag(out, metadata, {"lost": {}}) as bag:
        bag.record(state.published(run_id, 0), 0)
        total = frames.n_frames or 0
        for stamp_ns, forces, missing in progress(frames.filled(), total, "import"):
            taxels = Taxels(stamp_ns=stamp_ns, patch=patch, forces=forces, missing=missing)
            bag.record(taxels.published(run_id, bag.n_messages - 1), stamp_ns)
    return bag.n_messages - 1


def recover_bag(bag: BagReader, out: Path) -> int:
    """Copy every readable message and the metadata of a broken bag into a new bag.

    The new metadata have the entry "recovered", a line on the damage. Returns the number of
    messages. Raises BagError if the new bag exists or cannot be written.
    """
    metadata = dict(bag.metadata)
    if bag.recovered:
        metadata["recovered"] = bag.recovered
    total = sum(info.n_messages for info in bag.topics.values())
    with _whole_bag(out, metadata, bag.counts) as new:
        for message in progress(bag.messages(), total, "recover"):
            new.write(message)
    return new.n_messages


@contextmanager
def _whole_bag(
    out: Path, metadata: Mapping[str, str], counts: Mapping[str, Any] | None
) -> Iterator[BagWriter]:
    """Yield a bag to write into; if an exception is raised it is removed, as its source remains."""
    with removing(out, out):
        writer = BagWriter(out, metadata)
        try:
            yield writer
            writer.close(counts)
        except BaseException:
            writer.discard()
            raise
