"""Random scenes that nothing was tuned on: bodies of random shape, pressed, slid or rolled."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from sparseskin.messages.skin import PAPER_F_MAX_N
from sparseskin.nodes.numerics.arrays import Doubles, Floats
from sparseskin.nodes.sensor.scenes.simulation import MovingAverage

KINDS = ("press", "slide", "tap", "roll", "several")
SIDES = (40, 64)
PITCH_M, RADIUS_M = 0.005, 0.0025
STIFFNESS_N_M = 122.24
STEP_S = 1e-3
SMOOTHING_STEPS = 10
OFF_M = 1.0


@dataclass(frozen=True)
class Part:
    """A piece of a body's sole, flat or domed: an ellipse, a box or a ring.

    Lengths in m: place of its middle, half axes, height above the lowest part, radius of the
    dome (0: flat); angle in rad.
    """

    kind: str
    x: float
    y: float
    a: float
    b: float
    angle: float
    height: float
    dome: float

    def gap(self, x: Doubles, y: Doubles) -> Doubles:
        """Height of the sole over taxels at (x, y); a taxel is a sphere and feels round edges."""
        cos, sin = math.cos(self.angle), math.sin(self.angle)
        u = cos * (x - self.x) + sin * (y - self.y)
        v = cos * (y - self.y) - sin * (x - self.x)
        if self.kind == "box":
            du, dv = np.abs(u) - self.a, np.abs(v) - self.b
            outside = np.hypot(np.maximum(du, 0), np.maximum(dv, 0))
            distance = outside + np.minimum(np.maximum(du, dv), 0)
        else:
            r = np.hypot(u / self.a, v / self.b) + 1e-12
            distance = (r - 1) * np.hypot(u, v) / r
            if self.kind == "ring":
                distance = np.abs(distance) - min(0.3 * self.b, 0.006)
        rise = (u * u + v * v) / (2 * self.dome) if self.dome else 0.0
        return self.height + rise + over_edge(distance)


def over_edge(distance_m: Doubles) -> Doubles:
    """Height of an edge over a sphere that far beside it."""
    beside = np.clip(distance_m, 0, RADIUS_M)
    height = RADIUS_M - np.sqrt(RADIUS_M**2 - beside**2)
    return np.where(distance_m < RADIUS_M, height, OFF_M)


@dataclass(frozen=True)
class Touch:
    """One body and its course: depth in m and place in m of each frame."""

    parts: tuple[Part, ...]
    depths: Doubles
    places: Doubles

    def force(self, k: int, x: Doubles, y: Doubles) -> Doubles:
        """Force of frame k on each taxel, in N."""
        px, py = self.places[k]
        gap = np.minimum.reduce([part.gap(x - px, y - py) for part in self.parts])
        force: Doubles = STIFFNESS_N_M * np.maximum(0, self.depths[k] - gap)
        return force


def side_of(number: int) -> int:
    """Rows, as many as columns, of a random scene by its number."""
    return SIDES[number % 2]


def random_scene(
    seed: int, n_frames: int = 200, side: int | None = None
) -> tuple[str, Iterator[Floats]]:
    """Draw a scene.

    Parameters
    ----------
    seed : int
        What is drawn from; even seeds have 40 x 40 taxels, odd ones 64 x 64, and each kind comes
        with both.
    n_frames : int
        Frames, 1 ms apart.
    side : int, optional
        Rows and columns, in place of 40 or 64.

    Returns
    -------
    kind : str
        One of `KINDS`.
    frames : iterator of ndarray of float32, shape (side, side)
        True forces in [0, 2.5] N, smoothed over 10 steps.
    """
    rng = np.random.default_rng(seed)
    kind = KINDS[seed // 2 % len(KINDS)]
    side = side or side_of(seed)
    n_bodies = int(rng.integers(2, 5)) if kind == "several" else 1
    touches = [_touch(rng, kind, side, n_frames) for _ in range(n_bodies)]
    return kind, _frames(touches, side, n_frames)


def _frames(touches: list[Touch], side: int, n_frames: int) -> Iterator[Floats]:
    y, x = (np.indices((side, side)) - (side - 1) / 2) * PITCH_M
    average = MovingAverage(SMOOTHING_STEPS, (side, side))
    for k in range(n_frames):
        average.newest[...] = sum(touch.force(k, x, y) for touch in touches)
        yield np.minimum(average.step(), np.float32(PAPER_F_MAX_N))


def _touch(rng: np.random.Generator, kind: str, side: int, n_frames: int) -> Touch:
    half_m = side * PITCH_M / 2
    t_s = np.arange(n_frames) * STEP_S
    begin_s = rng.uniform(0.005, 0.05)
    since = t_s - begin_s
    deepest_m = rng.uniform(0.1, 1.5) / STIFFNESS_N_M
    if kind == "tap":
        depth = deepest_m * np.maximum(0, np.sin(2 * np.pi * since / rng.uniform(0.02, 0.06)))
    else:
        depth = deepest_m * np.clip(since / rng.uniform(0.002, 0.05), 0, 1)
    if kind in ("press", "several"):
        depth *= 1 + 0.3 * np.sin(2 * np.pi * rng.uniform(1, 10) * since)
    places = np.tile(rng.uniform(-0.6, 0.6, 2) * half_m, (n_frames, 1))
    if kind in ("slide", "roll") or (kind == "several" and rng.random() < 0.5):
        angle, speed_m_s = rng.uniform(0, 2 * np.pi), rng.uniform(0.05, 0.5)
        way_m = speed_m_s * np.clip(since - 0.03, 0, None)
        places += np.outer(way_m, [math.cos(angle), math.sin(angle)])
    size_m = rng.uniform(0.01, 0.05 if kind == "several" else 0.8 * half_m)
    parts = (_roller(rng),) if kind == "roll" else _sole(rng, size_m)
    return Touch(parts, np.where(since > 0, depth, 0.0), places)


def _sole(rng: np.random.Generator, size_m: float) -> tuple[Part, ...]:
    parts = []
    for _ in range(rng.integers(1, 4)):
        a = size_m * rng.uniform(0.3, 1)
        parts.append(
            Part(
                kind=str(rng.choice(["ellipse", "box", "ring"])),
                x=size_m * rng.uniform(-0.5, 0.5),
                y=size_m * rng.uniform(-0.5, 0.5),
                a=a,
                b=a * rng.uniform(0.2, 1),
                angle=rng.uniform(0, np.pi),
                height=rng.uniform(0, 0.002),
                dome=float(rng.choice([0, 0, rng.uniform(0.02, 0.2)])),
            )
        )
    return tuple(parts)


def _roller(rng: np.random.Generator) -> Part:
    """A short roller seen from above: a box, domed along and across."""
    width_m, radius_m = rng.uniform(0.02, 0.08), rng.uniform(0.01, 0.04)
    return Part("box", 0, 0, OFF_M, width_m, rng.uniform(0, np.pi), 0, radius_m)
