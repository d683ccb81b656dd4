"""A recording that is started and stopped while its graph runs."""

import time
from collections.abc import Callable
from typing import Any

from sparseskin.launch.launchfile.load import single_node
from sparseskin.launch.launchfile.spec import LIVE_RECORDER, LaunchFile
from sparseskin.nodes.errors import RefusedError, SparseskinError

from .fleet import Fleet
from .process import NodeProcess

Say = Callable[[bool, str], None]


class LiveRecording:
    """Starts a recorder of all topics on request, as one node more, and stops it on request."""

    def __init__(self, launch: LaunchFile, fleet: Fleet) -> None:
        self._launch = launch
        self._fleet = fleet
        self._node = ""
        self._say: Say | None = None
        self._n = 0
        self.out: str | None = None

    def command(self, name: str, value: Any, say: Say) -> None:
        """Take the request "record": true or false.
        Raises RefusedError if it is not that, or a recording cannot begin or end just now.
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
        """Handle the start, the end and a failure of the recorder."""
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
            n = recording.get("n_messages", 0)
            came = f"{n} messages recorded" if n else "no message came, so there is no file"
            text = fault or f"{out}: {came}"
            self._done(not fault, text)

    def _begin(self) -> None:
        self._n += 1
        self.out = f"{self._launch.name}-{time.strftime('%Y%m%d-%H%M%S')}.mcap"
        self._node = f"{LIVE_RECORDER}{self._n}"
        specs = self._launch.nodes.values()
        topics = list(dict.fromkeys(topic for spec in specs for topic in spec.outputs))
        values = {
            "out": self.out,
            "topics": topics,
            "launch": self._launch.text,
            "source": self._launch.name,
        }
        try:
            spec = single_node(self._node, "recorder", values).nodes[self._node]
            self._fleet.add(spec, topics)
        except SparseskinError as error:
            self.out = None
            raise RefusedError(f"record: {error}") from error

    def _done(self, done: bool, text: str) -> None:
        say, self._say = self._say, None
        if say is not None:
            say(done, text)
