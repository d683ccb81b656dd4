"""Figures of the study `speed`: those of two ways in turn, and that they do the same work."""

import os

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from sparseskin.nodes.process.proc import cpu_s, resident_bytes
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.studies.speed import host, matrices, offline

times_s = st.floats(1e-6, 1e3)


def test_figures_of_this_host_agree_with_those_of_its_processes():
    pid = os.getpid()
    assert 0 < host.own_bytes(pid) <= 1.5 * resident_bytes(pid)
    assert host.host_busy_s() >= cpu_s(pid)


@given(*[times_s] * 4, st.integers(1, 10_000))
def test_reprocessing_is_stated_in_frames_of_the_solver(
    alone_s, alone_cpu_s, whole_s, whole_cpu_s, n_frames
):
    figures = offline.compared(
        offline.Used(alone_s, alone_cpu_s),
        offline.Used(whole_s, whole_cpu_s),
        n_frames,
    )
    alone_hz = n_frames / alone_s
    assert figures["hz ratio"] * alone_hz == pytest.approx(n_frames / whole_s)
    assert figures["cpu ratio"] == pytest.approx(
        figures["alone_us"] / figures["reprocess_us"]
    )
    assert figures["reprocess_us"] == pytest.approx(1e6 * whole_cpu_s / n_frames)


def test_the_recording_that_is_reprocessed_has_the_truth_and_no_forces(tmp_path):
    point = {"scene": "drag_wrench_40", "first": 0, "n_frames": 5, "seed": 1}
    offline.record_scene(tmp_path / "a.mcap", point)
    with BagReader(tmp_path / "a.mcap") as bag:
        n_messages = {topic: info.n_messages for topic, info in bag.topics.items()}
    frames = dict.fromkeys(("/skin/taxels", "/skin/truth", "/skin/measurements"), 5)
    assert n_messages == frames | {"/skin/skin": 1, "/skin/phi": 1}


def test_each_matrix_runs_on_the_frames_of_the_default(monkeypatch):
    monkeypatch.setattr(matrices, "N_FRAMES", 34)
    monkeypatch.setattr(matrices, "WARM_UP", 30)
    point = {"kind": "full", "ratio": 1, "side": 8, "seed": 0}
    figures = matrices.measure(point)
    assert 0 < figures["error"] < 0.1
    names = ("set_up_s", "edge_us", "host_us", "ratio to default")
    assert all(np.isfinite(figures[name]) and figures[name] > 0 for name in names)
