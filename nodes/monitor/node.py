"""The monitor: measures accuracy, latency and losses of patches, and shows them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.messages import (
    Contacts,
    Labels,
    Measurements,
    Message,
    PhiState,
    Reconstruction,
    SkinState,
    SolverState,
    Taxels,
    Truth,
    topic_of,
)
from sparseskin.messages.frames import Frames
from sparseskin.messages.ranges import is_real
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.clock import ClockEstimate
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.process.control import Document
from sparseskin.nodes.settings import (
    Settings,
    check_patch,
    check_patches,
    naming,
    setting,
)

from .metrics import PatchMetrics
from .table import FEW, status_line

if TYPE_CHECKING:
    from .live.feed import Feed
    from .live.server import PageServer

SUMMARY_EVERY_NS = 500_000_000
"""Period in which the live page gets a new summary."""
REQUIRED = (SkinState, PhiState, Measurements, SolverState, Reconstruction)
OPTIONAL = (Taxels, Truth, Contacts, Labels)
"""A compressor outside the graph publishes no taxels."""
WATCHED = (*REQUIRED, *OPTIONAL)


@dataclass(frozen=True)
class MonitorSettings(Settings):
    """Settings of the monitor node."""

    patches: tuple[str, ...] = setting(("skin",), "names of the patches to watch")
    batches: Document | None = setting(
        None,
        "a table of the batches to watch: the names of the patches of each, by its name",
    )
    poses: Document | None = setting(
        None,
        "a table of the pose of each patch on the page, by its name: x, y, z of its middle in mm, "
        "roll, pitch, yaw in degrees",
    )
    page: bool = setting(
        True, "serve a live page on 127.0.0.1, where the graph has a launcher"
    )
    port: int = setting(
        8470, "port of the page; a free one where it is busy, or 0", low=0, high=65535
    )
    token: bool = setting(True, "ask for the random token in the address of the page")
    browser: bool = setting(False, "open the page in a browser")
    screen: bool = setting(
        False,
        "update a full screen of text in the terminal, in place of one status line",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.patches and not self.batches:
            raise SettingsError("patches: expected at least one name")
        for k, patch in enumerate(self.patches):
            check_patch(f"patches[{k}]", patch)
        for batch, names in (self.batches or {}).items():
            with naming(f"batches.{batch}"):
                _check_batch(batch, names)

        all_patches = self.all_patches
        for patch, pose in (self.poses or {}).items():
            if patch not in all_patches:
                raise SettingsError(
                    f"poses.{patch}: no patch{did_you_mean(patch, all_patches)}"
                )
            check_pose(f"poses.{patch}", pose)
        # Messages of a patch could not be told apart.
        if len(set(all_patches)) < len(all_patches):
            raise SettingsError("batches: a patch occurs twice")

    @property
    def groups(self) -> dict[str, tuple[str, ...]]:
        """Names of the patches of each batch, by its name; of a single patch its own."""
        groups: dict[str, tuple[str, ...]] = {}
        for name in self.patches:
            groups[name] = (name,)
        for batch, names in (self.batches or {}).items():
            groups[batch] = tuple(names)
        return groups

    @property
    def all_patches(self) -> tuple[str, ...]:
        """Names of all patches, those of batches too."""
        return tuple(chain.from_iterable(self.groups.values()))


class Monitor(Node[MonitorSettings]):
    """Publishes nothing; its status is a line, its report the summary of every patch.

    The live page and its web server are imported when they are used.
    """

    Settings = MonitorSettings
    watches = True
    # Not visible to a person, and a frame's messages cost half as much when read together.
    patience_s = 0.008

    def __init__(self, settings: MonitorSettings, context: Context) -> None:
        super().__init__(settings, context)
        # A monitor that joins late states from when its figures are.
        since_ns = None
        if context.late:
            since_ns = context.clock.now_ns()
        self._groups = settings.groups
        self._patches: dict[str, PatchMetrics] = {}
        for group, names in self._groups.items():
            clock_of = partial(_clock_of, context, group)
            for name in names:
                self._patches[name] = PatchMetrics(since_ns, clock_of)
        self._last_forces: Document = {}
        self._feed: Feed | None = None
        self._page: PageServer | None = None
        self._opener: Path | None = None
        self._next_summary_ns = 0
        self._status_ns = context.clock.now_ns()
        self._status_frames = dict.fromkeys(settings.all_patches, 0)

    @classmethod
    def inputs(cls, settings: MonitorSettings) -> tuple[str, ...]:
        return _topics(settings, REQUIRED)

    @classmethod
    def optional_inputs(cls, settings: MonitorSettings) -> tuple[str, ...]:
        return _topics(settings, OPTIONAL)

    @classmethod
    def totals(
        cls,
        settings: MonitorSettings,
        report: Mapping[str, Any],
        counts: Iterable[Any],
        again: bool,
    ) -> Document:
        # Counts of nodes are by topic, those of a batch being of all its patches.
        counts_of = {}
        for of_node in counts:
            for topic in of_node["published"]:
                counts_of[topic] = of_node

        patches = dict(report.get("patches", {}))
        for group, names in settings.groups.items():
            for name in names:
                if name not in patches:
                    continue
                patch = patches[name]
                frames = _published_frames(patch["frames"], group, counts_of, again)
                patches[name] = {**patch, "frames": frames}
        return {"patches": patches}

    def start(self) -> Iterable[Message]:
        # Without a launcher nobody answers a page: there is none then.
        ask = None
        if self.settings.page:
            ask = self.context.ask
        if ask is None and not self.settings.screen:
            return ()

        from .live.feed import Feed
        from .live.notices import Notices

        self._feed = Feed(self.settings.all_patches, self.settings.poses)
        self._notices = Notices(self._feed)
        if ask is not None:
            self._serve_page(self._feed, ask)
        return ()

    def _serve_page(self, feed: Feed, ask: Callable[[Document], None]) -> None:
        from .live.server import PageServer

        port = self.settings.port
        token = ""
        if self.settings.token:
            token = self.context.page_token
        self._page = PageServer(feed, self._notices, port, ask, token)
        line = f"live page: {self._page.url}"
        if port not in (0, self._page.port):
            line += f" (port {port} is taken)"
        self.context.log(line)
        if self.settings.browser and not self._open_browser(self._page.url):
            self.context.log(
                "no browser could be opened here; open the address yourself"
            )

    def step(self, message: Message) -> Iterable[Message]:
        if isinstance(message, Frames):
            for part in message.split(self._last_forces):
                self._add(part)
            return ()
        # A state of a batch is one of each of its patches.
        names = self._groups.get(message.patch, (message.patch,))
        for name in names:
            if name != message.patch:
                message = replace(message, patch=name)
            self._add(message)
        return ()

    def _add(self, message: Message) -> None:
        metrics = self._patches.get(message.patch)
        if metrics is None:
            raise RefusedError(f"{message.topic}: patch {message.patch} is not watched")
        # A page shows the frame that this message completes.
        complete = metrics.add(message)
        if self._feed is not None:
            self._feed.frame(message.patch, message, complete, metrics.latency_ns)

    def ended(self, topic: str, n_messages: int) -> Iterable[Message]:
        # The end of a batch is that of all its patches.
        patch, schema = split_topic(topic)
        names = self._groups[patch]
        for name in names:
            self._patches[name].end(schema, n_messages)
        if self._feed is not None and schema == Reconstruction.schema:
            for name in names:
                summary = self._patches[name].summary()
                self._feed.update(summaries={name: summary}, ended=name)
        return ()

    def idle(self) -> None:
        if self._feed is None:
            return
        self._feed.pulse()
        now_ns = self.context.clock.now_ns()
        # A summary costs more than a frame.
        if now_ns >= self._next_summary_ns:
            self._next_summary_ns = now_ns + SUMMARY_EVERY_NS
            self._feed.update(summaries=self.report()["patches"])

    def command(self, name: str, value: Any) -> str:
        """Accept the state of the graph, and answers to requests of pages, from the launcher."""
        if name not in ("graph", "answer"):
            return super().command(name, value)
        if self._feed is not None:
            self._feed.update(**{name: value})
        return ""

    def close(self, counts: Document) -> None:
        if self._feed is not None:
            self._feed.update(summaries=self.report()["patches"])
        if self._page is not None:
            self._page.close()
        if self._opener is not None:
            self._opener.unlink(missing_ok=True)

    def status(self) -> str:
        line = self._status_line()
        if self._feed is None or not self.settings.screen:
            return line
        from .live.screen import screen

        return screen(self._feed, self._notices, line)

    def _status_line(self) -> str:
        now_ns = self.context.clock.now_ns()
        seconds = max(now_ns - self._status_ns, 1) / 1e9
        self._status_ns = now_ns

        # Of few patches each has a line.
        parts = [self._patches]
        if len(self._patches) <= FEW:
            parts = [{name: metrics} for name, metrics in self._patches.items()]
        lines = []
        for patches in parts:
            # Frames since the last line, of a patch in the mean.
            n_new = 0
            for name, metrics in patches.items():
                n_new += metrics.reconstructed
                n_new -= self._status_frames[name]
            rate_hz = n_new / seconds / len(patches)
            lines.append(status_line(patches, rate_hz))

        for name, metrics in self._patches.items():
            self._status_frames[name] = metrics.reconstructed
        return "\n".join(lines)

    def report(self) -> Document:
        summaries = {name: patch.summary() for name, patch in self._patches.items()}
        return {"patches": summaries}

    def _open_browser(self, url: str) -> bool:
        import webbrowser

        # Without a display a text browser would occupy the terminal of the graph.
        display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
        if not display or not self.context.page_file:
            return False

        # Any user can list the arguments of a browser: its token is in a file of this user's.
        self._opener = Path(self.context.page_file)
        # It is there already if the monitor has been killed and started again.
        self._opener.unlink(missing_ok=True)
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        opener = os.open(self._opener, flags, 0o600)
        with os.fdopen(opener, "w") as file:
            file.write(f'<meta http-equiv="refresh" content="0; url={url}">\n')
        return webbrowser.open(self._opener.as_uri())


def check_pose(place: str, pose: object) -> None:
    """Raise SettingsError unless this is x, y, z in mm and three angles in degrees."""
    values: list[Any] = []
    if isinstance(pose, list | tuple):
        values = list(pose)
    # Beyond a kilometre, or many turns, it is rather a mistake than a place on a robot.
    are_numbers = all(is_real(value, -1e6, 1e6) for value in values)
    if len(values) != 6 or not are_numbers:
        expected = "expected [x, y, z, roll, pitch, yaw], in mm and degrees"
        raise SettingsError(f"{place}: {expected}, got {pose!r:.80}")


def _check_batch(batch: str, names: Any) -> None:
    check_patch("name", batch)
    if not isinstance(names, list | tuple) or not names:
        raise SettingsError(f"expected a list of names, got {names!r}")
    check_patches("patches", tuple(names))


def _published_frames(
    frames: Mapping[str, Any], group: str, counts_of: Mapping[str, Any], again: bool
) -> Mapping[str, Any]:
    """Numbers of frames of a patch by the counts of the nodes that publish them; as they are where
    one of these is on another host.
    """
    taxels = topic_of(group, Taxels.schema)
    measured = topic_of(group, Measurements.schema)
    answered = topic_of(group, Reconstruction.schema)
    # A compressor outside the graph publishes no taxels.
    sensed = measured
    if taxels in counts_of:
        sensed = taxels
    needed = {sensed}
    if again:
        # The monitor that was started again has counted only its own part of the answers.
        needed.add(answered)
    if not needed <= counts_of.keys():
        return frames

    published = dict(frames)
    published["sensed"] = counts_of[sensed]["published"][sensed]
    if again:
        counts = counts_of[answered]
        published["reconstructed"] = counts["published"][answered]
        published["skipped"] = counts["skipped"].get(measured, 0)
    n_answered = published["reconstructed"] + published["skipped"]
    if sensed == taxels:
        n_answered += published.get("quiet", 0)
    published["lost"] = max(0, published["sensed"] - n_answered)
    return published


def _topics(
    settings: MonitorSettings, classes: tuple[type[Message], ...]
) -> tuple[str, ...]:
    """Topics of all patches and batches, of some classes of messages."""
    return tuple(
        topic_of(group, cls.schema) for group in settings.groups for cls in classes
    )


def _clock_of(context: Context, group: str, topic: str) -> ClockEstimate | None:
    """Clock of the publisher of a topic of a batch, or patch, by that of one of its patches."""
    _, schema = split_topic(topic)
    return context.clock_of(topic_of(group, schema))
