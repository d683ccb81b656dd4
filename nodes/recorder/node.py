"""The recorder: writes any topics into a bag, without slowing their publishers."""

import json
import math
import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from sparseskin.messages import Message
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.process.control import Document
from sparseskin.nodes.recorder.bag.format import (
    FILE_SUFFIX,
    PART_SUFFIX,
    BagError,
    check_new_bag,
)
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.settings import Settings, setting

FLUSH_EVERY_S = 0.1
"""Half of the time that may be lost when the recorder is killed: the rest is for a busy machine."""


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Settings of the recorder node."""

    out: str = setting("recording.mcap", "file to write, NAME.mcap")
    topics: tuple[str, ...] = setting(("*",), "topics to record; * stands for any text")
    launch: str = setting("", "text of the launch file, kept in the recording")
    source: str = setting("", "name of the graph, kept in the recording")

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.topics:
            raise SettingsError("topics: expected at least one topic")

    def check(self) -> None:
        try:
            check_new_bag(Path(self.out))
        except BagError as error:
            raise SettingsError(f"out: {error}") from error


class Recorder(Node[RecorderSettings]):
    """Writes every message unchanged, and the number of dropped ones. The file begins with the
    first message.
    """

    Settings = RecorderSettings
    # A graph goes on without its recorder, as on a full disk.
    required = False

    def __init__(self, settings: RecorderSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._writer: BagWriter | None = None
        self._error = ""
        self._closed = False

    @classmethod
    def inputs(cls, settings: RecorderSettings) -> tuple[str, ...]:
        return settings.topics

    @classmethod
    def values_again(cls, settings: RecorderSettings, n_restarts: int) -> Document:
        # The file of the previous run is kept, whole or not: nothing is written over.
        out = Path(settings.out)
        stem = out.stem.removesuffix(f".restart{n_restarts - 1}")
        return {"out": str(out.with_name(f"{stem}.restart{n_restarts}{FILE_SUFFIX}"))}

    @classmethod
    def left_behind(cls, settings: RecorderSettings) -> str:
        part = f"{settings.out}{PART_SUFFIX}"
        if not Path(part).is_file():
            return ""
        command = f"sparseskin recording recover {part}"
        return f"what was recorded before it ended is in {part} ({command})"

    def step(self, message: Message) -> Iterable[Message]:
        self._guard(lambda: self._write(message))
        # It publishes nothing.
        return ()

    def idle(self) -> None:
        if self._writer is not None:
            self._guard(self._writer.tick)

    def close(self, counts: Document) -> None:
        writer = self._writer
        if writer is not None:
            self._guard(lambda: writer.close(counts))
        # A late message must not begin a new file, nor add to one that is complete.
        self._closed = True

    def status(self) -> str:
        text = f"recorded {self._n_messages} messages in {self.settings.out}"
        if self._error:
            text += f" ({self._error})"
        return text

    def report(self) -> Document:
        recording = {
            "out": self.settings.out,
            "n_messages": self._n_messages,
            "error": self._error or None,
        }
        return {"recording": recording}

    @property
    def _n_messages(self) -> int:
        if self._writer is None:
            return 0
        return self._writer.n_messages

    def _write(self, message: Message) -> None:
        # Made with the first message: a recorder that hears nothing leaves no file.
        if self._writer is None:
            metadata = metadata_of(self.settings.launch, self.settings.source)
            # Offline, where a recording is complete or not at all, chunks are as large as they may.
            every_s = math.inf
            if self.context.live:
                every_s = FLUSH_EVERY_S
            self._writer = BagWriter(
                Path(self.settings.out), metadata, flush_every_s=every_s
            )
        self._writer.record(message, self.context.clock.now_ns())

    def _guard(self, action: Callable[[], None]) -> None:
        """Act on the file; its first error is kept and raised, and ends the recording."""
        # Raised once: the node logs it, and each later message would repeat it.
        if self._error or self._closed:
            return
        try:
            action()
        except BagError as error:
            self._error = str(error)
            raise


def metadata_of(launch: str, graph: str) -> dict[str, str]:
    """Metadata of a recording: text of the launch file, name of the graph, and versions."""
    versions = {
        "sparseskin": version("sparseskin"),
        "python": platform.python_version(),
        "numpy": np.__version__,
        "mcap": version("mcap"),
        "schemas": {schema: cls.version for schema, cls in SCHEMAS.items()},
    }
    return {
        "graph": graph,
        "launch": launch,
        "versions": json.dumps(versions),
    }
