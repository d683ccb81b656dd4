"""The recorder: writes any topics into a bag, and never slows who publishes them."""

from __future__ import annotations

import json
import platform
from collections.abc import Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Message, PhiState, SkinState, encode
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.settings import Settings, setting

from .bag import FILE_SUFFIX, BagError
from .bag_writer import BagWriter

FLUSH_EVERY_S = 0.1
"""Half of what may be lost when the recorder is killed: the other half is for a busy machine."""
PATIENCE_MESSAGES, PATIENCE_NS, MOST_WAITING = 64, 100_000_000, 1024
"""So many messages, and for so long, but never more than the last, wait for all states to be known
before the file is begun without.
"""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """What a recorder can be told."""

    out: str = setting("recording.mcap", "file to write, NAME.mcap")
    topics: tuple[str, ...] = setting(("*",), "topics to record; * stands for any text")
    launch: str = setting("", "text of the launch file, kept in the recording")
    source: str = setting("", "name of the graph, kept in the recording")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.topics:
            raise SettingsError("topics: expected at least one topic")

    def check(self) -> None:
        path = Path(self.out)
        if path.suffix != FILE_SUFFIX:
            raise SettingsError(f"out: {self.out}: expected a name that ends in {FILE_SUFFIX}")
        for taken in (path, path.with_name(path.name + ".part")):
            if taken.exists():
                raise SettingsError(f"out: {taken}: exists already, and is not written over")
        if not path.resolve().parent.is_dir():
            raise SettingsError(f"out: {self.out}: its folder does not exist")


class Recorder(Node[RecorderSettings]):
    """Writes every message as it came; what it had to drop is counted in the file.

    The file is begun once the states (skin, Phi, solver) of the recorded topics are known, so
    that its metadata can name scene, seed and Phi.
    """

    Settings = RecorderSettings
    required = False

    def __init__(self, settings: RecorderSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._writer: BagWriter | None = None
        self._waiting: list[tuple[int, Message]] = []
        self._states: dict[str, Message] = {}
        self._error = ""
        self._closed = False

    @classmethod
    def inputs(cls, settings: RecorderSettings) -> tuple[str, ...]:
        return settings.topics

    @classmethod
    def values_again(cls, settings: RecorderSettings, n_restarts: int) -> dict[str, Any]:
        # What the one before could write stands in its file, and nothing is written over it.
        out = Path(settings.out)
        stem = out.stem.removesuffix(f".restart{n_restarts - 1}")
        return {"out": str(out.with_name(f"{stem}.restart{n_restarts}{FILE_SUFFIX}"))}

    def step(self, message: Message) -> Iterable[Message]:
        if self._error or self._closed:
            return ()
        now_ns = self.context.clock.now_ns()
        if message.latched:
            self._states[message.topic] = message
        if self._writer is not None:
            self._write(now_ns, message)
            return ()
        self._waiting.append((now_ns, message))
        waited = len(self._waiting) >= PATIENCE_MESSAGES
        waited &= now_ns - self._waiting[0][0] >= PATIENCE_NS
        if len(self._states) == len(STATES) or waited or len(self._waiting) >= MOST_WAITING:
            self._begin()
        return ()

    def idle(self) -> None:
        if self._writer is not None and not self._error and not self._closed:
            self._guard(self._writer.tick)

    def close(self, counts: dict[str, Any]) -> None:
        self._closed = True
        if self._error:
            if self._writer is not None:
                self._writer.close()
            return
        if self._writer is None and self._waiting:
            self._begin()
        if self._writer is not None and not self._error:
            writer = self._writer
            self._guard(lambda: writer.close(counts))

    def status(self) -> str:
        n_messages = self._writer.n_messages if self._writer is not None else 0
        return f"recorded {n_messages} messages in {self.settings.out}" + (
            f" ({self._error})" if self._error else ""
        )

    def report(self) -> dict[str, Any]:
        n_messages = self._writer.n_messages if self._writer is not None else 0
        return {
            "recording": {
                "out": self.settings.out,
                "n_messages": n_messages,
                "error": self._error or None,
            }
        }

    def _begin(self) -> None:
        def begin() -> None:
            self._writer = BagWriter(
                Path(self.settings.out), self._metadata(), flush_every_s=FLUSH_EVERY_S
            )

        self._guard(begin)
        waiting, self._waiting = self._waiting, []
        for log_time_ns, message in waiting:
            self._write(log_time_ns, message)

    def _write(self, log_time_ns: int, message: Message) -> None:
        writer = self._writer
        if writer is None or self._error:
            return
        _, payload = encode(message)
        self._guard(
            lambda: writer.write(
                message.topic,
                payload,
                schema=message.schema,
                version=message.version,
                log_time_ns=log_time_ns,
                stamp_ns=message.stamp_ns,
            )
        )

    def _guard(self, action: Any) -> None:
        """Do something with the file; its first error is the last, and is told once."""
        try:
            action()
        except BagError as error:
            self._error = str(error)
            raise

    def _metadata(self) -> dict[str, str]:
        return metadata_of(self._states.values(), self.settings.launch, self.settings.source)


STATES = tuple(schema for schema, cls in SCHEMAS.items() if cls.latched)


def metadata_of(states: Iterable[Message], launch: str, graph: str) -> dict[str, str]:
    """The metadata of a recording, from the state messages of its patches."""
    states = list(states)
    skins = [state for state in states if isinstance(state, SkinState)]
    phis = {
        state.patch: {
            "kind": state.kind,
            "n": state.n,
            "m": state.m,
            "block": state.block,
            "seed": state.seed,
            "fingerprint": state.fingerprint,
            "rows": state.rows,
        }
        for state in states
        if isinstance(state, PhiState)
    }
    versions = {
        "sparseskin": version("sparseskin"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "mcap": version("mcap"),
        "schemas": {schema: cls.version for schema, cls in SCHEMAS.items()},
    }
    return {
        "graph": graph,
        "scene": ", ".join(dict.fromkeys(skin.source for skin in skins)),
        "seed": ", ".join(dict.fromkeys(str(skin.seed) for skin in skins)),
        "launch": launch,
        "phi": json.dumps(phis),
        "versions": json.dumps(versions),
    }
