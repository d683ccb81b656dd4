"""Reprocessing in time slices: computed by an executor, kept as parts, joined without a seam."""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from tqdm import tqdm

from sparseskin.messages import Message, Reconstruction, SkinState, topic_of
from sparseskin.messages.ranges import is_whole
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.rotation import ROTATING
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.files import TAKEN, OutputError, check_private, os_errors, whole_file
from sparseskin.nodes.lookup import one_line
from sparseskin.nodes.monitor.tally import joined
from sparseskin.nodes.player.settings import renamed_topics
from sparseskin.nodes.recorder.bag.checked import checked_once
from sparseskin.nodes.recorder.bag.format import PART_SUFFIX, BagError, span_ns
from sparseskin.nodes.recorder.bag.frames import decoded
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter, removing
from sparseskin.nodes.tasks.computed import computed
from sparseskin.nodes.tasks.fingerprint import code_fingerprint

from .job import Job, checked_out, how, make_graph, start_of, untimed
from .part import FINGERPRINT, PART_NAME, Part, PartTask, digest_of, ends_of, run_part
from .plan import Slice, plan_slices, read_stamps

PARTS_SUFFIX = ".slices"
"""Suffix of the folder of finished slices, after the name of the result."""
NOTES = "slices.jsonl"
FORMAT_VERSION = 1
"""Raised when parts change their meaning."""
_CHOOSING = ("acts", "adaptive")
"""Kinds of Phi whose rows follow from earlier frames."""
_MOST_NOTE_BYTES = 1 << 20


@dataclasses.dataclass(frozen=True)
class Sliced:
    """How to cut a recording: seconds of a slice (None: chosen), frames of the warm-up, executor,
    and the folder of finished slices ("": beside the result).
    """

    slice_s: float | None
    warm_up: int
    executor: str
    parts: str = ""


def run_sliced(job: Job, source: Path, how_cut: Sliced, progress: bool) -> tuple[Any, list[str]]:
    """Reprocess a recording in slices; return the monitor's summary by patch, and notes.

    Slices that an earlier run has finished, of the same recording, settings and code, are not
    computed again. The folder of the parts is removed once the result is complete.

    Raises
    ------
    SparseskinError
        If a slice fails, the recording cannot be cut, or the result cannot be written.
    """
    out = checked_out(job)
    if os.path.lexists(out):
        raise OutputError(f"{out}: {TAKEN}")
    folder = Path(how_cut.parts or f"{out}{PARTS_SUFFIX}").absolute()
    with checked_once():
        patch, slices, first_ns, made_by = _plan(job, source, how_cut)
        fingerprint = _fingerprint(job, source, slices)
        with _opened(folder) as notes:
            known = _known(folder, notes, fingerprint, slices)
            common: dict[str, Any] = {
                "job": job,
                "first_ns": first_ns,
                "folder": str(folder),
                "fingerprint": fingerprint,
                "launch": _how(job, how_cut, slices, made_by),
                "ends": ends_of(source),
                "code": code_fingerprint(),
            }
            missing = {
                one.number: PartTask(slice=one, **common)
                for one in slices
                if one.number not in known
            }
            try:
                for part in _computed(missing, how_cut.executor, progress):
                    known[part.number] = part
                    _note(notes, part, fingerprint)
            except KeyboardInterrupt:
                kept = f"{len(known)} of {len(slices)} slices are kept in {folder}"
                print(f"{kept}; the same command continues", file=sys.stderr)
                raise
            parts = [known[one.number] for one in slices]
            text = _counted(slices, len(missing))
            with whole_file(out) as draft, removing(draft, out):
                seams = _join(folder, parts, slices, patch, draft, fingerprint)
        _remove(folder)
    patches = untimed({patch: joined([part.tally for part in parts])})
    return patches, [text, *seams]


