"""Reprocessing of a recording beside its solver alone, in turn, in one process."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from sparseskin.launch.offline.job import Job, run_job
from sparseskin.messages import Measurements, PhiState, SkinState
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import Phi
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.node import phis_to_invert
from sparseskin.nodes.reconstructor.patch import Patch
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.recorder.bag.frames import decoded
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.node import Recorder
from sparseskin.nodes.sensor.node import Sensor
from sparseskin.studies.points import StudyError

from .beside import medians

SCENES = ("drag_wrench_40", "drag_wrench_64")
FIRST = 1900
"""First frame of a scene, shortly before the first contact."""
N_FRAMES = 3200
QUICK_N_FRAMES = 800
SLICES = 5
QUICK_SLICES = 3
ITERATIONS = (24, 8)
"""Iterations of a frame: those of the preset, and fewer, as for a skin at 500 Hz; of these the
solver hides less of the rest."""


class Used(NamedTuple):
    """Time that a piece of work took, seconds."""

    clock_s: float
    processor_s: float  # of all threads of this process


def points(quick: bool, seed: int) -> list[dict[str, Any]]:
    """One recording of each scene, in as many iterations as `ITERATIONS` has."""
    common = {"first": FIRST, "n_frames": N_FRAMES, "slices": SLICES, "seed": seed}
    if quick:
        common |= {"n_frames": QUICK_N_FRAMES, "slices": QUICK_SLICES}
    return [
        {**common, "scene": scene, "iterations": iterations}
        for scene in SCENES
        for iterations in ITERATIONS
    ]


def measure(point: dict[str, Any]) -> dict[str, Any]:
    """Reconstruct a recording by `reprocess` and by its solver alone, in turn.

    `point`: scene, first (frame), n_frames, iterations, slices, seed. Returns medians over the
    slices: "alone_us" and "reprocess_us", processor time of a frame; "hz ratio", frames per second
    by the clock in those of the solver alone; "cpu ratio", the same of processor time. Setting up
    is left out of the solver's time, and counts in that of `reprocess`. Raises StudyError if the
    recording cannot be reprocessed.
    """
    with tempfile.TemporaryDirectory(prefix="sparseskin-speed-") as folder:
        source = Path(folder, "source.mcap")
        record_scene(source, point)
        slices = []
        for k in range(point["slices"]):
            alone = _of_solver(source, point["iterations"])
            out = Path(folder, f"out{k}.mcap")
            whole = _of_reprocess(source, out, point["iterations"])
            # The next slice writes as much: disks may be small.
            out.unlink()
            slices.append(compared(alone, whole, point["n_frames"]))
    return medians(slices)


def compared(alone: Used, whole: Used, n_frames: int) -> dict[str, float]:
    """Figures of a slice, as of `measure`."""
    return {
        "alone_us": 1e6 * alone.processor_s / n_frames,
        "reprocess_us": 1e6 * whole.processor_s / n_frames,
        "hz ratio": alone.clock_s / whole.clock_s,
        "cpu ratio": alone.processor_s / whole.processor_s,
    }


def record_scene(path: Path, point: dict[str, Any]) -> None:
    """Record truth, taxels and measurements of a scene, as of `measure`."""
    part = {"first": point["first"], "seed": point["seed"]}
    sensor = Sensor.Settings(source=f"scene:{point['scene']}", **part)
    nodes: dict[str, Any] = {
        "sensor": (Sensor, sensor),
        "compressor": (Compressor, Compressor.Settings()),
        "recorder": (Recorder, Recorder.Settings(out=str(path))),
    }
    bus = Bus(nodes)
    with closing(bus):
        bus.run(point["n_frames"])
    bus.check()


def _of_reprocess(source: Path, out: Path, iterations: int) -> Used:
    changes = (f"reconstructor.iterations={iterations}",)
    job = Job(str(source), str(out), changes, "auto")

    def work() -> None:
        outcome = run_job(job)
        if outcome.error:
            raise StudyError(outcome.error)

    return _used(work)


def _of_solver(source: Path, iterations: int) -> Used:
    settings = ReconstructorSettings(iterations=iterations)
    states: dict[str, Any] = {}
    received: list[Measurements] = []
    # All messages are decoded before: their time is not that of the solver.
    with BagReader(source) as bag:
        for recorded in bag.messages():
            if recorded.schema == Measurements.schema:
                message: Any = decoded(bag, recorded)
                received.append(message)
            elif recorded.schema in (SkinState.schema, PhiState.schema):
                states[recorded.schema] = decoded(bag, recorded)

    skin = states[SkinState.schema]
    phis = phis_to_invert(settings, skin, states[PhiState.schema])
    patch = Patch(settings, log=lambda line: None)
    patch.set_up(settings, phis, skin, live=False)
    patch.set_noise(skin)
    phi_of = {phi.fingerprint: phi for phi in phis}
    frames = [(phi_of[message.phi], message.y[0]) for message in received]
    return _used(lambda: solve_all(patch, frames))


def solve_all(patch: Patch, frames: list[tuple[Phi, Floats]]) -> None:
    """Solve frames by the solver of a patch, without any check of them."""
    solver = patch.solver
    assert solver is not None
    for phi, y in frames:
        solver.use(phi)
        solver.setup(y, None)
        for _ in range(min(patch.most_steps, solver.n_steps)):
            solver.step()
        solver.finish()


def _used(work: Callable[[], None]) -> Used:
    begin_s = time.perf_counter()
    processor_s = time.process_time()
    work()
    return Used(time.perf_counter() - begin_s, time.process_time() - processor_s)
