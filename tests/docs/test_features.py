"""Tables of features and documents in JSON, against what nodes do and commands print."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from bags import skin_state

from sparseskin.messages import Contacts, Reconstruction, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.solvers.base import SOLVERS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "reference" / "launch_files.md"
SHAPE = (12, 10)
PHIS = (*KINDS, "local:4")
FEATURES = (
    *("rotating rows", "masked", "points", "several patches", "bits"),
    *("contacts", "uncertainty"),
)


def works(phi, solver, feature=""):
    """True if frames pass through a compressor and a reconstructor with this feature."""
    names = ("left", "right") if feature == "several patches" else ()
    of_skin = {"patch": "skin", "stamp_ns": 1}
    mask = points = None
    if feature == "masked":
        mask = np.ones(SHAPE, np.bool_)
        mask[:3, :4] = False
    if feature == "points":
        place = np.mgrid[: SHAPE[0], : SHAPE[1]].reshape(2, -1) * 0.004
        points = np.zeros((place.shape[1], 6), np.float32)
        points[:, :2] = place.T
        points[:, 5] = 1
    grid = {"n_rows": SHAPE[0], "n_cols": SHAPE[1], "mask": mask, "points": points}
    skin = skin_state(**grid, sigma_mid=0.02, has_truth=False)
    context = Context("", ManualClock(1), live=False)
    edge_settings = {"phi": phi, "patches": names, "ratio": 3.0}
    edge_settings |= {"rows": "rotating"} if feature == "rotating rows" else {}
    edge_settings |= {"bits": 8} if feature == "bits" else {}
    host_settings = {"solver": solver, "patches": names, "fast": "off"}
    if feature in ("contacts", "uncertainty"):
        host_settings[feature] = True
    found = []
    try:
        edge = Compressor(Compressor.Settings(**edge_settings), context)
        host = Reconstructor(Reconstructor.Settings(**host_settings), context)
        made = [skin, *edge.step(skin)]
        rng = np.random.default_rng(0)
        for k in range(2):
            forces = (
                rng.random((max(1, len(names)), *SHAPE), dtype=np.float32)
                * skin.skin.exists
            )
            made += edge.step(
                Taxels(**{**of_skin, "stamp_ns": k + 2}, names=names, forces=forces)
            )
        for message in made:
            found += host.step(message)
    except SparseskinError:
        return False
    wanted = Contacts if feature == "contacts" else Reconstruction
    assert sum(isinstance(one, wanted) for one in found) == 2
    reconstructed = next(one for one in found if isinstance(one, Reconstruction))
    assert feature != "uncertainty" or reconstructed.sd is not None
    return True


@pytest.mark.slow
def test_the_table_of_features_is_what_the_nodes_do():
    rows = []
    for phi in PHIS:
        marks = {
            solver: tuple(
                "yes" if works(phi, solver, one) else "no" for one in FEATURES
            )
            for solver in SOLVERS
            if works(phi, solver)
        }
        for cells, group in itertools.groupby(marks, key=marks.__getitem__):
            rows.append(
                " | ".join((f"| `{phi}`", ", ".join(f"`{s}`" for s in group), *cells))
            )
    head = " | ".join(("| phi | solver", *FEATURES)) + " |"
    table = [
        head,
        "| --- " * head.count(" | ") + "| --- |",
        *(f"{row} |" for row in rows),
    ]
    assert "\n".join(table) in PAGE.read_text(encoding="utf-8")
