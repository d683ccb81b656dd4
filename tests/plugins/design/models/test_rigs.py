"""Predictions of the models for rigs that were built."""

from __future__ import annotations

import pytest

from sparseskin.plugins.design.models.rigs import RIGS


def test_most_rigs_are_predicted_within_a_factor_2_and_of_others_the_reason_is_stated() -> None:
    beyond = [rig for rig in RIGS if not rig.is_within]
    assert [rig.name for rig in beyond] == ["3D-ViTac", "SPTS, 7 % of 100"]
    assert all(rig.reason for rig in beyond)
    assert all(rig.facts for rig in RIGS)


def test_a_flexitac_is_limited_by_its_converter_and_its_line_allows_389_hz() -> None:
    line, whole = RIGS[:2]
    assert line.predicted_hz == pytest.approx(389.1, abs=0.1)
    # 16 MHz / 16 / 13 clocks are 76,923 conversions a second, of 512 taxels
    assert (whole.limit, whole.predicted_hz) == ("ADC", pytest.approx(76_923 / 512, rel=1e-4))
