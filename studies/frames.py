"""Sources of frames for studies: scenes, presses and recordings, stated as data."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache, lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.numerics.arrays import Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX
from sparseskin.nodes.sensor.files.format import suffixes
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene
from sparseskin.nodes.sensor.scenes.simulation import Scene
from sparseskin.nodes.touch import in_contact
from sparseskin.recordings import read_recording
from sparseskin.studies.presses import press_frames, scattered_mask

from .evaluate import LOADED
from .points import StudyError

NOISE = NoiseModel.for_range(PAPER_F_MAX_N)
MOST_KEPT = 500
"""Frames of a scene that a worker keeps in memory; more are simulated anew for each point."""
MOST_PADS = 300
MAX_PAD = 12
Pairs: TypeAlias = Iterable[tuple[Floats, Floats]]


def scene_frames(
    scene: str,
    seed: int,
    first: int = 0,
    stop: int | None = None,
    every: int = 1,
    times: float = 1,
) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of the frames first, first + every, ... below `stop` (None: the end).

    The noise of a frame is `times` what a sensor node of that seed adds to it, whichever other
    frames are asked for. Arrays are fresh, float32, shape (n_rows, n_cols), newtons.
    """
    source = open_scene(scene, seed)
    noise = NoiseModel.for_range(source.skin.f_max, times)
    rng = np.random.default_rng(seed)
    for k, (_, truth) in enumerate(islice(source, stop)):
        taxels = noise.apply(truth, rng)
        if k >= first and (k - first) % every == 0:
            yield truth, taxels


@cache
def first_contact(scene: str, seed: int) -> int:
    """Number of a scene's first frame in contact."""
    f_max_n = scene_of(scene).f_max_n
    frames = enumerate(open_scene(scene, seed))
    return next(k for k, (_, truth) in frames if in_contact(truth, f_max_n))


@cache
def scene_of(scene: str) -> Scene:
    """A scene by name: its shape, number of frames, time step and range."""
    return SCENES[scene]()


@dataclass(frozen=True)
class Take:
    """Frames of a source, and what estimators and scores have to know of them.

    `mask`: True where a taxel exists; `f_max`: upper end of the range, in the unit of the frames;
    `parts` returns the parts, between which estimators are reset, of (truth, taxels): float32,
    shape (n_rows, n_cols); `sigma_end`, `norm`, `total`: as of `make_method` and `Scores`;
    `unscored`: first frames of each part that are not scored; `pitch_mm`: where known.
    """

    mask: Mask
    f_max: float
    parts: Callable[[], Iterable[Pairs]]
    sigma_end: float = NOISE.sigma_end
    norm: float = 0.0
    total: float = 0.0
    unscored: int = 0
    pitch_mm: float | None = 5.0

    @property
    def n(self) -> int:
        """Number of taxels that exist."""
        return int(np.count_nonzero(self.mask))

    def state(self, sigma_mid: float, sigma_end: float) -> SkinState:
        """The skin with a noise, newtons, as a sensor states it."""
        n_rows, n_cols = self.mask.shape
        return SkinState(
            stamp_ns=0,
            patch="skin",
            source="",
            seed=0,
            has_truth=False,
            **vars(Skin(n_rows, n_cols, self.f_max, mask=self.mask)),
            sigma_mid=sigma_mid,
            sigma_end=sigma_end,
            rate_hz=0.0,
        )


class Frames(Protocol):
    """Source of frames: a frozen dataclass whose fields are as JSON holds them."""

    def open(self, seed: int) -> Take:
        """Open the frames; `seed`: of scene and noise."""


