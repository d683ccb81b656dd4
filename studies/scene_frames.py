"""Frames of a scene by number: true forces and noisy readings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from itertools import islice

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.scenes import SCENES, open_scene

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
    f_max_n = f_max_of(scene)
    frames = enumerate(open_scene(scene, seed))
    return next(k for k, (_, truth) in frames if in_contact(truth, f_max_n))


def f_max_of(scene: str) -> float:
    """Upper end of the range of a scene's taxels, in newtons."""
    return SCENES[scene]().f_max_n


def shape_of(scene: str) -> tuple[int, int]:
    """Rows and columns of a scene's skin."""
    return SCENES[scene]().shape


def n_steps_of(scene: str) -> int:
    """Number of frames of a scene."""
    return SCENES[scene]().n_steps


def step_s(scene: str) -> float:
    """Time between two frames of a scene, in seconds."""
    return SCENES[scene]().dt_ns * 1e-9
