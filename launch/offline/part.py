"""One slice of a recording, reconstructed by a worker into a file of its own."""

from __future__ import annotations

import hashlib
import os
import re
import secrets
import socket
from collections import Counter
from collections.abc import Iterable
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sparseskin.messages import Message, Reconstruction
from sparseskin.nodes.bus import LOCAL_RUN_ID, Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.monitor.metrics import PatchMetrics
from sparseskin.nodes.monitor.tally import tally
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.recorder.bag.checked import checked_once
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, PART_SUFFIX
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.recorder.node import metadata_of
from sparseskin.nodes.remote import local_path
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.tasks.fingerprint import code_fingerprint

from .job import Job, Span, make_graph, run_bus
from .plan import Slice, n_states_before

PART_NAME = re.compile(r"slice_\d{5,6}_[0-9a-f]{16}\.mcap")
FINGERPRINT = "slice_of"
"""Key of a part's metadata: fingerprint of recording, settings and slices."""
_END_BYTES = 1 << 16


@dataclass(frozen=True)
class PartTask:
    """What a worker is to compute: a slice of the recording of a job.

    Attributes
    ----------
    job : Job
    slice : Slice
    first_ns : int
        First stamp that is played of the whole recording.
    folder : str
        Where the part is written.
    fingerprint, launch : str
        What it is part of, and its provenance, for its metadata.
    ends, code : str
        Compared with the recording and the code that the worker finds.
    """

    job: Job
    slice: Slice
    first_ns: int
    folder: str
    fingerprint: str
    launch: str
    ends: str
    code: str


@dataclass(frozen=True)
class Part:
    """A finished part, as it is noted: number, file, digest of its bytes, figures of its patch."""

    number: int
    name: str
    digest: str
    tally: dict[str, Any]


@dataclass(frozen=True)
class SliceSettings(Settings):
    """Settings of the node that writes a slice."""

    out: str = setting("", "file to write, NAME.mcap")
    first_ns: int | None = setting(None, "stamp of the first frame to write; by default all are")
    n_before: int = setting(0, "frames of earlier slices")
    n_states: int = setting(0, "states in earlier slices")
    counts: dict[str, Any] | None = setting(None, "messages of earlier slices, by played topic")
    launch: str = setting("", "provenance, kept in the file")
    fingerprint: str = setting("", "what the file is a part of, kept in it")


class SliceWriter(Node[SliceSettings]):
    """Writes the messages of a slice, numbered as in the whole recording, and one of its warm-up.

    The last reconstruction of the warm-up is written as well: it shows how well the slice fits the
    one before.
    """

    Settings = SliceSettings

    def __init__(self, settings: SliceSettings, context: Context) -> None:
        super().__init__(settings, context)
        self._writer: BagWriter | None = None
        self._waiting: list[tuple[int, Message]] = []
        self._states: list[Message] = []
        self._last: tuple[int, Message] | None = None
        self._seqs: Counter[str] = Counter()
        self.metrics = PatchMetrics()
        self.n_frames = 0

    @classmethod
    def inputs(cls, settings: SliceSettings) -> tuple[str, ...]:
        return ("*",)

    def step(self, message: Message) -> Iterable[Message]:
        first_ns, now_ns = self.settings.first_ns, self.context.clock.now_ns()
        if message.latched:
            self._states.append(message)
        if first_ns is not None and message.stamp_ns < first_ns:
            if message.latched:
                self.metrics.add(message)
            elif isinstance(message, Reconstruction):
                self._last = now_ns, message
        elif self._writer is None and message.latched:
            self._waiting.append((now_ns, message))  # the file begins with the states
        else:
            if self._writer is None:
                self._begin()
            self._write(now_ns, message)
        return ()

    def _begin(self) -> None:
        s = self.settings
        metadata = metadata_of(self._states, s.launch, "reprocess")
        self._writer = BagWriter(Path(s.out), {**metadata, FINGERPRINT: s.fingerprint})
        if self._last is not None:
            log_time_ns, message = self._last
            self._writer.record(message.published(LOCAL_RUN_ID, 0), log_time_ns)
        waiting, self._waiting = self._waiting, []
        for log_time_ns, message in waiting:
            self._write(log_time_ns, message)

    def _write(self, log_time_ns: int, message: Message) -> None:
        numbered = message.published(LOCAL_RUN_ID, self._seq_of(message))
        self.metrics.add(numbered)
        self.n_frames += isinstance(message, Reconstruction)
        assert self._writer is not None
        self._writer.record(numbered, log_time_ns)

    def _seq_of(self, message: Message) -> int:
        """Number of a message in the whole recording."""
        s, topic = self.settings, message.topic
        k = self._seqs[topic]
        self._seqs[topic] += 1
        before = s.n_states if message.latched else s.n_before
        return k + int((s.counts or {}).get(topic, before))

    def close(self, counts: dict[str, Any]) -> None:
        if self._writer is not None:
            self._writer.close({})


