"""Conclusions at the top of study pages follow from the figures of the run."""

from __future__ import annotations

from typing import Any

import pandas as pd
import pytest

pytest.importorskip("matplotlib")

from sparseskin.studies.attacks import study as attacks
from sparseskin.studies.faults import study as faults
from sparseskin.studies.soak import study as soak
from sparseskin.studies.targets import page as targets


def test_a_soak_names_what_grew_most() -> None:
    def of(growth: float, before: int, after: int) -> dict[str, Any]:
        return {
            "growth": growth,
            "mb_per_hour": 40 * growth,
            "files_before": before,
            "files_after": after,
        }

    found = {"frames": {"sensed": 900, "lost": 2}, "restarts": 1}
    lines = soak.conclusion(found, {"sensor": of(0.01, 9, 9), "monitor": of(0.05, 9, 8)}, 30)
    assert "2 of 900 frames were lost, 1 nodes started again" in lines[0]
    assert lines[1].startswith("Memory grew most in the monitor: by 5.0 %")
    assert lines[2] == "In no process did the number of open files grow."
    lines = soak.conclusion(found, {"sensor": of(0.01, 9, 12), "monitor": of(0.0, 9, 9)}, 30)
    assert lines[2] == "Open files grew most in the sensor, by 3."


def test_attacks_are_summed() -> None:
    one = {"lost": 1, "frames": 50, "stopped": ["monitor"], "left": []}
    two = {"lost": 0, "frames": 70, "stopped": [], "left": ["a.sock"]}
    listed = {"graphs": {"stop": 3, "Ctrl-C": 4}, "faults": ["x"], "left": []}
    lines = attacks.conclusion([one, two], {**listed, "frames": {"lost": 0}})
    assert "1 of 120 frames lost; nodes that ended: monitor." in lines[0]
    assert lines[1].startswith("Commands beside 7 graphs that started and ended: 1 faults")
    assert lines[2] == "Left behind: a.sock."


def test_of_faults_the_worst_are_named() -> None:
    signal = next(iter(faults.SIGNALS))
    common = {"fault": signal, "stopped": [], "left": []}
    rows = [
        {**common, "node": "sensor", "lost": 0, "recover_s": [0.5, 0.7]},
        {**common, "node": "compressor", "lost": 12, "recover_s": [2.0, 3.0], "left": ["f"]},
        {**common, "node": "monitor", "lost": faults.UNKNOWN, "recover_s": []},
    ]
    lines = faults.conclusion(rows)
    worst = faults.name_of(rows[1])
    assert lines[0] == f"1 of 2 faults lose no frame; most are lost by: {worst} (12)."
    assert lines[1].endswith(f"at most 2.50 s in the median: {worst}.")
    assert lines[2] == (f"Other nodes stop after: none. Something is left behind by: {worst}.")


def test_targets_that_are_reached_are_counted() -> None:
    rows = [
        {"n": n, "kind": "the paper's", "ratio": ratio, "method": "skin", "gain": gain}
        for n, ratio, gain in ((1600, 3, 12.5), (1600, 8, 16.0), (4096, 4, 12.0), (400, 3, 99.0))
    ]
    (line,) = targets.conclusion(pd.DataFrame(rows))
    assert line.startswith("skin reaches 2 of 3 wanted gains over preset paper: +12.5 dB at N/3 of")
    assert "+16.0 dB at N/8 of 1600 (wanted 17)" in line
