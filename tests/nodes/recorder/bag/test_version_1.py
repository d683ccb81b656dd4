"""Recordings of version 1 of the messages, and of several patches in a message."""

from pathlib import Path

import msgpack
import numpy as np
import pytest
from bags import N_COLS, N_ROWS, PHI, record, skin_state

from sparseskin import read_recording
from sparseskin.launch.commands.cli import main
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
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.player.node import Player
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings, phis_to_invert
from sparseskin.nodes.recorder.bag.patches import split_bag
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter
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


NAMES = ("palm", "back", "sole")
N_FRAMES = 6
FORCES = np.random.default_rng(0).random((N_FRAMES, 3, N_ROWS, N_COLS), dtype=np.float32)
"""Of each frame and patch."""


def unchanged(k):
    """Of patch 1 every second frame is unchanged."""
    return (False, k % 2 == 1, False)


def reconstructed(k):
    solved = {"iterations": (k,) * 3, "residual": (0.5,) * 3, "solve_ns": (7,) * 3}
    solved |= {"error": (0.25, None, None), "trusted": (True, True, False)}
    return Reconstruction(
        **{"stamp_ns": k, "patch": "body", "names": NAMES, "seq": k, "done_ns": k + 5, "phi": PHI},
        **{"forces": FORCES[k][~np.array(unchanged(k))], "unchanged": unchanged(k), **solved},
    )


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "body.mcap"
    with BagWriter(path, {}) as writer:
        record(writer, skin_state("body"))
        for k in range(N_FRAMES):
            record(writer, Taxels(stamp_ns=k, patch="body", names=NAMES, forces=FORCES[k]))
            record(writer, reconstructed(k))
        writer.close({})
    return path


def test_messages_are_those_of_the_patches_with_what_is_unchanged(bag):
    with BagReader(bag) as whole:
        split = split_bag(whole)
        assert list(split.topics) == [
            f"/{name}/{schema}"
            for name in sorted(NAMES)
            for schema in ("reconstruction", "skin", "taxels")
        ]
        for p, name in enumerate(NAMES):
            topic = f"/{name}/reconstruction"
            assert split.topics[topic].n_messages == N_FRAMES
            found = [decode(m.topic.encode(), m.payload) for m in split.messages([topic])]
            for k, message in enumerate(found):
                same = unchanged(k)[p]
                np.testing.assert_array_equal(message.forces[0], FORCES[k - same, p])
                assert (message.stamp_ns, message.error) == (k, (None if p else 0.25,))
                assert (message.trusted, message.unchanged) == ((p != 2,), (same,))
        # A part of the time begins with the forces of the message before it.
        first = next(split.messages(["/back/reconstruction"], start_ns=3))
        message = decode(first.topic.encode(), first.payload)
        np.testing.assert_array_equal(message.forces[0], FORCES[2, 1])
        (state,) = split.messages(["/sole/skin"])
        assert decode(state.topic.encode(), state.payload).patch == "sole"


def test_exports_are_of_each_patch(bag, tmp_path, capsys):
    assert main(["recording", "export", str(bag), "--to", "npz"]) == 0
    assert main(["recording", "export", str(bag), "--to", "csv"]) == 0
    for p, name in enumerate(NAMES):
        with np.load(tmp_path / f"body_{name}.npz") as held:
            np.testing.assert_array_equal(held["forces"], FORCES[:, p])
            assert held["f_max"] == 2.5
        assert (tmp_path / "body_csv" / f"{name}_taxels.csv").is_file()
        np.testing.assert_array_equal(read_recording(bag, name)["forces"], FORCES[:, p])
    with pytest.raises(SparseskinError, match="has patches back, palm, sole: state one of them"):
        read_recording(bag)
