"""Small bags for tests."""

from pathlib import Path
from typing import Any

import numpy as np

from sparseskin.launch.commands.cli import make_parser
from sparseskin.launch.launchfile.load import load
from sparseskin.messages import (
    Measurements,
    Reconstruction,
    SkinState,
    Taxels,
    Truth,
    encode,
)
from sparseskin.messages.base import Message
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import Clock, ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.node import Tick
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.nodes.recorder.node import Recorder
from sparseskin.nodes.sensor.node import Sensor

PERIOD_NS = 10_000_000
LAG_NS = 700
PHI = "0123456789abcdef"
N_ROWS, N_COLS, M = 5, 7, 12
MASK = np.ones((N_ROWS, N_COLS), np.bool_)
MASK[2, 3] = False


def skin_state(patch: str = "skin", **changes: Any) -> SkinState:
    """The state of a small skin, with changed fields."""
    values: dict[str, Any] = {
        "stamp_ns": 0,
        "patch": patch,
        "n_rows": N_ROWS,
        "n_cols": N_COLS,
    }
    values |= {
        "f_max": 2.5,
        "unit": "N",
        "pitch_m": 0.005,
        "mask": MASK,
        "source": "test",
    }
    values |= {
        "seed": 3,
        "rate_hz": 100.0,
        "has_truth": True,
        "sigma_mid": 0.06,
        "sigma_end": 0.01,
    }
    return SkinState(**values | changes)


def frame(k: int, patch: str = "skin") -> list[Message]:
    """The messages of frame k; every number differs from every other frame's."""
    rng = np.random.default_rng(k)

    def forces() -> Any:
        return rng.uniform(0, 2.5, (N_ROWS, N_COLS)).astype(np.float32) * MASK

    of_frame: dict[str, Any] = {"stamp_ns": k * PERIOD_NS, "patch": patch}
    return [
        Taxels(**of_frame, forces=forces()),
        Truth(**of_frame, forces=forces()),
        Measurements(**of_frame, y=rng.normal(size=M).astype(np.float32), phi=PHI),
        Reconstruction(
            **of_frame,
            forces=forces(),
            phi=PHI,
            iterations=(30,),
            residual=(float(rng.uniform()),),
            solve_ns=(1,),
            done_ns=1,
        ),
    ]


def frames(n_frames: int, patch: str = "skin") -> list[Message]:
    return [
        skin_state(patch),
        *(message for k in range(n_frames) for message in frame(k, patch)),
    ]


def record(writer: BagWriter, message: Message) -> bytes:
    """Write a message as the recorder does; its payload."""
    writer.record(message, message.stamp_ns + LAG_NS)
    return encode(message)[1]


def run_bag(*arguments: object) -> int:
    """Run `sparseskin recording ARGUMENTS` in this process; its exit code."""
    words = ["recording", *map(str, arguments)]
    chosen = make_parser(words).parse_args(words)
    return int(chosen.run(chosen))


class FakeClock:
    """A monotonic clock in seconds that stands still."""

    def __init__(self) -> None:
        self.now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def on_disk(path: Path) -> list[bytes]:
    """Payloads that a reader finds in a bag that is still being written."""
    with BagReader(path.with_name(path.name + ".part")) as bag:
        return [message.payload for message in bag.messages()]


def make_bag(path: Path, messages: list[Message], flush_every: int = 40) -> list[bytes]:
    """A whole bag with several chunks; the payloads in it, in order."""
    payloads = []
    # Its chunks end where they are told to, however busy the host.
    with BagWriter(
        path, {"scene": "test", "seed": "3"}, monotonic=FakeClock()
    ) as writer:
        for number, message in enumerate(messages, start=1):
            payloads.append(record(writer, message))
            if number % flush_every == 0:
                writer.flush()
        writer.close({"lost": {"/skin/taxels": 2}})
    return payloads


CHAIN = (Sensor, Compressor, Reconstructor)
STATIONS = {cls.__name__.lower(): cls for cls in (*CHAIN, Monitor, Recorder)}


def chain(clock: Clock | None = None, **settings: dict[str, Any]) -> Bus:
    """Sensor, compressor, reconstructor and other nodes by their settings, in one process."""
    chosen: dict[str, Any] = {cls.__name__.lower(): {} for cls in CHAIN} | settings
    nodes = {
        name: (STATIONS[name], STATIONS[name].Settings(**v))
        for name, v in chosen.items()
    }
    return Bus(nodes, clock)


def launched(name: str, *changes: str, record: str | None = None) -> Bus:
    """The nodes of a launch file in one process, on a clock that goes on by 1 ns a frame."""
    nodes = load(name, changes, record).nodes.values()
    return Bus({node.name: (node.cls, node.settings) for node in nodes}, ManualClock(1))


def only(messages: list[Message], kind: type[Message]) -> Any:
    """The one message of a kind."""
    (found,) = [message for message in messages if isinstance(message, kind)]
    return found


def record_scene(out: Path, scene: str, first: int, n_frames: int, every: int) -> Path:
    """Record steps of a scene from `first` on, `every` steps apart, at 100 Hz, with all topics."""
    clock, recorder = ManualClock(PERIOD_NS), {"out": str(out), "source": scene}
    bus = chain(clock, sensor={"source": f"scene:{scene}"}, recorder=recorder)
    sensor: Any = bus.hosts["sensor"].node

    def skip(n_steps: int) -> None:
        for step in range(n_steps):
            list(sensor.acquire(Tick(0, step)))

    skip(first)
    for _ in bus.frames(n_frames):
        clock.advance(PERIOD_NS)
        skip(every - 1)
    bus.close()
    bus.check()
    return out
