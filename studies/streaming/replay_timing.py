"""Timing of a replay: send-time error, achieved rate and drift, as a table.

Run as `python -m sparseskin.studies.streaming.replay_timing [SECONDS]`, or `make replay-timing`. A
recording of 100 Hz or 1 kHz is played by a player in a process of its own; each frame is stamped
when it is sent, and recorded by a recorder in another.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Taxels
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
from sparseskin.studies.graph_run import GraphRun, launch_text

RATES_HZ = (100, 1000)
SPEEDS = (0.1, 1.0, 10.0)
SIDE = 8
COLUMNS = "recorded | rate | frames | send-time error p50 ms | p99 ms | achieved Hz | drift over"


def make_recording(path: Path, rate_hz: int, n_frames: int) -> None:
    """Write a recording of small frames, exactly 1 / rate_hz apart."""
    forces = np.zeros((SIDE, SIDE), np.float32)
    with BagWriter(path, {"scene": "timing"}) as bag:
        for k in range(n_frames):
            stamp_ns = k * 1_000_000_000 // rate_hz
            frame = Taxels(stamp_ns=stamp_ns, patch="skin", run_id="0" * 16, seq=k, forces=forces)
            bag.record(frame, stamp_ns)


def sent_times_ns(rate_hz: int, speed: float, seconds: float) -> npt.NDArray[np.int64]:
    """Times at which the frames of a recording were sent, played for some seconds."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_recording(folder / "in.mcap", rate_hz, round(rate_hz * speed * seconds) + 1)
        player, recorder = {"file": "in.mcap", "rate": speed}, {"out": "out.mcap"}
        with GraphRun(
            launch_text({"player": player, "recorder": recorder}), folder=folder
        ) as graph:
            graph.wait(None)
        with BagReader(folder / "out.mcap") as bag:
            return np.array([message.stamp_ns for message in bag.messages()], np.int64)


def table_row(rate_hz: int, speed: float, seconds: float) -> str:
    """One line of the table: errors against t0 + k / (rate_hz * speed)."""
    sent_ns = sent_times_ns(rate_hz, speed, seconds)
    target_ns = np.arange(len(sent_ns)) * 1e9 / (rate_hz * speed)
    late_ms = (sent_ns - sent_ns[0] - target_ns) / 1e6
    # Frames are never early, so the earliest of many shows where the schedule lies.
    late_ms -= late_ms.min()
    tenth = max(1, len(late_ms) // 10)
    drift_ms = float(np.median(late_ms[-tenth:]) - np.median(late_ms[:tenth]))
    achieved_hz = (len(sent_ns) - 1) / ((sent_ns[-1] - sent_ns[0]) / 1e9)
    off = 100 * (achieved_hz / (rate_hz * speed) - 1)
    median_ms, p99_ms = np.quantile(late_ms, [0.5, 0.99])
    return (
        f"| {rate_hz} Hz | {speed:g} | {len(sent_ns)} | {median_ms:.3f} | {p99_ms:.2f} "
        f"| {achieved_hz:.2f} ({off:+.2f} %) | {drift_ms:+.3f} |"
    )


def main(arguments: list[str]) -> int:
    """Print the table; SECONDS of playing for each line, 60 by default."""
    seconds = float(arguments[0]) if arguments else 60.0
    print(f"| {COLUMNS} {seconds:g} s, ms |")
    print("|---" * 7 + "|")
    for rate_hz in RATES_HZ:
        for speed in SPEEDS:
            print(table_row(rate_hz, speed, seconds), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
