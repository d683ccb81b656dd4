"""A sensor that never ends: the frames of a scene, again and again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from sparseskin.nodes.sensor.scenes import open_scene
from sparseskin.nodes.sensor.source import Forces

SCENES = {40: "path_40", 64: "drag_wrench_64"}
LOOP = 500
"""Frames that are repeated, from the middle of the scene on."""
PERIOD_NS = 1_000_000


class Endless:
    """A source of true forces without an end, as `sparseskin.nodes.sensor.source.Source`."""

    delivers = "truth"
    rate_hz = None
    n_frames = None

    def __init__(self, scene: str) -> None:
        source = open_scene(scene, seed=0)
        assert source.n_frames is not None
        begin = source.n_frames // 2
        frames = [forces for k, (_, forces) in zip(range(begin + LOOP), source, strict=False)
                  if k >= begin]  # fmt: skip
        self.name = f"{scene}, again and again"
        self.skin = source.skin
        self._frames: Forces = np.stack(frames)

    def __iter__(self) -> Iterator[tuple[int, Forces]]:
        k = 0
        while True:
            yield k * PERIOD_NS, self._frames[k % LOOP]
            k += 1


def frames_40() -> Endless:
    """40 x 40 taxels: `source = "sparseskin.studies.soak_driver:frames_40"`."""
    return Endless(SCENES[40])


def frames_64() -> Endless:
    """64 x 64 taxels."""
    return Endless(SCENES[64])
