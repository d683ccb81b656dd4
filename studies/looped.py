"""Sensor sources without an end: frames of a scene, computed once and repeated."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np

from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.scenes.scenes import open_scene

from .frames import scene_frames

PERIOD_NS = 1_000_000


class Looped:
    """Source of a sensor node that repeats frames first, ..., first + n - 1 of a scene.

    `delivers`: "truth", true forces, or "taxels", readings with the skin's noise.
    """

    rate_hz = None
    n_frames = None

    def __init__(
        self, scene: str, first: int, n: int, delivers: Literal["truth", "taxels"]
    ) -> None:
        self.name = f"{scene}, repeated"
        self.skin = open_scene(scene, seed=0).skin
        self.delivers = delivers
        frames = scene_frames(scene, 0, first, first + n)
        self._frames: Floats = np.stack([pair[delivers == "taxels"] for pair in frames])

    def __iter__(self) -> Iterator[tuple[int, Floats]]:
        k = 0
        while True:
            yield k * PERIOD_NS, self._frames[k % len(self._frames)]
            k += 1


# As settings of a sensor: `source = "sparseskin.studies.looped:path_40"`. The skin is touched in
# all of their frames: an untouched one takes less time.
path_40 = partial(Looped, "path_40", 1000, 2000, "taxels")
drag_wrench_40 = partial(Looped, "drag_wrench_40", 1500, 2000, "taxels")
drag_wrench_64 = partial(Looped, "drag_wrench_64", 5000, 2000, "taxels")
truth_40 = partial(Looped, "path_40", 6100, 500, "truth")
truth_64 = partial(Looped, "drag_wrench_64", 6300, 500, "truth")
