"""What every export needs of a bag: its decoded frames, and its skins."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from sparseskin.messages import (
    Measurements,
    Message,
    MessageError,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    decode,
)
from sparseskin.messages.topics import split_topic, topic_of

from .bag import BagError, BagMessage
from .bag_reader import BagReader

FRAMES = (Taxels, Truth, Measurements, Reconstruction)
FRAME_SCHEMAS = tuple(cls.schema for cls in FRAMES)


@dataclass(frozen=True)
class Frame:
    """One message with an array.

    Attributes
    ----------
    message : Message
        Taxels, Truth, Measurements or Reconstruction.
    log_time_ns : int
        When it was recorded.
    array : ndarray of float32, shape (n_rows, n_cols), or (M,) of measurements
        Its numbers, in the skin's unit.
    """

    message: Message
    log_time_ns: int
    array: npt.NDArray[np.float32]


def frame_topics(bag: BagReader, topics: Iterable[str] | None) -> list[str]:
    """The topics with frames, all of them or those asked for.

    Raises
    ------
    BagError
        If there is none, or one that is asked for is not there or holds no frames.
    """
    wanted = list(bag.topics) if topics is None else list(dict.fromkeys(topics))
    bag.messages(wanted)  # refuses a topic that the bag does not hold
    found = [topic for topic in wanted if bag.topics[topic].schema in FRAME_SCHEMAS]
    if topics is not None and found != wanted:
        other = next(topic for topic in wanted if topic not in found)
        raise BagError(
            f"{bag.path}: topic {other} holds no frames; allowed are topics of "
            f"{', '.join(FRAME_SCHEMAS)}"
        )
    found = [topic for topic in found if bag.topics[topic].n_messages]
    if not found:
        raise BagError(f"{bag.path}: holds no frames to export")
    return found


def frames(bag: BagReader, topics: Iterable[str], doing: str) -> Iterator[Frame]:
    """The frames on some topics in the order of recording; a bar shows how far, on a terminal.

    Raises
    ------
    BagError
        If a message cannot be decoded.
    """
    wanted = list(topics)
    total = sum(bag.topics[topic].n_messages for topic in wanted)
    for recorded in progress(bag.messages(wanted), total, doing):
        message = decoded(bag, recorded)
        if isinstance(message, Measurements):
            yield Frame(message, recorded.log_time_ns, message.y)
        elif isinstance(message, Taxels | Truth | Reconstruction):
            yield Frame(message, recorded.log_time_ns, message.forces)


def decoded(bag: BagReader, recorded: BagMessage) -> Message:
    """Decode a recorded message.

    Raises
    ------
    BagError
        If it cannot be decoded.
    """
    try:
        return decode(recorded.topic.encode(), recorded.payload)
    except MessageError as error:
        raise BagError(
            f"{bag.path}: {recorded.topic}, stamp {recorded.stamp_ns}: {error}"
        ) from error


def skin_of(bag: BagReader, patch: str) -> SkinState | None:
    """What the bag last says of a patch's skin; None where it says nothing.

    Raises
    ------
    BagError
        If the message cannot be decoded.
    """
    topic = topic_of(patch, SkinState.schema)
    state = None
    if topic in bag.topics:
        for recorded in bag.messages([topic]):
            message = decoded(bag, recorded)
            if isinstance(message, SkinState):
                state = message
    return state


def patch_of(topic: str) -> str:
    """The patch of a topic."""
    return split_topic(topic)[0]


def progress(items: Iterable[Any], total: int, doing: str) -> Iterator[Any]:
    """Pass items on; a bar on stderr shows how far, if that is a terminal."""
    # tqdm takes None for: only where it is a terminal.
    yield from tqdm(items, total=total, desc=doing, unit="msg", disable=None, leave=False)
