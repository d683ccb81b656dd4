"""Study `gpu`: nothing is run without a device, and the table states what was timed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.errors import SettingsError
from sparseskin.studies.gpu import study
from sparseskin.studies.gpu.patches import ONE_BY_ONE


@pytest.mark.parametrize("torch", [True, False])
def test_without_a_device_nothing_is_run(
    torch: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def no_gpu(device: str) -> None:
        raise SettingsError(f"device: {device!r}: torch finds no GPU")

    def runs(*_: Any) -> None:
        pytest.fail("a point was computed")

    monkeypatch.setattr(study, "find_spec", lambda name: name if torch else None)
    monkeypatch.setattr(study, "Backend", no_gpu)
    monkeypatch.setattr(study, "compute_rows", runs)
    assert main(["study", "gpu", "--quick", "--out", str(tmp_path)]) == 0
    why = "torch finds no GPU" if torch else "torch is not installed"
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("no device: ")
    assert why in line
    assert line.endswith("; nothing was run")
    page = (tmp_path / "gpu.md").read_text()
    assert "No device: " in page
    assert why in page
    assert "Nothing was run" in page
    assert "## Measured on an H100" in page
    assert not list(tmp_path.glob("*.csv"))


def row(device: str, name: str, **changed: Any) -> dict[str, Any]:
    timed = {"p50_ms": 1.75, "p99_ms": 4.0031, "max_ms": 4.257, "iterations": 8.91}
    point = {"mode": "fused", "patches": 244, "idle": 0.0, "host": True, "frames_hz": 458.4}
    return {"device": device, "name": name, **timed, **point, **changed}


def test_the_table_has_a_line_of_each_point() -> None:
    rows = [
        row(ONE_BY_ONE, ONE_BY_ONE, patches=1, frames_hz=100.0, mode="eager"),
        row("cuda", "a GPU", idle=0.875),
        row("cuda", "a GPU", host=False),
    ]
    lines = study.table_of(pd.DataFrame(rows), 4096).strip().splitlines()
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert len(cells) == 2 + len(rows)
    head, _, alone, idle, stays = cells
    assert alone[:4] == [ONE_BY_ONE, "eager", "1", "4096"]
    timed = dict(zip(head, idle, strict=True))
    assert timed == {
        **{"device": "a GPU", "mode": "fused", "patches": "244", "taxels": "999424"},
        **{"idle": "88%", "forces": "to the host", "frames/s": "458", "patch frames/s": "111850"},
        **{"p50, ms": "1.750", "p99, ms": "4.003", "longest, ms": "4.257", "iterations": "8.9"},
    }
    assert stays[head.index("forces")] == "stay there"


def test_points_time_each_number_of_patches_with_and_without_idle_ones() -> None:
    points = study.points_of(quick=False, seed=0)
    compiled = [p for p in points if p["mode"] == "compiled"]
    assert {p["patches"] for p in compiled} == set(study.ON_GPU)
    assert {(p["idle"], p["host"]) for p in compiled} == {
        (0.0, True),
        (0.0, False),
        (study.IDLE, True),
    }
    assert all(p["device"] == "cuda" for p in compiled)


def test_the_goal_is_compared_with_the_best_rate_that_has_all_forces_on_the_host() -> None:
    slower, best = row("cuda", "a GPU", mode="graph", frames_hz=53.0), row("cuda", "a GPU")
    others = [
        row("cuda", "a GPU", idle=study.IDLE, frames_hz=900.0),
        row("cuda", "a GPU", host=False, frames_hz=901.0),
        row("cuda", "a GPU", patches=1, frames_hz=902.0),
        row("numpy", "numpy", frames_hz=903.0),
    ]
    assert study.reached_hz(pd.DataFrame([slower, best, *others])) == 458.4
    assert study.GOAL in study.ON_GPU
    assert study.GOAL in study.QUICK_ON_GPU


def test_with_a_device_the_page_has_its_figures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def computed(function: Any, points: list[dict[str, Any]], *_: Any) -> list[dict[str, Any]]:
        timed = row("cuda", "a GPU", iterations=4.5)
        compared = {"largest_n": 5.6e-6, "same": 0.8875, "numpy_db": 54.932, "device_db": 54.936}
        return [{**timed, **compared, **point} for point in points]

    monkeypatch.setattr(study, "why_no_device", lambda: "")
    monkeypatch.setattr(study, "compute_rows", computed)
    assert main(["study", "gpu", "--quick", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "gpu.md").read_text()
    assert "Goal: 244 patches, 999424 taxels, at 1000 frames/s. On a GPU: 458 frames/s" in page
    assert "54.936" in page.partition("## Measured on an H100")[0]
    assert "No device" not in page
    assert (tmp_path / "times.csv").exists()
