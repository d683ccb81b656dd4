"""Kinds whose taxels or rows are chosen anew in each frame, in a graph: acts and adaptive."""

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile.load import LaunchError, load
from sparseskin.messages import Measurements, Reconstruction, Taxels
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock

ACTS = ("compressor.phi=acts", "reconstructor.solver=interpolation")
ADAPTIVE = ("compressor.phi=adaptive",)
KINDS = pytest.mark.parametrize("chosen", [ACTS, ADAPTIVE])


def graph(*overrides, name="path_40", record=None):
    nodes = load(name, [*overrides], record).nodes.values()
    return Bus({node.name: (node.cls, node.settings) for node in nodes}, ManualClock(1))


def reconstructions(bus, n_frames):
    found = [m for frame in bus.frames(n_frames) for m in frame if isinstance(m, Reconstruction)]
    bus.close()
    return found


@pytest.mark.parametrize("overrides", [ACTS, ADAPTIVE])
def test_m_changes_while_the_graph_runs(overrides):
    bus = graph(*overrides, "compressor.bits=12")
    messages = []
    for k, frame in enumerate(bus.frames(6), start=1):
        messages += frame
        if k == 3:
            bus._deliver(bus.hosts["compressor"].change({"ratio": 8.0}))
    made = [m for m in messages if isinstance(m, Measurements)]
    found = [m for m in messages if isinstance(m, Reconstruction)]
    assert [m.y.shape[1] for m in made] == [533] * 3 + [200] * 3
    assert [m.phi for m in found] == [m.phi for m in made]
    # An untouched skin, before and after.
    assert max(float(np.abs(m.forces).max()) for m in found) < 0.1
    assert bus.hosts["reconstructor"].counts.refused == {}
    if overrides == ADAPTIVE:
        assert all(m.nodes is not None and m.nodes.size < m.y.size / 4 for m in made)


def test_interpolation_leaves_readings_unchanged():
    for frame in graph(*ACTS, "compressor.bits=12").frames(3):
        (taxels,) = [m for m in frame if isinstance(m, Taxels)]
        (made,) = [m for m in frame if isinstance(m, Measurements)]
        (found,) = [m for m in frame if isinstance(m, Reconstruction)]
        assert made.places is not None
        read = np.flatnonzero(np.unpackbits(made.places))
        np.testing.assert_allclose(made.y[0], taxels.forces.reshape(-1)[read], atol=1e-3)
        np.testing.assert_array_equal(found.forces.reshape(-1)[read], np.maximum(made.y[0], 0))
        assert found.residual == (0,)


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (ACTS[:1], 'solver "skin": phi "acts" reads other taxels each frame'),
        (ACTS[1:], 'solver "interpolation": phi "sbhe" mixes taxels; allowed: acts, subsample'),
        ((*ACTS, "compressor.rows=rotating"), '"rotating" is not allowed for phi "acts"'),
        (
            (*ADAPTIVE, "reconstructor.preset=paper"),
            'solver "fista": phi "adaptive" reads other rows each frame; allowed: skin',
        ),
        ((*ADAPTIVE, "reconstructor.resultant=true"), "is not available with phi adaptive"),
        (
            ("reconstructor.uncertainty=true", "reconstructor.solver=tv"),
            "uncertainty=true: is not available with solver tv, whose error is not known",
        ),
    ],
)
def test_settings_that_do_not_go_together_are_refused_in_one_line(overrides, text):
    with pytest.raises(LaunchError) as refused:
        graph(*overrides)
    (line,) = refused.value.lines
    assert text in line


@KINDS
def test_a_recording_replays_and_is_reprocessed_to_the_same_bits(chosen, tmp_path):
    bag, out = tmp_path / "chosen.mcap", tmp_path / "again.mcap"
    streamed = reconstructions(graph(*chosen, record=str(bag)), 6)
    # From the taxels, the edge chooses as it chose before.
    changes = [argument for text in chosen for argument in ("--set", text)]
    assert main(["reprocess", str(bag), *changes, "--out", str(out)]) == 0
    assert len(streamed) == 6
    for file in (bag, out):
        bus = graph(f"player.file={file}", *chosen[1:], name="replay_measurements")
        for once, again in zip(streamed, reconstructions(bus, 6), strict=True):
            np.testing.assert_array_equal(once.forces, again.forces)
            assert once.phi == again.phi
