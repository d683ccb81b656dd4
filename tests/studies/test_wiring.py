"""Study `wiring`: circuits of row sums against exact ones, its points and its page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sparseskin.nodes.compressor.phi.row_local import RowLocalPhi
from sparseskin.studies.wiring import readout, study
from sparseskin.studies.wiring.readout import ReadRows
from sparseskin.studies.wiring.study import KINDS, LOCAL, PRESET_ROWS, SCENES, method, wiring


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "SHAPE", (16, 16))


def measured(**circuit: Any) -> tuple[Any, Any]:
    """Measurements of a press by a circuit, and by the matrix."""
    made = method("row_local", "skin", 0)
    press = np.zeros((16, 16), np.float32)
    press[4:8, 3:9] = 1.5
    phi: Any = made.phi
    assert isinstance(phi, RowLocalPhi)
    found = ReadRows(made, **circuit)._measured(phi, press.astype(np.float64))
    return found, phi.forward(press.ravel())


@pytest.mark.usefixtures("small")
def test_exact_sums_are_the_measurements_of_the_matrix() -> None:
    found, exact = measured()
    np.testing.assert_allclose(found, exact, atol=1e-5)


@pytest.mark.usefixtures("small")
def test_a_divider_that_is_undone_errs_by_the_steps_of_its_converter_alone() -> None:
    found, exact = measured(divider="undone")
    error = np.abs(found - exact).max()
    # A step of v is (everything + load)^2 / load of force at most, in each of two readings.
    step = (9.0 + readout.LOAD_N) ** 2 / readout.LOAD_N / (2**readout.ADC_BITS - 1)
    assert 0 < error <= 1.5 * 3 * step / 4
    linear, _ = measured(divider="ignored")
    # The reading of all columns of a row of 9 N is 40 / 49 of it.
    assert linear.min() >= -exact.max()
    assert linear.max() == pytest.approx(exact.max() * 40 / 49, rel=1e-3)


@pytest.mark.usefixtures("small")
def test_crosstalk_adds_to_the_sum_of_all_columns() -> None:
    found, exact = measured(crosstalk=0.1)
    assert found.max() == pytest.approx(1.2 * exact.max(), rel=1e-5)


@pytest.mark.usefixtures("small")
def test_points_have_figures_of_all_matrices() -> None:
    point = {"scene": "gaussian", "seed": 0, "n_frames": 3}
    found = study.accuracy(point)["methods"]
    assert set(found) == {f"{preset} {kind}" for preset in PRESET_ROWS for kind in KINDS}
    assert all(one["min_db"] <= one["mean_db"] for one in found.values())
    wires = wiring({"seed": 0})["methods"]
    assert [wires[k]["length"] for k in ("local:4", "local:8", "sbhe")] == sorted(
        wires[k]["length"] for k in ("local:4", "local:8", "sbhe")
    )
    circuits = study.readout(point | {"n_frames": 12})["methods"]
    assert list(circuits)[:2] == ["exact sums", "divider, undone"]
    assert circuits["crosstalk 10 %"]["mean_db"] < circuits["crosstalk 1 %"]["mean_db"] - 1


def test_the_page_states_losses_and_wires(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def found(function: Any, points: list[Any], *_: Any) -> list[Any]:
        def figures(value: float) -> dict[str, float]:
            return {"mean_db": value, "min_db": value - 9}

        if function is study.wiring:
            wires = {"crossings": 7, "wires_a_taxel": 1.0, "conversions": 1366}
            kinds = {kind: {"length": 1000.0 * k, **wires} for k, kind in enumerate(KINDS, 1)}
            return [{"methods": kinds} for _ in points]
        if function is study.readout:
            return [{"methods": {"exact sums": figures(48), "crosstalk 1 %": figures(47)}}] * len(
                points
            )
        made = {
            f"{preset} {kind}": figures((50 if preset == "skin" else 40) - 2 * (kind in LOCAL))
            for preset in PRESET_ROWS
            for kind in KINDS
        }
        return [{"methods": made} for _ in points]

    monkeypatch.setattr(study, "compute", found)
    study.run(out=tmp_path, quick=False, seed=0, executor="process:1")
    page = (tmp_path / "wiring.md").read_text()
    (row,) = (line for line in page.splitlines() if line.startswith("| local:8 |"))
    cells = [cell.strip() for cell in row.split("|")[2:-1]]
    assert cells == [
        *("3,000", "7", "1.000", "1366"),
        *("48.0", "2.0", "2.0 .. 2.0", "38.0", "2.0", "2.0 .. 2.0"),
    ]
    assert f"| exact sums |{' 48.0 |' * len(SCENES)}" in page
    assert (tmp_path / "wiring.png").stat().st_size > 10_000
