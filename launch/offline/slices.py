"""One recording reprocessed in time slices, which an executor computes.

A worker reconstructs a slice with a warm-up of earlier frames and writes it into a part, a
recording of its own whose frames are numbered as in the whole. Parts are joined in order.
"""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import shutil
import socket
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from sparseskin.messages import Message, Reconstruction, SkinState, topic_of
from sparseskin.nodes.bus import LOCAL_RUN_ID, Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.files import TAKEN, OutputError, check_private, os_errors, whole_file
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.monitor.metrics import PatchMetrics
from sparseskin.nodes.monitor.tally import joined, tally
from sparseskin.nodes.node import Context, Node
from sparseskin.nodes.player.settings import renamed_topics
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX, BagError, span_ns
from sparseskin.nodes.recorder.bag.frames import decoded
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter, removing
from sparseskin.nodes.recorder.node import metadata_of
from sparseskin.nodes.remote import local_path
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.tasks.fingerprint import code_fingerprint
from sparseskin.nodes.tasks.results import computed

from .job import Job, checked_out, how, make_graph, run_bus, start_of, untimed
from .plan import Slice, plan_slices, read_stamps

PARTS_SUFFIX = ".slices"
"""Suffix of the folder of parts, after the name of the result."""
PARTS = "slice_*.mcap"
"""Names of parts; each holds the number of its slice and the fingerprint of the run."""
TALLY = "tally"
"""Key of a part's counts: the figures of its frames, JSON."""
FORMAT_VERSION = 3
"""Raised when parts change their meaning."""
_CHOOSING = ("acts", "adaptive")
"""Kinds of Phi whose rows follow from earlier frames."""
_END_BYTES = 1 << 16


@dataclass(frozen=True)
class Sliced:
    """How to cut a recording: seconds of a slice (None: `LEAST_FRAMES` frames each), frames of the
    warm-up, executor, and the folder of parts ("": beside the result).
    """

    slice_s: float | None
    warm_up: int
    executor: str
    parts: str = ""


@dataclass(frozen=True)
class Task:
    """A slice for a worker: `first_ns` is the first stamp that is played of the whole recording,
    `folder` where the part is written, `launch` the provenance for its metadata.
    """

    job: Job
    how_cut: Sliced
    slice: Slice
    first_ns: int
    folder: str
    fingerprint: str
    launch: str


def run_sliced(job: Job, source: Path, how_cut: Sliced, progress: bool) -> tuple[Any, list[str]]:
    """Reprocess a recording in slices; return the monitor's summary by patch, and notes.

    Parts that an earlier run of the same recording, settings and code has finished are not computed
    again. The folder of the parts is removed once the result is complete.

    Raises
    ------
    SparseskinError
        If a slice fails, the recording cannot be cut, or the result cannot be written.
    """
    out = checked_out(job)
    if os.path.lexists(out):
        raise OutputError(f"{out}: {TAKEN}")
    folder = Path(how_cut.parts or f"{out}{PARTS_SUFFIX}").absolute()
    patch, slices, first_ns, made_by = _plan(job, source, how_cut)
    command, _, rest = how(job, made_by).partition("\n")
    launch = f"{command} (in {len(slices)} slices, warm-up {how_cut.warm_up} frames)\n{rest}"
    fingerprint = fingerprint_of(job, source, how_cut)
    with _locked(folder):
        parts = _known(folder, fingerprint, len(slices))
        missing = {
            one.number: Task(job, how_cut, one, first_ns, str(folder), fingerprint, launch)
            for one in slices
            if one.number not in parts
        }
        try:
            for number, path in _computed(missing, how_cut.executor, progress):
                parts[number] = path
        except KeyboardInterrupt:
            kept = f"{len(parts)} of {len(slices)} slices are kept in {folder}"
            print(f"{kept}; the same command continues", file=sys.stderr)
            raise
        with whole_file(out) as draft, removing(draft, out):
            tallies, seams = _join(parts, slices, patch, draft)
        for path in folder.glob(PARTS):
            path.unlink(missing_ok=True)
        for attempt in folder.glob(f".{PARTS}.*"):  # of a worker that was killed
            shutil.rmtree(attempt, ignore_errors=True)
    patches = untimed({patch: joined(tallies)})
    return patches, [_counted(slices, len(missing)), *seams]


