"""Rests and signs drawn at random: what `Zero` notices of readings that are no forces yet.

`python -m sparseskin.studies.stability.rests 1000` prints misses and false alarms of so many worlds
of each kind.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass

import numpy as np

from sparseskin.messages.skin import Skin
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.sensor.zero import Zero

from .loads import draw_load

N_FRAMES = 90
LEVEL = "level"
LEVEL_FALLS = "level, falls"
FALLS = "falls"
FORCES = "forces"
KINDS = (LEVEL, LEVEL_FALLS, FALLS, FORCES)
"""Kinds of worlds: untouched taxels read a level; they do, and a press lowers it; they read 0, and
a press lowers it; they read 0, and a press raises it."""
RANGES = (2.5, 100.0, 255.0, 1023.0, 4095.0)
"""Ends of a range: newtons of the paper's skin, and those of recordings and of converters."""


@dataclass(frozen=True, eq=False)
class RestWorld:
    """Readings of a drawn skin, float32 (n_rows, n_cols) each, and `forces` of its load; `begin` is
    the first frame of the load, `level` the median reading of an untouched taxel, `noise` its
    standard deviation.
    """

    kind: str
    skin: Skin
    readings: list[Floats]
    forces: list[Floats]
    begin: int
    level: float
    noise: float
    load: str

    def describe(self) -> str:
        """Kind, size, level, noise and load in a line."""
        skin = self.skin
        f_max = self.skin.f_max
        size = f"{skin.n_taxels} taxels of {skin.n_rows} x {skin.n_cols}"
        level = f"level {self.level / f_max:.3f}"
        noise = f"noise {self.noise / f_max:.4f} of f_max"
        load = f"{self.load} from frame {self.begin} on"
        return f"{self.kind}: {size}, {level}, {noise}, {load}"


def draw_rest_world(rng: np.random.Generator, kind: str) -> RestWorld:
    """Draw a skin, its rest, noise and load. The load is there from the first frame on in a third
    of the worlds; noise around 0 is clipped at 0 in half of them.
    """
    rows, cols = rng.integers(4, 41, 2).tolist()
    exists = _draw_mask(rng, (rows, cols))
    f_max = float(rng.choice(RANGES))
    mask = None if exists.all() else exists
    skin = Skin(rows, cols, f_max, "counts", mask=mask)
    exponent = rng.uniform(math.log(1e-4), math.log(0.02))
    noise = f_max * math.exp(exponent)
    # One skin in five has none.
    noise *= float(rng.random() < 0.8)
    is_whole = f_max > 2.5 and rng.random() < 0.7
    load = draw_load(rng, exists, f_max)
    begin = int(rng.choice([0, 0, *rng.integers(5, 60, 4)]))
    is_level = kind in (LEVEL, LEVEL_FALLS)
    levels = np.zeros((rows, cols))
    if is_level:
        levels = _draw_levels(rng, (rows, cols), f_max)
    is_clipped = is_level or (kind == FORCES and rng.random() < 0.5)

    readings = []
    forces = []
    for k in range(N_FRAMES):
        press = np.zeros((rows, cols))
        if k >= begin:
            press += load.forces(k - begin, N_FRAMES - begin)
        values = _pressed(levels, press, f_max, kind)
        values += noise * rng.standard_normal(values.shape)
        if is_whole:
            values = np.rint(values)
        if is_clipped:
            values = values.clip(0, f_max)
        of_taxels = np.where(exists, values, 0)
        readings.append(of_taxels.astype(np.float32))
        forces.append(press.astype(np.float32))

    level = float(np.median(levels[exists]))
    return RestWorld(kind, skin, readings, forces, begin, level, noise, load.describe())


def _draw_mask(rng: np.random.Generator, shape: tuple[int, int]) -> Mask:
    """Taxels that exist: all, or some of them."""
    exists = np.ones(shape, dtype=np.bool_)
    if rng.random() < 0.3:
        exists = rng.random(shape) < rng.uniform(0.6, 1.0)
    # Of fewer, a level shows nothing.
    if exists.sum() <= 8:
        return np.ones_like(exists)
    return exists


