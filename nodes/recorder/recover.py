"""What can be read of a broken bag, as a whole bag."""

from __future__ import annotations

from pathlib import Path

from .bag_frames import progress
from .bag_reader import BagReader
from .bag_writer import BagWriter


def recover_bag(bag: BagReader, out: Path) -> int:
    """Copy every message that survived, with the metadata, into a new bag.

    Its metadata say under "recovered" what happened to the one it comes from.

    Returns
    -------
    int
        How many messages it holds.

    Raises
    ------
    BagError
        If the new bag exists or cannot be written.
    """
    metadata = dict(bag.metadata)
    if bag.recovered:
        metadata["recovered"] = bag.recovered
    writer = BagWriter(out, metadata)
    try:
        total = sum(info.n_messages for info in bag.topics.values())
        for channel, message in progress(bag.records(), total, "recover"):
            writer.write(
                message.topic,
                message.payload,
                schema=channel.schema,
                version=channel.version,
                log_time_ns=message.log_time_ns,
                stamp_ns=message.stamp_ns,
            )
        writer.close(bag.counts)
    except BaseException:
        writer.discard()
        raise
    return writer.n_messages
