"""Frames of a scene by number: true forces and noisy readings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import islice

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene
from sparseskin.nodes.sensor.scenes.simulation import Scene

from .evaluate import in_contact


def scene_frames(
    scene: str, seed: int, first: int = 0, stop: int | None = None, every: int = 1
) -> Iterator[tuple[Floats, Floats]]:
    """Yield (truth, taxels) of the frames first, first + every, ... below `stop`.

    The noise of a frame is what a sensor node of that seed adds to it, whichever other frames
    are asked for.

    Parameters
    ----------
    scene : str
        Name of a scene.
    seed : int
        Of the scene and of the noise.
    first, stop, every : int
        Frames to yield; `stop` None: to the end of the scene.

    Yields
    ------
    truth, taxels : ndarray of float32, shape (n_rows, n_cols)
        Newtons; fresh arrays.
    """
    source = open_scene(scene, seed)
    noise = NoiseModel.for_range(source.skin.f_max)
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


def spacing_ms(scene: str, every: int = 1) -> float:
    """Time between every k-th frame of a scene, ms."""
    return 1e-6 * every * scene_of(scene).dt_ns


@cache
def scene_of(scene: str) -> Scene:
    """A scene by name: its shape, number of frames, time step and range."""
    return SCENES[scene]()
