"""Export of bags to a dataset of LeRobot, new or joined to one that exists: for each row a window
of tactile frames, the newest forces, and the strongest contacts.
"""

import contextlib
import math
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from sparseskin.messages import (
    Contacts,
    Measurements,
    Message,
    Reconstruction,
    SkinState,
    Taxels,
)
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.files import OutputError, whole_folder
from sparseskin.nodes.numerics.arrays import Floats, Indices
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
        span_ns = float(self.times_ns[-1] - self.times_ns[0])
        return span_ns / max(1, len(self.times_ns) - 1)

    def newest(self, times_ns: Times, back: int = 0) -> Indices:
        """Number of the frame `back` before the last one at or before each time, at least 0."""
        # Never a frame of later: a policy would see the future.
        newest_frames = np.searchsorted(self.times_ns, times_ns, side="right") - 1
        return np.maximum(newest_frames - back, 0)

    def part(self, back: int = 0, missing: float = math.nan) -> Part:
        """The values of those frames, with a number for readings that are missing."""

        def take(times_ns: Times, columns: slice) -> Floats:
            # Columns of a few frames: the file is mapped, and not read as a whole.
            values = self.values[self.newest(times_ns, back), columns]
            return np.nan_to_num(values, copy=False, nan=missing)

        return self.values.shape[1], take

    def ages(self, times_ns: Times, columns: slice) -> Floats:
        """How long before each time the frames of its window were acquired, seconds."""
        # The oldest frame of a window stands first.
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
        times = [stream.times_ns for stream in self.maps + self.contacts]
        first_ns = max(int(stream_times[0]) for stream_times in times)
        last_ns = min(int(stream_times[-1]) for stream_times in times)
        return first_ns, last_ns

    def n_rows(self, rate: int) -> int:
        """Rows of the episode at a rate a second, where no dataset states them."""
        _, last_ns = self.span_ns
        return max(0, last_ns) * rate // 10**9 + 1

    def check(self, rows_ns: Times, period_ns: float) -> None:
        """Raise BagError if rows lie before the first frame, or more than a period after the last;
        log frames after the last row.
        """
        first_ns, last_ns = self.span_ns
        begin_ns = int(rows_ns[0])
        end_ns = int(rows_ns[-1])
        periods_ns = [stream.period_ns for stream in self.maps + self.contacts]
        # The last row may lie between two frames of the slowest topic.
        slack_ns = max(period_ns, *periods_ns)
        if begin_ns < first_ns or end_ns > last_ns + slack_ns:
            span_s = (last_ns - first_ns) / 1e9
            begin_s = (begin_ns - first_ns) / 1e9
            end_s = (end_ns - first_ns) / 1e9
            raise BagError(
                f"{self.path}: lasts {span_s:.3f} s, but the rows of its episode are those of "
                f"{begin_s:.3f} to {end_s:.3f} s; state --offset, or the recording of that episode"
            )
        # Allowed, as people stop a robot before its recorder; but it may be the wrong recording.
        if end_ns + slack_ns < last_ns:
            print(
                f"{self.path}: its last {(last_ns - end_ns) / 1e9:.3f} s have no rows",
                file=sys.stderr,
            )

    def features(self, rows_ns: Times | None) -> dict[str, Feature]:
        """Those of maps and contacts; of a dataset that has no other, with rows at these times,
        a state and an action in any case.
        """
        features = {}
        for stream in self.maps:
            n = stream.values.shape[1]
            window = range(stream.size - 1, -1, -1)
            frames = [stream.part(back) for back in window]
            ages = [(stream.size, stream.ages)]
            features[stream.key] = Feature((stream.size, n), None, frames)
            features[f"{stream.key}.age"] = Feature((stream.size,), None, ages)

        # A NaN in the state would spoil a training: a missing reading is no force there.
        forces = [stream.part(missing=0) for stream in self.maps]
        n_forces = sum(width for width, _ in forces)
        features[FORCES] = Feature((n_forces,), None, forces)

        if self.contacts:
            names: list[str] = []
            for stream in self.contacts:
                patch, _ = split_topic(stream.topic)
                names += state_names(patch, stream.shape[0])
            states = [stream.part() for stream in self.contacts]
            features[STATE] = Feature((len(names),), names, states)

        # LeRobot trains nothing without a state and an action: what is felt, and felt next.
        if rows_ns is not None:
            touched = features.setdefault(STATE, features[FORCES])
            parts = [_following(rows_ns, part) for part in touched.parts]
            features[ACTION] = Feature(touched.shape, touched.names, parts)
        return features