def _draw_levels(
    rng: np.random.Generator, shape: tuple[int, int], f_max: float
) -> Doubles:
    """Readings at rest: of one size, on a slope, or of few kinds. One taxel in 200 is dead."""
    exponent = rng.uniform(math.log(0.05), math.log(0.9))
    highest = f_max * math.exp(exponent)
    lowest_part = rng.uniform(0.3, 1.0)
    kind = rng.integers(3)
    if kind == 0:
        parts = rng.uniform(lowest_part, 1.0, shape)
    elif kind == 1:
        slope = np.linspace(lowest_part, 1.0, shape[0])
        parts = slope[:, np.newaxis] * np.ones(shape)
    else:
        parts = np.exp(-0.4 * np.abs(rng.standard_normal(shape)))
    is_dead = rng.random(shape) < 0.005
    return highest * np.where(is_dead, 0.0, parts)


def _pressed(levels: Doubles, press: Doubles, f_max: float, kind: str) -> Doubles:
    """Readings under a press: up to the range, or down towards 0 as of a divider."""
    if kind == LEVEL_FALLS:
        return np.asarray(levels / (1 + 4 * press / f_max))
    if kind == FALLS:
        return levels - press
    return levels + press


def reasons_of(world: RestWorld) -> list[str]:
    """Reason of each frame, by its readings alone."""
    zero = Zero(world.skin)
    reasons = []
    for frame in world.readings:
        zero.forces(frame)
        reasons.append(str(zero.reason))
    return reasons


def are_hidden(world: RestWorld, reasons: list[str]) -> list[bool]:
    """True for each frame that is trusted, and whose force is wrong: all of a level; of falls those
    whose press is twice what noise and contact may hide.
    """
    if world.kind in (LEVEL, LEVEL_FALLS):
        return [not reason for reason in reasons]
    if world.kind == FORCES:
        return [False] * len(reasons)
    hidden_n = 2 * max(0.01 * world.skin.f_max, 6 * world.noise)
    is_pressed = [float(forces.max()) > hidden_n for forces in world.forces]
    frames = zip(is_pressed, reasons, strict=True)
    return [pressed and not reason for pressed, reason in frames]


def is_missed(world: RestWorld, reasons: list[str]) -> bool:
    """True if a frame with a wrong force is trusted."""
    return any(are_hidden(world, reasons))


def is_false_alarm(world: RestWorld, reasons: list[str]) -> bool:
    """True if a frame of forces is not trusted."""
    return world.kind == FORCES and any(reasons)


def main(n_worlds: int) -> None:
    """Print the shares of misses and false alarms: worlds, and frames of them."""
    for kind in KINDS:
        for begins in (True, False):
            when = "touched from the first frame on" if begins else "untouched at first"
            error = "false alarms" if kind == FORCES else "misses"
            print(f"{kind}, {when}: {error}: {_counts(kind, n_worlds, begins)}")


def _counts(kind: str, n_worlds: int, begins: bool) -> str:
    """Numbers of wrong worlds and frames, each of all, in words."""
    counts = [0, 0, 0, 0]
    for seed in range(n_worlds):
        rng = np.random.default_rng((KINDS.index(kind), seed))
        world = draw_rest_world(rng, kind)
        if (world.begin == 0) != begins:
            continue
        reasons = reasons_of(world)
        wrong = are_hidden(world, reasons)
        if kind == FORCES:
            wrong = [bool(reason) for reason in reasons]
        counts[0] += any(wrong)
        counts[1] += 1
        counts[2] += sum(wrong)
        counts[3] += len(wrong)
    return "{} of {} worlds, {} of {} frames".format(*counts)


if __name__ == "__main__":
    main(int(sys.argv[1]))
