"""Settings of the player node, and the names under which it plays topics."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import lru_cache

from sparseskin.messages import MessageError, Truth, topic_of
from sparseskin.messages.topics import split_topic
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.recorder.bag.format import TopicInfo, span_ns
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.settings import Settings, setting


@dataclass(frozen=True)
class PlayerSettings(Settings):
    """Settings of the player node."""

    file: str = setting("", "recording to play, NAME.mcap")
    rate: float = setting(
        1.0, "times the recorded speed; 0: as fast as the readers allow", low=0.0, high=1000.0
    )
    loop: bool = setting(False, "restart at the end")
    start_s: float = setting(0.0, "seconds of the recording to skip", low=0.0, high=1e9)
    duration_s: float | None = setting(None, "seconds to play", low=0.0, high=1e9)
    paused: bool = setting(False, "wait for a command before the first frame")
    topics: tuple[str, ...] = setting((), "topics to play; all by default")
    schemas: tuple[str, ...] = setting(
        (), "schemas to play (skin, taxels, truth ...), instead of topics"
    )
    remap: tuple[str, ...] = setting((), "FROM:=TO each: /PATCH:=/PATCH or whole topics")
    lockstep: bool = setting(False, "send no frame before all readers have processed the last")
    keep_stamps: bool = setting(False, "keep stamps as recorded")
    wait: int = setting(0, "readers to wait for before the first frame", low=0, high=1000)

    def __post_init__(self) -> None:
        super().__post_init__()
        for pair in self.remap:
            if pair.count(":=") != 1:
                raise SettingsError(f"remap: '{pair}': expected FROM:=TO")
        for schema in self.schemas:
            if schema not in SCHEMAS:
                raise SettingsError(f"schemas: {schema}: no schema{did_you_mean(schema, SCHEMAS)}")
        if self.schemas and self.topics:
            raise SettingsError("schemas: cannot be combined with topics")
        if self.keep_stamps and self.loop:
            raise SettingsError("keep_stamps: cannot be combined with loop")

    def check(self) -> None:
        names = renamed_topics(self)
        present = _topics_of(self.file)
        first_ns, last_ns = span_ns(present[topic] for topic in names if topic in present) or (0, 0)
        length_s = (last_ns - first_ns) / 1e9
        if self.start_s > length_s:
            raise SettingsError(f"start_s: {self.start_s:g}: the recording lasts {length_s:.3f} s")


@lru_cache(maxsize=8)
def _topics_of(file: str) -> dict[str, TopicInfo]:
    with BagReader(file, whole=False) as bag:
        return dict(bag.topics)


def renamed_topics(settings: PlayerSettings) -> dict[str, str]:
    """Names under which the chosen topics of the recording are played.

    Raises SparseskinError if the file cannot be opened, lacks a topic, or a new name is no topic
    of the same schema.
    """
    if not settings.file:
        raise SettingsError("file: state the recording to play")
    present = _topics_of(settings.file)
    for topic in settings.topics:
        if topic not in present:
            raise SettingsError(f"topics: {topic}: not in the file{_known(present)}")
    chosen = list(settings.topics or _of_schemas(present, settings) or present)
    names = {topic: topic for topic in chosen}
    for pair in settings.remap:
        old, new = (side.strip().rstrip("/") for side in pair.split(":="))
        matching = [topic for topic in chosen if topic == old or topic.startswith(old + "/")]
        if not matching:
            raise SettingsError(f"remap: {old}: not in the file{_known(chosen)}")
        for topic in matching:
            names[topic] = _renamed(topic, new + topic.removeprefix(old))
    if len(set(names.values())) < len(names):
        raise SettingsError("remap: two topics would have one name")
    return names


def _known(topics: Iterable[str]) -> str:
    """All topics: their names are too alike for a nearest one."""
    return f" (known: {', '.join(sorted(topics))})"


def _of_schemas(present: Iterable[str], settings: PlayerSettings) -> list[str]:
    """Topics of the chosen schemas; the truth may be missing, as for real skins."""
    patches = dict.fromkeys(split_topic(topic)[0] for topic in present)
    chosen = [topic_of(patch, schema) for patch in patches for schema in settings.schemas]
    for topic in chosen:
        if topic not in present and split_topic(topic)[1] != Truth.schema:
            raise SettingsError(
                f"schemas: {topic}: not in {settings.file}, which has {', '.join(sorted(present))}"
                "; record it with them"
            )
    return chosen


def _renamed(topic: str, new: str) -> str:
    try:
        schema = split_topic(new)[1]
    except MessageError as error:
        raise SettingsError(f"remap: {error}") from error
    if schema != split_topic(topic)[1]:
        raise SettingsError(f"remap: {topic} cannot become {new}: a topic ends in its schema")
    return new
