"""Rotating rows through the stations: live, with losses, replayed and reprocessed."""

import numpy as np
import pytest

from sparseskin.launch.launchfile.load import load
from sparseskin.messages import Measurements, Reconstruction
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.limits import OTHER_ROWS
from sparseskin.nodes.reconstructor.node import Reconstructor

FIXED, ROTATING = "compressor.rows=fixed", "compressor.rows=rotating"


def graph(*overrides):
    nodes = load("path_40", list(overrides)).nodes.values()
    return Bus({node.name: (node.cls, node.settings) for node in nodes}, ManualClock(1))


def frames_of(bus, n_frames):
    return list(bus.frames(n_frames))


def states_of(bus):
    """The skin and Phi that the reconstructor received before the first frame."""
    node = bus.hosts["reconstructor"].node
    return [node._skin, node._announced]


def only(messages, kind):
    (found,) = [message for message in messages if isinstance(message, kind)]
    return found


def test_row_subsets_alternate_and_each_frame_is_inverted_by_its_own_matrix():
    bus = graph("compressor.ratio=4")  # rows rotate by default
    frames = frames_of(bus, 10)
    prints = [phi.fingerprint for phi in row_subsets(make_phi("sbhe", 1600, 400, 0), "rotating")]
    assert [state.rows for state in states_of(bus)[1:]] == ["rotating"]
    for k, messages in enumerate(frames):
        assert only(messages, Measurements).phi == prints[k % 4]
        assert only(messages, Reconstruction).phi == prints[k % 4]
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert bus.hosts["compressor"].node.status() == "sbhe 400 x 1600, rotating rows"
    assert bus.hosts["compressor"].node.state()["rows"] == "rotating"


def test_frames_that_are_lost_cost_themselves_alone():
    """Any frames may be missing: no other is refused, and none is inverted by a wrong matrix."""
    bus = graph(ROTATING)
    messages = [m for f in frames_of(bus, 60) for m in f]
    settings = load("path_40", []).nodes["reconstructor"].settings
    node = Reconstructor(settings, Context("reconstructor", ManualClock(1)))
    lost = np.random.default_rng(0).random(60) < 0.4
    for state in states_of(bus):
        list(node.step(state))
    for k, measured in enumerate(m for m in messages if isinstance(m, Measurements)):
        if not lost[k]:
            (restored,) = node.step(measured)
            assert restored.phi == measured.phi
            assert restored.residual[0] < 0.05


def test_it_can_be_switched_on_and_off_while_the_graph_runs():
    bus = graph(FIXED)
    frames = []
    said = []
    for k, messages in enumerate(bus.frames(24)):
        frames.append([*said, *messages])
        changes = {
            5: {"rows": "rotating"},
            11: {"ratio": 8.0},
            14: {"rows": "fixed", "ratio": 3.0},
            17: {"rows": None},  # the default
            20: {"m": 1600},  # no row is left to rotate to
        }
        said = bus._deliver(bus.hosts["compressor"].change(changes[k])) if k in changes else []
    assert bus.hosts["reconstructor"].counts.refused == {}
    prints = [only(messages, Measurements).phi for messages in frames]
    assert [len(set(part)) for part in (prints[:6], prints[6:12], prints[12:15])] == [1, 3, 3]
    assert (set(prints[15:18]), prints[18:21]) == ({prints[0]}, prints[6:9])
    assert len(set(prints[21:])) == 1
    assert all(only(m, Reconstruction).phi == p for m, p in zip(frames, prints, strict=True))


@pytest.mark.parametrize(
    ("settings", "warned"),
    [
        (["reconstructor.preset=paper"], True),
        (["reconstructor.preset=paper", "compressor.rows=paper"], False),
        (["reconstructor.preset=skin"], False),
    ],
)
def test_the_papers_method_with_other_rows_than_its_own_is_warned_of(settings, warned):
    bus = graph(*settings)
    frames_of(bus, 1)
    assert (f"[reconstructor] {OTHER_ROWS}" in bus.lines) == warned


@pytest.mark.parametrize(
    ("rows", "some_doubted"), [(FIXED, False), (ROTATING, False), ("compressor.ratio=8", True)]
)
def test_an_untouched_skin_at_the_start_logs_no_doubt(rows, some_doubted):
    bus = graph(rows, "reconstructor.iterations=8")
    doubted = [not only(messages, Reconstruction).trusted[0] for messages in frames_of(bus, 40)]
    assert any(doubted) == some_doubted
    assert not [line for line in bus.lines if "not to be trusted" in line]
