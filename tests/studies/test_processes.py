"""Nodes in few processes: figures of a run, each process counted once."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pandas")

from sparseskin.studies.speed import processes
from sparseskin.studies.speed.beside import WARM_UP
from sparseskin.studies.speed.stopwatch import PROCESSOR, WATCH

N = 400
PERIOD_NS = 1_000_000


@given(
    st.sampled_from(list(processes.PROCESSES)),
    st.integers(1, 10**6),
    st.integers(1, 10**6),
)
def test_a_process_is_counted_once_and_skipped_frames_are_counted(
    kind, frame_ns, age_ns
):
    of_nodes = processes.PROCESSES[kind]
    n_processes = len({of_nodes.get(node, node) for node in processes.NODES})
    stamps = PERIOD_NS * np.arange(N)
    used = (frame_ns * np.arange(N)).tolist()
    reports = {node: {PROCESSOR: used} for node in processes.NODES}
    reports["sensor"][WATCH] = [[stamp, 1] for stamp in stamps]
    reports["reconstructor"][WATCH] = [
        [stamp, 1, 2, age_ns, 4] for stamp in stamps[::2]
    ]
    figures = processes._figures(reports, of_nodes)
    counted = (1 - WARM_UP) * N
    assert figures["cpu_us"] == pytest.approx(
        n_processes * frame_ns / 1e3, rel=2 / counted
    )
    assert figures["hz"] == pytest.approx(1e9 / PERIOD_NS)
    assert figures["skipped"] == 0.5
    assert figures["p50_ms"] == pytest.approx(age_ns / 1e6)


def test_ratios_are_those_to_four_processes():
    figures = {
        kind: {"cpu_us": 10.0 * k, "p50_ms": 1.0, "p99_ms": 5.0 / k, "skipped": 0.0}
        for k, kind in enumerate(processes.PROCESSES, start=1)
    }
    found = processes.with_ratios(figures)
    assert found["one cpu ratio"] == 4
    assert found["two p50 ratio"] == 1
    assert found["two p99 ratio"] == 0.5
    assert found["four cpu ratio"] == 1
    assert found["one cpu_us"] == 40