def _plan(job: Job, source: Path, how_cut: Sliced) -> tuple[str, list[Slice], int, str]:
    """The patch of a recording, its slices, the first stamp that is played, and its provenance."""
    launch = make_graph(job, source)
    played = list(renamed_topics(launch.nodes["player"].settings))
    edge = launch.nodes.get("compressor")

    def subsets_of(state: SkinState) -> int:
        if edge is None:
            return 1
        assert isinstance(edge.settings, CompressorSettings)
        return len(edge.settings.phis(state.skin))

    if edge is not None and edge.settings.phi in _CHOOSING:
        raise SettingsError(
            f"--slices: phi {edge.settings.phi} chooses rows by earlier frames; "
            "allowed: --from measurements, or to leave out --slices"
        )
    with BagReader(source) as bag:
        start_from, patch = start_of(job, bag)
        topics = [topic for topic in played if topic in bag.topics]
        stamps = read_stamps(bag, topics, topic_of(patch, start_from), subsets_of)
        span = span_ns(bag.topics[topic] for topic in topics)
        made_by = bag.metadata.get("launch", "")
    assert span is not None
    return patch, plan_slices(stamps, how_cut.slice_s, how_cut.warm_up), span[0], made_by


def fingerprint_of(job: Job, source: Path, how_cut: Sliced) -> str:
    """Digest of all that the parts follow from: code, settings, and of the recording its size and
    its first and last 64 KiB, where its checksums are. Raises SparseskinError if it cannot be read.
    """
    cut = [how_cut.slice_s, how_cut.warm_up]
    values = [FORMAT_VERSION, code_fingerprint(), job.overrides, job.start_from, cut]
    digest = hashlib.sha256(json.dumps(values).encode())
    try:
        with source.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            digest.update(str(size).encode() + file.read(_END_BYTES))
            file.seek(max(0, size - _END_BYTES))
            digest.update(file.read(_END_BYTES))
    except OSError as error:
        raise SparseskinError(f"{source}: {error.strerror}") from error
    return digest.hexdigest()


def run_slice(task: Task) -> str:
    """Reconstruct one slice with its warm-up into a part, a task that any executor can run, also
    twice; return the name of its file.
    Raises SparseskinError if the worker reads another recording under that name, runs other code,
    or the slice fails.
    """
    where = f"worker {socket.gethostname()}"
    source, folder = local_path(task.job.source), Path(task.folder)
    if fingerprint_of(task.job, source, task.how_cut) != task.fingerprint:
        raise SparseskinError(
            f"{where}: reads another file under {task.job.source}, or runs other code of "
            "sparseskin than this process"
        )
    if not folder.is_dir():
        raise SparseskinError(f"{where}: has no folder {folder}; it must be on a shared disk")
    path = folder / _part_name(task.slice.number, task.fingerprint)
    try:
        with whole_file(path) as draft:
            _reconstruct(task, source, draft)
    except OutputError:
        if not path.is_file():  # another attempt at the same slice was first
            raise
    return path.name


def _reconstruct(task: Task, source: Path, path: Path) -> None:
    one = task.slice
    begin_ns = task.first_ns if one.first_ns is None else one.begin_ns
    duration_s = None if one.stop_ns is None else (one.stop_ns - begin_ns) / 1e9
    launch = make_graph(task.job, source, span=((begin_ns - task.first_ns) / 1e9, duration_s))
    nodes: dict[str, Any] = {n.name: (n.cls, n.settings) for n in launch.nodes.values()}
    clock = ManualClock()
    writer = SliceWriterSettings(out=str(path), task=task)
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


