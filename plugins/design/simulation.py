"""Accuracy of each strategy on the skin of a design, by simulations that the command runs.

`N_SCENES` scenes: each body of `presses.BODIES` with each course of `presses.COURSES`. Bodies touch
3 to 20 % of the taxels (log-uniform) with peaks of 0.2 to 0.9 of the range; moving ones slide by
`SPEED` taxels a second; times of a scene are those below, whatever the frame rate. Noise is normal
with one standard deviation at all forces, clipped to the range; all taxels of a frame are read at
one time. Single taxels are rounded to steps of f_max / (2^bits - 1), sums as the compressor does,
relative to the largest of their frame.
"""

import itertools
import math
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy.special import stdtrit
from tqdm import tqdm

from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.monitor.metrics import psnr_db
from sparseskin.nodes.numerics.arrays import Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.tasks import computed
from sparseskin.nodes.touch import in_contact
from sparseskin.studies.baselines.larger import LargerTaxels
from sparseskin.studies.evaluate import make_method
from sparseskin.studies.presses import BODIES, COURSES, Timing, press_frames

from .budget import Accuracy, Row
from .spec import Design
from .strategies import FEW_SCENES, LARGER, N_SCENES, Strategy

F_MAX_N = PAPER_F_MAX_N
SPEED = 20.0
"""Speed of moving bodies, taxels a second: 0.1 m/s at a pitch of 5 mm. Chosen: twice the speed at
which the paper drags."""
RAMP_S = 0.05
HELD_S = 0.1
PAUSE_S = 0.05
SCENE_S = 0.5
"""Chosen: those of a quick tap with a finger or a tool."""
MOST_FRAMES = 100
"""Most frames of a scene, untouched ones not counted. Chosen: at 1 kHz the ramp, and some slide."""
N_UNTOUCHED = 16
"""Untouched frames at the begin: in as many, rotating rows of N/16 have read all rows."""
ACTIVE = (0.03, 0.2)
"""Parts of the taxels that bodies touch. Chosen: from a fingertip to a forearm that leans on."""
WITHIN = 0.9
"""Part of the scenes that lie within the band."""

Reader: TypeAlias = "Callable[[Floats], Floats]"
"""A strategy's edge and host: forces from a frame's readings, both float32 of shape (n_rows,
n_cols), newtons."""


def raster(mask: Mask, bits: int, phis: list[Phi] | None = None) -> Reader:
    """Reader of every taxel in every frame, or of the row subsets `phis` of kind "subsample" in
    turn, other taxels keeping their last reading.
    """
    step = np.float32(F_MAX_N / (2**bits - 1))
    taxels = np.flatnonzero(mask)
    subsets = [taxels]
    if phis:
        # Rows of such a phi are numbers of taxels.
        subsets = [taxels[getattr(phi, "rows")] for phi in phis]  # noqa: B009
    subset_in_turn = itertools.cycle(subsets)
    readings_kept = np.zeros(mask.size, dtype=np.float32)

    def read(readings: Floats) -> Floats:
        subset = next(subset_in_turn)
        codes = np.rint(readings.reshape(-1)[subset] / step)
        readings_kept[subset] = codes * step
        return readings_kept.reshape(readings.shape).copy()

    return read


def larger_raster(mask: Mask, bits: int, m: int) -> Reader:
    """Reader of m larger taxels, each of the range of all that it sums, rounded to `bits`."""
    larger_taxels = LargerTaxels(mask, m)
    steps = (F_MAX_N * larger_taxels.sizes / (2**bits - 1)).astype(np.float32)

    def read(readings: Floats) -> Floats:
        codes = np.rint(larger_taxels.sums(readings) / steps)
        return larger_taxels.spread(codes * steps)

    return read


def make_reader(
    strategy: Strategy, mask: Mask, noise: float, bits: int, seed: int
) -> Reader:
    """Make the reader of a strategy on a skin, `mask` True where a taxel exists; `noise` of a taxel
    as a part of the range; `bits` of a value that is read or sent; `seed` of Phi. Raises PhiError
    or SolverError if the strategy is not possible on it.
    """
    options: dict[str, Any] = {"rows": strategy.rows, "phi": strategy.phi}
    shape = (mask.shape[0], mask.shape[1])
    n = int(np.count_nonzero(mask))
    # Readings of single taxels are used as they are: nothing is reconstructed.
    if strategy.phi == LARGER:
        return larger_raster(mask, bits, strategy.m(n))
    if strategy.reads_single:
        settings = CompressorSettings(
            ratio=strategy.ratio,
            seed=seed,
            **options,
        )
        if strategy.phi == "full":
            return raster(mask, bits)
        skin = Skin(*shape, F_MAX_N, mask=mask)
        return raster(mask, bits, settings.phis(skin))

    options |= {
        "mask": mask,
        "f_max_n": F_MAX_N,
        "sigma_end": noise * F_MAX_N,
    }
    m = strategy.m(n, mask.shape[0])
    method = make_method(PRESETS["skin"], shape, strategy.ratio, seed, m=m, **options)
    method.bits = bits
    return lambda taxels: method.reconstruct(taxels).forces


