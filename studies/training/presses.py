"""Procedural presses: the frames that the gates of the default solver are trained on.

No recording and no scene of the project is among them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from sparseskin.nodes.numerics.arrays import Floats

SIDE = 32
"""Rows and columns of a frame."""
N_FRAMES = 3
"""Successive frames of a press, in which it moves, turns, grows or fades."""
LEAST = 0.02
"""Largest force of a press of unit strength that passes beside the frame, and is drawn anew."""

Doubles: TypeAlias = npt.NDArray[np.float64]
Shape: TypeAlias = Callable[[Doubles, Doubles], Doubles]


def presses(count: int, seed: int) -> Floats:
    """Draw presses: float32 (count, N_FRAMES, SIDE, SIDE), at least 0; the peak of each is 1."""
    rng = np.random.default_rng(seed)
    return np.stack([press(rng) for _ in range(count)])


def masks(rng: np.random.Generator, count: int) -> Floats:
    """Draw masks: of four in five all taxels exist, else those of a sole, a disc or a rectangle.

    The result is float32 (count, SIDE, SIDE), 1 where a taxel exists.
    """
    is_taxel = np.ones((count, SIDE, SIDE), dtype=np.float32)
    row, col = np.mgrid[:SIDE, :SIDE] + 0.5
    for k in np.flatnonzero(rng.random(count) < 0.2):
        c = rng.uniform(8, 24, 2)
        a = rng.uniform(4, 20, 2)
        power = rng.choice([2.0, 4.0, 64.0])
        down = np.abs((row - c[0]) / a[0]) ** power
        across = np.abs((col - c[1]) / a[1]) ** power
        is_taxel[k] = down + across < 1
    return is_taxel


def press(rng: np.random.Generator) -> Floats:
    """Draw one press, float32 (N_FRAMES, SIDE, SIDE), as `presses`."""
    forces = _drawn(rng)
    while not forces.max() > LEAST:
        forces = _drawn(rng)
    scaled: Floats = (forces / forces.max()).astype(np.float32)
    return scaled


def _drawn(rng: np.random.Generator) -> Doubles:
    kind = rng.random()
    if kind < 0.16:
        forces = smooth_field(rng)
    else:
        forces = np.zeros((N_FRAMES, SIDE, SIDE))
        for _ in range(1 + rng.poisson(0.7)):
            body = bodies(rng) * math.exp(rng.normal(0, 0.5))
            forces = np.maximum(forces, body) if rng.random() < 0.5 else forces + body
        if kind < 0.24:
            forces += smooth_field(rng) * rng.uniform(0.02, 0.5)
        if kind > 0.97:
            forces += rng.uniform(0.02, 0.3)
    if rng.random() < 0.25:
        noise = rng.standard_normal((SIDE, SIDE))
        grain = ndimage.gaussian_filter(noise, rng.uniform(0, 1.5))
        rough = 1 + rng.uniform(0.05, 0.5) * grain / grain.std()
        forces = forces * np.maximum(0, rough)
    if rng.random() < 0.1:
        single = rng.random((SIDE, SIDE)) < rng.uniform(0.001, 0.02)
        forces = forces + single * rng.uniform(0.1, 1.0, (SIDE, SIDE)) * forces.max()
    if rng.random() < 0.3:
        steps = np.linspace(-1, 1, N_FRAMES)[:, None, None]
        forces = forces * np.exp(rng.normal(0, 0.15) * steps)
    return forces


def bodies(rng: np.random.Generator) -> Doubles:
    """Draw a body that moves over the skin, float64 (N_FRAMES, SIDE, SIDE)."""
    shape = shapes(rng)
    centre = rng.uniform(-4, SIDE + 4, 2)
    angle = rng.uniform(0, 2 * math.pi)
    speed = rng.normal(0, 1, 2) * rng.choice([0.0, 0.05, 0.3, 1.0])
    turn = rng.normal(0, 0.02) * (rng.random() < 0.3)
    tilt = rng.normal(0, 0.03, 2) * (rng.random() < 0.4)
    edge = math.exp(rng.uniform(math.log(0.08), math.log(2.5)))
    pressures = np.empty((N_FRAMES, SIDE, SIDE))
    for t in range(N_FRAMES):
        place = centre + t * speed
        row = (np.arange(SIDE) + 0.5 - place[0])[:, None]
        col = np.arange(SIDE) + 0.5 - place[1]
        phi = angle + t * turn
        along = math.cos(phi) * row + math.sin(phi) * col
        across = -math.sin(phi) * row + math.cos(phi) * col
        pressure: Any = shape(along, across)
        # A blur of less than a tenth of a taxel changes nothing.
        if edge >= 0.2:
            pressure = ndimage.gaussian_filter(pressure, edge * 0.5)
        pressures[t] = pressure * np.clip(1 + tilt[0] * row + tilt[1] * col, 0, 3)
    return np.maximum(pressures, 0)


def shapes(rng: np.random.Generator) -> Shape:
    """Draw a shape: its pressure by coordinates along and across, in taxels, from its centre."""
    a, b = np.exp(rng.uniform(math.log(0.8), math.log(12.0), 2))
    return _KINDS[rng.integers(len(_KINDS))](rng, a, b)


def _box(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A box, or a superellipse."""
    power = rng.choice([2.0, 4.0, 16.0])

    def box(x: Doubles, y: Doubles) -> Doubles:
        return _inside(1 - (np.abs(x / a) ** power + np.abs(y / b) ** power), a, b)

    return box


