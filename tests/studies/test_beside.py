"""The shipped nodes beside lean ones: what a slice states, and that both reconstruct the same."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("pandas")

from sparseskin.studies.speed import beside, lean
from sparseskin.studies.speed.latency import run_graph
from sparseskin.studies.speed.stopwatch import PROCESSOR, WATCH

POINT = {"scene": "truth_40", "rate_hz": 200, "n_frames": 40, "iterations": 1}


@given(st.integers(0, 2**62), st.integers(0, 2**62), st.integers(1, 300))
def test_a_lean_frame_arrives_as_it_was_sent(number, stamp_ns, n):
    array = np.random.default_rng(n).standard_normal(n, dtype=np.float32)
    found = lean.unpacked(lean.packed(number, stamp_ns, array))
    assert found[:2] == (number, stamp_ns)
    np.testing.assert_array_equal(found[2], array)


@given(st.integers(2, 400), st.integers(0, 10**12), st.integers(1, 10**7))
def test_processor_time_of_a_frame_that_takes_the_same_each_time(n, begin_ns, frame_ns):
    used_ns = begin_ns + frame_ns * np.arange(n, dtype=np.int64)
    assert beside.per_frame_us(used_ns) == pytest.approx(frame_ns / 1e3)


def test_ratios_are_those_of_the_nodes_that_both_have():
    ages = {"p50_ms": 2.0, "p99_ms": 3.0, "lost": 0}
    ours = {
        "sensor_us": 1,
        "compressor_us": 2,
        "reconstructor_us": 6,
        "monitor_us": 100,
        **ages,
    }
    least = {
        "sensor_us": 1,
        "compressor_us": 1,
        "reconstructor_us": 1,
        **ages,
        "p50_ms": 0.5,
    }
    found = beside.together(ours, least)
    assert found["cpu ratio"] == 3
    assert found["p50 ratio"] == 4
    assert found["ours monitor_us"] == 100


@pytest.mark.slow
def test_both_kinds_of_nodes_reconstruct_every_frame_and_note_it():
    notes = lean.run_lean(POINT)
    assert tuple(notes) == lean.NODES
    for of_node in notes.values():
        assert of_node.shape == (40, 3)
        np.testing.assert_array_equal(of_node[:, 0], notes["sensor"][:, 0])
        assert (np.diff(of_node[:, 0]) > 0).all()
        assert (of_node[:, 1] > 0).all()
        assert (np.diff(of_node[:, 2]) >= 0).all()

    reports = run_graph({**POINT, "preset": "skin", "depth": 0, "monitor": True})
    assert {len(report[PROCESSOR]) for report in reports.values()} == {40}
    assert len(reports["reconstructor"][WATCH]) == 40
    figures = beside.of_graph(reports, 40)
    assert figures["lost"] == 0
    assert figures["p50_ms"] > 0