def presses(
    scene: int, mask: Mask, noise: float, rate_hz: float, seed: int
) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, readings) of one of the scenes, 0..N_SCENES - 1, newtons; see the module."""
    rng = np.random.default_rng([seed, scene, 4])
    active_part = math.exp(rng.uniform(*np.log(ACTIVE)))
    # At a low rate each part still has a frame.
    spans = [max(1, round(span_s * rate_hz)) for span_s in (RAMP_S, PAUSE_S, HELD_S)]
    timing = Timing(N_UNTOUCHED, *spans)
    n_pressed = min(MOST_FRAMES, max(4, round(SCENE_S * rate_hz)))
    return press_frames(
        BODIES[scene % len(BODIES)],
        (mask.shape[0], mask.shape[1]),
        N_UNTOUCHED + n_pressed,
        seed * N_SCENES + scene,
        course=COURSES[scene % len(COURSES)],
        speed=SPEED / rate_hz,
        active=active_part,
        mask=mask,
        f_max=F_MAX_N,
        noise=NoiseModel(F_MAX_N, noise * F_MAX_N, noise * F_MAX_N),
        timing=timing,
    )


def contact_db(reader: Reader, frames: Iterable[tuple[Floats, Floats]]) -> list[float]:
    """PSNR of each contact frame in dB, of (truth, readings) in newtons."""
    dbs = []
    for truth, taxels in frames:
        # Every frame is read: the reader has a memory.
        forces = reader(taxels)
        if in_contact(truth, F_MAX_N):
            dbs.append(psnr_db(forces - truth, F_MAX_N))
    return dbs


TOUCH_SIDE = 3
TOUCH_FRAMES = 8
GAP_FRAMES = 4
"""Side of a light touch in taxels, frames in which it has to be found, and untouched ones before
the next. Chosen: rotating rows of N/8 have read all rows in as many frames."""
SETTLING_FRAMES = 24
FALSE_FRAMES = 60
"""Untouched frames before the threshold of detection is learnt, and in which it is."""
TRIALS = 10
MISSES = 1
"""Touches of one force, and how many may be missed: 10 %."""
LADDER = 1.25
"""Factor from one tested force to the next."""


def light_touch(reader: Reader, mask: Mask, noise: float, seed: int) -> float:
    """Find the least force a taxel at which a touch of 3 x 3 taxels is found in 90 % of cases, as a
    part of the range; NaN if not even touches with the whole range are found.

    The touch begins from one frame to the next at a random place. It is found if in one of the
    first 8 frames the mean reconstructed force over its taxels is larger than that of any 3 x 3
    taxels in 60 untouched frames, and within 50 % of the true one. Forces rise from half the noise
    in steps of 25 %, 10 touches each.
    """
    model = NoiseModel(F_MAX_N, noise * F_MAX_N, noise * F_MAX_N)
    rng = np.random.default_rng([seed, 5])
    nothing = np.zeros(mask.shape, dtype=np.float32)
    sides = tuple(min(TOUCH_SIDE, side) for side in mask.shape)
    # Places where all taxels of the touch exist.
    windows_of_mask = sliding_window_view(mask, sides)
    is_whole = windows_of_mask.all(axis=(-2, -1))
    places = np.zeros((1, 2), dtype=np.intp)
    if is_whole.any():
        places = np.argwhere(is_whole)

    # Noise is drawn anew in each frame: one generator goes through all of them.
    def frame(truth: Floats) -> Floats:
        taxels = model.apply(truth, rng)
        taxels[~mask] = 0
        return reader(taxels)

    def largest(forces: Floats) -> float:
        windows = sliding_window_view(forces, sides)
        return float(windows.mean(axis=(-2, -1)).max())

    # The reader settles before the threshold is learnt.
    for _ in range(SETTLING_FRAMES):
        frame(nothing)
    threshold = max(largest(frame(nothing)) for _ in range(FALSE_FRAMES))

    def is_missed(force: float) -> bool:
        for _ in range(GAP_FRAMES):
            frame(nothing)

        row, col = places[rng.integers(len(places))]
        touched = (slice(row, row + sides[0]), slice(col, col + sides[1]))
        truth = nothing.copy()
        truth[touched] = force
        for _ in range(TOUCH_FRAMES):
            mean = float(frame(truth)[touched].mean())
            if mean > threshold and abs(mean - force) <= force / 2:
                return False
        return True

    # From below the noise, where no touch can be found.
    force_part = noise / 2
    while force_part < LADDER:
        force_part = min(force_part, 1.0)
        if _count_misses(is_missed, F_MAX_N * force_part) <= MISSES:
            return force_part
        force_part *= LADDER
    return math.nan


def _count_misses(is_missed: Callable[[float], bool], force: float) -> int:
    """Count the misses among `TRIALS` touches of one force; end when there are too many."""
    n_missed = 0
    for _ in range(TRIALS):
        if is_missed(force):
            n_missed += 1
        if n_missed > MISSES:
            break
    return n_missed


def grid_of(design: Design) -> Mask:
    """Cells on which a skin is simulated, True where a taxel exists: bool (n_rows, n_cols). Points
    are on their virtual grid; those that are only counted on the smallest near square, row by row.
    """
    if design.mask is not None:
        return design.mask
    if design.n_rows is not None and design.n_cols is not None:
        return np.ones((design.n_rows, design.n_cols), dtype=np.bool_)

    # The last row may have cells without a taxel.
    side = math.isqrt(design.n_taxels - 1) + 1
    n_rows = -(-design.n_taxels // side)
    cells = np.arange(n_rows * side) < design.n_taxels
    return cells.reshape(n_rows, side)


def simulated(
    rows: Sequence[Row], design: Design, n_scenes: int = FEW_SCENES
) -> list[Row]:
    """Return rows with the accuracy of their strategies, each at the rate that it reaches, in the
    first `n_scenes` scenes; in a process each core, with a progress bar on stderr where that is a
    terminal. Raises SparseskinError if a strategy is not possible on the skin.
    """
    mask = grid_of(design)
    tasks: dict[tuple[int, int], tuple[Reading, int]] = {}
    for scene in (TOUCH, *range(n_scenes)):
        # A task a scene: with one a strategy, all cores but one wait for the slowest, which takes
        # half of the time of all. Touches take longest, and come first.
        for k, row in enumerate(rows):
            bits = design.adc.bits if row.strategy.reads_single else design.bits
            reading = Reading(row.strategy, mask, design.noise, bits, row.reached_hz)
            tasks[k, scene] = (reading, scene)

    n_workers = min(len(os.sched_getaffinity(0)), len(tasks))
    executor = "serial"
    if n_workers > 1:
        executor = f"process:{n_workers}"
    finished = computed(executor, figure, tasks)
    # Closed, it ends the workers if one of them fails.
    with closing(finished):
        progress = tqdm(
            finished,
            "simulated",
            len(tasks),
            file=sys.stderr,
            disable=None,
            leave=False,
        )
        figures = {key: future.result() for key, future in progress}

    simulated_rows = []
    for k, row in enumerate(rows):
        dbs = np.array([figures[k, scene] for scene in range(n_scenes)])
        accuracy = Accuracy(float(np.mean(dbs)), *band(dbs), figures[k, TOUCH])
        simulated_rows.append(replace(row, accuracy=accuracy))
    return simulated_rows


TOUCH = -1
"""In place of the number of a scene: light touches."""


@dataclass(frozen=True, eq=False)
class Reading:
    """A strategy on a skin; `strategy`, `mask`, `noise`, `bits` as of `make_reader`."""

    strategy: Strategy
    mask: Mask
    noise: float
    bits: int
    rate_hz: float


def figure(task: tuple[Reading, int]) -> float:
    """Mean PSNR of contact frames of a strategy in a scene in dB, or its lightest touch; seed of
    Phi is the scene's number.
    """
    reading, scene = task
    mask = reading.mask
    noise = reading.noise
    # A reader of its own for each: it has a memory.
    seed = max(scene, 0)
    reader = make_reader(reading.strategy, mask, noise, reading.bits, seed)
    if scene == TOUCH:
        return light_touch(reader, mask, noise, seed)
    frames = presses(scene, mask, noise, reading.rate_hz, seed=0)
    return float(np.mean(contact_db(reader, frames)))


def band(db: Doubles) -> tuple[float, float]:
    """Ends of the interval in which the PSNR of a further scene lies in 90 % of cases.

    Mean -/+ t s sqrt(1 + 1 / n) of n scenes, 2 or more; t is of Student's distribution with n - 1
    degrees of freedom. Source: prediction interval of a normal distribution; Hahn, Meeker,
    "Statistical Intervals", Wiley, 1991, section 4.7.
    """
    n = len(db)
    factor = float(stdtrit(n - 1, (1 + WITHIN) / 2)) * math.sqrt(1 + 1 / n)
    mean = float(db.mean())
    half = factor * float(db.std(ddof=1))
    return mean - half, mean + half
