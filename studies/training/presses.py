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
FIELD_MARGIN = 4
"""Taxels beyond the edges of a frame from which a dense pressure moves in."""
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
        # A superellipse: of power 2 an ellipse, of power 64 a rectangle.
        centre_row, centre_col = rng.uniform(8, 24, 2)
        half_height, half_width = rng.uniform(4, 20, 2)
        power = rng.choice([2.0, 4.0, 64.0])
        down = np.abs((row - centre_row) / half_height)
        across = np.abs((col - centre_col) / half_width)
        is_taxel[k] = down**power + across**power < 1
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
    forces = smooth_field(rng) if kind < 0.16 else _drawn_bodies(rng, kind)

    # The surface is rough, some taxels stick out, and the force grows or fades.
    if rng.random() < 0.25:
        noise = rng.standard_normal((SIDE, SIDE))
        grain = ndimage.gaussian_filter(noise, rng.uniform(0, 1.5))
        depth = rng.uniform(0.05, 0.5)
        rough = 1 + depth * grain / grain.std()
        forces = forces * np.maximum(0, rough)
    if rng.random() < 0.1:
        draws = rng.random((SIDE, SIDE))
        is_single = draws < rng.uniform(0.001, 0.02)
        heights = is_single * rng.uniform(0.1, 1.0, (SIDE, SIDE))
        forces = forces + heights * forces.max()
    if rng.random() < 0.3:
        steps = np.linspace(-1, 1, N_FRAMES)
        growth = np.exp(rng.normal(0, 0.15) * steps)
        forces = forces * growth[:, None, None]
    return forces


def _drawn_bodies(rng: np.random.Generator, kind: float) -> Doubles:
    """Bodies that lie on each other or beside each other; by kind on a dense or an even load."""
    forces = np.zeros((N_FRAMES, SIDE, SIDE))
    n_bodies = 1 + rng.poisson(0.7)
    for _ in range(n_bodies):
        body = bodies(rng)
        body *= math.exp(rng.normal(0, 0.5))
        on_others = forces + body
        beside_others = np.maximum(forces, body)
        forces = beside_others if rng.random() < 0.5 else on_others
    if kind < 0.24:
        field = smooth_field(rng)
        forces += field * rng.uniform(0.02, 0.5)
    if kind > 0.97:
        forces += rng.uniform(0.02, 0.3)
    return forces


def bodies(rng: np.random.Generator) -> Doubles:
    """Draw a body that moves over the skin, float64 (N_FRAMES, SIDE, SIDE)."""
    shape = shapes(rng)
    centre = rng.uniform(-4, SIDE + 4, 2)
    angle = rng.uniform(0, 2 * math.pi)
    direction = rng.normal(0, 1, 2)
    speed = direction * rng.choice([0.0, 0.05, 0.3, 1.0])
    turn = rng.normal(0, 0.02)
    turn *= rng.random() < 0.3
    slope_down, slope_across = rng.normal(0, 0.03, 2) * (rng.random() < 0.4)
    edge = _log_uniform(rng, 0.08, 2.5)

    pressures = np.empty((N_FRAMES, SIDE, SIDE))
    middles = np.arange(SIDE) + 0.5
    for t in range(N_FRAMES):
        centre_row, centre_col = centre + t * speed
        row = (middles - centre_row)[:, None]
        col = middles - centre_col

        # In the frame of the body, which has turned.
        cos = math.cos(angle + t * turn)
        sin = math.sin(angle + t * turn)
        along = cos * row + sin * col
        across = -sin * row + cos * col
        pressure: Any = shape(along, across)
        # A blur of less than a tenth of a taxel changes nothing.
        if edge >= 0.2:
            pressure = ndimage.gaussian_filter(pressure, edge * 0.5)

        tilt = 1 + slope_down * row + slope_across * col
        pressures[t] = pressure * np.clip(tilt, 0, 3)
    return np.maximum(pressures, 0)


def _log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a size of any order of magnitude in a range."""
    exponent = rng.uniform(math.log(low), math.log(high))
    return math.exp(exponent)


def shapes(rng: np.random.Generator) -> Shape:
    """Draw a shape: its pressure by coordinates along and across, in taxels, from its centre."""
    a, b = np.exp(rng.uniform(math.log(0.8), math.log(12.0), 2))
    number = rng.integers(len(_KINDS))
    kind = _KINDS[number]
    return kind(rng, a, b)


def _box(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A box, or a superellipse."""
    power = rng.choice([2.0, 4.0, 16.0])

    def box(x: Doubles, y: Doubles) -> Doubles:
        level = np.abs(x / a) ** power + np.abs(y / b) ** power
        # Near the edge, the level falls by 1 over about half of the smaller size.
        depth = (1 - level) * min(a, b) / 2
        return _step(depth)

    return box


