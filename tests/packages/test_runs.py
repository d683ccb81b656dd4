"""A measurement matrix and a solver of another package, installed as pip installs it."""

import shutil
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from bags import launched, only

import sparseskin
from sparseskin.messages import PhiState, Reconstruction, Taxels
from sparseskin.nodes import extensions
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings

PACKAGE = Path(__file__).parents[2] / "packages" / "sparseskin_runs"


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """The package in a folder of `sys.path`, with the metadata of its pyproject.toml."""
    project = tomllib.loads((PACKAGE / "pyproject.toml").read_text())["project"]
    shutil.copy2(PACKAGE / "sparseskin_runs.py", tmp_path)
    info = tmp_path / f"sparseskin_runs-{project['version']}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Name: {project['name']}\nVersion: {project['version']}\n")
    lines = []
    for group, points in project["entry-points"].items():
        lines += [f"[{group}]", *(f"{name} = {target}" for name, target in points.items())]
    (info / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(tmp_path)
    extensions.forget()
    yield
    extensions.forget()
    sys.modules.pop("sparseskin_runs", None)


def known(settings, key):
    """The values that are proposed for a setting, as by the page and the completion."""
    return next(entry["known"] for entry in settings.described() if entry["key"] == key)


@pytest.mark.usefixtures("installed")
def test_both_have_names_beside_those_of_the_core_and_pass_the_checks():
    assert "runs" in known(CompressorSettings, "phi")
    assert "spread" in known(ReconstructorSettings, "solver")
    phi = sparseskin.make_phi("runs", n=100, m=30, seed=0)
    sparseskin.check_phi(phi)
    solver = sparseskin.make_solver("spread", phi, sparseskin.make_basis("haar", 10, 10))
    sparseskin.check_solver(solver)


@pytest.mark.usefixtures("installed")
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
