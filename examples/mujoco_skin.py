"""The same box, dropped and dragged, in MuJoCo and in the contact model of the scenes.

Needs MuJoCo: pip install 'sparseskin[mujoco]'. MuJoCo moves the body; the taxels of models/pad.xml
press on it by the force law of the scenes.
"""

from __future__ import annotations

import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from sparseskin.nodes.sensor.scenes.bodies import Body, build_sole, slab
from sparseskin.nodes.sensor.scenes.scenes import SKIN, TAXEL_RADIUS_M
from sparseskin.nodes.sensor.scenes.simulation import Drag, Scene, SceneSource
from sparseskin.plugins.simulators.source import MujocoSource

if find_spec("mujoco") is None:
    sys.exit("this example runs MuJoCo: pip install 'sparseskin[mujoco]'")

MODEL = Path(__file__).parent / "models" / "pad.xml"
N_STEPS = 2000
DRAG_AT_S = 1.0
SPEED_M_S = 0.05
MASS_KG = 0.3


def drag(model, data, time_s):
    """Prescribe the motion along x, as a scene does."""
    moving = time_s >= DRAG_AT_S
    data.qpos[0] = SPEED_M_S * (time_s - DRAG_AT_S) if moving else 0.0
    data.qvel[0] = SPEED_M_S if moving else 0.0


def in_mujoco(path=MODEL):
    """Forces of each ms, and the load of MuJoCo's own contacts at the end, in newtons."""
    source = MujocoSource(f"{path}#pad", control=drag, duration_s=N_STEPS * 1e-3)
    begin = time.perf_counter()
    frames = np.stack([forces for _, forces in source])
    seconds = time.perf_counter() - begin
    return frames, source.touch.contact_force(), N_STEPS * 1e-3 / seconds


def in_the_contact_model(radius_m):
    """Forces of each ms, of taxels that are spheres, or needles of radius 0."""
    sides = (-0.03, 0.03, -0.02, 0.02)
    body = Body(
        build_sole([slab(*sides, 0.0)], sides, radius_m), MASS_KG, inertia_kg_m2=1.0
    )
    scene = Scene(
        name="box",
        shape=(32, 32),
        n_steps=N_STEPS,
        dt_ns=1_000_000,
        body=body,
        surface=SKIN,
        drop_height_m=0.03,
        motion=Drag(at_s=DRAG_AT_S, velocity_m_s=(SPEED_M_S, 0.0)),
        place_m=(-0.03, 0.0),
    )
    frames = np.zeros((N_STEPS, *scene.shape), np.float32)
    for frame, state in zip(frames, SceneSource(scene, seed=0).states(), strict=True):
        state.write_forces(frame)
    return np.minimum(frames, scene.f_max_n)


def line(name, frames, reference):
    total = frames.sum(axis=(1, 2))
    touched = (frames > 0).sum(axis=(1, 2))
    contact = (frames.max(axis=(1, 2)) > 0.01) | (reference.max(axis=(1, 2)) > 0.01)
    error = ((frames - reference) ** 2).mean(axis=(1, 2))[contact]
    psnr = np.minimum(10 * np.log10(2.5**2 / np.maximum(error, 1e-30)), 100)
    print(
        f"{name:<34} {total.max():7.3f} {total[900]:7.3f} {total[-1]:7.3f} {touched[900]:6d} "
        f"{touched[-1]:6d} {psnr.mean():7.1f} {psnr.min():7.1f} dB"
    )


needles = in_the_contact_model(0.0)
spheres = in_the_contact_model(TAXEL_RADIUS_M)
mujoco, _, factor = in_mujoco()
print(
    f"weight of the box: {MASS_KG * 9.81:.3f} N; PSNR of contact frames against needles"
)
print(f"{'':<34} {'sum, N':^23} {'footprint':^13} {'PSNR':^15}")
print(
    f"{'':<34} {'peak':>7} {'rest':>7} {'drag':>7} {'rest':>6} {'drag':>6} {'mean':>7} {'min':>7}"
)
line("contact model, needles", needles, needles)
line("contact model, spheres of 2.5 mm", spheres, needles)
line("MuJoCo, the taxels bear the load", mujoco, needles)
with tempfile.TemporaryDirectory() as folder:
    colliding = Path(folder) / "pad.xml"
    foam = '0.005" contype="0" conaffinity="0"'
    collides = '0.005" contype="1" conaffinity="1" condim="1" priority="1"'  # no friction, either
    colliding.write_text(MODEL.read_text().replace(foam, collides))
    stiff, load, _ = in_mujoco(colliding)
line("MuJoCo, its contact bears the load", stiff, needles)
print(f"its contact bears {load:.3f} N, and is too stiff for the taxels to read it")
print(f"{N_STEPS} frames at 1 kHz of simulated time: {factor:.1f} times real time")