@dataclass(frozen=True)
class SliceWriterSettings(Settings):
    """Settings of the node that writes a slice."""

    out: str = setting("", "file to write, NAME.mcap")
    task: Task | None = setting(None, "the slice")


class SliceWriter(Node[SliceWriterSettings]):
    """Writes the messages of a slice, numbered as in the whole recording, and one of its warm-up.

    The last reconstruction of the warm-up is written as well: it shows how well the slice fits the
    one before. The counts of the file hold the figures of its frames.
    """

    Settings = SliceWriterSettings

    def __init__(self, settings: SliceWriterSettings, context: Context) -> None:
        super().__init__(settings, context)
        assert settings.task is not None
        self._task = settings.task
        self._writer: BagWriter | None = None
        self._waiting: list[tuple[int, Message]] = []
        self._states: list[Message] = []
        self._last: tuple[int, Message] | None = None
        self._seqs: Counter[str] = Counter()
        self._metrics = PatchMetrics()
        self.n_frames = 0

    @classmethod
    def inputs(cls, settings: SliceWriterSettings) -> tuple[str, ...]:
        return ("*",)

    def step(self, message: Message) -> Iterable[Message]:
        first_ns, now_ns = self._task.slice.first_ns, self.context.clock.now_ns()
        if message.latched:
            self._states.append(message)
        if first_ns is not None and message.stamp_ns < first_ns:
            if message.latched:
                self._metrics.add(message)
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
        task = self._task
        metadata = metadata_of(self._states, task.launch, "reprocess")
        self._writer = BagWriter(Path(self.settings.out), metadata)
        if self._last is not None:
            log_time_ns, message = self._last
            self._writer.record(message.published(LOCAL_RUN_ID, 0), log_time_ns)
        for log_time_ns, message in self._waiting:
            self._write(log_time_ns, message)

    def _write(self, log_time_ns: int, message: Message) -> None:
        one, topic = self._task.slice, message.topic
        before = one.counts.get(topic, one.n_states_before if message.latched else one.n_before)
        numbered = message.published(LOCAL_RUN_ID, before + self._seqs[topic])
        self._seqs[topic] += 1
        self._metrics.add(numbered)
        self.n_frames += isinstance(message, Reconstruction)
        assert self._writer is not None
        self._writer.record(numbered, log_time_ns)

    def close(self, counts: dict[str, Any]) -> None:
        if self._writer is not None:
            self._writer.close({TALLY: json.dumps(tally(self._metrics))})