def _following(rows_ns: Times, part: Part) -> Part:
    """A block of columns at the row after each, or at the last one."""
    width, take_part = part

    def take(times_ns: Times, columns: slice) -> Floats:
        # An action is what comes next.
        following = np.searchsorted(rows_ns, times_ns, side="right")
        following = np.minimum(following, len(rows_ns) - 1)
        return take_part(rows_ns[following], columns)

    return width, take


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
    numbers = {"fps": fps, "window": window, "contacts": contacts}
    _check_options(numbers, out, into)
    offsets_ns = _offsets_ns(offset, len(bags))
    rate = fps or FPS
    # Rows are those of the dataset where there is one.
    existing = None
    if into is not None:
        existing = _dataset_of(into, len(bags))
        rate = existing.fps

    with whole_folder(out):
        with tempfile.TemporaryDirectory(dir=out, prefix=".frames") as name:
            folder = Path(name)
            # All episodes have the window of the first one: shapes of features must agree.
            sizes: dict[str, int] = {}
            episodes = []
            for bag, offset_ns in zip(bags, offsets_ns, strict=True):
                maps = []
                states = []
                for topic in _topics_of(bag, topics):
                    if topic.endswith(f"/{Contacts.schema}"):
                        states.append(_read_contacts(bag, topic, folder, contacts))
                    else:
                        maps.append(_read_map(bag, topic, folder, rate, window, sizes))
                episodes.append(_episode(bag.path, maps, states, offset_ns))

            dataset = existing
            # Its length is known once all topics have been read.
            if dataset is None:
                lengths = [episode.n_rows(rate) for episode in episodes]
                dataset = make_dataset(folder / "rows", lengths, rate)

            added: list[dict[str, Feature]] = []
            for episode, rows_ns in zip(episodes, dataset.times_ns, strict=True):
                episode.check(rows_ns, 1e9 / rate)
                added.append(episode.features(None if existing else rows_ns))
                _check_shapes(added, episode.path, bags[0].path)
            dataset.join(out, added, _readme(episodes))
        return sorted(path for path in out.rglob("*") if path.is_file())


def _dataset_of(into: str, n_episodes: int) -> Dataset:
    """The dataset in a folder. Raises BagError if it has another number of episodes."""
    dataset = Dataset(Path(into))
    n = len(dataset.times_ns)
    if n != n_episodes:
        raise BagError(
            f"{into}: has {n} episodes; state as many recordings, not {n_episodes}"
        )
    return dataset


def _check_shapes(
    added: Sequence[dict[str, Feature]], path: Path, path_of_first: Path
) -> None:
    """Raise BagError if the features of the last episode have other shapes than the first one's."""
    # A dataset has one shape of each feature for all of its episodes.
    expected = {key: feature.shape for key, feature in added[0].items()}
    shapes = {key: feature.shape for key, feature in added[-1].items()}
    if shapes != expected:
        raise BagError(
            f"{path}: its features differ from those of {path_of_first}: {shapes}, not "
            f"{expected}"
        )


def _check_options(numbers: dict[str, int | None], out: Path, into: str | None) -> None:
    """Raise BagError or OutputError if an option is out of its range, or contradicts another."""
    highest = {
        "fps": MAX_FPS,
        "window": MAX_WINDOW,
        "contacts": MAX_CONTACTS,
    }
    for name, number in numbers.items():
        if number is not None and not 1 <= number <= highest[name]:
            raise BagError(f"--{name}: {number} is outside 1..{highest[name]}")
    if into is not None and numbers["fps"] is not None:
        raise BagError("--fps: is that of the dataset of --into")
    if into is not None and out.resolve().is_relative_to(Path(into).resolve()):
        raise OutputError(
            f"{out}: is within the dataset of --into; state another --out"
        )


def _offsets_ns(text: str, n: int) -> list[int]:
    """Offsets of n episodes."""
    with contextlib.suppress(ValueError):
        offsets_s = [float(word) for word in text.split(",")]
        if len(offsets_s) == 1:
            offsets_s *= n
        # NaN is not allowed either.
        are_allowed = all(abs(seconds) <= MAX_OFFSET_S for seconds in offsets_s)
        if are_allowed and len(offsets_s) == n:
            return [round(1e9 * seconds) for seconds in offsets_s]
    raise BagError(
        f"--offset: {text[:40]!r}; allowed is a number of seconds up to {MAX_OFFSET_S}, or one for "
        f"each of {n} recordings, separated by commas"
    )


def _topics_of(bag: BagReader, topics: Iterable[str] | None) -> list[str]:
    """Topics requested; or else the reconstruction of each patch, or its taxels, and contacts."""
    readable = frame_topics(bag, topics, (*FRAME_SCHEMAS, Contacts.schema))
    if topics is not None:
        for topic in readable:
            if topic.endswith(f"/{Measurements.schema}"):
                raise BagError(
                    f"{topic}: measurements are no map; allowed are topics of forces"
                )
        return readable

    # A reconstruction goes before the taxels of its patch.
    map_of_patch: dict[str, str] = {}
    for map_schema in (Taxels.schema, Reconstruction.schema):
        for topic in readable:
            patch, schema = split_topic(topic)
            if schema == map_schema:
                map_of_patch[patch] = topic
    if not map_of_patch:
        raise BagError(f"{bag.path}: holds neither reconstructions nor taxels")
    contacts = [topic for topic in readable if topic.endswith(f"/{Contacts.schema}")]
    return [*map_of_patch.values(), *contacts]


