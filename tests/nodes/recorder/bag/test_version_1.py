"""Recordings of version 1 of the messages are read as those of today."""

from pathlib import Path

import msgpack
import numpy as np
import pytest

from sparseskin.messages import (
    MalformedError,
    Measurements,
    PhiState,
    Reconstruction,
    SkinState,
    Taxels,
    decode,
)
from sparseskin.messages.quantised import Quantised
from sparseskin.messages.version_1 import payload_today, topic_today
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.phi.base import RANDOM
from sparseskin.nodes.player.node import Player
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings, phis_to_invert
from sparseskin.nodes.recorder.bag.patches import split_bag
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.convert.to_bag import recover_bag

RECORDINGS = Path(__file__).parents[3] / "recordings"
BODY = RECORDINGS / "form_1_body.mcap"
"""20 frames of 3 patches of 6 x 8 taxels, two of which are idle at the end."""
BITS = RECORDINGS / "form_1_bits.mcap"
"""6 frames of one patch, measurements of 8 bits, standard deviations, resultants."""
RULE_1 = [RECORDINGS / f"rule_1_{rows}.mcap" for rows in ("fixed", "rotating")]
"""12 frames of 96 taxels of 9 x 11 cells by version 0.1, which states no rule of rows: rule 1."""


def messages(path):
    with BagReader(path) as bag:
        return [decode(one.topic.encode(), one.payload) for one in bag.messages()]


@pytest.mark.parametrize(("path", "n"), [(BODY, 20), (BITS, 6), *((path, 12) for path in RULE_1)])
def test_measurements_are_those_of_the_taxels(path, n):
    found = messages(path)
    (skin,) = (one for one in found if isinstance(one, SkinState))
    (state,) = (one for one in found if isinstance(one, PhiState))
    phis = {phi.fingerprint: phi for phi in phis_to_invert(ReconstructorSettings(), skin, state)}
    taxels = {one.stamp_ns: one for one in found if isinstance(one, Taxels)}
    measured = [one for one in found if isinstance(one, Measurements)]
    assert len(measured) == len(taxels) == n
    assert (state.rule, state.rows) == (RANDOM, path.stem[7:]) or path not in RULE_1
    for one in measured:
        of = taxels[one.stamp_ns]
        assert of.patches == one.patches == (("p0", "p1", "p2") if path == BODY else ("skin",))
        y = phis[one.phi].forward(of.forces[:, skin.skin.exists])
        within = one.y.step / 2 * 1.001 if isinstance(one.y, Quantised) else 0.0
        np.testing.assert_allclose(one.y, y, atol=within, rtol=0)


@pytest.mark.parametrize("path", RULE_1)
def test_measurements_of_version_0_1_are_reconstructed(path):
    player = Player.Settings(file=str(path), rate=0.0)
    host = (Reconstructor, ReconstructorSettings())
    bus = Bus({"player": (Player, player), "reconstructor": host})
    made = [message for messages in bus.frames() for message in messages]
    assert sum(isinstance(message, Reconstruction) for message in made) == 12
    assert bus.hosts["reconstructor"].counts.refused == {}


def test_patches_that_are_unchanged_have_the_forces_of_the_frame_before():
    found = [one for one in messages(BODY) if isinstance(one, Reconstruction)]
    assert {one.unchanged for one in found} == {(False,) * 3, (False, True, True)}
    assert all(type(n) is int for one in found for n in one.iterations + one.solve_ns)
    with BagReader(BODY) as whole:
        recorded = split_bag(whole).messages(["/p1/reconstruction"])
        of_patch = [decode(one.topic.encode(), one.payload) for one in recorded]
    last = None
    for one in of_patch:
        assert (one.unchanged == (True,)) == (one.forces.tobytes() == last)
        last = one.forces.tobytes()
    assert len(of_patch) == 20


@pytest.mark.parametrize("path", [BODY, BITS])
def test_a_copy_is_a_recording_of_today(path, tmp_path):
    with BagReader(path) as bag:
        recover_bag(bag, tmp_path / "copy.mcap")
        topics = bag.topics
    with BagReader(tmp_path / "copy.mcap") as copy:
        assert copy.topics == topics
        assert copy.topics["/body/taxels" if path == BODY else "/skin/taxels"].version == 2
    assert messages(tmp_path / "copy.mcap") == messages(path)


def test_topics_of_several_patches_have_the_names_of_today():
    assert topic_today("/body/taxels_batch") == "/body/taxels"
    assert topic_today("/body/skin") == "/body/skin"
    end = msgpack.packb({"schema": "end", "version": 1, "of": "truth_batch"})
    assert msgpack.unpackb(payload_today(end))["of"] == "truth"


@pytest.mark.parametrize(
    "changes",
    [
        {"forces": 3},
        {"schema": "reconstruction_batch", "iterations": {"dtype": "|O", "data": b""}},
        {"schema": "end", "of": "other"},
    ],
)
def test_what_is_no_message_of_that_version_is_refused(changes):
    body = {"schema": "taxels", "version": 1, "forces": {"shape": [2, 2]}} | changes
    with pytest.raises(MalformedError):
        payload_today(msgpack.packb(body))
