"""Analytic presses on a skin of any size, fast enough for tests: no physics, known forces.

Bodies of `BODIES` press a skin, move by a stated part of a taxel a frame and turn slowly. Forces
are closed expressions of place and time, so that a body may lie between taxels. The readings may
have the noise of `NoiseModel`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from sparseskin.messages import SkinState
from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Indices, Mask
from sparseskin.nodes.sensor.noise import NoiseModel

BODIES = ("plate", "wrench", "peg", "fingertips", "gaussian")
COURSES = ("moving", "ramped", "sudden")
SKINS = ((1, 16), (4, 4), (5, 5), (8, 8), (10, 10), (1, 128), (40, 40), (64, 64))
"""Shapes from the smallest skins that are sold to the largest of the paper."""

N_BEFORE = 10
"""Untouched frames at the beginning."""
RAMP = 20
"""Frames of a ramp from 0 to the full force."""
N_JUMPS = 997
"""Places of a sudden press before they come again."""
_CHUNK = 32
"""Frames that are computed at once. Chosen: arrays of them fit into a cache."""
_LEAST_SIZE = 0.4
"""Least size of a body in taxels: a smaller one would vanish between two of them."""
_LEAST_GAUSSIAN = 0.02
"""Part of the peak of a Gaussian press below which nothing touches: a skin has a threshold."""
Field = Callable[[Doubles, Doubles, float], Doubles]
"""Force of a part in units of its peak, at (u, v) taxels from its middle, of a body of a size."""


@dataclass(frozen=True)
class Timing:
    """Lengths of the parts of a course, in frames."""

    untouched: int = N_BEFORE
    ramp: int = RAMP
    # Between two contacts.
    pause: int = 10
    # Of one that begins and ends at once.
    contact: int = 20


def press_frames(
    body: str,
    shape: tuple[int, int],
    n_frames: int,
    seed: int,
    *,
    course: str = "moving",
    speed: float = 0.3,
    active: float = 0.1,
    mask: Mask | None = None,
    f_max: float = PAPER_F_MAX_N,
    noise: NoiseModel | None = None,
    timing: Timing = Timing(),
) -> Iterator[tuple[Floats, Floats]]:
    """Yield true forces and readings of a skin that a body presses: fresh arrays, float32 of
    `shape`, in [0, f_max], 0 where no taxel exists.

    Parameters
    ----------
    body : str
        "plate": a rectangle, flat and a little tilted; "wrench": a handle and an open jaw; "peg": a
        disc, flat; "fingertips": three to five round tips, each with a course of its own;
        "gaussian": one to three smooth presses.
    course : str
        "moving": after a ramp, the body moves on a straight path and turns back near the edges of
        the skin; "ramped": it rests, and its force rises and falls; "sudden": it presses with its
        full force from one frame to the next, then somewhere else.
    speed : float
        Taxels a frame, of a moving body; the outer parts of a turning one are up to 1.5 times as
        fast.
    active : float
        Part of the existing taxels that the whole body touches, about, 0.01 to 0.6; at least one
        taxel. A body near the edge touches fewer.
    mask : ndarray of bool, shape `shape`, optional
        True where a taxel exists. None: everywhere.
    f_max : float
        Upper end of the range; peaks are 0.2 to 0.9 of it.
    noise : NoiseModel, optional
        That of the readings. None: none.
    """
    if mask is None:
        mask = np.ones(shape, dtype=np.bool_)
    press = _Press(body, mask, seed, course, speed, active, f_max, timing)
    taxels = np.flatnonzero(mask)
    rng = np.random.default_rng([seed, 2])
    for truth in press.frames(n_frames):
        reading = truth.copy()
        if noise is not None:
            # Only where a taxel exists: noise is drawn for those alone.
            forces = truth.reshape(-1)[taxels]
            reading.reshape(-1)[taxels] = noise.apply(forces, rng)
        yield truth, reading


def scattered_mask(shape: tuple[int, int], n: int, seed: int) -> Mask:
    """Return a mask of n cells at random places of a grid, where alone taxels exist."""
    size = math.prod(shape)
    mask = np.zeros(size, dtype=np.bool_)
    rng = np.random.default_rng([seed, 3])
    cells = rng.permutation(size)[:n]
    mask[cells] = True
    return mask.reshape(shape)


class _Press:
    """A body of a size that touches a part of the skin, with its course."""

    def __init__(
        self,
        body: str,
        mask: Mask,
        seed: int,
        course: str,
        speed: float,
        active: float,
        f_max: float,
        timing: Timing,
    ) -> None:
        rng = np.random.default_rng([seed, 0])
        self._mask = mask
        self._course = course
        self._f_max = f_max
        self._timing = timing
        self._sides = np.array(mask.shape, dtype=np.float64)
        cells: Doubles = np.indices(mask.shape).astype(np.float64)
        self._i = cells[:1]
        self._j = cells[1:]
        self._fields, self._beside = _make(body, rng)
        n = len(self._fields)
        self._peaks = f_max * rng.uniform(0.2, 0.9, n)
        # A path and a place of its own for each fingertip; one for all parts of another body.
        self._n_paths = n if body == "fingertips" else 1
        self._anchors = self._draw_anchors(rng)
        self._velocity = speed * self._draw_directions(rng)
        self._turned = rng.uniform(0, np.pi)
        is_line = min(mask.shape) == 1
        if is_line:
            # What lies beside a line of taxels is not felt.
            self._turned = 0.0 if mask.shape[0] == 1 else np.pi / 2
            self._beside[:, 1] = 0
            self._anchors[:, self._sides == 1] = 0

        self._size = self._fitted(active)
        # A body smaller than a taxel covers a part of it alone.
        highest = max(float(self._at_middle().max()), 1e-9 * f_max)
        self._peaks *= min(3.0, self._peaks.max() / highest)

        # Half of the way that a body may move, so that most of it stays on the skin.
        way = self._sides * (1 - math.sqrt(active))
        self._reach = np.maximum(1.0, 0.5 * way)
        self._start = rng.uniform(0, 4, (1, 2)) * self._reach
        # The rim turns half as fast as the body moves; the sign is drawn for a line, too.
        sign = float(rng.choice([-1, 1]))
        self._turning = 0.0
        if not is_line:
            self._turning = sign * 0.5 * speed / max(1.0, self._size)
        self._jumps = rng.uniform(-0.7, 0.7, (N_JUMPS, 1, 2)) * self._reach
        for along_line in (self._start, self._jumps):
            along_line[..., self._sides == 1] = 0

    def _draw_anchors(self, rng: np.random.Generator) -> Doubles:
        """Places of the paths about the middle of the body, (paths, 2): on a circle."""
        angles = np.linspace(0, 2 * np.pi, self._n_paths, endpoint=False)
        angles += rng.uniform(0, 7)
        circle = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        anchors: Doubles = 0.28 * self._sides * circle
        # One path alone is at the middle.
        return anchors * (self._n_paths > 1)

    def _draw_directions(self, rng: np.random.Generator) -> Doubles:
        """Unit vectors of the paths, (paths, 2); along a line of taxels, if they are one."""
        angles = rng.uniform(0, 2 * np.pi, self._n_paths)
        directions = np.stack([np.sin(angles), np.cos(angles)], axis=-1)
        directions[:, self._sides == 1] = 0
        lengths = np.linalg.norm(directions, axis=-1, keepdims=True)
        units: Doubles = directions / np.maximum(lengths, 1e-9)
        return units

    def frames(self, n_frames: int) -> Iterator[Floats]:
        """Yield the true forces, some frames computed at once."""
        for begin in range(0, n_frames, _CHUNK):
            k = np.arange(begin, min(begin + _CHUNK, n_frames))
            places = self._places(k)
            angles = self._angles(k)
            forces = self._forces(places, angles, self._strength(k))
            for force in forces:
                of_taxels = np.where(self._mask, force, 0)
                yield of_taxels.astype(np.float32)

    def _strength(self, k: Indices) -> Doubles:
        """Part of the full force in frames k."""
        timing = self._timing
        since = k - self._timing.untouched
        if self._course == "moving":
            part = np.clip((since + 1) / timing.ramp, 0, 1)
        elif self._course == "ramped":
            phase = since % (2 * timing.ramp + timing.pause)
            rising = phase + 1
            falling = 2 * timing.ramp - phase - 1
            n_frames = np.minimum(rising, falling)
            part = np.clip(n_frames / timing.ramp, 0, 1)
        else:
            phase = since % (timing.contact + timing.pause)
            part = np.where(phase < timing.contact, 1.0, 0.0)
        strength: Doubles = np.where(since < 0, 0.0, part)
        return strength

    def _places(self, k: Indices) -> Doubles:
        """Middle of each path in frames k, (frames, paths, 2): rows and columns of a taxel."""
        middle = (self._sides - 1) / 2
        if self._course == "moving":
            # A triangle wave has the same speed all the way.
            way = self._start + self._velocity * k[:, None, None]
            period = 4 * self._reach
            phase = (way + self._reach) % period
            bent = np.abs(phase - 2 * self._reach)
            moved: Doubles = middle + bent - self._reach
            return moved

        timing = self._timing
        turn = 0 * k
        if self._course == "sudden":
            period_frames = timing.contact + timing.pause
            turn = np.maximum(k - timing.untouched, 0) // period_frames
        places = middle + self._jumps[turn % len(self._jumps)]
        return np.broadcast_to(places, (len(k), self._n_paths, 2))

    def _angles(self, k: Indices) -> Doubles:
        turning = self._turning if self._course == "moving" else 0.0
        angles: Doubles = self._turned + turning * k.astype(np.float64)
        return angles

    def _forces(self, places: Doubles, angles: Doubles, strength: Doubles) -> Doubles:
        """Forces on all cells, (frames, rows, columns)."""
        cos = np.cos(angles)[:, None, None]
        sin = np.sin(angles)[:, None, None]
        force = np.zeros((len(places), *self._mask.shape))
        size = self._size
        for part, field in enumerate(self._fields):
            # Where all parts have one path, it is the first.
            path = part if self._n_paths > 1 else 0
            place = places[:, path] + self._anchors[path]
            i = self._i - place[:, 0, None, None]
            j = self._j - place[:, 1, None, None]

            # The middle of a part is in units of the size of the body.
            u = (cos * j + sin * i) / size - self._beside[part, 0]
            v = (cos * i - sin * j) / size - self._beside[part, 1]
            of_part = self._peaks[part] * field(u * size, v * size, size)
            np.maximum(force, of_part, out=force)
        force *= strength[:, None, None]
        return np.minimum(force, self._f_max, out=force)

    def _fitted(self, active: float) -> float:
        """Return the size in taxels at which the body touches a part of the existing taxels."""
        n_touched = max(1.0, active * np.count_nonzero(self._mask))
        low = _LEAST_SIZE
        high = 2.0 * float(self._sides.max())
        for _ in range(14):
            self._size = math.sqrt(low * high)
            if np.count_nonzero(self._at_middle() > 0) < n_touched:
                low = self._size
            else:
                high = self._size
        return high

    def _at_middle(self) -> Doubles:
        """Full forces of the existing taxels with the body in the middle of the skin."""
        middle = (self._sides - 1) / 2
        places = np.broadcast_to(middle, (1, self._n_paths, 2))
        angles = np.array([self._turned])
        forces = self._forces(places, angles, np.ones(1))
        of_taxels: Doubles = forces[0, self._mask]
        return of_taxels


def _edge(distance: Doubles) -> Doubles:
    """Part of a taxel that a flat body covers whose edge is so many taxels away, inside below 0."""
    return np.clip(0.5 - distance, 0, 1)


def _make(body: str, rng: np.random.Generator) -> tuple[list[Field], Doubles]:
    """Return the parts of a body, and the middle of each in units of the body's size."""
    if body == "plate":
        half_width = rng.uniform(0.4, 1.0)
        tilt = rng.uniform(-0.3, 0.3)
        return [_box(1.0, half_width, tilt)], np.zeros((1, 2))
    if body == "peg":
        return [_disc(1.0)], np.zeros((1, 2))
    if body == "wrench":
        handle = _box(1.0, 0.12, 0.2)
        jaw = _box(0.1, 0.3, 0.0)
        finger = _box(0.15, 0.09, 0.0)
        middles = [[0.0, 0.0], [1.0, 0.0], [1.2, 0.22], [1.2, -0.22]]
        return [handle, jaw, finger, finger], np.array(middles)
    if body == "fingertips":
        n = int(rng.integers(3, 6))
        fields = [_dome(rng.uniform(0.5, 1.0)) for _ in range(n)]
        return fields, np.zeros((n, 2))
    n = int(rng.integers(1, 4))
    sizes = rng.uniform(0.4, 1.0, (n, 2))
    fields = [_gaussian(a, b) for a, b in sizes.tolist()]
    # One press alone is at the middle.
    return fields, rng.uniform(-1.0, 1.0, (n, 2)) * (n > 1)


