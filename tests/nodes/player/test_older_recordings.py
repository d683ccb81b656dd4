"""Recordings and descriptions of version 0.1, which state no rule of rows: it is rule 1."""

from pathlib import Path

import numpy as np
import pytest

from sparseskin.messages import Measurements, PhiState, Reconstruction, SkinState, Taxels, decode
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.phi.base import RANDOM
from sparseskin.nodes.player.node import Player
from sparseskin.nodes.player.settings import PlayerSettings
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings, phis_to_invert
from sparseskin.nodes.recorder.bag.reader import BagReader

#: 12 frames of 96 taxels of 9 x 11 cells, recorded by version 0.1: taxels and measurements.
RECORDINGS = Path(__file__).parents[2] / "recordings"
ROWS = ["fixed", "rotating"]


@pytest.mark.parametrize("rows", ROWS)
def test_its_matrices_are_made_again(rows):
    with BagReader(RECORDINGS / f"rule_1_{rows}.mcap") as bag:
        found = [decode(message.topic.encode(), message.payload) for message in bag.messages()]
    (skin,) = (one for one in found if isinstance(one, SkinState))
    (state,) = (one for one in found if isinstance(one, PhiState))
    assert (state.rule, state.rows, state.block) == (RANDOM, rows, 32)
    phis = {phi.fingerprint: phi for phi in phis_to_invert(ReconstructorSettings(), skin, state)}
    taxels = [one.forces[0][skin.skin.exists] for one in found if isinstance(one, Taxels)]
    measured = [one for one in found if isinstance(one, Measurements)]
    assert len(measured) == len(taxels) == 12
    for x, one in zip(taxels, measured, strict=True):
        np.testing.assert_array_equal(phis[one.phi].forward(x), one.y[0])


@pytest.mark.parametrize("rows", ROWS)
def test_it_is_reconstructed(rows):
    player = PlayerSettings(file=str(RECORDINGS / f"rule_1_{rows}.mcap"), rate=0.0)
    bus = Bus({
        "player": (Player, player),
        "reconstructor": (Reconstructor, ReconstructorSettings()),
    })  # fmt: skip
    made = [message for messages in bus.frames() for message in messages]
    assert sum(isinstance(message, Reconstruction) for message in made) == 12
    assert bus.hosts["reconstructor"].counts.refused == {}
