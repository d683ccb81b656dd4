"""A node that serves a batch of equal patches: one process, one message each way for all.

It holds an ordinary node for each patch and gives it the patch's part of each message, so that
the results are those of one node a patch.
"""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, TypeVar

from sparseskin.messages import Message, topic_of
from sparseskin.messages.batches import BATCHES, MAX_NAMES, MAX_PATCHES, BatchMessage
from sparseskin.messages.topics import split_topic

from .errors import RefusedError, SettingsError
from .node import Context, Node
from .settings import PatchSettings, check_patch

S = TypeVar("S", bound=PatchSettings)
LOGGED = 3
"""Lines of one kind that are logged for single patches; then the 10th, 100th ... of them."""


def check_patches(names: tuple[str, ...]) -> None:
    """Raise SettingsError unless `names` can be those of a batch."""
    if not 1 <= len(names) <= MAX_PATCHES:
        raise SettingsError(f"patches: {len(names)} names; allowed: 1..{MAX_PATCHES}")
    for k, name in enumerate(names):
        check_patch(f"patches[{k}]", name)
        if name in names[:k]:
            raise SettingsError(f"patches[{k}]: '{name}' occurs twice")
    if len(" ".join(names)) > MAX_NAMES:
        raise SettingsError(f"patches: more than {MAX_NAMES} characters of names in all")


def batch_topic(topic: str) -> str:
    """Topic of a batch in place of that of a single patch; of a state the same."""
    patch, schema = split_topic(topic)
    return topic_of(patch, BATCHES[schema].schema) if schema in BATCHES else topic


def is_due(times: int) -> bool:
    """True the 10th, 100th, 1000th ... time."""
    return times >= 10 and str(times).strip("0") == "1"


def _alike(line: str) -> str:
    """A line without its numbers: the same of all patches."""
    return re.sub(r"[0-9.]+", "#", line)


class BatchNode(Node[S]):
    """Base of the nodes of a batch; `one` is the class of the node of a single patch.

    The settings are those of `one` and `patches`. Changes of settings apply to all patches.
    """

    one: ClassVar[type[Node[Any]]]

    def __init__(self, settings: S, context: Context) -> None:
        super().__init__(settings, context)
        self._names: tuple[str, ...] = settings.patches  # type: ignore[attr-defined]
        self._held: dict[str, Any] = {}
        self._logged: Counter[str] = Counter()
        self._setting_up = True
        self.nodes = {
            name: self.one(
                self._of_patch(settings, name),
                dataclasses.replace(context, log=self._log_of(name)),
            )
            for name in self._names
        }
        self._setting_up = False

    @classmethod
    def inputs(cls, settings: S) -> tuple[str, ...]:
        return tuple(map(batch_topic, cls.one.inputs(settings)))

    @classmethod
    def outputs(cls, settings: S) -> tuple[str, ...]:
        return tuple(map(batch_topic, cls.one.outputs(settings)))

    @classmethod
    def facts(cls, settings: S) -> Mapping[str, Any]:
        return cls.one.facts(settings)

    @classmethod
    def check_inputs(cls, settings: S, facts: Mapping[str, Any]) -> None:
        cls.one.check_inputs(settings, facts)

    @property
    def depth(self) -> int:
        return self._first.depth

    @property
    def _first(self) -> Node[Any]:
        return self.nodes[self._names[0]]

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, BatchMessage):
            if message.names != self._names:
                raise RefusedError(f"{message.topic}: of other patches than this node serves")
            yield from self._step_batch(message)
        else:
            yield from self._set_up(
                lambda name, node: node.step(dataclasses.replace(message, patch=name))
            )

    def overtaken(self, message: Message) -> None:
        if isinstance(message, BatchMessage):
            for part in message.split(self._held):
                self.nodes[part.patch].overtaken(part)

    def change(self, settings: S) -> Iterable[Message]:
        before = self.settings
        messages = list(
            self._set_up(lambda name, node: node.change(self._of_patch(settings, name)))
        )
        self.settings = settings
        assert before is not None
        return messages

    def idle(self) -> None:
        for node in self.nodes.values():
            node.idle()

    def state(self) -> dict[str, Any]:
        """State of the first patch's node; texts and flags that differ are those of all."""
        states = {name: node.state() for name, node in self.nodes.items()}
        merged = dict(states[self._names[0]])
        for key, value in merged.items():
            values = {name: state.get(key) for name, state in states.items()}
            if isinstance(value, bool):
                merged[key] = any(values.values())
            elif isinstance(value, str) and set(values.values()) != {value}:
                merged[key] = "; ".join(f"{name}: {each}" for name, each in values.items() if each)
        return merged

    def status(self) -> str:
        text = self._first.status()
        return f"{text}, {len(self._names)} patches" if text else ""

    def _step_batch(self, message: BatchMessage) -> Iterator[Message]:
        """Messages of the batch for one that it received."""
        yield from self._joined(self._step_all(message))

    def _step_all(self, message: BatchMessage) -> Iterator[list[Message]]:
        """Messages of each patch's node for its part of a message."""
        for part in message.split(self._held):
            yield list(self.nodes[part.patch].step(part))

    def _joined(self, answers: Iterable[list[Message]]) -> Iterator[Message]:
        """Messages of the batch made of those of its patches, one of each schema."""
        by_schema: dict[str, list[Message]] = {}
        for messages in answers:
            for message in messages:
                by_schema.setdefault(message.schema, []).append(message)
        for schema, parts in by_schema.items():
            if len(parts) != len(self._names):
                raise RefusedError(f"{schema}: of {len(parts)} of {len(self._names)} patches")
            yield BATCHES[schema].join(self.settings.patch, parts)

    def _set_up(self, of: Callable[[str, Node[Any]], Iterable[Message]]) -> Iterator[Message]:
        """Do the same for all patches; of the states that follow, the first patch's are those of
        the batch.
        """
        self._setting_up = True
        try:
            found = [list(of(name, node)) for name, node in self.nodes.items()]
        finally:
            self._setting_up = False
        for message in found[0]:
            yield dataclasses.replace(message, patch=self.settings.patch)

    def _of_patch(self, settings: S, name: str) -> Any:
        """Settings of the node of one patch."""
        known = [field.name for field in dataclasses.fields(self.one.Settings)]
        return self.one.Settings(**{key: getattr(settings, key) for key in known} | {"patch": name})

    def _log_of(self, name: str) -> Callable[[str], None]:
        """Log of one patch's node: what all nodes log as they are set up is logged once."""

        def log(line: str) -> None:
            if not self._setting_up:
                self._logged[_alike(line)] += 1
                n = self._logged[_alike(line)]
                if n <= LOGGED:
                    self.context.log(f"{name}: {line}")
                elif is_due(n):
                    self.context.log(f"{name}: {line} ({n} such lines)")
            elif name == self._names[0]:
                self.context.log(line)

        return log
