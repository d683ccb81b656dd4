"""A bag whose messages hold frames of several patches, read as one of a topic for each patch."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

from sparseskin.messages import End, Message, encode
from sparseskin.messages.arrays import Floats
from sparseskin.messages.frames import Frames
from sparseskin.messages.topics import split_topic, topic_of
from sparseskin.messages.wire import SCHEMAS

from .format import BagMessage, TopicInfo
from .frames import decoded
from .reader import BagReader

Unchanged = dict[str, dict[str, Floats]]
"""Forces of the patches of each topic of reconstructions, for those that are unchanged."""


def names_of(bag: BagReader) -> dict[str, tuple[str, ...]]:
    """Names of the patches whose frames the messages of a bag hold together, by the name of these
    in topics; without patches that have topics of their own.

    Raises BagError if a message cannot be decoded.
    """
    by_patch = {}
    for topic in _frame_topics(bag):
        by_patch[split_topic(topic)[0]] = _names_on(bag, topic)
    return {patch: names for patch, names in by_patch.items() if names}


def _frame_topics(bag: BagReader) -> list[str]:
    topics = []
    for topic, info in bag.topics.items():
        if info.n_messages and issubclass(SCHEMAS[info.schema], Frames):
            topics.append(topic)
    return topics


def _names_on(bag: BagReader, topic: str) -> tuple[str, ...]:
    """Names that the first message on a topic states; () for one patch of its own name."""
    # They hold for the whole topic: a publisher states its patches once.
    for recorded in bag.messages([topic]):
        message = decoded(bag, recorded)
        if isinstance(message, Frames):
            return message.names
    return ()


def split_bag(bag: BagReader) -> BagReader:
    """The bag itself, or as one of single patches where its messages hold several."""
    names = names_of(bag)
    return SplitBag(bag, names) if names else bag


class SplitBag(BagReader):
    """A bag whose messages are split into those of single patches, and the states that hold for
    several patches are those of each of them. Topics and their counts are those of the single
    messages.

    `names` are those of the patches whose frames its messages hold together, as of `names_of`. The
    bag is closed with this one. Raises BagError if a message of several patches cannot be decoded.
    """

    def __init__(self, bag: BagReader, names: Mapping[str, tuple[str, ...]]) -> None:
        self.path = bag.path
        self.metadata = bag.metadata
        self.counts = bag.counts
        self.recovered = bag.recovered
        self._bag = bag
        self._names = names

        several = [t for t in _frame_topics(bag) if split_topic(t)[0] in names]
        # Each message is read once for the counts: an index has those of all patches together.
        topics: dict[str, TopicInfo] = {}
        unchanged: Unchanged = {}
        for recorded in bag.messages(several):
            for single in self._singles(recorded, unchanged):
                schema = split_topic(single.topic)[1]
                empty = TopicInfo(schema, SCHEMAS[schema].version)
                info = topics.setdefault(single.topic, empty)
                info.add(schema, single.stamp_ns, single.log_time_ns)

        # States hold for each of the patches.
        for topic in bag.topics.keys() - set(several):
            for topic_of_patch in self._of_patches(topic):
                topics[topic_of_patch] = bag.topics[topic]
        self.topics = dict(sorted(topics.items()))

    def close(self) -> None:
        """Close the file."""
        self._bag.close()

    def _of_patches(self, topic: str) -> list[str]:
        """The topics of its patches, or the topic itself."""
        patch, schema = split_topic(topic)
        return [topic_of(name, schema) for name in self._names.get(patch, (patch,))]

    def _messages(
        self, wanted: frozenset[str], start_ns: int | None, stop_ns: int | None
    ) -> Iterator[BagMessage]:
        topics = []
        for topic in self._bag.topics:
            if not wanted.isdisjoint(self._of_patches(topic)):
                topics.append(topic)
        unchanged: Unchanged = {}
        # From the first on: a patch that is unchanged has the forces of an earlier message.
        for recorded in self._bag.messages(topics, None, stop_ns):
            for single in self._singles(recorded, unchanged):
                is_early = start_ns is not None and single.stamp_ns < start_ns
                if single.topic in wanted and not is_early:
                    yield single

    def _singles(
        self, recorded: BagMessage, unchanged: Unchanged
    ) -> Iterator[BagMessage]:
        """The messages of the patches that one of the bag stands for."""
        patch = split_topic(recorded.topic)[0]
        if patch not in self._names:
            yield recorded
            return
        message = decoded(self._bag, recorded)
        # It counts messages of all patches: of a single one it would be wrong.
        if isinstance(message, End):
            return
        parts: Iterable[Message]
        if isinstance(message, Frames):
            last_forces = unchanged.setdefault(recorded.topic, {})
            parts = message.split(last_forces)
        else:
            parts = (replace(message, patch=name) for name in self._names[patch])
        for part in parts:
            topic, payload = encode(part)
            yield recorded._replace(topic=topic.decode(), payload=payload)
