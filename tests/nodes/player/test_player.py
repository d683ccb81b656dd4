"""The player: what it publishes, in what order, under which names and stamps."""

import numpy as np
import pytest
from bags import MASK, PERIOD_NS, chain, frames, launched, make_bag, skin_state
from damaged import launch_faults

from sparseskin.messages import Measurements, PhiState, Reconstruction, decode, encode
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import RefusedError, SparseskinError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.player.node import Player, PlayerSettings
from sparseskin.nodes.player.schedule import Schedule
from sparseskin.nodes.reconstructor.node import Reconstructor, ReconstructorSettings
from sparseskin.nodes.reconstructor.solvers.fista import FistaSolver
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter

MS = 1_000_000
N_FRAMES = 20
BEGIN_NS = 10**15


def record(path):
    """A recording of 20 frames, 10 ms apart, and the messages it was made of."""
    clock = ManualClock(BEGIN_NS)
    settings = {"reconstructor": {"iterations": 3}, "recorder": {"out": str(path)}}
    bus = chain(clock, sensor={"source": "scene:path_40"}, **settings)
    seen = []
    for messages in bus.frames(N_FRAMES):
        seen += messages
        clock.advance(10 * MS)
    bus.close()
    return seen


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    return path, record(path)


def player(path, **settings):
    return Player(
        Player.Settings(file=str(path), **settings), Context("player", ManualClock())
    )


def play(node, n_ticks=1000):
    """All frames that the player gives, tick by tick."""
    frames = []
    for k in range(n_ticks):
        if node.exhausted:
            break
        frames.append(list(node.acquire(Tick(7 * MS * k, k))))
    return frames


def test_a_recording_that_is_cut_before_its_first_message_is_refused(
    recording, tmp_path
):
    cut = tmp_path / "holds_no_message.mcap"
    cut.write_bytes(recording[0].read_bytes()[:3000])  # within the first chunk
    with pytest.raises(
        SparseskinError, match="holds no message, so there is nothing to play"
    ):
        player(cut)


def test_kept_stamps_are_those_of_what_was_recorded_to_the_bit(recording):
    path, seen = recording
    node = player(path, keep_stamps=True)
    played = [encode(m) for frame in play(node) for m in frame]
    assert played == [encode(m) for m in seen]
    assert {m.topic for m in node.start()} == {
        "/skin/skin",
        "/skin/phi",
        "/skin/solver",
    }


@pytest.mark.parametrize(
    ("settings", "first", "count"),
    [({"start_s": 0.1, "duration_s": 0.03}, 10, 3), ({"start_s": 5.0}, 0, 0)],
)
def test_a_part_is_half_open(recording, settings, first, count):
    frames = play(player(recording[0], keep_stamps=True, **settings))
    stamps = [frame[0].stamp_ns for frame in frames]
    assert stamps == [BEGIN_NS + 10 * MS * (first + k) for k in range(count)]


def test_chosen_topics_alone_are_played(recording):
    topics = ("/skin/skin", "/skin/taxels")
    settings = Player.Settings(file=str(recording[0]), topics=topics)
    assert Player.outputs(settings) == topics
    node = Player(settings, Context("player", ManualClock()))
    assert [m.topic for m in node.start()] == ["/skin/skin"]
    assert {m.topic for frame in play(node) for m in frame} == {"/skin/taxels"}


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"file": "none.mcap"}, "none.mcap: no such file"),
        ({"schemas": ("taxel",)}, "did you mean 'taxels'"),
        ({"topics": ("/left/skin",)}, "/left/skin: not in the file .known: /skin/"),
        ({"keep_stamps": True, "loop": True}, "cannot be combined with loop"),
    ],
)
def test_a_wrong_setting_is_named(recording, settings, text):
    with pytest.raises(SparseskinError, match=text):
        Player.Settings(**({"file": str(recording[0])} | settings)).check()


class OfTaxels(FistaSolver):
    """A solver of measurements that are single taxels."""

    reads_taxels = True


@pytest.mark.parametrize(
    ("name", "override", "text"),
    [
        (
            "replay_taxels",
            "compressor.ratio=2000",
            "leaves no measurement of 1600 taxels",
        ),
        (
            "replay_measurements",
            f"reconstructor.solver={__name__}:OfTaxels",
            'phi "sbhe" mixes taxels',
        ),
    ],
)
def test_what_does_not_go_with_a_recording_is_refused(recording, name, override, text):
    (line,) = launch_faults(name, [f"player.file={recording[0]}", override])
    assert line.startswith(f"--set {override}: ")
    assert text in line


def test_a_faster_rate_is_shown_and_what_is_no_command_is_refused(recording):
    node = player(recording[0])
    node.begin(0)
    node.command("faster", None)
    assert "rate 1.1" in node.status()
    with pytest.raises(RefusedError, match="knows no command 'jump'"):
        node.command("jump", None)
    with pytest.raises(RefusedError, match="at rate 0"):
        player(recording[0], rate=0.0).command("faster", None)