def _frame(rng: np.random.Generator, a: float, b: float) -> Shape:
    wall = rng.uniform(0.6, 3.0)

    def frame(x: Doubles, y: Doubles) -> Doubles:
        outer = np.maximum(np.abs(x) - a - wall, np.abs(y) - b - wall)
        inner = np.maximum(np.abs(x) - a, np.abs(y) - b)
        return _step(-np.maximum(outer, -inner))

    return frame


def _fingertip(rng: np.random.Generator, a: float, b: float) -> Shape:
    """Pressure under an ellipsoid, by Hertz."""
    return lambda x, y: np.sqrt(np.maximum(0, 1 - (x / a) ** 2 - (y / b) ** 2))


def _pad(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A soft pad."""
    return lambda x, y: np.exp(-((x / a) ** 2) - (y / b) ** 2)


def _tool(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A shaft with a head, or with two."""
    shaft = rng.uniform(0.6, 2.0)
    head = rng.uniform(1.5, 5.0)
    gap = rng.uniform(0, 0.8) * head
    ends = (1.0, -1.0) if rng.random() < 0.5 else (1.0,)

    def tool(x: Doubles, y: Doubles) -> Doubles:
        inside = np.maximum(np.abs(x) - a - b, np.abs(y) - shaft)
        for end in ends:
            r = np.hypot(x - end * (a + b), y)
            inside = np.minimum(inside, np.maximum(r - head, gap - r))
        return _step(-inside)

    return tool


def _foot(rng: np.random.Generator, a: float, b: float) -> Shape:
    """Heel, ball, the bridge between them, and toes; of one size."""
    toes = rng.uniform(-1, 1, 4)
    ball = rng.uniform(0.4, 1.4)
    bridge = rng.uniform(0, 0.4)

    def foot(x: Doubles, y: Doubles) -> Doubles:
        f = np.exp(-(((x + 9) / 4) ** 2) - (y / 3.4) ** 2)
        f = f + ball * np.exp(-(((x - 5) / 3) ** 2) - (y / 4.5) ** 2)
        f = f + bridge * np.exp(-((x / 8) ** 2) - ((y - 2) / 2) ** 2)
        for k, level in enumerate(toes):
            squares = (x - 11) ** 2 + (y - 3 * k + 4.5) ** 2
            f = f + max(0.0, level) * np.exp(-squares / 2)
        return f - 0.05

    return foot


def _peg(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A peg of a few taxels."""
    r = rng.uniform(0.5, 2.5)
    return lambda x, y: _step(r - np.hypot(x, y))


def _ripples(rng: np.random.Generator, a: float, b: float) -> Shape:
    """Ripples under a pad."""
    wave = rng.uniform(2, 12)
    phase = rng.uniform(0, 2 * math.pi)

    def ripples(x: Doubles, y: Doubles) -> Doubles:
        wavy = 0.6 + 0.4 * np.sin(2 * math.pi * x / wave + phase)
        return wavy * np.exp(-((x / (2 * a)) ** 2) - (y / (2 * b)) ** 2)

    return ripples


_KINDS = (_box, _frame, _fingertip, _pad, _tool, _foot, _peg, _ripples)


def _step(depth: Doubles) -> Doubles:
    """Cover of a taxel whose centre lies that many taxels within an edge: 0 to 1."""
    return np.clip(depth + 0.5, 0, 1)


def _inside(level: Doubles, a: float, b: float) -> Doubles:
    return np.clip(level * min(a, b) / 2 + 0.5, 0, 1)


def smooth_field(rng: np.random.Generator) -> Doubles:
    """Draw a dense pressure, as of a bed, a seat or a sole, float64 (N_FRAMES, SIDE, SIDE)."""
    scale = math.exp(rng.uniform(math.log(0.7), math.log(6.0)))
    drift = rng.normal(0, 1, 2) * rng.choice([0.0, 0.1, 0.5])
    noise: Any = rng.standard_normal((SIDE + 8, SIDE + 8))
    field = ndimage.gaussian_filter(noise, scale, mode="wrap")
    noise = rng.standard_normal(field.shape)
    fine = ndimage.gaussian_filter(noise, scale / 3, mode="wrap")
    field = field / field.std() + rng.uniform(0, 0.5) * fine / fine.std()
    noise = rng.standard_normal(field.shape)
    change = ndimage.gaussian_filter(noise, scale, mode="wrap")
    change *= rng.choice([0.0, 0.03, 0.2]) / change.std()
    level = rng.uniform(-1.0, 1.2)
    shifted = np.empty((N_FRAMES, SIDE, SIDE))
    for t in range(N_FRAMES):
        moved = ndimage.shift(field + t * change, t * drift, order=1, mode="nearest")
        # The margin of 4 taxels has moved in from beyond the edge.
        shifted[t] = moved[4:-4, 4:-4]
    raised = np.maximum(0, shifted + level)
    if rng.random() < 0.7:
        bent: Doubles = raised ** rng.choice([1.0, 1.0, 1.5, 2.0])
        return bent
    return np.exp(shifted)
