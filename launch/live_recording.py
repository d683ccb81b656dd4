"""A recording that is begun and ended while its graph runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from sparseskin.nodes.errors import RefusedError, SettingsError

from .fleet import Fleet
from .launchfile import single_node
from .launchspec import LaunchFile
from .process import NodeProcess

LIVE_RECORDER = "live_recorder_"
Say = Callable[[bool, str], None]


class LiveRecording:
    """Starts a recorder of all topics on request, and ends it on request.

    Parameters
    ----------
    launch : LaunchFile
        The graph.
    fleet : Fleet
        Its nodes; the recorder becomes one of them.
    """

    def __init__(self, launch: LaunchFile, fleet: Fleet) -> None:
        self._launch = launch
        self._fleet = fleet
        self._node = ""
        self._say: Say | None = None
        self._n = 0
        self.out: str | None = None

    def command(self, name: str, value: Any, say: Say) -> None:
        """Take the request "record": true or false.

        Raises
        ------
        RefusedError
            If it is not that, or a recording cannot begin or end just now.
        """
        if name != "record" or not isinstance(value, bool):
            raise RefusedError(f"launch: {name}: expected the command 'record', true or false")
        if self._say is not None:
            raise RefusedError("record: the last request is still being done")
        if value == (self.out is not None):
            raise RefusedError(f"record: {'already on: ' + self.out if self.out else 'not on'}")
        if value:
            self._begin()
        else:
            self._fleet.nodes[self._node].command("stop")
        self._say = say

    def hear(self, node: NodeProcess, event: str) -> None:
        """Notice when the recorder has begun, has ended or has failed."""
        if node.name != self._node or self.out is None:
            return
        out = self.out
        if event == "ready":
            self._done(True, f"recording to {out}")
        elif event in ("failed", "error", "died"):
            self.out = None
            self._done(False, f"{out}: {node.refusal or 'cannot be recorded; see the log'}")
        elif event == "ended":
            self.out = None
            recording = node.report.get("recording", {})
            fault = recording.get("error")
            text = fault or f"{out}: {recording.get('n_messages', 0)} messages recorded"
            self._done(not fault, text)

    def _begin(self) -> None:
        self._n += 1
        self.out = f"{self._launch.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        self._node = f"{LIVE_RECORDER}{self._n}"
        topics = list(
            dict.fromkeys(
                topic
                for node in self._launch.nodes.values()
                for topic in node.cls.outputs(node.settings)
            )
        )
        values = {
            "out": self.out,
            "topics": topics,
            "launch": self._launch.text,
            "source": self._launch.name,
        }
        try:
            spec = single_node(self._node, "recorder", values).nodes[self._node]
        except SettingsError as error:
            self.out = None
            raise RefusedError(f"record: {error}") from error
        self._fleet.add(spec, topics)

    def _done(self, done: bool, text: str) -> None:
        say, self._say = self._say, None
        if say is not None:
            say(done, text)
