"""Hostile messages and launch files by the hundred thousand: `sparseskin study fuzz`."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.studies.points import compute, compute_rows
from sparseskin.studies.report import fill_page, write_csv

from . import launch_files, nodes

N_MESSAGES = 200_000
N_FILES = 20_000
FILES_A_POINT = 2000


def points(quick: bool, seed: int) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Messages, a point a node type; launch files, in lots."""
    part = 50 if quick else 1
    n_files = min(FILES_A_POINT, N_FILES // part)
    messages = [{"type": name, "n": N_MESSAGES // part, "seed": seed} for name in nodes.TYPES]
    lots = N_FILES // part // n_files
    return messages, [{"n": n_files, "seed": seed * 1000 + k} for k in range(lots)]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Fuzz nodes and launch files (quick: a fiftieth) and write the page; see `command.Study`."""
    node_points, lots = points(quick, seed)
    sent = compute_rows(nodes.measure, node_points, out, "serial", "messages")
    files = compute(launch_files.measure, lots, out, executor, "launch files")
    rows = [
        {
            "node": of["type"],
            "messages": of["n"],
            "refused": sum(of["refused"].values()),
            "lives": "yes" if of["alive"] else "**no**",
            "sound frames taken": of["received"],
            "memory_mb": " to ".join(f"{mb:.1f}" for mb in of["memory_mb"]),
            "after subscriptions": " then ".join(f"{mb:.1f}" for mb in of["subscribed_mb"]),
            "reasons": ", ".join(f"{n} {why}" for why, n in sorted(of["refused"].items())),
        }
        for of in sent
    ]
    codes: Counter[str] = sum((Counter(found["codes"]) for found in files), Counter())
    fill_page(
        out,
        "fuzz",
        conclusion=[
            f"{sum(of['n'] for of in sent):,} hostile messages to {len(sent)} types of nodes: "
            f"{sum(bool(of['alive']) for of in sent)} live and go on.",
            f"{sum(sum(of['refused'].values()) for of in sent):,} were refused and counted.",
            f"{sum(point['n'] for point in lots):,} mutated launch files: "
            f"{sum(found['n_faulty'] for found in files)} were not answered as they have to be.",
        ],
        n_sound=nodes.N_SOUND,
        table=pd.DataFrame(rows, dtype=object),
        n_files=sum(point["n"] for point in lots),
        codes=dict(sorted(codes.items())),
        files=files,
        csv=write_csv(out, "fuzz", rows),
    )