def _box(a: float, b: float, tilt: float) -> Field:
    def field(u: Doubles, v: Doubles, size: float) -> Doubles:
        cover_u = _edge(np.abs(u) - a * size)
        cover_v = _edge(np.abs(v) - b * size)
        # Its higher end has the full force.
        slope = np.clip(u / max(a * size, 0.5), -1, 1)
        level = 1 - abs(tilt) + tilt * slope
        return cover_u * cover_v * level

    return field


def _disc(radius: float) -> Field:
    return lambda u, v, size: _edge(np.hypot(u, v) - radius * size)


def _dome(radius: float) -> Field:
    def field(u: Doubles, v: Doubles, size: float) -> Doubles:
        # Pressure under a sphere, Hertz 1881; at least half a taxel wide, so that it is not lost.
        r2 = (u * u + v * v) / max(radius * size, 0.75) ** 2
        depth = np.maximum(0, 1 - r2)
        return np.asarray(np.sqrt(depth))

    return field


def _gaussian(a: float, b: float) -> Field:
    def field(u: Doubles, v: Doubles, size: float) -> Doubles:
        # At least 0.3 taxels wide, so that it is not lost between two of them.
        wide = max(a * size, 0.3)
        high = max(b * size, 0.3)
        squares = (u / wide) ** 2 + (v / high) ** 2
        above = np.exp(-0.5 * squares) - _LEAST_GAUSSIAN
        return np.asarray(np.maximum(0, above) / (1 - _LEAST_GAUSSIAN))

    return field


def noisy_skin(side: int, **stated: Any) -> SkinState:
    """A square skin with the noise of the paper; fields of `SkinState` may be stated otherwise."""
    noise = NoiseModel()
    usual = {
        "stamp_ns": 0,
        "patch": "skin",
        "pitch_m": None,
        "source": "drawn",
        "seed": 0,
        "rate_hz": 0.0,
    }
    return SkinState(
        **{**usual, **stated},
        n_rows=side,
        n_cols=side,
        f_max=noise.f_max,
        unit="N",
        mask=None,
        has_truth=False,
        sigma_mid=noise.sigma_mid,
        sigma_end=noise.sigma_end,
    )