def _frame(rng: np.random.Generator, a: float, b: float) -> Shape:
    wall = rng.uniform(0.6, 3.0)

    def frame(x: Doubles, y: Doubles) -> Doubles:
        x_beyond = np.abs(x) - a
        y_beyond = np.abs(y) - b
        # Signed distances from both edges of the wall, inside below 0.
        outer = np.maximum(x_beyond - wall, y_beyond - wall)
        inner = np.maximum(x_beyond, y_beyond)
        return _step(-np.maximum(outer, -inner))

    return frame


def _fingertip(rng: np.random.Generator, a: float, b: float) -> Shape:
    """Pressure under an ellipsoid, by Hertz."""

    def fingertip(x: Doubles, y: Doubles) -> Doubles:
        depth = 1 - (x / a) ** 2 - (y / b) ** 2
        pressure: Doubles = np.sqrt(np.maximum(0, depth))
        return pressure

    return fingertip


def _pad(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A soft pad."""
    return lambda x, y: _bell(x / a, y / b)


def _bell(x: Doubles, y: Doubles) -> Doubles:
    """A Gaussian of x and y, 1 at its centre."""
    pressure: Doubles = np.exp(-(x**2) - y**2)
    return pressure


def _tool(rng: np.random.Generator, a: float, b: float) -> Shape:
    """A shaft with a head, or with two."""
    shaft = rng.uniform(0.6, 2.0)
    head = rng.uniform(1.5, 5.0)
    gap = rng.uniform(0, 0.8) * head
    has_two_heads = rng.random() < 0.5
    reach = a + b
    ends = (reach, -reach) if has_two_heads else (reach,)

    def tool(x: Doubles, y: Doubles) -> Doubles:
        # Signed distance from the edge of the shaft, then of the union with rings.
        distance = np.maximum(np.abs(x) - a - b, np.abs(y) - shaft)
        for end in ends:
            r = np.hypot(x - end, y)
            of_head = np.maximum(r - head, gap - r)
            distance = np.minimum(distance, of_head)
        return _step(-distance)

    return tool


def _foot(rng: np.random.Generator, a: float, b: float) -> Shape:
    """Heel, ball, the bridge between them, and toes; of one size."""
    toes = rng.uniform(-1, 1, 4)
    ball = rng.uniform(0.4, 1.4)
    bridge = rng.uniform(0, 0.4)

    def foot(x: Doubles, y: Doubles) -> Doubles:
        pressure = _bell((x + 9) / 4, y / 3.4)
        pressure = pressure + ball * _bell((x - 5) / 3, y / 4.5)
        pressure = pressure + bridge * _bell(x / 8, (y - 2) / 2)
        for k, level in enumerate(toes):
            squares = (x - 11) ** 2 + (y - 3 * k + 4.5) ** 2
            toe = np.exp(-squares / 2)
            pressure = pressure + max(0.0, level) * toe
        # Below this the skin feels nothing.
        return pressure - 0.05

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
        angle = 2 * math.pi * x / wave + phase
        wavy = 0.6 + 0.4 * np.sin(angle)
        return wavy * _bell(x / (2 * a), y / (2 * b))

    return ripples


_KINDS = (_box, _frame, _fingertip, _pad, _tool, _foot, _peg, _ripples)


def _step(depth: Doubles) -> Doubles:
    """Cover of a taxel whose centre lies that many taxels within an edge: 0 to 1."""
    return np.clip(depth + 0.5, 0, 1)


def smooth_field(rng: np.random.Generator) -> Doubles:
    """Draw a dense pressure, as of a bed, a seat or a sole, float64 (N_FRAMES, SIDE, SIDE)."""
    scale = _log_uniform(rng, 0.7, 6.0)
    direction = rng.normal(0, 1, 2)
    drift = direction * rng.choice([0.0, 0.1, 0.5])

    # A coarse field with a finer one on it, and how it changes from frame to frame.
    coarse = _smooth_noise(rng, scale)
    fine = _smooth_noise(rng, scale / 3)
    part = rng.uniform(0, 0.5)
    field = coarse / coarse.std() + part * fine / fine.std()
    change = _smooth_noise(rng, scale)
    change *= rng.choice([0.0, 0.03, 0.2]) / change.std()
    level = rng.uniform(-1.0, 1.2)

    shifted = np.empty((N_FRAMES, SIDE, SIDE))
    for t in range(N_FRAMES):
        changed = field + t * change
        moved = ndimage.shift(changed, t * drift, order=1, mode="nearest")
        # What is within the margin may have moved in from beyond the edge.
        shifted[t] = moved[FIELD_MARGIN:-FIELD_MARGIN, FIELD_MARGIN:-FIELD_MARGIN]

    raised = np.maximum(0, shifted + level)
    if rng.random() < 0.7:
        power = rng.choice([1.0, 1.0, 1.5, 2.0])
        bent: Doubles = raised**power
        return bent
    return np.exp(shifted)


def _smooth_noise(rng: np.random.Generator, scale: float) -> Doubles:
    """Draw normal noise that is smooth over so many taxels, with a margin."""
    side = SIDE + 2 * FIELD_MARGIN
    noise: Any = rng.standard_normal((side, side))
    smooth: Doubles = ndimage.gaussian_filter(noise, scale, mode="wrap")
    return smooth