def _read(
    bag: BagReader,
    topic: str,
    folder: Path,
    values_in: Callable[[Message], Floats | None],
) -> tuple[tuple[int, ...], Times, Floats]:
    """Shape of the values of a message, stamps, and all values, each flat."""
    stamps: list[int] = []
    shape: tuple[int, ...] = ()
    # In a file: a recording may be larger than the memory.
    with tempfile.TemporaryFile(dir=folder) as file:
        for message, _ in streams(bag, [topic], "read"):
            values = values_in(message)
            if values is None:
                continue
            shape = shape or values.shape
            if values.shape != shape:
                raise BagError(f"{bag.path}: {topic}: the shape of its frames changes")
            if stamps and message.stamp_ns <= stamps[-1]:
                # Played again, or late.
                continue
            file.write(np.ascontiguousarray(values, "<f4").tobytes())
            stamps.append(message.stamp_ns)
        if not stamps:
            raise BagError(f"{bag.path}: {topic}: states messages, but holds none")
        file.flush()
        # The mapping keeps the deleted file until the dataset is written.
        mapped = np.memmap(file, "<f4", "r", shape=(len(stamps), math.prod(shape)))
    return shape, np.array(stamps, np.int64), mapped


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
    key = f"observation.tactile.{patch}"
    if schema != Reconstruction.schema:
        key = f"{key}_{schema}"
    shape, stamps_ns, values = _read(bag, topic, folder, values_of)
    stream = _Stream(topic, key, 1, shape, skin_of(bag, patch), stamps_ns, values)

    # As many frames as come in the time of a row.
    if size is None:
        per_row = 1.0
        if stream.period_ns:
            per_row = 1e9 / (fps * stream.period_ns)
        n_frames = min(max(1, math.ceil(per_row - 1e-6)), MAX_WINDOW)
        size = sizes.setdefault(topic, n_frames)
    return replace(stream, size=size)


def _read_contacts(bag: BagReader, topic: str, folder: Path, k: int) -> _Stream:
    def values_in(message: Message) -> Floats | None:
        if not isinstance(message, Contacts):
            return None
        return state(message, k)

    _, stamps_ns, values = _read(bag, topic, folder, values_in)
    patch, _ = split_topic(topic)
    skin = skin_of(bag, patch)
    return _Stream(topic, STATE, 1, (k,), skin, stamps_ns, values)


def _episode(
    path: Path, maps: list[_Stream], contacts: list[_Stream], offset_ns: int
) -> _Episode:
    """An episode with times after its begin."""
    # With times as they are in the bag.
    first_ns, last_ns = _Episode(path, 0, maps, contacts).span_ns
    if last_ns < first_ns:
        raise BagError(f"{path}: its topics have no time in common")

    begin_ns = first_ns + offset_ns
    return _Episode(path, begin_ns, _after(maps, begin_ns), _after(contacts, begin_ns))


def _after(streams: list[_Stream], begin_ns: int) -> list[_Stream]:
    """Streams with times after the begin of an episode."""
    return [replace(stream, times_ns=stream.times_ns - begin_ns) for stream in streams]


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
        n_rows, n_cols = stream.shape
        about_skin = "- | - | -"
        if skin is not None:
            about_skin = f"{skin.unit} | 0..{skin.f_max:g} | {skin.pitch_m or '-'}"
        lines.append(
            f"| {stream.key} | {stream.size} | {n_rows} x {n_cols} | {about_skin} | "
            f"{stream.topic} |"
        )
    if contacts:
        contact_texts = []
        for stream in contacts:
            unit = stream.skin.unit if stream.skin else "-"
            contact_texts.append(f"{stream.topic} ({stream.shape[0]}, {unit})")
        lines += [
            "",
            f"`{STATE}` ends with the contacts of the largest forces, the largest first, of "
            f"{', '.join(contact_texts)}: 1 where their frame is trusted, then of each contact "
            "total force and its standard deviation in that unit, centre and velocity in mm, "
            "area in mm2 (taxels where no pitch is known), and age in seconds; zeros where there "
            "are fewer.",
        ]
    lines += ["", "| episode | recording | stamp of timestamp 0, ns |", "|---|---|---|"]
    for k, episode in enumerate(episodes):
        lines.append(f"| {k} | {episode.path.name} | {episode.begin_ns} |")
    return "\n".join(lines)
