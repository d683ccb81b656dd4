"""What looking at a graph costs it: the figures by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.launchfile import load
from sparseskin.studies.introspection_load import DEPTH, LAUNCH, WAYS, Turn, report

S = 1_000_000_000


def test_each_turn_with_onlookers_is_compared_with_the_one_before(
    capsys: pytest.CaptureFixture[str],
) -> None:
    alone, looked = WAYS
    turns = [
        Turn(way, k * S, (k + 1) * S, cpu_s)
        for k, (way, cpu_s) in enumerate(
            [(alone, 0.1), (looked, 0.15), (alone, 0.1), (looked, 0.2)]
        )
    ]
    stamps = np.arange(0, 4 * S, S // 100)
    # What lies between turns, or after them, is of none.
    stamps = np.append(stamps, 5 * S)
    latency_ms = np.append(np.repeat([2.0, 3.0, 4.0, 5.0], 100), 99.0)
    report(turns, stamps, latency_ms)
    _, of_alone, of_looked, ratios, medians, calm = capsys.readouterr().out.splitlines()
    assert of_alone.split()[1:] == ["200", "3.000", "4.000", "1000"]
    assert of_looked.split()[-4:] == ["200", "4.000", "5.000", "1750"]
    assert ratios.endswith(": 1.500 1.250")
    assert medians == "median 1.375; p50 of all x 1.333, CPU x 1.750"
    # Four windows a turn: a quarter of those of both turns is 2 ms alone, and 3 ms looked at.
    assert calm.endswith("p50 2.000 and 3.000 ms, x 1.500")


def test_its_graph_is_sound_and_bounds_what_waits(
    tmp_path: Path,
) -> None:
    path = tmp_path / "load.toml"
    path.write_text(LAUNCH.format(out="x.npy", rate_hz=1000.0, depth=DEPTH))
    nodes = load(str(path)).nodes
    assert nodes["reconstructor"].settings.depth == DEPTH > 0
    assert nodes["sensor"].settings.rate_hz == 1000.0
