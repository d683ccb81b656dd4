"""Export of bags to a dataset of LeRobot, new or joined to one that exists: for each row a window
of tactile frames, the newest forces, and the strongest contacts.
"""

from __future__ import annotations

import contextlib
import math
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Contacts, Measurements, Message, Reconstruction, SkinState, Taxels
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import OutputError, whole_folder
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import (
    FRAME_SCHEMAS,
    frame_topics,
    skin_of,
    streams,
    values_of,
)
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.base import check_installed
from sparseskin.plugins.bridges.contacts import N_STATE, state, state_names

from .lerobot_dataset import (
    ACTION,
    FORCES,
    MAX_FPS,
    STATE,
    Dataset,
    Feature,
    Part,
    Times,
    make_dataset,
)

FPS = 30
MAX_WINDOW = 4096
MAX_CONTACTS = 100
MAX_OFFSET_S = 86400


@dataclass(frozen=True)
class _Stream:
    """One topic: feature, frames in a row, all frames (n_frames, N), and their times."""

    topic: str
    key: str
    size: int
    shape: tuple[int, ...]
    skin: SkinState | None
    times_ns: Times
    values: Floats

    @property
    def period_ns(self) -> float:
        """Mean time from a frame to the next."""
        return float(self.times_ns[-1] - self.times_ns[0]) / max(1, len(self.times_ns) - 1)

    def newest(self, times_ns: Times, back: int = 0) -> npt.NDArray[np.intp]:
        """Number of the frame `back` before the last one at or before each time, at least 0."""
        last = np.searchsorted(self.times_ns, times_ns, side="right") - 1
        return np.maximum(last - back, 0)

    def part(self, back: int = 0, missing: float = math.nan) -> Part:
        """The values of those frames, with a number for readings that are missing."""

        def take(times_ns: Times, columns: slice) -> Floats:
            found = self.values[self.newest(times_ns, back), columns]
            return np.nan_to_num(found, copy=False, nan=missing)

        return self.values.shape[1], take

    def ages(self, times_ns: Times, columns: slice) -> Floats:
        """How long before each time the frames of its window were acquired, seconds."""
        window = range(self.size - 1, -1, -1)[columns]
        frames = np.stack([self.newest(times_ns, back) for back in window], axis=1)
        return ((times_ns[:, None] - self.times_ns[frames]) / 1e9).astype(np.float32)