@dataclass(frozen=True)
class SceneFrames:
    """Frames of a simulated scene, counted in its own steps from its first contact on (None: the
    beginning and the end of the scene), each `every` steps. `later`: number of frames of a second
    part, from half way between the first contact and the end on. `noise`: in that of the paper.
    """

    scene: str
    first: int | None = -20
    stop: int | None = None
    every: int = 1
    later: int = 0
    noise: float = 1.0

    def open(self, seed: int) -> Take:
        """See `Frames`."""
        scene = scene_of(self.scene)
        mask = np.ones(scene.shape, dtype=np.bool_)
        return Take(mask, scene.f_max_n, lambda: self._parts(seed))

    def windows(self, seed: int) -> Iterator[tuple[int, int | None]]:
        """First frame and end of each part, counted from the beginning of the scene."""
        contact = first_contact(self.scene, seed)
        begin = 0
        if self.first is not None:
            begin = max(0, contact + self.first)
        end = None
        if self.stop is not None:
            end = contact + self.stop
        yield begin, end

        if self.later:
            half = (contact + scene_of(self.scene).n_steps) // 2
            yield half, half + self.later * self.every

    def _parts(self, seed: int) -> Iterator[Pairs]:
        for begin, stop in self.windows(seed):
            asked = (self.scene, seed, begin, stop, self.every, self.noise)
            # A long scene is simulated anew each time: it would fill the memory.
            if stop is not None and stop - begin <= MOST_KEPT * self.every:
                yield _kept(*asked)
            else:
                yield scene_frames(*asked)


@lru_cache(maxsize=4)
def _kept(*asked: Any) -> list[tuple[Floats, Floats]]:
    return list(scene_frames(*asked))


@dataclass(frozen=True)
class PressFrames:
    """Frames of an analytic body that presses a skin, with the noise of the paper. Fields as of
    `press_frames`; `n_scattered`: number of taxels, at random places of the grid (None: one in each
    cell); `skip`: frames at the beginning that are left out; `strength`: factor of the forces.
    """

    body: str
    shape: tuple[int, int]
    n_frames: int
    course: str = "moving"
    speed: float = 0.3
    active: float = 0.1
    n_scattered: int | None = None
    skip: int = 0
    strength: float = 1.0

    def open(self, seed: int) -> Take:
        """See `Frames`."""
        mask = np.ones(self.shape, dtype=np.bool_)
        if self.n_scattered is not None:
            mask = scattered_mask(self.shape, self.n_scattered, seed)

        def parts() -> Iterable[Pairs]:
            frames = press_frames(
                self.body,
                self.shape,
                self.n_frames,
                seed,
                course=self.course,
                speed=self.speed,
                active=self.active,
                mask=mask,
                f_max=self.strength * PAPER_F_MAX_N,
                noise=NOISE,
            )
            return [list(frames)[self.skip :]]

        return Take(mask, PAPER_F_MAX_N, parts)