def _plan(job: Job, source: Path, how_cut: Sliced) -> tuple[str, list[Slice], int, str]:
    """The patch of a recording, its slices, the first stamp that is played, and its provenance."""
    launch = make_graph(job, source)
    played = list(renamed_topics(launch.nodes["player"].settings))
    edge = launch.nodes.get("compressor")

    def subsets_of(state: SkinState) -> int:
        if edge is None:
            return 1
        assert isinstance(edge.settings, CompressorSettings)
        n = state.skin.n_taxels
        rows, m = edge.settings.rows_and_m(n)
        return math.ceil(n / m) if rows == ROTATING else 1

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


def _how(job: Job, how_cut: Sliced, slices: Sequence[Slice], made_by: str) -> str:
    command, _, rest = how(job, made_by).partition("\n")
    return f"{command} (in {len(slices)} slices, warm-up {how_cut.warm_up} frames)\n{rest}"


def _fingerprint(job: Job, source: Path, slices: Sequence[Slice]) -> str:
    """Digest of all that the parts follow from."""
    parts = [dataclasses.asdict(one) for one in slices]
    values = [FORMAT_VERSION, digest_of(source), job.overrides, job.start_from, parts]
    text = json.dumps([*values, code_fingerprint()], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


@contextmanager
def _opened(folder: Path) -> Iterator[BinaryIO]:
    """Open the notes of the parts in a folder of this user alone, by one run at a time."""
    with os_errors(folder):
        folder.mkdir(mode=0o700, exist_ok=True)
    check_private(folder)
    path = folder / NOTES
    with os_errors(path):
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW, 0o600)
    with os.fdopen(fd, "a+b") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise OutputError(f"{folder}: another run uses these slices") from error
        yield file


def _note(file: BinaryIO, part: Part, fingerprint: str) -> None:
    line = json.dumps({"fingerprint": fingerprint, **dataclasses.asdict(part)})
    file.write(line.encode() + b"\n")
    file.flush()


def _known(
    folder: Path, file: BinaryIO, fingerprint: str, slices: Sequence[Slice]
) -> dict[int, Part]:
    """Parts that an earlier run has finished; one whose file differs from its note is named, and
    computed again.
    """
    file.seek(0)
    found: dict[int, Part] = {}
    whole = 0
    while (line := file.readline(_MOST_NOTE_BYTES)).endswith(b"\n"):
        whole += len(line)
        part = _noted(line, fingerprint, len(slices))
        if part is not None:
            found[part.number] = part
    file.truncate(whole)  # an incomplete last line, of a run that was killed
    for number, part in list(found.items()):
        path = folder / part.name
        what = ""
        if not path.is_file() or path.is_symlink():
            what = "is missing"
        elif digest_of(path) != part.digest:
            what = "was changed since it was written"
        if what:
            print(f"{path}: {what}; slice {number} is computed again", file=sys.stderr)
            del found[number]
    kept = {part.name for part in found.values()}
    for path in folder.iterdir():
        # Of other settings, or of attempts that were given up.
        if PART_NAME.match(path.name) and path.name not in kept:
            path.unlink(missing_ok=True)
    return found


def _noted(line: bytes, fingerprint: str, n_slices: int) -> Part | None:
    """The part of one line of the notes; None if it is of another run, or no such line."""
    try:
        values = json.loads(line)
        if values.pop("fingerprint") != fingerprint:
            return None
        part = Part(**values)
        joined([part.tally])
        fits = PART_NAME.fullmatch(part.name) and isinstance(part.digest, str)
        return part if fits and is_whole(part.number, 0, n_slices - 1) else None
    except (ValueError, TypeError, KeyError, AttributeError, IndexError, RecursionError):
        return None


def _computed(missing: dict[int, PartTask], executor: str, progress: bool) -> Iterator[Part]:
    with (
        closing(computed(executor, run_part, missing)) as finished,
        tqdm(total=len(missing), unit="slice", disable=not progress) as bar,
    ):
        for number, future in finished:
            try:
                part = future.result()
            except SparseskinError:
                raise
            except Exception as error:
                raise SparseskinError(f"slice {number}: {one_line(error)}") from error
            folder = Path(missing[number].folder)
            if not (folder / part.name).is_file():
                raise SparseskinError(
                    f"{folder / part.name}: written by a worker, and not there; the folder must "
                    "be on a disk that workers and this process share"
                )
            yield part
            bar.update()