def run_part(task: PartTask) -> Part:
    """Reconstruct one slice with its warm-up; a task that any executor can run, also twice.

    Raises
    ------
    SparseskinError
        If the worker reads another file under that name, runs other code, or the slice fails.
    """
    where = f"worker {socket.gethostname()}"
    if task.code != code_fingerprint():
        raise SparseskinError(f"{where}: runs other code of sparseskin than this process")
    source = local_path(task.job.source)
    if ends_of(source) != task.ends:
        raise SparseskinError(f"{where}: reads another file under {task.job.source}")
    folder = Path(task.folder)
    if not folder.is_dir():
        raise SparseskinError(f"{where}: has no folder {folder}; it must be on a shared disk")
    # A name for each attempt: one that was given up may still be running.
    name = f"slice_{task.slice.number:05d}_{secrets.token_hex(8)}{FILE_SUFFIX}"
    try:
        with checked_once():
            return _run_part(task, source, folder / name)
    except BaseException:
        for left in (folder / name, folder / f"{name}{PART_SUFFIX}"):
            left.unlink(missing_ok=True)
        raise


def _run_part(task: PartTask, source: Path, path: Path) -> Part:
    one = task.slice
    begin_ns = task.first_ns if one.first_ns is None else one.begin_ns
    start_s = (begin_ns - task.first_ns) / 1e9
    duration_s = None if one.stop_ns is None else (one.stop_ns - begin_ns) / 1e9
    launch = make_graph(task.job, source, span=Span(start_s, duration_s))
    writer = SliceSettings(
        out=str(path),
        first_ns=one.first_ns,
        n_before=one.n_before,
        n_states=n_states_before(one),
        counts=one.counts,
        launch=task.launch,
        fingerprint=task.fingerprint,
    )
    nodes: dict[str, Any] = {n.name: (n.cls, n.settings) for n in launch.nodes.values()}
    clock = ManualClock()
    bus = Bus({**nodes, "writer": (SliceWriter, writer)}, clock)
    with closing(bus):
        run_bus(bus, clock)
    bus.check()
    node = bus.hosts["writer"].node
    assert isinstance(node, SliceWriter)
    if node.n_frames != one.n_frames:
        raise SparseskinError(
            f"slice {one.number}: {node.n_frames} frames reconstructed of {one.n_frames}"
        )
    return Part(one.number, path.name, digest_of(path), tally(node.metrics))


def digest_of(path: Path) -> str:
    """SHA-256 of a file. Raises SparseskinError if it cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise SparseskinError(f"{path}: {error.strerror}") from error


def ends_of(path: Path) -> str:
    """Digest of the size of a recording and of its first and last 64 KiB, where its checksums are.

    Raises SparseskinError if it cannot be read.
    """
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest = hashlib.sha256(str(size).encode() + file.read(_END_BYTES))
            file.seek(max(0, size - _END_BYTES))
            digest.update(file.read(_END_BYTES))
    except OSError as error:
        raise SparseskinError(f"{path}: {error.strerror}") from error
    return digest.hexdigest()
