"""Time slices of a recording: where it is cut, and where the work for a slice begins."""

from __future__ import annotations

import bisect
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from sparseskin.messages import End, SkinState
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.node_host import is_latched
from sparseskin.nodes.recorder.bag.frames import decoded
from sparseskin.nodes.recorder.bag.reader import BagReader

WARM_UP = 256
"""Frames before a slice that are reconstructed and left out of its result. Measured
(`make stress STRESS=test_slices.py`): on scenes from 64 frames on at N/3 and from 128 at N/8, on a
recording of a bed from 256, a solver that began with nothing differs from one that ran all the time
by no more than two that ran all the time with other random shifts. The watch for stuck taxels needs
200 frames."""
LEAST_FRAMES = 20 * WARM_UP
"""Frames of a slice where no length is stated: the warm-up is then a twentieth of the work."""
MAX_SLICES = 100_000


@dataclass(frozen=True)
class Slice:
    """One slice of a recording.

    Attributes
    ----------
    number : int
        From 0.
    first_ns, stop_ns : int or None
        Its frames have stamps in [first_ns, stop_ns); None: from the begin, to the end.
    begin_ns : int
        Stamp of the first frame of the warm-up; that of the first frame where there is none.
    n_frames, n_before, n_warm_up : int
        Number of its frames, of those of earlier slices, and of those of its warm-up.
    counts : dict of str to int
        Number of messages of earlier slices by recorded topic.
    """

    number: int
    first_ns: int | None
    stop_ns: int | None
    begin_ns: int
    n_frames: int
    n_before: int
    n_warm_up: int
    counts: dict[str, int] = field(default_factory=dict)

    @property
    def n_states_before(self) -> int:
        """Number of states (skin, Phi) that were recorded before it."""
        return sum(n for topic, n in self.counts.items() if is_latched(topic))


@dataclass
class Stamps:
    """Stamps of a recording in recorded order, by topic, and at which frame a skin is announced.

    Attributes
    ----------
    frames : array of int
        Stamps of the stream that is reprocessed, increasing.
    others : dict of str to array of int
        Those of the other topics that are played.
    skins : list of (int, int)
        (frame, P): from that frame on, P row subsets are measured in turn, the first one first.
    """

    frames: array[int]
    others: dict[str, array[int]]
    skins: list[tuple[int, int]]


def read_stamps(
    bag: BagReader, topics: list[str], stream: str, subsets_of: Callable[[SkinState], int]
) -> Stamps:
    """Read the stamps of the played topics.

    `stream` is the topic that is reprocessed; `subsets_of` returns the number of row subsets that
    the frames of a skin are measured by.

    Raises
    ------
    SparseskinError
        If stamps of the stream do not increase, or the recording cannot be read.
    """
    found = Stamps(array("q"), {t: array("q") for t in topics if t != stream}, [])
    frames = found.frames
    for recorded in bag.messages(topics):
        if recorded.schema == End.schema:
            continue
        if recorded.topic != stream:
            schema = split_topic(recorded.topic)[1]
            if schema == SkinState.schema:
                state = decoded(bag, recorded)
                if isinstance(state, SkinState):
                    found.skins.append((len(frames), subsets_of(state)))
            found.others[recorded.topic].append(recorded.stamp_ns)
        elif frames and recorded.stamp_ns <= frames[-1]:
            raise SparseskinError(
                f"frame {len(frames)} of {stream} is not newer than the one before: the recording "
                "cannot be cut into slices; leave out --slices"
            )
        else:
            frames.append(recorded.stamp_ns)
    if not frames:
        raise SparseskinError(f"holds no frames on {stream}")
    return found


def plan_slices(stamps: Stamps, slice_s: float | None, warm_up: int) -> list[Slice]:
    """Cut a recording into slices.

    Parameters
    ----------
    stamps : Stamps
    slice_s : float or None
        Length of a slice, seconds; None: `LEAST_FRAMES` frames each.
    warm_up : int
        Frames before a slice that are reconstructed with it. A few more are, so that the row
        subsets of rotating rows come in the order of the whole recording.

    Raises
    ------
    SettingsError
        If there were more than 100,000 slices.
    """
    frames = stamps.frames
    if slice_s is None:
        firsts = list(range(0, len(frames), LEAST_FRAMES))
        if len(firsts) > 1 and len(frames) - firsts[-1] < LEAST_FRAMES // 2:
            firsts.pop()
    else:
        length_ns = max(1, round(1e9 * slice_s))
        n_slices = math.ceil((frames[-1] + 1 - frames[0]) / length_ns)
        if n_slices > MAX_SLICES:
            raise SettingsError(f"--slices {slice_s:g}: {n_slices} slices, at most {MAX_SLICES}")
        ends = (frames[0] + k * length_ns for k in range(n_slices))
        # A pause of the recording may leave a slice without frames.
        firsts = sorted({bisect.bisect_left(frames, end_ns) for end_ns in ends})
    others = {t: np.sort(np.frombuffer(of, np.int64)) for t, of in stamps.others.items()}
    found = []
    for number, (first, stop) in enumerate(zip(firsts, [*firsts[1:], len(frames)], strict=True)):
        begin = _begin(stamps.skins, max(0, first - warm_up)) if number else 0
        first_ns = frames[first] if number else None
        found.append(
            Slice(
                number=number,
                first_ns=first_ns,
                stop_ns=frames[stop] if stop < len(frames) else None,
                begin_ns=frames[begin],
                n_frames=stop - first,
                n_before=first,
                n_warm_up=first - begin,
                counts={
                    t: int(np.searchsorted(of, frames[first])) if number else 0
                    for t, of in others.items()
                },
            )
        )
    return found


def _begin(skins: list[tuple[int, int]], frame: int) -> int:
    """The last frame up to `frame` that is measured by the first row subset."""
    origin, n_subsets = max((s for s in skins if s[0] <= frame), default=(0, 1))
    return frame - (frame - origin) % n_subsets
