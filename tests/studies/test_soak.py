"""The study `soak`: a graph that runs for a minute in small, and its figures by hand."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from sparseskin.launch.cli import main
from sparseskin.studies.soak_driver import LOOP, frames_40
from sparseskin.studies.soak_points import LAUNCHER, measure, verdict

FLAT_MB = 3.0
"""Of 50 to 180 MB; a leak of 1 kB a frame would be 5 MB in the time that is looked at."""


def test_a_graph_that_runs_for_a_minute_leaks_nothing_and_loses_nothing() -> None:
    found = measure({"seconds": 60.0, "rate_hz": 100, "side": 40})
    names = {LAUNCHER, "sensor", "compressor", "reconstructor", "monitor", "recorder"}
    assert found["samples"].keys() == {"time_s", *names}
    assert found["frames"]["lost"] == found["restarts"] == 0
    assert set(found["lost"].values()) == {0}
    for name in names:
        v = verdict(found["samples"], name)
        assert v["after_mb"] - v["before_mb"] < FLAT_MB, name
        assert v["files_after"] <= v["files_before"], name


def samples(memory_mb: list[float], files: list[int]) -> dict[str, Any]:
    n = len(memory_mb)
    looked_at = {"memory_mb": memory_mb, "files": files, "cpu_s": [0.25 * k for k in range(n)]}
    return {"time_s": [float(k) for k in range(n)], "x": looked_at}


def test_memory_is_judged_after_the_warm_up_by_its_first_and_last_fifth() -> None:
    n = 600
    warm, flat = [float(k) for k in range(70)], [100.0] * (n - 70)
    v = verdict(samples(warm + flat, [9] * n), "x")
    assert (v["growth"], v["files_before"], v["files_after"]) == (0.0, 9, 9)
    assert v["mb_per_hour"] == pytest.approx(0.0, abs=1e-6)
    assert v["cpu"] == pytest.approx(0.25)
    leaks = (100.0 + 0.01 * np.arange(n)).tolist()
    v = verdict(samples(leaks, [9] * (n - 1) + [10]), "x")
    assert v["mb_per_hour"] == pytest.approx(36.0)
    assert v["growth"] > 0.02
    assert (v["files_before"], v["files_after"]) == (9, 10)


def test_a_queue_that_is_long_for_some_seconds_is_no_growth() -> None:
    memory_mb = [100.0] * 600
    memory_mb[560:590] = [180.0] * 30
    v = verdict(samples(memory_mb, [9] * 600), "x")
    assert (v["growth"], v["highest_mb"]) == (0.0, 180.0)


def test_of_a_short_run_a_third_is_warm_up() -> None:
    assert verdict(samples([1.0] * 31, [1] * 31), "x")["warm_up_s"] == 10.0


def test_the_endless_sensor_goes_on_where_its_scene_ends() -> None:
    source = frames_40()
    forces, stamps = [], []
    for _, (stamp_ns, frame) in zip(range(2 * LOOP), source, strict=False):
        forces.append(frame)
        stamps.append(stamp_ns)
    assert all(np.diff(stamps) > 0)
    np.testing.assert_array_equal(forces[0], forces[LOOP])
    assert any(np.any(a != b) for a, b in itertools.pairwise(forces))


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "ten", "1e9"])
def test_minutes_are_a_number_in_range(minutes: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["study", "soak", "--minutes", minutes])
    assert ended.value.code == 2


def test_only_the_soak_takes_minutes(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    assert main(["study", "stability", "--minutes", "1", "--out", str(tmp_path)]) == 2
    assert capsys.readouterr().err == "--minutes: study 'stability' takes none; allowed: soak\n"
