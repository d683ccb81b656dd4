"""Scenes with a degree of freedom or a term more or less, and the change of their frames."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from sparseskin.messages.skin import CONTACT_FRACTION
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.scenes.bodies import Body, metal_peg, monkey_wrench, wooden_cube
from sparseskin.nodes.sensor.scenes.scenes import SCENES, SKIN_ON_GROUND, TAXEL_RADIUS_M
from sparseskin.nodes.sensor.scenes.simulation import (
    SMOOTHING_STEPS,
    MovingAverage,
    Scene,
    SceneSource,
)

FINER = 10
BODIES: tuple[Callable[[float], Body], ...] = (wooden_cube, metal_peg, monkey_wrench)


@dataclass(frozen=True)
class Variant:
    """One way to change a scene.

    Attributes
    ----------
    carried : bool
        True: the scene has what is varied, and it is removed. False: it is added.
    scene : Scene
        The changed scene.
    smoothing_steps : int
        Width of the moving average.
    finer : int
        Steps of the simulation that make one frame.
    """

    carried: bool
    scene: Scene
    smoothing_steps: int = SMOOTHING_STEPS
    finer: int = 1

    def frames(self) -> Iterator[Floats]:
        """True forces in N, float32 of shape (n_rows, n_cols), one for each frame."""
        average = MovingAverage(self.smoothing_steps, self.scene.shape)
        for step, state in enumerate(SceneSource(self.scene, seed=0).states()):
            if step % self.finer == 0:
                state.write_forces(average.newest)
                yield np.minimum(average.step(), np.float32(self.scene.f_max_n))


def variants(scene: Scene) -> dict[str, Variant]:
    """All variants of a scene, by name."""
    surface, dof = scene.surface, scene.dof
    grounded = surface.ground_drop_m is not None
    needles = next(body(0.0) for body in BODIES if body(TAXEL_RADIUS_M) is scene.body)
    other_ground = replace(surface, ground_drop_m=None) if grounded else SKIN_ON_GROUND
    found = {
        "damping of the skin": Variant(True, replace(scene, surface=replace(surface, damping=0.0))),
        "round taxels": Variant(True, replace(scene, body=needles)),
        "moving average": Variant(True, scene, smoothing_steps=1),
        "pitch": _with_or_without(scene, "pitch"),
        "roll": _with_or_without(scene, "roll"),
        "ground": Variant(grounded, replace(scene, surface=other_ground)),
        "steps a tenth as long": Variant(
            False,
            replace(scene, n_steps=FINER * scene.n_steps, dt_ns=scene.dt_ns // FINER),
            finer=FINER,
        ),
    }
    if grounded:
        deadened = replace(surface, ground_damping=0.0)
        found["damping of the ground"] = Variant(True, replace(scene, surface=deadened))
    if len(dof) == 1:
        both = replace(scene, dof=("z", "pitch", "roll"))
        found["pitch and roll"] = Variant(False, both)
    return found


def _with_or_without(scene: Scene, axis: Any) -> Variant:
    carried = axis in scene.dof
    if carried:
        return Variant(True, replace(scene, dof=tuple(a for a in scene.dof if a != axis)))
    return Variant(False, replace(scene, dof=(*scene.dof, axis)))


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Change of a variant's frames from the scene's, beside the noise, and the time of a frame.

    Returns
    -------
    dict
        change_db, noise_db: 10 log10(f_max^2 / mean squared difference) over the frames in
        contact, of the change and of the noise; worst_db: the frame that changes most;
        above_noise: share of the contact frames that change by more than the noise;
        scene_us, variant_us: time of the processor for a frame.
    """
    scene = shortened(point["scene"], point["n_steps"])
    variant = variants(scene)[point["variant"]]
    noise_model = NoiseModel.for_range(scene.f_max_n)
    rng = np.random.default_rng(point["seed"])
    changes, noises = [], []
    timed = (_Timed(Variant(True, scene).frames()), _Timed(variant.frames()))
    for ours, theirs in zip(*timed, strict=True):
        if max(ours.max(), theirs.max()) <= CONTACT_FRACTION * scene.f_max_n:
            continue
        changes.append(float(np.mean(np.square(theirs - ours), dtype=np.float64)))
        noise = noise_model.apply(ours, rng) - ours
        noises.append(float(np.mean(np.square(noise), dtype=np.float64)))
    above = [change > noise for change, noise in zip(changes, noises, strict=True)]
    n_frames = scene.n_steps
    return {
        "carried": variant.carried,
        "change_db": decibels(float(np.mean(changes)), scene.f_max_n),
        "noise_db": decibels(float(np.mean(noises)), scene.f_max_n),
        "worst_db": decibels(max(changes), scene.f_max_n),
        "above_noise": float(np.mean(above)),
        "scene_us": timed[0].total_s / n_frames * 1e6,
        "variant_us": timed[1].total_s / n_frames * 1e6,
    }


def shortened(name: str, n_steps: int | None) -> Scene:
    """A scene by name, up to so many steps."""
    scene = SCENES[name]()
    return scene if n_steps is None else replace(scene, n_steps=min(n_steps, scene.n_steps))


def decibels(error: float, f_max_n: float) -> float:
    """PSNR of a mean squared difference in N^2, at most 100 dB."""
    return float(10.0 * np.log10(f_max_n**2 / max(error, f_max_n**2 * 1e-10)))


class _Timed:
    """An iterator that sums the processor time of its frames."""

    def __init__(self, frames: Iterator[Floats]) -> None:
        self._frames = frames
        self.total_s = 0.0

    def __iter__(self) -> Iterator[Floats]:
        return self

    def __next__(self) -> Floats:
        begin_s = time.thread_time()
        frame = next(self._frames)
        self.total_s += time.thread_time() - begin_s
        return frame