@dataclass(frozen=True)
class _Episode:
    """What is read of a bag: the stamp of its first row, maps and contacts."""

    path: Path
    begin_ns: int
    maps: list[_Stream]
    contacts: list[_Stream]

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time between which there are frames of all topics."""
        times = [one.times_ns for one in self.maps + self.contacts]
        return max(int(each[0]) for each in times), min(int(each[-1]) for each in times)

    def check(self, rows_ns: Times, period_ns: float) -> None:
        """Raise BagError if rows lie before the first frame, or more than a period after the last;
        log frames after the last row.
        """
        (first, last) = self.span_ns
        begin = int(rows_ns[0])
        end = int(rows_ns[-1])
        late = max(period_ns, *(one.period_ns for one in self.maps + self.contacts))
        if begin < first or end > last + late:
            raise BagError(
                f"{self.path}: lasts {(last - first) / 1e9:.3f} s, but the rows of its episode are "
                f"those of {(begin - first) / 1e9:.3f} to {(end - first) / 1e9:.3f} s; state "
                "--offset, or the recording of that episode"
            )
        if end + late < last:
            left = (last - end) / 1e9
            print(f"{self.path}: its last {left:.3f} s have no rows", file=sys.stderr)

    def features(self, rows_ns: Times | None) -> dict[str, Feature]:
        """Those of maps and contacts; of a dataset that has no other, with rows at these times,
        a state and an action in any case.
        """
        found = {}
        for one in self.maps:
            n = one.values.shape[1]
            window = range(one.size - 1, -1, -1)
            found[one.key] = Feature((one.size, n), None, [one.part(back) for back in window])
            found[f"{one.key}.age"] = Feature((one.size,), None, [(one.size, one.ages)])
        parts = [one.part(missing=0) for one in self.maps]
        found[FORCES] = Feature((sum(width for width, _ in parts),), None, parts)
        if self.contacts:
            named = [(split_topic(one.topic)[0], one.shape[0]) for one in self.contacts]
            names = [name for patch, k in named for name in state_names(patch, k)]
            found[STATE] = Feature((len(names),), names, [one.part() for one in self.contacts])
        if rows_ns is not None:
            touch = found.setdefault(STATE, found[FORCES])
            parts = [_following(rows_ns, part) for part in touch.parts]
            found[ACTION] = Feature(touch.shape, touch.names, parts)
        return found


def _following(rows_ns: Times, part: Part) -> Part:
    """A block of columns at the row after each, or at the last one."""

    def take(times_ns: Times, columns: slice) -> Floats:
        after = np.searchsorted(rows_ns, times_ns, side="right")
        return part[1](rows_ns[np.minimum(after, len(rows_ns) - 1)], columns)

    return part[0], take


def export_lerobot(
    bags: Sequence[BagReader],
    out: Path,
    topics: Iterable[str] | None = None,
    fps: int | None = None,
    window: int | None = None,
    contacts: int = N_STATE,
    into: str | None = None,
    offset: str = "0",
) -> list[Path]:
    """Write a dataset into a new folder `out`, bag k being its episode k; the paths of its files.

    Parameters
    ----------
    topics
        Topics of maps and contacts; by default the reconstructions, or else the taxels, and all
        contacts.
    fps, window, contacts : int, optional
        Rows a second (30), tactile frames K of a row (as many as come in 1 / fps, rounded up), and
        contacts of a patch in the state.
    into : str, optional
        Folder of a dataset with an episode for each bag, to whose copy the features are added.
    offset : str
        Time of the first row after the first frame, seconds; of all episodes, or of each, separated
        by commas.

    The features are those of docs/howto/bridges.md. A row with timestamp s is that of the time
    t0 + offset + s, where t0 is the stamp from which on there are frames of all topics. Before K
    frames have come, the first stands in place of those that are missing. In names of features
    PATCH stands for reconstructions, PATCH_SCHEMA for others.

    Raises BagError if pyarrow is not installed, the bags have no such frames or those of different
    skins, a number is out of its range, `into` is no such dataset, or an episode is not within its
    bag; OutputError if the folder exists or cannot be written.
    """
    check_installed("writing for LeRobot", "lerobot", "pyarrow", error=BagError)
    limits = {"fps": (fps, MAX_FPS), "window": (window, MAX_WINDOW)}
    for name, (number, high) in (limits | {"contacts": (contacts, MAX_CONTACTS)}).items():
        if number is not None and not 1 <= number <= high:
            raise BagError(f"--{name}: {number} is outside 1..{high}")
    if into is not None and fps is not None:
        raise BagError("--fps: is that of the dataset of --into")
    if into is not None and out.resolve().is_relative_to(Path(into).resolve()):
        raise OutputError(f"{out}: is within the dataset of --into; state another --out")
    offsets_ns = _offsets_ns(offset, len(bags))
    joined = None if into is None else Dataset(Path(into))
    if joined and (n := len(joined.times_ns)) != len(bags):
        raise BagError(f"{into}: has {n} episodes; state as many recordings, not {len(bags)}")
    rate = joined.fps if joined else fps or FPS
    with whole_folder(out):
        with tempfile.TemporaryDirectory(dir=out, prefix=".frames") as name:
            folder = Path(name)
            sizes = dict[str, int]()
            episodes = []
            for bag, offset_ns in zip(bags, offsets_ns, strict=True):
                maps, touched = _wanted(bag, topics)
                read = [_read_map(bag, one, folder, rate, window, sizes) for one in maps]
                states = [_read_contacts(bag, one, folder, contacts) for one in touched]
                episodes.append(_episode(bag.path, read, states, offset_ns))
            lengths = [max(0, one.span_ns[1]) * rate // 10**9 + 1 for one in episodes]
            dataset = joined or make_dataset(folder / "rows", lengths, rate)
            added = []
            for one, rows_ns in zip(episodes, dataset.times_ns, strict=True):
                one.check(rows_ns, 1e9 / rate)
                added.append(one.features(None if joined else rows_ns))
                shapes = [{k: f.shape for k, f in features.items()} for features in added]
                if shapes[-1] != shapes[0]:
                    raise BagError(
                        f"{one.path}: its features differ from those of {bags[0].path}: "
                        f"{shapes[-1]}, not {shapes[0]}"
                    )
            dataset.join(out, added, _readme(episodes))
        return sorted(path for path in out.rglob("*") if path.is_file())


def _offsets_ns(text: str, n: int) -> list[int]:
    """Offsets of n episodes."""
    with contextlib.suppress(ValueError):
        found = [float(word) for word in text.split(",")]
        if len(found) in (1, n) and all(abs(one) <= MAX_OFFSET_S for one in found):
            return [round(1e9 * one) for one in found] * (n // len(found))
    raise BagError(
        f"--offset: {text[:40]!r}; allowed is a number of seconds up to {MAX_OFFSET_S}, or one for "
        f"each of {n} recordings, separated by commas"
    )


def _wanted(bag: BagReader, topics: Iterable[str] | None) -> tuple[list[str], list[str]]:
    """Topics requested; or else the reconstruction of each patch, or its taxels, and contacts."""
    found = frame_topics(bag, topics, (*FRAME_SCHEMAS, Contacts.schema))
    touched = [topic for topic in found if split_topic(topic)[1] == Contacts.schema]
    if topics is not None:
        for topic in found:
            if split_topic(topic)[1] == Measurements.schema:
                raise BagError(f"{topic}: measurements are no map; allowed are topics of forces")
        return [topic for topic in found if topic not in touched], touched
    best: dict[str, str] = {}
    for schema in (Taxels.schema, Reconstruction.schema):
        for topic in found:
            if split_topic(topic)[1] == schema:
                best[split_topic(topic)[0]] = topic
    if not best:
        raise BagError(f"{bag.path}: holds neither reconstructions nor taxels")
    return list(best.values()), touched


def _read(
    bag: BagReader, topic: str, folder: Path, values_in: Callable[[Message], Floats | None]
) -> tuple[tuple[int, ...], Times, Floats]:
    """Shape of the values of a message, stamps, and all values, each flat."""
    stamps: list[int] = []
    shape: tuple[int, ...] = ()
    with tempfile.TemporaryFile(dir=folder) as file:
        for message, _ in streams(bag, [topic], "read"):
            if (values := values_in(message)) is None:
                continue
            shape = shape or values.shape
            if values.shape != shape:
                raise BagError(f"{bag.path}: {topic}: the shape of its frames changes")
            if stamps and message.stamp_ns <= stamps[-1]:
                continue  # played again, or late
            file.write(np.ascontiguousarray(values, "<f4").tobytes())
            stamps.append(message.stamp_ns)
        if not stamps:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        file.flush()
        held = np.memmap(file, "<f4", "r", shape=(len(stamps), math.prod(shape)))
    return shape, np.array(stamps, np.int64), held


def _read_map(
    bag: BagReader,
    topic: str,
    folder: Path,
    fps: float,
    size: int | None,
    sizes: dict[str, int],
) -> _Stream:
    """A map; `sizes` has the windows of the first bag."""
    patch, schema = split_topic(topic)
    name = patch if schema == Reconstruction.schema else f"{patch}_{schema}"
    shape, stamps_ns, values = _read(bag, topic, folder, values_of)
    found = _Stream(
        topic, f"observation.tactile.{name}", 1, shape, skin_of(bag, patch), stamps_ns, values
    )
    if size is None:
        per_row = 1e9 / (fps * found.period_ns) if found.period_ns else 1
        size = sizes.setdefault(topic, min(max(1, math.ceil(per_row - 1e-6)), MAX_WINDOW))
    return replace(found, size=size)


def _read_contacts(bag: BagReader, topic: str, folder: Path, k: int) -> _Stream:
    def values_in(message: Message) -> Floats | None:
        return state(message, k) if isinstance(message, Contacts) else None

    _, stamps_ns, values = _read(bag, topic, folder, values_in)
    skin = skin_of(bag, split_topic(topic)[0])
    return _Stream(topic, STATE, 1, (k,), skin, stamps_ns, values)


def _episode(path: Path, maps: list[_Stream], contacts: list[_Stream], offset_ns: int) -> _Episode:
    """An episode with times after its begin."""
    first_ns, last_ns = _Episode(path, 0, maps, contacts).span_ns
    if last_ns < first_ns:
        raise BagError(f"{path}: its topics have no time in common")
    begin_ns = first_ns + offset_ns
    moved = [
        [replace(one, times_ns=one.times_ns - begin_ns) for one in group]
        for group in (maps, contacts)
    ]
    return _Episode(path, begin_ns, *moved)


def _readme(episodes: Sequence[_Episode]) -> str:
    """What the features are, in Markdown."""
    maps = episodes[0].maps
    contacts = episodes[0].contacts
    lines = [
        "# Tactile frames", "",
        "Of each row the last frames at or before its time, the newest last; `.age` is the time "
        f"since each was acquired, in seconds. `{FORCES}` ends with the newest of each.", "",
        "| feature | frames a row | taxels (rows x columns) | unit | range | pitch, m | topic |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for stream in maps:
        skin = stream.skin
        (n_rows, n_cols) = stream.shape
        known = (skin.unit, f"0..{skin.f_max:g}", skin.pitch_m or "-") if skin else ("-",) * 3
        cells = (stream.key, stream.size, f"{n_rows} x {n_cols}", *known, stream.topic)
        lines.append(f"| {' | '.join(map(str, cells))} |")
    if contacts:
        of = [f"{s.topic} ({s.shape[0]}, {s.skin.unit if s.skin else '-'})" for s in contacts]
        lines += [
            "",
            f"`{STATE}` ends with the contacts of the largest forces, the largest first, of "
            f"{', '.join(of)}: 1 where their frame is trusted, then of each contact total force "
            "and its standard deviation in that unit, centre and velocity in mm, area in mm2 "
            "(taxels where no pitch is known), and age in seconds; zeros where there are fewer.",
        ]
    lines += ["", "| episode | recording | stamp of timestamp 0, ns |", "|---|---|---|"]
    lines += [f"| {k} | {one.path.name} | {one.begin_ns} |" for k, one in enumerate(episodes)]
    return "\n".join(lines)
