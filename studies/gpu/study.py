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
ON_GPU, QUICK_ON_GPU = (1, 4, 16, 64, 244, 1024), (1, 244)
ON_HOST, QUICK_ON_HOST = (1, 4, 16), (1, 4)
N_FRAMES, QUICK_N_FRAMES = 200, 30
#: Part of the patches that is untouched, in half of the points of a GPU.
IDLE = 0.875
GOAL_TAXELS, GOAL_HZ = 1_000_000, 1000
COMPARED = {"patches": 4, "n_frames": 60, "idle": 0.0}

Point = dict[str, Any]


def devices() -> tuple[list[str], str]:
    """Devices of the host that can be timed, and why there is no GPU among them, if so."""
    if find_spec("torch") is None:
        return ["numpy"], "torch is not installed (pip install 'sparseskin[gpu]')"
    try:
        Backend("cuda")
    except SettingsError as error:
        return ["numpy", "cpu"], str(error)
    return ["numpy", "cuda"], ""


def points_of(found: list[str], quick: bool, seed: int) -> list[Point]:
    """Points to time on these devices."""
    common = {"seed": seed, "n_frames": QUICK_N_FRAMES if quick else N_FRAMES}
    points = [
        {**common, "device": device, "mode": "eager", "patches": b, "idle": 0.0, "host": True}
        for device in [ONE_BY_ONE, *(one for one in found if one != "cuda")]
        for b in (QUICK_ON_HOST if quick else ON_HOST)
    ]
    if "cuda" not in found:
        return points
    return points + [
        {**common, "device": "cuda", "mode": mode, "patches": b, "idle": idle, "host": host}
        for mode in (MODES[-2:] if quick else MODES[1:])
        for b in (QUICK_ON_GPU if quick else ON_GPU)
        for idle, host in ((0.0, True), (0.0, False), (IDLE, True))
        if host or mode == MODES[-1]
    ]


def run(out: Path, quick: bool, seed: int, executor: str) -> None:
    """Compute the study and write its page; see `command.Study`.

    `executor` is not used: all is timed in this process, one point at a time.
    """
    found, why_not = devices()
    if why_not:
        print(f"no device: {why_not}", file=sys.stderr)
    points = points_of(found, quick, seed)
    rows = pd.DataFrame(compute_rows(time_patches, points, out, TIMED_IN, "time"))
    others = [device for device in found if device != "numpy"]
    compared = [
        {**COMPARED, "seed": seed, "device": device, "mode": mode}
        for device in others
        for mode in (MODES if device == "cuda" else MODES[:1])
    ]
    agreement = pd.DataFrame(compute_rows(compare, compared, out, TIMED_IN, "compare"))
    n = scene_of(SCENE).shape[0] * scene_of(SCENE).shape[1]
    goal = -(-GOAL_TAXELS // n)
    fill_page(
        out,
        "gpu",
        scene=SCENE,
        spacing_ms=1e-6 * EVERY * scene_of(SCENE).dt_ns,
        ratio=RATIO,
        warm_up=WARM_UP,
        why_not=why_not,
        goal=goal,
        goal_hz=GOAL_HZ,
        idle=IDLE,
        device=rows["name"].iloc[-1],
        reached=_reached(rows, goal),
        table=_table(rows, n),
        agreement=_agreement(agreement),
        csv=write_csv(out, "times", rows),
    )
    print(_table(rows, n))


def _reached(rows: pd.DataFrame, goal: int) -> float | None:
    """Best rate of a GPU with as many patches as the goal has, all touched, forces on the host."""
    some = rows[(rows["device"] == "cuda") & (rows["patches"] == goal) & rows["host"]]
    some = some[some["idle"] == 0]
    return float(some["frames_hz"].max()) if len(some) else None


def _table(rows: pd.DataFrame, n: int) -> str:
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
    if found.empty:
        return "No other library is installed."
    columns = {
        **{"device": "device", "mode": "mode", "largest_n": "largest difference, N"},
        **{"same": "frames with the same decisions so far"},
        **{"numpy_db": "PSNR of numpy, dB", "device_db": "PSNR, dB"},
    }
    return markdown(found[list(columns)].rename(columns=columns))
