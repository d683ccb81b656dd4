"""Hostile messages and launch files by the hundred thousand: `sparseskin study fuzz`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.studies.points import compute
from sparseskin.studies.report import fill_page, write_csv

from . import launch_files as fuzz_launch
from . import nodes as fuzz_nodes

N_MESSAGES = 200_000
N_FILES = 20_000
FILES_A_POINT = 2000


def points(quick: bool, seed: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Messages, a point a node type; launch files, in lots."""
    part = 50 if quick else 1
    n_files = min(FILES_A_POINT, N_FILES // part)
    nodes = [{"type": name, "n": N_MESSAGES // part, "seed": seed} for name in fuzz_nodes.TYPES]
    lots = N_FILES // part // n_files
    return nodes, [{"n": n_files, "seed": seed * 1000 + k} for k in range(lots)]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Fuzz nodes and launch files (quick: a fiftieth) and write the page; see `command.Study`."""
    node_points, lots = points(quick, seed)
    nodes = compute(fuzz_nodes.measure, node_points, out, "serial", "messages")
    files = compute(fuzz_launch.measure, lots, out, executor, "launch files")
    rows = [
        {
            "node": point["type"],
            "messages": point["n"],
            "refused": sum(found["refused"].values()),
            "lives": "yes" if found["alive"] else "**no**",
            "sound frames taken": found["received"],
            "memory_mb": f"{found['memory_mb'][0]:.1f} to {found['memory_mb'][-1]:.1f}",
            "after subscriptions": " then ".join(f"{mb:.1f}" for mb in found["subscribed_mb"]),
            "reasons": ", ".join(f"{n} {why}" for why, n in sorted(found["refused"].items())),
        }
        for point, found in zip(node_points, nodes, strict=True)
    ]
    codes = {
        code: sum(found["codes"].get(code, 0) for found in files)
        for code in sorted({code for found in files for code in found["codes"]})
    }
    fill_page(
        out,
        "fuzz",
        n_sound=fuzz_nodes.N_SOUND,
        table=pd.DataFrame(rows, dtype=object),
        n_files=sum(point["n"] for point in lots),
        codes=codes,
        n_lines=sum(found["n_lines"] for found in files),
        longest_ms=max(found["longest_ms"] for found in files),
        n_faulty=sum(found["n_faulty"] for found in files),
        faulty=[text[:1000] for found in files for text in found["faulty"]],
        csv=write_csv(out, "fuzz", rows),
    )