@dataclass(frozen=True)
class MeetingFrames:
    """Two fingertips that meet and part every 80 frames, with the noise of the paper."""

    side: int
    n_frames: int
    radius: float = 4.0

    def open(self, seed: int) -> Take:
        """See `Frames`."""
        # Each seed has a direction of its own.
        angle = 0.5 + seed
        direction = np.array([np.sin(angle), np.cos(angle)])
        along = direction[:, None, None]
        middle = (self.side - 1) / 2
        places = np.indices((self.side, self.side)) - middle

        def frame(k: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
            # From 2 radii, where they are apart, to 0.6, where they are one.
            course = abs(np.cos(np.pi * k / 80))
            half_distance = self.radius * (0.6 + 1.4 * course)
            truth = np.zeros(places.shape[1:], dtype=np.float32)
            for force, sign in ((0.8, 1), (0.5, -1)):
                off = places - sign * half_distance * along
                u = np.linalg.norm(off, axis=0) / self.radius
                # Pressure under a sphere, Hertz 1881.
                dome = force * np.sqrt(np.maximum(0, 1 - u * u))
                np.maximum(truth, dome, out=truth)
            return truth, NOISE.apply(truth, rng)

        def parts() -> Iterable[Pairs]:
            rng = np.random.default_rng(seed)
            return [[frame(k, rng) for k in range(self.n_frames)]]

        mask = np.ones((self.side, self.side), dtype=np.bool_)
        return Take(mask, PAPER_F_MAX_N, parts)


@dataclass(frozen=True)
class UntouchedFrames:
    """Frames of a skin that nothing touches, with the noise of the paper."""

    side: int
    n_frames: int
    unscored: int = 5

    def open(self, seed: int) -> Take:
        """See `Frames`."""
        truth = np.zeros((self.side, self.side), dtype=np.float32)

        def parts() -> Iterable[Pairs]:
            rng = np.random.default_rng(seed)
            return [((truth, NOISE.apply(truth, rng)) for _ in range(self.n_frames))]

        mask = np.ones(truth.shape, dtype=np.bool_)
        return Take(mask, PAPER_F_MAX_N, parts, unscored=self.unscored)


@dataclass(frozen=True)
class PadFrames:
    """Pads of 1 to `MAX_PAD` taxels a side and 0.2 to 1.5 N, held still, with the paper's noise; so
    many that the frame has about `n_coefficients` Haar coefficients, and not more.
    """

    side: int
    n_coefficients: int
    n_frames: int
    unscored: int = 0

    def open(self, seed: int) -> Take:
        """See `Frames`."""
        rng = np.random.default_rng((seed, self.n_coefficients))
        truth = self._pads(rng)
        pairs = [(truth, NOISE.apply(truth, rng)) for _ in range(self.n_frames)]
        mask = np.ones(truth.shape, dtype=np.bool_)
        return Take(mask, PAPER_F_MAX_N, lambda: [pairs], unscored=self.unscored)

    def _pads(self, rng: np.random.Generator) -> Floats:
        """Forces of pads that are added one by one, those left out that would be too many."""
        basis = make_basis("haar", self.side, self.side)
        truth = np.zeros((self.side, self.side), np.float32)
        for _ in range(MOST_PADS):
            height, width = rng.integers(1, MAX_PAD + 1, 2)
            most_row_col = np.array([self.side - height, self.side - width])
            row, col = rng.integers(0, most_row_col + 1)
            trial = truth.copy()
            trial[row : row + height, col : col + width] = rng.uniform(0.2, 1.5)
            # Coefficients that are rounding alone do not count.
            sizes = np.abs(basis.analysis(trial))
            count = np.count_nonzero(sizes > 1e-5 * PAPER_F_MAX_N)
            if count <= self.n_coefficients:
                truth = trial
                # Near enough: the next pad would hardly fit.
                if count > 0.9 * self.n_coefficients:
                    break
        return truth


@dataclass(frozen=True)
class RecordedFrames:
    """A part of a recording, of at most `n_most` frames: that with most loaded ones, next to the
    middle. The truth is the true forces where the recording has them, or else the readings. The
    noise is not known. With another `digest` (`digest_of`), figures are computed anew.
    """

    path: str
    digest: str
    n_most: int
    unscored: int = 0

    def open(self, seed: int) -> Take:
        """See `Frames`. Raises SparseskinError if the file holds no frames that can be used."""
        part = part_of(self.path, self.n_most)
        pairs = list(zip(part.truth, part.frames, strict=True))
        unscored = min(self.unscored, len(pairs) - 1)
        scaling = part.norm, part.total, unscored, part.pitch_mm
        return Take(part.mask, part.f_max, lambda: [pairs], 0.0, *scaling)


_KINDS = (
    SceneFrames,
    PressFrames,
    MeetingFrames,
    UntouchedFrames,
    PadFrames,
    RecordedFrames,
)
KINDS = {kind.__name__: kind for kind in _KINDS}
"""Sources by the names with which points state them."""


def stated(frames: Frames) -> dict[str, Any]:
    """Frames as a point states them: kind, and its fields."""
    return {"kind": type(frames).__name__, **vars(frames)}


def opened(point: Mapping[str, Any]) -> Take:
    """Open the frames of a point: frames (kind, and its fields) and seed."""
    fields = dict(point["frames"])
    kind = KINDS[fields.pop("kind")]
    frames = kind(**fields)
    return frames.open(point["seed"])


class Part(NamedTuple):
    """A part of a recording: frames and truth, float32 (n_frames, n_rows, n_cols); mask; time
    between frames and pitch, if known; number of its first frame, and of all; 95th percentiles of
    norms and totals of all frames in which anything touches it.
    """

    frames: Floats
    truth: Floats
    mask: Mask
    f_max: float
    unit: str
    spacing_ms: float | None
    pitch_mm: float | None
    first: int
    n_recorded: int
    norm: float
    total: float


@cache
def part_of(path: str, n_most: int) -> Part:
    """Read the part of a recording that `RecordedFrames` describes. Raises SparseskinError if the
    file cannot be read, holds no readings, or nothing touches the skin.
    """
    read = read_recording(path)
    if "forces" not in read:
        raise SparseskinError(f"{path}: holds no readings of taxels")
    frames = read["forces"]
    truth = read.get("truth", frames)
    if truth.shape != frames.shape:
        counts = f"{len(truth)} frames of true forces, but {len(frames)} of readings"
        raise SparseskinError(f"{path}: {counts}")
    mask = read.get("mask", np.ones(frames.shape[1:], dtype=np.bool_))

    # Of true forces, and of the frames in which anything touches the skin.
    flat = truth[:, mask].astype(np.float64)
    norms = np.linalg.norm(flat, axis=1)
    totals = flat.sum(axis=1)
    touched = norms > 0
    if not touched.any():
        raise SparseskinError(f"{path}: nothing touches the skin, all readings are 0")
    # Not the largest one: a single spike would set the scale.
    norm = float(np.percentile(norms[touched], 95))
    begin = _busiest(norms > LOADED * norm, n_most)
    part = slice(begin, begin + n_most)

    # A recording may state neither.
    spacing_ms = None
    if "rate_hz" in read:
        spacing_ms = 1e3 / float(read["rate_hz"])
    pitch_mm = None
    if "pitch_m" in read:
        pitch_mm = 1e3 * float(read["pitch_m"])
    return Part(
        frames[part],
        truth[part],
        mask,
        float(read["f_max"]),
        read["unit"],
        spacing_ms=spacing_ms,
        pitch_mm=pitch_mm,
        first=begin,
        n_recorded=len(frames),
        norm=norm,
        total=float(np.percentile(totals[touched], 95)),
    )


def _busiest(loaded: np.ndarray[tuple[int], np.dtype[np.bool_]], n_most: int) -> int:
    """Return the first frame of the part of `n_most` frames with most loaded ones."""
    if loaded.size <= n_most:
        return 0
    counts = np.convolve(loaded, np.ones(n_most, dtype=np.intp), "valid")
    best = np.flatnonzero(counts == counts.max())
    # Of several, the one nearest to the middle.
    middle = (counts.size - 1) / 2
    return int(best[np.argmin(np.abs(best - middle))])


def files_in(folder: Path) -> list[Path]:
    """Files of a folder whose suffix is that of a recording, by name; StudyError if there are
    none.
    """
    allowed = (*suffixes(), FILE_SUFFIX)
    try:
        paths = sorted(folder.iterdir())
    except OSError as error:
        raise StudyError(f"--recordings {folder}: {error.strerror}") from error
    files = [path for path in paths if path.suffix.lower() in allowed]
    if not files:
        raise StudyError(
            f"--recordings {folder}: no recording; allowed are {', '.join(allowed)}"
        )
    return files


def digest_of(path: Path) -> str:
    """Return 16 hexadecimal characters that change with the content of a file."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise StudyError(f"{path}: {error.strerror}") from error
