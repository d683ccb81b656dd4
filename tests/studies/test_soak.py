"""The study `soak`: a short run of its graph, and its figures by hand."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.studies.looped import Looped
from sparseskin.studies.scene_frames import scene_frames
from sparseskin.studies.soak.study import LAUNCHER, measure, verdict

FLAT_MB = 3.0
"""Of 50 to 180 MB; a leak of 1 kB a frame would be 5 MB in the time that is looked at."""


NAMES = {LAUNCHER, "sensor", "compressor", "reconstructor", "monitor", "recorder"}


def test_every_process_of_a_graph_is_sampled_and_nothing_is_lost() -> None:
    found = measure({"seconds": 3.5, "rate_hz": 50, "side": 40})
    samples = found["samples"]
    assert samples.keys() == {"time_s", *NAMES}
    assert len(samples["time_s"]) >= 2
    for name in NAMES:
        for values in samples[name].values():
            assert len(values) == len(samples["time_s"])
            assert min(values) > 0
    assert found["frames"]["sensed"] == found["frames"]["reconstructed"] > 0
    assert (found["frames"]["lost"], found["restarts"], found["exit_code"]) == (0, 0, 130)
    assert found["lost"].keys() == NAMES - {LAUNCHER}
    assert set(found["lost"].values()) == {0}


@pytest.mark.slow
def test_a_graph_that_runs_for_a_while_leaks_nothing_and_loses_nothing() -> None:
    found = measure({"seconds": 24.0, "rate_hz": 100, "side": 40})
    assert found["frames"]["lost"] == found["restarts"] == 0
    assert set(found["lost"].values()) == {0}
    for name in NAMES:
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


def test_a_looped_source_repeats_its_frames_with_stamps_that_go_on() -> None:
    first, n = 60, 5
    pairs = list(scene_frames("lift_box_40", 0, first, first + n))
    for delivers in ("truth", "taxels"):
        source = Looped("lift_box_40", first, n, delivers)
        stamps, forces = zip(*itertools.islice(source, 2 * n), strict=True)
        assert all(np.diff(stamps) > 0)
        expected = [pair[delivers == "taxels"] for pair in pairs]
        np.testing.assert_array_equal(forces, 2 * expected)


@pytest.mark.parametrize("minutes", ["0", "-1", "nan", "ten", "1e9"])
def test_minutes_are_a_number_in_range(minutes: str) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["study", "soak", "--minutes", minutes])
    assert ended.value.code == 2


def test_only_some_studies_take_minutes(capsys: pytest.CaptureFixture[str], tmp_path: Any) -> None:
    assert main(["study", "stability", "--minutes", "1", "--out", str(tmp_path)]) == 2
    assert (
        capsys.readouterr().err
        == "--minutes: study 'stability' takes none; allowed: soak, attacks\n"
    )
