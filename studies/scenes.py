"""The six scenes, streamed through real processes, beside table III of the paper.

Run as `python -m sparseskin.studies.scenes [SCENE ...]`, or `make scenes`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

RATE_HZ = 200


@dataclass(frozen=True)
class PaperRow:
    """What the paper reports for M = N/3 and 30 iterations: mean PSNR in dB and its minimum."""

    noisy_mean: float
    noisy_min: float
    restored_mean: float
    restored_min: float


PAPER = {
    "lift_box_40": PaperRow(46.5, 39.1, 52.5, 40.9),
    "lift_wrench_40": PaperRow(47.2, 38.4, 52.7, 31.1),
    "drag_wrench_40": PaperRow(46.4, 37.4, 47.7, 28.5),
    "path_40": PaperRow(48.0, 44.8, 55.9, 49.2),
    "lift_box_64": PaperRow(46.8, 36.6, 49.9, 39.0),
    "drag_wrench_64": PaperRow(46.4, 36.2, 46.4, 29.8),
}
_HEADER = (
    "| scene | frames | lost | noisy mean (paper) | noisy min (paper) | restored mean (paper) "
    "| restored min (paper) | latency p50 / p99 ms | solve p50 / p99 ms |"
)


def stream(scene: str) -> dict[str, Any]:
    """Launch a scene at 200 Hz and return its patch's summary.

    Raises
    ------
    RuntimeError
        If the graph did not end well.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "out.json"
        command = [sys.executable, "-m", "sparseskin.launch.entry", "launch", scene]
        command += ["--set", f"sensor.rate_hz={RATE_HZ}", "--summary", str(out)]
        command += ["--set", "reconstructor.preset=paper"]
        done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
        if done.returncode:
            raise RuntimeError(f"{scene}: exit code {done.returncode}")
        summary: dict[str, Any] = json.loads(out.read_text())["patches"]["skin"]
    return summary


def table_row(scene: str, patch: dict[str, Any]) -> str:
    """One line of the table."""
    paper = PAPER[scene]
    noisy, restored = (patch["psnr_db"][key]["all"] for key in ("noisy", "reconstruction"))
    cells = [
        scene,
        str(patch["frames"]["sensed"]),
        str(patch["frames"]["lost"]),
        f"{noisy['mean']:.2f} ({paper.noisy_mean})",
        f"{noisy['min']:.1f} ({paper.noisy_min})",
        f"{restored['mean']:.2f} ({paper.restored_mean})",
        f"{restored['min']:.1f} ({paper.restored_min})",
        *(f"{patch[key]['p50']:.2f} / {patch[key]['p99']:.2f}" for key in _TIMES),
    ]
    return "| " + " | ".join(cells) + " |"


_TIMES = ("latency_ms", "solve_ms")


def main(scenes: list[str]) -> int:
    """Stream scenes, all six by default, and print the table."""
    unknown = [scene for scene in scenes if scene not in PAPER]
    if unknown:
        print(f"{unknown[0]}: no such scene (known: {', '.join(PAPER)})", file=sys.stderr)
        return 2
    print(_HEADER)
    print("|---" * 9 + "|")
    for scene in scenes or PAPER:
        print(table_row(scene, stream(scene)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
