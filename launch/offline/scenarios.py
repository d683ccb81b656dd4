"""Short recordings of scenes, which are made when they are first used."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import OutputError, os_errors, user_folder, whole_file
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.remote import is_remote, local_path

if TYPE_CHECKING:
    from sparseskin.messages import Message
    from sparseskin.nodes.sensor.node import Sensor

FILE_SUFFIX = ".mcap"
PERIOD_NS = 10_000_000
"""Time between two frames of a scenario, nanoseconds: the sensor's default rate, 100 Hz."""


class ScenarioError(SparseskinError):
    """There is no scenario or recording of that name, or it cannot be made."""


@dataclass(frozen=True)
class Scenario:
    """A part of a scene, recorded with all its topics: `n_frames` from step `first` on, `every`
    steps apart. Played at 100 Hz, that is slower than the scene itself.
    """

    scene: str
    first: int
    n_frames: int
    every: int
    about: str


SCENARIOS = {
    "press_box": Scenario("lift_box_40", 310, 195, 2, "a cube lands, 5 x slower"),
    "drag_wrench": Scenario("drag_wrench_40", 2000, 250, 5, "a wrench dragged, 2 x slower"),
    "tap_peg": Scenario("path_40", 310, 250, 2, "a peg is dropped, 5 x slower"),
    "big_wrench": Scenario("drag_wrench_64", 4000, 100, 10, "a wrench lands, 10 x slower"),
}


def data_folder() -> Path:
    """Folder of the recordings that are made on first use."""
    return user_folder("data")


def resolve_recording(name_or_path: str) -> Path:
    """The recording that a person means: a file, a copy of that at an address, or a scenario, made
    if it is not there yet. Raises SparseskinError if it is none of these, has no suffix, or cannot
    be read or written.
    """
    if is_remote(name_or_path):
        return local_path(name_or_path)
    path = Path(name_or_path)
    if name_or_path in SCENARIOS and not path.is_file():
        path = data_folder() / f"{name_or_path}{FILE_SUFFIX}"
        if not path.exists():
            print(f"{name_or_path}: made on first use, in {path.parent}", file=sys.stderr)
            make_scenario(name_or_path, path.parent)
        return path
    if path.suffix or (name_or_path and path.exists()):
        return path
    raise unknown_scenario(name_or_path)


def make_scenario(name: str, folder: Path) -> Path:
    """Record a scenario into FOLDER/NAME.mcap, whole or not at all; one that is there is kept.
    Raises SparseskinError if there is no such scenario, or it cannot be written.

    The same bytes in every message each time: the clock is moved by hand, and solver times, which
    no two runs share, are left at 0.
    """
    from sparseskin.nodes.recorder.bag.writer import removing

    if name not in SCENARIOS:
        raise unknown_scenario(name)
    path = folder / f"{name}{FILE_SUFFIX}"
    if path.exists():
        return path
    with os_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    try:
        with whole_file(path) as draft, removing(draft, path):
            record_scenario(name, SCENARIOS[name], draft)
    except OutputError:
        # Another process that made the same was done first.
        if not path.is_file():
            raise
    return path


def record_scenario(name: str, scenario: Scenario, out: Path) -> None:
    """Record a scenario into a new file; ScenarioError if a node fails."""
    from sparseskin.messages import Reconstruction
    from sparseskin.nodes.bus import Bus
    from sparseskin.nodes.clock import ManualClock
    from sparseskin.nodes.compressor.node import Compressor
    from sparseskin.nodes.reconstructor.node import Reconstructor
    from sparseskin.nodes.recorder.node import Recorder
    from sparseskin.nodes.sensor.node import Sensor

    class UntimedReconstructor(Reconstructor):
        """A reconstructor that publishes no solver time."""

        def step(self, message: Message) -> Iterable[Message]:
            for made in super().step(message):
                yield replace(made, solve_ns=(0,)) if isinstance(made, Reconstruction) else made

    text = f"# sparseskin scenes make {name}\n# {scenario.scene}, "
    text += f"from step {scenario.first} on, one frame every {scenario.every} steps\n"
    clock = ManualClock(PERIOD_NS)
    bus = Bus(
        {
            "sensor": (Sensor, Sensor.Settings(source=f"scene:{scenario.scene}")),
            "compressor": (Compressor, Compressor.Settings()),
            "reconstructor": (UntimedReconstructor, Reconstructor.Settings()),
            "recorder": (Recorder, Recorder.Settings(out=str(out), launch=text, source=name)),
        },
        clock,
    )
    sensor = bus.hosts["sensor"].node
    assert isinstance(sensor, Sensor)
    _skip(sensor, scenario.first)
    try:
        for _ in bus.frames(scenario.n_frames):
            clock.advance(PERIOD_NS)
            _skip(sensor, scenario.every - 1)
    finally:
        bus.close()
    for node, host in bus.hosts.items():
        if host.failure:
            raise ScenarioError(f"{name}: {node}: {host.failure}")


def _skip(sensor: Sensor, n_steps: int) -> None:
    from sparseskin.nodes.node import Tick

    for step in range(n_steps):
        deque(sensor.acquire(Tick(0, step)), maxlen=0)


def unknown_scenario(name: str) -> ScenarioError:
    """The error for a name that is no scenario, with the nearest ones."""
    known = ", ".join(SCENARIOS)
    # Where one is near, it is named first; the list is there in any case.
    hint = did_you_mean(name, SCENARIOS)
    listed = "" if "known:" in hint else f"; there are {known}"
    return ScenarioError(f"{name!r}: no file and no recorded scenario of that name{hint}{listed}")