@pytest.mark.parametrize("n_frames", [1, N_FRAMES])
def test_a_number_of_frames_is_played_with_all_their_messages(
    recording, tmp_path, n_frames
):
    # As in a running graph, measurements are recorded after the taxels of later frames.
    lags = {Measurements: 3, Reconstruction: 4}
    period_ns = 10 * MS
    with BagReader(recording[0]) as bag:
        recorded = [decode(one.topic.encode(), one.payload) for one in bag.messages()]
    late = sorted(recorded, key=lambda m: m.stamp_ns + lags.get(type(m), 0) * period_ns)
    path = tmp_path / "late.mcap"
    with BagWriter(path, {}) as writer:
        for k, message in enumerate(late):
            writer.record(message, BEGIN_NS + k)
    bus = launched("replay_measurements", f"player.file={path}")
    bus.run(n_frames)
    bus.check()
    frames = bus.reports()["monitor"]["patches"]["skin"]["frames"]
    counts = {"sensed": n_frames, "reconstructed": n_frames}
    assert frames == counts | {"skipped": 0, "quiet": 0, "lost": 0, "unpaired": 0}
    assert bus.reports()["player"]["played"]["frames"] == n_frames
    assert bus.hosts["player"].counts.published["/skin/measurements"] == n_frames


N = int(MASK.sum())
CHANGED_AT = N_FRAMES // 2
PHIS = [make_phi("sbhe", N, m, 0) for m in (N // 3, N // 2)]


@pytest.fixture
def changed(tmp_path):
    """Frames; before the eleventh M was changed."""
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
            Measurements(
                stamp_ns=stamp_ns, patch="skin", y=y, phi=phi.fingerprint
            ).published("0" * 16, k)
        )
    path = tmp_path / "changed.mcap"
    make_bag(path, messages)
    return str(path)


def graph(changed, **settings):
    player = PlayerSettings(file=changed, rate=0.0, **settings)
    return Bus({
        "player": (Player, player),
        "reconstructor": (Reconstructor, ReconstructorSettings(iterations=20)),
    })  # fmt: skip


def restored(bus, n_ticks=None):
    made = [message for messages in bus.frames(n_ticks) for message in messages]
    return [message for message in made if isinstance(message, Reconstruction)]


def test_every_frame_of_a_whole_or_a_part_is_inverted_by_the_phi_that_made_it(changed):
    bus = graph(changed, keep_stamps=True)
    found = restored(bus)
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert [m.phi for m in found] == [
        PHIS[k >= CHANGED_AT].fingerprint for k in range(N_FRAMES)
    ]
    found = restored(graph(changed, start_s=0.15))
    assert {m.phi for m in found} == {PHIS[1].fingerprint}
    assert len(found) == 5


def test_each_round_of_a_loop_begins_with_the_first_states(changed):
    bus = graph(changed, loop=True)
    found = restored(bus, n_ticks=3 * (N_FRAMES + 2))
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert [m.phi == PHIS[1].fingerprint for m in found[:45]] == (
        ([False] * CHANGED_AT + [True] * (N_FRAMES - CHANGED_AT)) * 3
    )[:45]


@pytest.mark.parametrize("keep_stamps", [False, True])
def test_a_seek_reports_the_states_that_hold_there(changed, keep_stamps):
    bus = graph(changed, keep_stamps=keep_stamps)
    ticks = bus.frames()
    for _ in range(15):
        next(ticks)
    bus.hosts["player"].node.command("seek", 0.0)
    rest = [m for messages in ticks for m in messages if isinstance(m, Reconstruction)]
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert len(rest) == N_FRAMES
    assert rest[0].phi == PHIS[0].fingerprint


def test_targets_are_absolute_and_a_change_of_rate_while_paused_keeps_the_position():
    rate = 0.1
    schedule = Schedule(first_ns=500, rate=rate)
    schedule.begin(1_000_000)
    for k in range(0, 100_000, 777):
        assert schedule.due_ns(500 + k * MS) == 1_000_000 + round(k * MS / rate)
    schedule = Schedule(first_ns=0, rate=1.0)
    schedule.begin(0)
    schedule.toggle_pause(now_ns=40 * MS)
    schedule.change_rate(4.0, now_ns=50 * MS)
    assert schedule.due_ns(40 * MS) is None
    schedule.toggle_pause(now_ns=100 * MS)
    assert schedule.due_ns(40 * MS) == 100 * MS
    assert schedule.due_ns(80 * MS) == 110 * MS


def test_frames_of_a_board_wait_when_they_are_played(tmp_path):
    path = tmp_path / "live.mcap"
    make_bag(path, [skin_state(live=True), *frames(2)[1:]])
    node = player(path)
    (skin,) = [state for state in node.start() if state.schema == "skin"]
    assert skin.live is False
