"""The six scenes, streamed through real processes, beside table III of the paper.

Run as `python -m sparseskin.studies.streaming.scenes [SCENE ...]`, or `make scenes`.
"""

from __future__ import annotations

import sys
from typing import Any

from sparseskin.nodes.compressor.phi.rotation import PAPER as PAPER_ROWS
from sparseskin.studies.graph_run import GraphRun
from sparseskin.studies.paper_tables.numbers import PAPER
from sparseskin.studies.points import StudyError

RATE_HZ = 200
RATIO = 3
_HEADER = (
    "| scene | frames | lost | noisy mean (paper) | noisy min (paper) | reconstructed mean (paper) "
    "| reconstructed min (paper) | latency p50 / p99 ms | solve p50 / p99 ms |"
)


def stream(scene: str) -> dict[str, Any]:
    """Launch a scene at 200 Hz with the paper's method, and return its patch's summary.

    Raises
    ------
    StudyError
        If the graph does not become ready, or ends with an error.
    """
    paper = ("reconstructor.preset=paper", f"compressor.rows={PAPER_ROWS}")
    settings = (f"sensor.rate_hz={RATE_HZ}", *paper)
    with GraphRun(scene, *(word for one in settings for word in ("--set", one))) as graph:
        code = graph.wait(None)
        if code:
            raise StudyError(f"{scene}: exit code {code}: {graph.log[-5:]}")
        summary: dict[str, Any] = graph.summary()["patches"]["skin"]
    return summary


def table_row(scene: str, patch: dict[str, Any]) -> str:
    """One line of the table."""
    cells = [scene, str(patch["frames"]["sensed"]), str(patch["frames"]["lost"])]
    paper = PAPER[scene]
    for key, theirs in (("noisy", paper.noisy), ("reconstruction", paper.by_ratio[RATIO])):
        ours = patch["psnr_db"][key]["all"]
        cells += [f"{ours['mean']:.2f} ({theirs.mean})", f"{ours['min']:.1f} ({theirs.low})"]
    for key in ("latency_ms", "solve_ms"):
        cells.append(f"{patch[key]['p50']:.2f} / {patch[key]['p99']:.2f}")
    return "| " + " | ".join(cells) + " |"


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
