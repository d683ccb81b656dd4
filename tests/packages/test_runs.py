"""A measurement matrix and a solver of another package, installed as pip installs it."""

import numpy as np
import pytest
from bags import launched, only
from installed import installed

import sparseskin
from sparseskin.messages import PhiState, Reconstruction, Taxels
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings


@pytest.fixture
def runs(tmp_path, monkeypatch):
    with installed("sparseskin_runs", tmp_path, monkeypatch):
        yield


def known(settings, key):
    """The values that are proposed for a setting, as by the page and the completion."""
    return next(entry["known"] for entry in settings.described() if entry["key"] == key)


@pytest.mark.usefixtures("runs")
def test_both_have_names_beside_those_of_the_core_and_pass_the_checks():
    assert "runs" in known(CompressorSettings, "phi")
    assert "spread" in known(ReconstructorSettings, "solver")
    phi = sparseskin.make_phi("runs", n=100, m=30, seed=0)
    sparseskin.check_phi(phi)
    solver = sparseskin.make_solver(
        "spread", phi, sparseskin.make_basis("haar", 10, 10)
    )
    sparseskin.check_solver(solver)


@pytest.mark.usefixtures("runs")
def test_a_graph_measures_and_reconstructs_by_their_names():
    bus = launched("path_40", "compressor.phi=runs", "reconstructor.solver=spread")
    starts = sparseskin.make_phi("runs", n=1600, m=533, seed=0).starts
    for frame in bus.frames(3):
        readings = only(frame, Taxels).forces.reshape(-1)
        reconstruction = only(frame, Reconstruction)
        sizes = np.diff(starts, append=1600)
        means = np.add.reduceat(readings, starts) / sizes
        forces = reconstruction.forces.reshape(-1)
        np.testing.assert_allclose(forces, np.repeat(means, sizes), atol=1e-5)
    assert bus.hosts["reconstructor"].counts.refused == {}
    # The host made the matrix that the message names: a plug-in of its own environment.
    announced = bus.hosts["reconstructor"].node._announced
    assert isinstance(announced, PhiState)
    assert announced.kind == "runs"
    bus.close()


def test_without_the_package_there_is_no_such_name():
    assert "runs" not in KINDS
