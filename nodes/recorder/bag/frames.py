"""Decoded frames of a bag, and the skins they belong to."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from tqdm import tqdm

from sparseskin.messages import (
    Contacts,
    End,
    Measurements,
    Message,
    MessageError,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    decode,
)
from sparseskin.messages.base import wire_fields
from sparseskin.messages.frames import known_forces
from sparseskin.messages.topics import split_topic, topic_of
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.numerics.arrays import Floats, mask_texts

from .format import BagError, BagMessage
from .reader import BagReader

FRAMES = (Taxels, Truth, Measurements, Reconstruction)
FRAME_SCHEMAS = tuple(cls.schema for cls in FRAMES)
STREAM_SCHEMAS = (*FRAME_SCHEMAS, Contacts.schema)
STATES = tuple(cls for cls in SCHEMAS.values() if cls.latched)


def array_names(schema: str) -> tuple[str, str]:
    """Names of the array that holds a schema's frames, and of that of their stamps."""
    if schema == Taxels.schema:
        return "forces", "stamp_ns"
    return schema, f"{schema}_stamp_ns"


def frame_topics(
    bag: BagReader,
    topics: Iterable[str] | None,
    schemas: tuple[str, ...] = FRAME_SCHEMAS,
) -> list[str]:
    """Names of the topics with frames: all of them, or those requested.

    Raises BagError if there is none, or if a requested topic is missing or holds no frames.
    """
    requested = list(bag.topics if topics is None else dict.fromkeys(topics))
    bag.messages(requested)  # refuses a topic that the bag does not hold
    # Of all topics of a bag, those without frames are left out; one that is asked for is refused.
    if topics is not None:
        for topic in requested:
            if bag.topics[topic].schema not in schemas:
                raise BagError(
                    f"{bag.path}: topic {topic} holds no frames; allowed are topics of "
                    f"{', '.join(schemas)}"
                )

    with_frames = []
    for topic in requested:
        info = bag.topics[topic]
        # Of a topic that ended before its first frame, there is the end alone.
        if info.schema in schemas and info.n_messages:
            with_frames.append(topic)
    if not with_frames:
        raise BagError(f"{bag.path}: holds no frames to export")
    return with_frames


def stream_topics(bag: BagReader, topics: Iterable[str] | None) -> list[str]:
    """As `frame_topics`, contacts included."""
    return frame_topics(bag, topics, STREAM_SCHEMAS)


def with_states(bag: BagReader, topics: Iterable[str]) -> list[str]:
    """Topics, and those of the states (skin, calibration, Phi, solver) of their patches."""
    # Each once, in the order of the topics.
    names = list(topics)
    for patch in [patch_of(topic) for topic in names]:
        for cls in STATES:
            state = topic_of(patch, cls.schema)
            if state in bag.topics and bag.topics[state].n_messages:
                names.append(state)
    return list(dict.fromkeys(names))


def last_messages(bag: BagReader, topics: Iterable[str]) -> dict[str, Message]:
    """The last message on each of some topics that the bag holds; raises as `decoded`."""
    # Messages of a topic come in the order of recording: the last one stays.
    in_bag = [topic for topic in topics if topic in bag.topics]
    newest = {recorded.topic: recorded for recorded in bag.messages(in_bag)}
    return {topic: decoded(bag, recorded) for topic, recorded in newest.items()}


def last_states(bag: BagReader, topics: Iterable[str]) -> dict[str, dict[str, Any]]:
    """The last state of each kind of the patches of some topics, by topic: fields as JSON has
    them, a mask as rows of 0 and 1; raises as `decoded`.
    """
    states = [
        topic
        for topic in with_states(bag, topics)
        if bag.topics[topic].schema not in STREAM_SCHEMAS
    ]
    messages = last_messages(bag, states)
    return {topic: state_json(state) for topic, state in messages.items()}


def state_json(message: Message) -> dict[str, Any]:
    """Fields of a state as JSON has them, a mask as rows of 0 and 1."""
    values = {name: getattr(message, name) for name in wire_fields(type(message))}
    # Those of the publisher, not of the state.
    del values["run_id"]
    del values["seq"]
    mask = values.get("mask")
    if mask is not None:
        values["mask"] = mask_texts(mask)
    for name, value in values.items():
        if hasattr(value, "tolist"):
            values[name] = value.tolist()
    return values


def streams(
    bag: BagReader, topics: Iterable[str], doing: str
) -> Iterator[tuple[Message, int]]:
    """All messages on some topics in recorded order, each with its time of recording, without the
    ends of streams; with a progress bar; raises as `decoded`.
    """
    # The index knows the number of messages before any is read.
    topics = list(topics)
    total = sum(bag.topics[topic].n_messages for topic in topics)
    for recorded in progress(bag.messages(topics), total, doing):
        message = decoded(bag, recorded)
        if not isinstance(message, End):
            yield message, recorded.log_time_ns


def values_of(message: Message) -> Floats | None:
    """The forces of a frame of one patch, NaN where a reading is missing, or its measurements; None
    of another message.
    """
    if isinstance(message, Measurements):
        return np.asarray(message.y[0])
    if isinstance(message, Taxels | Truth | Reconstruction):
        return known_forces(message)
    return None


def decoded(bag: BagReader, recorded: BagMessage) -> Message:
    """Decode a recorded message; raises BagError if that fails."""
    try:
        return decode(recorded.topic.encode(), recorded.payload)
    except MessageError as error:
        raise BagError(
            f"{bag.path}: {recorded.topic}, stamp {recorded.stamp_ns}: {error}"
        ) from error


def skin_of(bag: BagReader, patch: str) -> SkinState | None:
    """The last recorded state of a patch's skin, None if there is none; raises as `decoded`."""
    topic = topic_of(patch, SkinState.schema)
    state = last_messages(bag, [topic]).get(topic)
    return state if isinstance(state, SkinState) else None


def patch_of(topic: str) -> str:
    """The patch of a topic."""
    return split_topic(topic)[0]


def patch_topics(bag: BagReader, patch: str | None) -> tuple[str, list[str]]:
    """The stated patch of a bag, or the only one, and its topics with frames. Raises BagError if
    there is none, or several, and none is stated.
    """
    topics = frame_topics(bag, None)
    patches = sorted({patch_of(topic) for topic in topics})
    names = ", ".join(patches)
    if patch is None and len(patches) > 1:
        raise BagError(f"{bag.path}: has patches {names}: state one of them")
    patch = patch or patches[0]
    of_patch = [topic for topic in topics if patch_of(topic) == patch]
    if not of_patch:
        raise BagError(f"{bag.path}: has no patch {patch!r} (it has {names})")
    return patch, of_patch


def progress(items: Iterable[Any], total: int, doing: str) -> Iterator[Any]:
    """Yield the items, with a progress bar on stderr if that is a terminal."""
    # disable=None: no bar unless stderr is a terminal.
    yield from tqdm(
        items,
        total=total,
        desc=doing,
        unit="msg",
        disable=None,
        leave=False,
    )