def _counted(slices: Sequence[Slice], n_computed: int) -> str:
    n_frames = sum(one.n_frames for one in slices)
    n_warm_up = sum(one.n_warm_up for one in slices)
    known = len(slices) - n_computed
    text = f"{len(slices)} slices, {n_frames} frames and {n_warm_up} of warm-up"
    return text + (f"; {known} slices known from an earlier run" if known else "")


def _join(
    folder: Path,
    parts: Sequence[Part],
    slices: Sequence[Slice],
    patch: str,
    draft: Path,
    fingerprint: str,
) -> list[str]:
    """Write all parts into one recording; return lines about their seams.

    Raises SparseskinError if a part is not what its worker wrote, or the frames of all are not
    each frame once, in order.
    """
    topic = topic_of(patch, Reconstruction.schema)
    writer: BagWriter | None = None
    last_ns, n_frames, seams = -1, 0, _Seams()
    before: Message | None = None
    try:
        for part, one in zip(parts, slices, strict=True):
            path = folder / part.name
            if digest_of(path) != part.digest:
                raise BagError(f"{path}: was changed since it was written")
            with BagReader(path) as bag:
                if bag.recovered or bag.metadata.get(FINGERPRINT) != fingerprint:
                    raise BagError(f"{path}: {bag.recovered or 'is of another recording'}")
                if writer is None:
                    metadata = {k: v for k, v in bag.metadata.items() if k != FINGERPRINT}
                    writer = BagWriter(draft, metadata)
                last: Any = None
                for channel, recorded in bag.records():
                    if recorded.topic == topic:
                        if one.first_ns is not None and recorded.stamp_ns < one.first_ns:
                            seams.add(before, decoded(bag, recorded))
                            continue
                        if recorded.stamp_ns <= last_ns:
                            raise BagError(f"{path}: frame {n_frames} is not newer than the last")
                        last_ns, last, n_frames = recorded.stamp_ns, recorded, n_frames + 1
                    writer.write(
                        recorded.topic,
                        recorded.payload,
                        schema=channel.schema,
                        version=channel.version,
                        log_time_ns=recorded.log_time_ns,
                        stamp_ns=recorded.stamp_ns,
                    )
                before = None if last is None else decoded(bag, last)
        expected = sum(one.n_frames for one in slices)
        if n_frames != expected:
            raise BagError(f"{folder}: holds {n_frames} frames of {expected}")
        assert writer is not None
        writer.close({})
    except BaseException:
        if writer is not None:
            writer.discard()
        raise
    return seams.lines()


class _Seams:
    """Differences between the last frame of a slice and that of the next warm-up."""

    def __init__(self) -> None:
        self._rms: list[float] = []
        self._force: list[float] = []

    def add(self, before: Message | None, warm: Message) -> None:
        if isinstance(before, Reconstruction) and isinstance(warm, Reconstruction):
            same = before.stamp_ns == warm.stamp_ns and before.forces.shape == warm.forces.shape
            if same:
                difference = before.forces - warm.forces
                self._rms.append(float(np.sqrt(np.mean(np.square(difference)))))
                self._force.append(float(np.sqrt(np.mean(np.square(before.forces)))))

    def lines(self) -> list[str]:
        if not self._rms:
            return []
        return [
            f"{len(self._rms)} seams: RMS difference of a frame computed from both sides, median "
            f"{np.median(self._rms):.2g}, most {max(self._rms):.2g}; RMS of the forces there "
            f"{np.median(self._force):.2g}"
        ]


def _remove(folder: Path) -> None:
    """Remove all parts and their notes; what else lies in the folder stays, and so does it then."""
    with suppress(OSError):
        for path in folder.iterdir():
            if PART_NAME.fullmatch(path.name.removesuffix(PART_SUFFIX)) or path.name == NOTES:
                path.unlink(missing_ok=True)
        folder.rmdir()