def _part_name(number: int, fingerprint: str) -> str:
    return f"slice_{number:05d}_{fingerprint[:32]}{FILE_SUFFIX}"


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold the folder of the parts, made for this user alone, for one run at a time."""
    with os_errors(folder):
        folder.mkdir(mode=0o700, exist_ok=True)
    check_private(folder)
    with os_errors(folder):
        fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        try:
            yield
        finally:
            with suppress(OSError):  # something is in it
                folder.rmdir()
    except BlockingIOError as error:
        raise OutputError(f"{folder}: another run uses these slices") from error
    finally:
        os.close(fd)


def _known(folder: Path, fingerprint: str, n_slices: int) -> dict[int, Path]:
    """Parts that an earlier run has finished, by the number of their slice. Others are removed;
    one that is damaged is named.
    """
    numbers = {_part_name(number, fingerprint): number for number in range(n_slices)}
    found: dict[int, Path] = {}
    for path in sorted(folder.glob(PARTS)):
        damage = ""
        if path.name in numbers:
            try:
                with BagReader(path) as bag:
                    damage = bag.recovered and f"{path}: {bag.recovered}"
            except SparseskinError as error:
                damage = str(error)
        if damage:
            print(f"{damage}; the slice is computed again", file=sys.stderr)
        if damage or path.name not in numbers:
            path.unlink(missing_ok=True)
        else:
            found[numbers[path.name]] = path
    return found


def _computed(
    missing: dict[int, Task], executor: str, progress: bool
) -> Iterator[tuple[int, Path]]:
    """Yield the number and the file of each slice as it is finished."""
    with (
        closing(computed(executor, run_slice, missing)) as finished,
        tqdm(total=len(missing), unit="slice", disable=not progress) as bar,
    ):
        for number, future in finished:
            try:
                path = Path(missing[number].folder) / future.result()
            except SparseskinError:
                raise
            except Exception as error:  # its worker died
                raise SparseskinError(f"slice {number}: {one_line(error)}") from error
            if not path.is_file():
                raise SparseskinError(
                    f"{path}: written by a worker, and not there; the folder must be on a disk "
                    "that workers and this process share"
                )
            yield number, path
            bar.update()


def _counted(slices: Sequence[Slice], n_computed: int) -> str:
    n_frames = sum(one.n_frames for one in slices)
    n_warm_up = sum(one.n_warm_up for one in slices)
    known = len(slices) - n_computed
    text = f"{len(slices)} slices, {n_frames} frames and {n_warm_up} of warm-up"
    return text + (f"; {known} slices known from an earlier run" if known else "")


def _join(
    parts: dict[int, Path], slices: Sequence[Slice], patch: str, draft: Path
) -> tuple[list[dict[str, Any]], list[str]]:
    """Write all parts into one recording; return the tally of each, and a line about their seams.

    Raises SparseskinError if a part is not what its worker wrote, or the frames of all are not
    each frame once, in order.
    """
    topic = topic_of(patch, Reconstruction.schema)
    writer: BagWriter | None = None
    last_ns, n_frames = -1, 0
    tallies: list[dict[str, Any]] = []
    seams: list[tuple[float, float]] = []
    before: Message | None = None
    try:
        for one in slices:
            path = parts[one.number]
            with BagReader(path) as bag:
                if bag.recovered:
                    raise BagError(f"{path}: {bag.recovered}")
                tallies.append(json.loads((bag.counts or {})[TALLY]))
                if writer is None:
                    writer = BagWriter(draft, bag.metadata)
                last: Any = None
                for recorded in bag.messages():
                    if recorded.topic == topic:
                        if one.first_ns is not None and recorded.stamp_ns < one.first_ns:
                            seams += _seam(before, decoded(bag, recorded))
                            continue
                        if recorded.stamp_ns <= last_ns:
                            raise BagError(f"{path}: frame {n_frames} is not newer than the last")
                        last_ns, last, n_frames = recorded.stamp_ns, recorded, n_frames + 1
                    writer.write(recorded)
                before = None if last is None else decoded(bag, last)
        expected = sum(one.n_frames for one in slices)
        if n_frames != expected:
            raise BagError(f"{draft.name}: {n_frames} frames in the slices, expected {expected}")
        assert writer is not None
        writer.close({})
    except BaseException:
        if writer is not None:
            writer.discard()
        raise
    return tallies, _seam_lines(seams)


def _seam(before: Message | None, warm: Message) -> list[tuple[float, float]]:
    """RMS difference of a frame computed by two slices, and RMS of its forces; empty where the two
    are not of the same frame.
    """
    if not (isinstance(before, Reconstruction) and isinstance(warm, Reconstruction)):
        return []
    if before.stamp_ns != warm.stamp_ns or before.forces.shape != warm.forces.shape:
        return []
    pair = (before.forces - warm.forces, before.forces)
    rms, force = (float(np.sqrt(np.mean(np.square(one)))) for one in pair)
    return [(rms, force)]


def _seam_lines(seams: Sequence[tuple[float, float]]) -> list[str]:
    if not seams:
        return []
    rms, force = zip(*seams, strict=True)
    return [
        f"{len(rms)} seams: RMS difference of a frame computed from both sides, median "
        f"{np.median(rms):.2g}, most {max(rms):.2g}; RMS of the forces there {np.median(force):.2g}"
    ]
