"""Study `wiring`: circuits of row sums against exact ones, its points and its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.compressor.phi.row_local import RowLocalPhi
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.plugins.wiring import study as wiring
from sparseskin.studies.frames import PressFrames
from sparseskin.studies.harness import Candidate, Measurement


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wiring, "SHAPE", (16, 16))


def measured(**circuit: Any) -> tuple[Any, Any]:
    """Measurements of a press by a circuit, and by the matrix."""
    take = PressFrames("gaussian", (16, 16), 10).open(0)
    made: Any = Candidate(PRESETS["skin"]).make(Measurement(3, phi="row_local"), take, 0)
    press = np.zeros((16, 16), np.float32)
    press[4:8, 3:9] = 1.5
    phi: Any = made.phi
    assert isinstance(phi, RowLocalPhi)
    found = wiring.ReadRows(made, **circuit).measured(phi, press.astype(np.float64))
    return found, phi.forward(press.ravel())


@pytest.mark.usefixtures("small")
def test_a_divider_that_is_undone_errs_by_the_steps_of_its_converter_alone() -> None:
    found, exact = measured(divider="undone")
    error = np.abs(found - exact).max()
    # A step of v is (everything + load)^2 / load of force at most, in each of two readings.
    step = (9.0 + wiring.LOAD_N) ** 2 / wiring.LOAD_N / (2**wiring.ADC_BITS - 1)
    assert 0 < error <= 1.5 * 3 * step / 4
    linear, _ = measured(divider="ignored")
    # The reading of all columns of a row of 9 N is 40 / 49 of it.
    assert linear.min() >= -exact.max()
    assert linear.max() == pytest.approx(exact.max() * 40 / 49, rel=1e-3)


@pytest.mark.usefixtures("small")
def test_exact_sums_are_those_of_the_matrix_and_crosstalk_adds_to_that_of_all_columns() -> None:
    found, exact = measured()
    np.testing.assert_allclose(found, exact, atol=1e-5)
    assert measured(crosstalk=0.1)[0].max() == pytest.approx(1.2 * exact.max(), rel=1e-5)


@pytest.mark.usefixtures("small")
def test_wires_grow_with_the_neighbourhood_and_crosstalk_costs_accuracy() -> None:
    wires = wiring.wiring({"seed": 0})["methods"]
    lengths = [wires[kind]["length"] for kind in ("local:4", "local:8", "sbhe")]
    assert lengths == sorted(lengths)
    (point, *_) = wiring.experiment([PressFrames("gaussian", (16, 16), 22)], range(1)).points()
    circuits = wiring.readout({"frames": point["frames"], "seed": 0})["methods"]
    assert list(circuits)[:2] == ["exact sums", "divider, undone"]
    assert circuits["crosstalk 10 %"]["mean_db"] < circuits["crosstalk 1 %"]["mean_db"] - 1


@pytest.mark.usefixtures("small")
def test_the_study_writes_its_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(wiring, "QUICK_FRAMES", 3)
    monkeypatch.setattr(wiring, "BODIES", ("gaussian",))
    words = ["--quick", "--executor", "serial", "--out", str(tmp_path)]
    assert main(["study", "wiring", *words]) == 0
    page = (tmp_path / "wiring.md").read_text()
    assert "| local:4 |" in page
    assert "nan" not in page
    assert (tmp_path / "wiring.csv").stat().st_size > 50
