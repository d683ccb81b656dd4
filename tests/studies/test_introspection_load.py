"""The load of observers on a graph: the figures by hand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from sparseskin.launch.launchfile.load import load
from sparseskin.studies.streaming.introspection_load import (
    DEPTH,
    NONE,
    OBSERVED,
    SUSPENDED,
    launch_file,
    report,
)
from sparseskin.studies.streaming.turns import Turn, latencies_ms

S = 1_000_000_000


def test_each_turn_with_observers_is_compared_with_its_neighbours(
    capsys: pytest.CaptureFixture[str],
) -> None:
    ways = [(NONE, 0.1), (OBSERVED, 0.15), (SUSPENDED, 0.1), (OBSERVED, 0.2), (SUSPENDED, 0.1)]
    turns = [Turn(way, k * S, (k + 1) * S, cpu_s) for k, (way, cpu_s) in enumerate(ways)]
    stamps = np.arange(0, 5 * S, S // 100)
    # Frames between turns, or after them, belong to none.
    stamps = np.append(stamps, 6 * S)
    latency_ms = np.append(np.repeat([1.0, 3.0, 2.0, 5.0, 4.0], 100), 99.0)
    times_ns = np.stack([stamps, stamps + (1e6 * latency_ms).astype(np.int64)], axis=1)
    report(turns, latencies_ms(turns, times_ns))
    _, of_none, of_suspended, of_looked, compared = capsys.readouterr().out.splitlines()
    assert of_none.split()[2:] == ["100", "1.000", "1.000", "1000"]
    assert of_suspended.split()[1:] == ["200", "3.000", "4.000", "1000"]
    assert of_looked.split()[-4:] == ["200", "4.000", "5.000", "1750"]
    # 3 / 2, 5 / 4 and 5 / 2
    logs = np.log([1.5, 1.25, 2.5])
    mean, error = np.exp(logs.mean()), logs.std() / np.sqrt(2)
    assert f"2 turns: x {mean:.3f} +- {error:.1%}" in compared
    assert compared.endswith("median 1.500; of all frames x 1.333; CPU x 1.750")


def test_its_graph_is_sound_and_bounds_what_waits(
    tmp_path: Path,
) -> None:
    path = tmp_path / "load.toml"
    path.write_text(launch_file(1000.0))
    nodes = load(str(path)).nodes
    assert nodes["reconstructor"].settings.depth == DEPTH > 0
    assert nodes["sensor"].settings.rate_hz == 1000.0
