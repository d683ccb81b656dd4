"""The recorder: writes any topics into a bag, without slowing their publishers."""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.messages import Calibration, Message, PhiState, SkinState
from sparseskin.messages.wire import SCHEMAS
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, BagError, check_new_bag
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.settings import Settings, setting

FLUSH_EVERY_S = 0.1
"""Half of the time that may be lost when the recorder is killed: the rest is for a busy machine."""
PATIENCE_MESSAGES, PATIENCE_NS, MOST_WAITING = 64, 100_000_000, 1024
"""The file begins without all states once `PATIENCE_MESSAGES` messages wait for them, the first for
`PATIENCE_NS`; or once `MOST_WAITING` messages wait.
"""


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
    """Writes every message unchanged, and the number of dropped ones.

    The file begins once the states (skin, Phi, solver) of the recorded topics are known, so that
    its metadata can name scene, seed and Phi.
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
        # The file of the previous run is kept.
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
        known = {state.schema for state in self._states.values()}
        if known >= set(STATES) or waited or len(self._waiting) >= MOST_WAITING:
            self._begin()
        return ()

    def idle(self) -> None:
        if self._writer is not None and not self._error and not self._closed:
            self._guard(self._writer.tick)

    def close(self, counts: dict[str, Any]) -> None:
        self._closed = True
        if self._writer is None and self._waiting and not self._error:
            self._begin()
        if self._writer is not None:
            writer = self._writer
            self._guard(lambda: writer.close(counts))

    def status(self) -> str:
        error = f" ({self._error})" if self._error else ""
        return f"recorded {self._n_messages} messages in {self.settings.out}{error}"

    def report(self) -> dict[str, Any]:
        report = {"out": self.settings.out, "n_messages": self._n_messages}
        return {"recording": {**report, "error": self._error or None}}

    @property
    def _n_messages(self) -> int:
        return self._writer.n_messages if self._writer is not None else 0

    def _begin(self) -> None:
        def begin() -> None:
            settings, states = self.settings, self._states.values()
            metadata = metadata_of(states, settings.launch, settings.source)
            self._writer = BagWriter(Path(settings.out), metadata, flush_every_s=FLUSH_EVERY_S)

        self._guard(begin)
        waiting, self._waiting = self._waiting, []
        for log_time_ns, message in waiting:
            self._write(log_time_ns, message)

    def _write(self, log_time_ns: int, message: Message) -> None:
        writer = self._writer
        if writer is not None and not self._error:
            self._guard(lambda: writer.record(message, log_time_ns))

    def _guard(self, action: Callable[[], None]) -> None:
        """Act on the file; its first error is kept and raised, and ends the recording."""
        try:
            action()
        except BagError as error:
            self._error = str(error)
            raise


STATES = tuple(schema for schema, cls in SCHEMAS.items() if cls.latched and cls is not Calibration)
"""States that every graph publishes."""


def metadata_of(states: Iterable[Message], launch: str, graph: str) -> dict[str, str]:
    """Metadata of a recording, from the state messages of its patches."""
    states = list(states)
    skins = [state for state in states if isinstance(state, SkinState)]
    fields = ("kind", "n", "m", "block", "seed", "fingerprint", "rows", "rule")
    phis = {
        state.patch: {name: getattr(state, name) for name in fields}
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
    } | _calibrations(states)


def _calibrations(states: Iterable[Message]) -> dict[str, str]:
    """Metadata of calibrated skins; their arrays are in the messages."""
    skins = {state.patch: state for state in states if isinstance(state, SkinState)}
    found = {}
    for state in states:
        if isinstance(state, Calibration) and (skin := skins.get(state.patch)):
            parts = ("baseline", "gains", "response_reading")
            found[state.patch] = {
                "name": state.name,
                "rows": skin.n_rows,
                "cols": skin.n_cols,
                "pitch_mm": None if skin.pitch_m is None else 1000 * skin.pitch_m,
                "unit": skin.unit,
                "f_min": skin.f_min,
                "f_max": skin.f_max,
                "noise": skin.sigma_end,
                "masked": 0 if skin.mask is None else int((~skin.mask).sum()),
                "calibrated": [
                    name.partition("_")[0] for name in parts if getattr(state, name) is not None
                ],
            }
    return {"skin": json.dumps(found)} if found else {}
