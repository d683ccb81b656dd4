"""Study `gpu`: frames a second of the batch solver, for 1 to 1024 patches."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pandas as pd

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.reconstructor.batch.backend import Backend
from sparseskin.nodes.reconstructor.batch.graphs import MODES
from sparseskin.studies.points import compute_rows
from sparseskin.studies.report import cells, fill_page, markdown, write_csv
from sparseskin.studies.scene_frames import scene_of

from .patches import EVERY, ONE_BY_ONE, RATIO, SCENE, WARM_UP, compare, time_patches

#: All is timed in this process: a GPU is not shared, and a core is not either.
TIMED_IN = "serial"
#: Patches, a million taxels but for 576, and their frames a second.
GOAL, GOAL_HZ = 244, 1000
ON_GPU, QUICK_ON_GPU = (1, 4, 16, 64, GOAL, 1024), (1, GOAL)
ON_HOST, QUICK_ON_HOST = (1, 4, 16), (1, 4)
N_FRAMES, QUICK_N_FRAMES = 200, 30
#: Part of the patches that is untouched, in half of the points of a GPU.
IDLE = 0.875
COMPARED = {"patches": 4, "n_frames": 60, "idle": 0.0}

Point = dict[str, Any]


def why_no_device() -> str:
    """Why there is no GPU to run on; empty if there is one."""
    if find_spec("torch") is None:
        return "torch is not installed (pip install 'sparseskin[gpu]')"
    try:
        Backend("cuda")
    except SettingsError as error:
        return str(error)
    return ""


def points_of(quick: bool, seed: int) -> list[Point]:
    """Points to time: those of the host, then those of the GPU."""
    common = {"seed": seed, "n_frames": QUICK_N_FRAMES if quick else N_FRAMES}
    points = [
        {**common, "device": device, "mode": "eager", "patches": b, "idle": 0.0, "host": True}
        for device in (ONE_BY_ONE, "numpy")
        for b in (QUICK_ON_HOST if quick else ON_HOST)
    ]
    return points + [
        {**common, "device": "cuda", "mode": mode, "patches": b, "idle": idle, "host": host}
        for mode in (MODES[-2:] if quick else MODES[1:])
        for b in (QUICK_ON_GPU if quick else ON_GPU)
        for idle, host in ((0.0, True), (0.0, False), (IDLE, True))
        if host or mode == MODES[-1]
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`. Without a GPU nothing is run.

    `executor` is not used: all is timed in this process, one point at a time.
    """
    why_not = why_no_device()
    given: dict[str, Any] = {
        "scene": SCENE,
        "spacing_ms": 1e-6 * EVERY * scene_of(SCENE).dt_ns,
        "ratio": RATIO,
        "warm_up": WARM_UP,
        "why_not": why_not,
    }
    if why_not:
        fill_page(out, "gpu", conclusion=[f"Nothing was run: {why_not}."], **given)
        print(f"no device: {why_not}; nothing was run", file=sys.stderr)
        return
    points = points_of(quick, seed)
    rows = pd.DataFrame(compute_rows(time_patches, points, out, TIMED_IN, "time"))
    compared = [{**COMPARED, "seed": seed, "device": "cuda", "mode": mode} for mode in MODES]
    agreement = pd.DataFrame(compute_rows(compare, compared, out, TIMED_IN, "compare"))
    n = scene_of(SCENE).shape[0] * scene_of(SCENE).shape[1]
    fill_page(
        out,
        "gpu",
        conclusion=conclusion(rows, agreement, n),
        **given,
        goal=GOAL,
        goal_taxels=GOAL * n,
        goal_hz=GOAL_HZ,
        device=rows["name"].iloc[-1],
        reached=reached_hz(rows),
        table=table_of(rows, n),
        agreement=_agreement(agreement),
        csv=write_csv(out, "times", rows),
    )
    print(table_of(rows, n))


def conclusion(rows: pd.DataFrame, agreement: pd.DataFrame, n: int) -> list[str]:
    """The rate of as many patches as the goal has, the best of all, and the largest difference."""
    busy = rows[(rows["device"] == "cuda") & rows["host"] & (rows["idle"] == 0)]
    best = busy.loc[(busy["patches"] * busy["frames_hz"]).idxmax()]
    return [
        f"{GOAL} patches of {n} taxels, all touched: {reached_hz(rows):.0f} frames/s of "
        f"{GOAL_HZ:g} wanted, forces on the host.",
        f"Most patch frames a second: {best['patches'] * best['frames_hz']:.0f}, with "
        f"{best['patches']} patches ({best['mode']}).",
        f"Forces differ from numpy's by at most {agreement['largest_n'].max():.2g} N.",
    ]


def reached_hz(rows: pd.DataFrame) -> float:
    """Best rate of a GPU with as many patches as the goal has, all touched, forces on the host."""
    some = rows[(rows["device"] == "cuda") & (rows["patches"] == GOAL) & rows["host"]]
    some = some[some["idle"] == 0]
    return float(some["frames_hz"].max())


def table_of(rows: pd.DataFrame, n: int) -> str:
    shown = pd.DataFrame(
        {
            "device": rows["name"],
            "mode": rows["mode"],
            "patches": rows["patches"],
            "taxels": rows["patches"] * n,
            "idle": cells(rows, "{idle:.0%}"),
            "forces": ["to the host" if host else "stay there" for host in rows["host"]],
            "frames/s": cells(rows, "{frames_hz:.0f}"),
            "patch frames/s": [f"{b * hz:.0f}" for b, hz in rows[["patches", "frames_hz"]].values],
            "p50, ms": cells(rows, "{p50_ms:.3f}"),
            "p99, ms": cells(rows, "{p99_ms:.3f}"),
            "longest, ms": cells(rows, "{max_ms:.3f}"),
            "iterations": cells(rows, "{iterations:.1f}"),
        }
    )
    return markdown(shown)


def _agreement(found: pd.DataFrame) -> str:
    columns = {
        **{"device": "device", "mode": "mode", "largest_n": "largest difference, N"},
        **{"same": "frames with the same decisions so far"},
        **{"numpy_db": "PSNR of numpy, dB", "device_db": "PSNR, dB"},
    }
    return markdown(found[list(columns)].rename(columns=columns))
