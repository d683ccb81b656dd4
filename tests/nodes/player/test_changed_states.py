"""Recordings in which a setting was changed while they were made: states come when they came."""

import numpy as np
import pytest
from bags import MASK, PERIOD_NS, make_bag, skin_state

from sparseskin.messages import Measurements, PhiState, Reconstruction
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.player.node import Player, PlayerSettings
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings

N = int(MASK.sum())
N_FRAMES, CHANGED_AT = 20, 10
PHIS = [make_phi("sbhe", N, m, 0) for m in (N // 3, N // 2)]


@pytest.fixture
def recording(tmp_path):
    """Twenty frames; before the eleventh M was changed."""
    messages = [skin_state()]
    for k in range(N_FRAMES):
        phi = PHIS[k >= CHANGED_AT]
        stamp_ns = (k + 1) * PERIOD_NS
        if k in (0, CHANGED_AT):
            told = {**phi.describe(), "fingerprint": phi.fingerprint}
            state = PhiState(stamp_ns=stamp_ns - 5, patch="skin", **told)
            messages.append(state.published("0" * 16, int(k > 0)))
        y = phi.forward(np.full(N, 0.1 * k, np.float32))
        messages.append(
            Measurements(stamp_ns=stamp_ns, patch="skin", y=y, phi=phi.fingerprint).published(
                "0" * 16, k
            )
        )
    path = tmp_path / "changed.mcap"
    make_bag(path, messages)
    return str(path)


def graph(recording, **settings):
    player = PlayerSettings(file=recording, rate=0.0, **settings)
    return Bus({
        "player": (Player, player),
        "reconstructor": (Reconstructor, ReconstructorSettings(iterations=20)),
    })  # fmt: skip


def restored(bus, n_ticks=None):
    made = [message for messages in bus.frames(n_ticks) for message in messages]
    return [message for message in made if isinstance(message, Reconstruction)]


def test_every_frame_is_inverted_by_the_phi_that_made_it(recording):
    bus = graph(recording, keep_stamps=True)
    found = restored(bus)
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert [m.phi for m in found] == [PHIS[k >= CHANGED_AT].fingerprint for k in range(N_FRAMES)]


def test_a_part_begins_with_the_states_that_held_there(recording):
    found = restored(graph(recording, start_s=0.15))
    assert {m.phi for m in found} == {PHIS[1].fingerprint}
    assert len(found) == 5


def test_each_round_of_a_loop_begins_with_the_first_states(recording):
    bus = graph(recording, loop=True)
    found = restored(bus, n_ticks=3 * (N_FRAMES + 2))
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert [m.phi == PHIS[1].fingerprint for m in found[:45]] == (
        ([False] * CHANGED_AT + [True] * (N_FRAMES - CHANGED_AT)) * 3
    )[:45]


@pytest.mark.parametrize("keep_stamps", [False, True])
def test_a_seek_reports_the_states_that_hold_there(recording, keep_stamps):
    bus = graph(recording, keep_stamps=keep_stamps)
    ticks = bus.frames()
    for _ in range(15):
        next(ticks)
    player = bus.hosts["player"].node
    player.command("seek", 0.0)
    rest = [m for messages in ticks for m in messages if isinstance(m, Reconstruction)]
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert len(rest) == N_FRAMES
    assert rest[0].phi == PHIS[0].fingerprint
