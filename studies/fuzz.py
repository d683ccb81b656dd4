"""Hostile messages and launch files by the hundred thousand: `sparseskin study fuzz`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from . import fuzz_launch, fuzz_nodes
from .points import compute
from .report import markdown_table, write_csv, write_page

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
    """Fuzz nodes and launch files, and write what came of it.

    Parameters
    ----------
    out : Path
        Folder to write to, which exists.
    quick : bool
        A fiftieth of it.
    seed : int
        Seed of the mutations.
    executor : str
        As in `compute`.
    """
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
            "memory_mb": " to ".join(f"{mb:.1f}" for mb in found["memory_mb"]),
            "after subscriptions": " then ".join(f"{mb:.1f}" for mb in found["subscribed_mb"]),
            "reasons": ", ".join(f"{n} {why}" for why, n in sorted(found["refused"].items())),
        }
        for point, found in zip(node_points, nodes, strict=True)
    ]
    codes = {
        code: sum(found["codes"].get(code, 0) for found in files)
        for code in sorted({code for found in files for code in found["codes"]})
    }
    faulty = [text for found in files for text in found["faulty"]]
    write_page(
        out,
        "fuzz",
        [
            "# Hostile messages and launch files",
            "Random, truncated, mutated and misplaced messages on the input socket of each node "
            "type, in a process of its own, and a tenth as many hostile subscriptions to its "
            f"output; then {fuzz_nodes.N_SOUND} sound frames. Memory is from after the first tenth "
            "to after the last message.",
            markdown_table(list(rows[0]), [list(row.values()) for row in rows]),
            f"{sum(point['n'] for point in lots)} mutated launch files: exit codes "
            + ", ".join(f"{code}: {n}" for code, n in codes.items())
            + f"; {sum(found['n_lines'] for found in files)} lines of errors; the longest check "
            f"took {max(found['longest_ms'] for found in files):.0f} ms; not as it has to be: "
            f"{sum(found['n_faulty'] for found in files)}.",
            *(f"```\n{text[:1000]}\n```" for text in faulty),
            f"All figures: {write_csv(out, 'fuzz', rows)}.",
        ],
    )
