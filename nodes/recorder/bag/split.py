"""A bag of batches, messages of many equal patches, read as one of a topic for each patch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

from sparseskin.messages import End, Message, MessageError, decode, encode
from sparseskin.messages.batches import BATCHES, BatchMessage
from sparseskin.messages.frames import Floats
from sparseskin.messages.topics import split_topic, topic_of
from sparseskin.messages.wire import SCHEMAS

from .format import BagError, BagMessage, TopicInfo
from .index import BagChannel
from .reader import BagReader

Held = dict[str, dict[str, Floats]]
"""Forces of the patches of each topic of reconstructions, for those that are unchanged."""
_BATCHES = {cls.schema for cls in BATCHES.values()}


def split_bag(bag: BagReader) -> BagReader:
    """The bag itself, or as one of single patches where it holds batches."""
    return SplitBag(bag) if any(one.schema in _BATCHES for one in bag.topics.values()) else bag


class SplitBag(BagReader):
    """A bag whose messages of batches are split, and the states of a batch are those of each of
    its patches. Topics and their counts are those of the single messages; the names of patches are
    those that the messages state.

    Parameters
    ----------
    bag : BagReader
        The bag, which is closed with this one.

    Raises
    ------
    BagError
        If a message of a batch cannot be decoded.
    """

    def __init__(self, bag: BagReader) -> None:
        self.path, self.metadata, self.counts = bag.path, bag.metadata, bag.counts
        self.recovered = bag.recovered
        self._bag = bag
        self._names: dict[str, dict[str, None]] = {}
        batches = [topic for topic, info in bag.topics.items() if info.schema in _BATCHES]
        found: dict[str, TopicInfo] = {}
        held: Held = {}
        for recorded in bag.messages(batches):
            for single in self._singles(recorded, held):
                patch, schema = split_topic(single.topic)
                self._names.setdefault(split_topic(recorded.topic)[0], {})[patch] = None
                info = found.setdefault(single.topic, TopicInfo(schema, SCHEMAS[schema].version))
                info.add(schema, info.version, single.stamp_ns, single.log_time_ns)
        for topic in bag.topics.keys() - set(batches):
            found |= dict.fromkeys(self._of_patches(topic), bag.topics[topic])
        self.topics = dict(sorted(found.items()))

    def close(self) -> None:
        """Close the file."""
        self._bag.close()

    def _of_patches(self, topic: str) -> list[str]:
        """The topic for each patch of its batch, or the topic itself."""
        patch, schema = split_topic(topic)
        return [topic_of(name, schema) for name in self._names.get(patch, (patch,))]

    def _records(
        self, wanted: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[tuple[BagChannel, BagMessage]]:
        batches = {patch for patch, names in self._names.items() if self._any(names, wanted)}
        topics = [
            topic
            for topic, info in self._bag.topics.items()
            if (split_topic(topic)[0] in batches and info.schema in _BATCHES)
            or not wanted.isdisjoint(self._of_patches(topic))
        ]
        held: Held = {}
        # From the first on: a patch that is unchanged has the forces of an earlier message.
        for channel, recorded in self._bag.records(topics, None, stop_ns):
            for single in self._singles(recorded, held):
                early = start_ns is not None and single.stamp_ns < start_ns
                if single.topic in wanted and not early:
                    yield channel, single

    @staticmethod
    def _any(names: Iterable[str], topics: Iterable[str]) -> bool:
        return not {split_topic(topic)[0] for topic in topics}.isdisjoint(names)

    def _singles(self, recorded: BagMessage, held: Held) -> Iterator[BagMessage]:
        """The messages of the patches that one of the bag stands for."""
        patch, schema = split_topic(recorded.topic)
        if schema not in _BATCHES and patch not in self._names:
            yield recorded
            return
        try:
            message = decode(recorded.topic.encode(), recorded.payload)
        except MessageError as error:
            raise BagError(
                f"{self.path}: {recorded.topic}, stamp {recorded.stamp_ns}: {error}"
            ) from error
        if isinstance(message, End):
            return
        parts: Iterable[Message]
        if isinstance(message, BatchMessage):
            parts = message.split(held.setdefault(recorded.topic, {}))
        else:
            parts = (replace(message, patch=name) for name in self._names[patch])
        for part in parts:
            topic, payload = encode(part)
            yield BagMessage(topic.decode(), recorded.log_time_ns, part.stamp_ns, payload)
