"""A player at the controls: seek, rate, step and pause."""

import pytest
from bags import PERIOD_NS, frames, make_bag
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import Taxels
from sparseskin.nodes.bus import LOCAL_RUN_ID
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.player.node import Player

N_FRAMES = 20
PER_FRAME = 4
RUN = "00000000000000aa"
TAXELS = [m.forces.tobytes() for m in frames(N_FRAMES) if isinstance(m, Taxels)]


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """20 frames, 10 ms apart, numbered as one run of their publishers has them."""
    path = tmp_path_factory.mktemp("bag") / "bag.mcap"
    skin, *messages = frames(N_FRAMES)
    numbered = [m.published(RUN, k // PER_FRAME) for k, m in enumerate(messages)]
    make_bag(path, [skin.published(RUN, 0), *numbered])
    return path


class Deck:
    """A player, its clock, and who presses its keys."""

    def __init__(self, bag, **values):
        self.clock = ManualClock(10**9)
        settings = Player.Settings(file=str(bag), **values)
        self.player = Player(settings, Context("player", self.clock))
        self.host = NodeHost(self.player, LOCAL_RUN_ID, lambda line: None)
        self.player.begin(self.clock.now_ns())
        self._n_ticks = self._stamp_ns = 0

    def press(self, name, value=None):
        return self.player.command(name, value)

    def play(self, n_frames):
        """The next frames, each when it is due."""
        return [self.play_one() for _ in range(n_frames)]

    def play_one(self):
        self.clock.advance(max(0, self.player.next_tick_ns() - self.clock.now_ns()))
        self._stamp_ns = max(self.clock.now_ns(), self._stamp_ns + 1)
        self._n_ticks += 1
        return list(self.host.tick(Tick(self._stamp_ns, self._n_ticks - 1)))

    def due_in_ns(self):
        due_ns = self.player.next_tick_ns()
        return None if due_ns is None else due_ns - self.clock.now_ns()


def recorded(messages):
    """Number of the recorded frame, by its forces, which no other frame has."""
    (taxels,) = [message for message in messages if isinstance(message, Taxels)]
    (number,) = [
        k for k, forces in enumerate(TAXELS) if forces == taxels.forces.tobytes()
    ]
    return number


@pytest.mark.parametrize(
    "values", [{"keep_stamps": True}, {"lockstep": True}, {"rate": 0.0}]
)
def test_a_seek_goes_forward_and_back(bag, values):
    deck = Deck(bag, **values)
    assert [recorded(f) for f in deck.play(3)] == [0, 1, 2]
    assert deck.press("seek", 0.15) == "at 0.15 s"
    assert [recorded(f) for f in deck.play(2)] == [15, 16]
    deck.press("seek", 0)
    assert [recorded(f) for f in deck.play(4)] == [0, 1, 2, 3]
    deck.press("seek", 0.045)  # between two frames: the next one
    assert [recorded(f) for f in deck.play(2)] == [5, 6]


@given(
    seeks=st.lists(
        st.tuples(st.integers(0, N_FRAMES - 2), st.integers(1, 3)), max_size=6
    )
)
def test_after_any_seeks_the_frame_that_was_asked_for_is_due_at_once(bag, seeks):
    deck = Deck(bag)
    played = []
    for k, n_frames in seeks:
        deck.press("seek", k * PERIOD_NS / 1e9)
        assert deck.due_in_ns() == 0
        n_frames = min(n_frames, N_FRAMES - 1 - k)
        played += deck.play(n_frames)
        found = [recorded(f) for f in played[len(played) - n_frames :]]
        assert found == list(range(k, k + n_frames))
        assert deck.due_in_ns() == PERIOD_NS
    # Stamps never go back, and numbers count on.
    stamps = [stamp for messages in played for stamp in {m.stamp_ns for m in messages}]
    assert len(stamps) == len(played)
    assert stamps == sorted(set(stamps))
    numbers = [m.seq for messages in played for m in messages if isinstance(m, Taxels)]
    assert numbers == list(range(len(played)))


def test_a_seek_counts_from_the_beginning_of_the_part_that_is_played(bag):
    deck = Deck(bag, start_s=0.05, duration_s=0.1)
    assert deck.player.state()["length_s"] == pytest.approx(0.1)
    deck.press("seek", 0.08)
    assert [recorded(f) for f in deck.play(2)] == [13, 14]
    assert deck.player.exhausted


def test_a_seek_keeps_stamps_where_they_are_kept_and_counts_on(bag):
    deck = Deck(bag, keep_stamps=True)
    played = deck.play(4)
    deck.press("seek", 0.02)
    played += deck.play(4)
    stamps = [k * PERIOD_NS for k in (0, 1, 2, 3, 2, 3, 4, 5)]
    assert [{m.stamp_ns for m in messages} for messages in played] == [
        {ns} for ns in stamps
    ]
    numbers = [m.seq for messages in played for m in messages if isinstance(m, Taxels)]
    assert numbers == list(range(8))


def test_in_a_loop_the_next_round_begins_at_the_beginning(bag):
    deck = Deck(bag, loop=True)
    deck.press("seek", 0.17)
    played = deck.play(5)
    assert [recorded(f) for f in played] == [17, 18, 19, 0, 1]
    stamps = [f[0].stamp_ns for f in played]
    assert stamps == sorted(set(stamps))
    deck.press("seek", 0.18)
    assert deck.player.state()["position_s"] == pytest.approx(0.18)
    assert [recorded(f) for f in deck.play(3)] == [18, 19, 0]


@pytest.mark.parametrize(
    ("name", "values", "allowed"),
    [
        ("seek", (-0.01, 0.5, None, "0.1", True, float("nan")), r"0\.\.0\.19"),
        ("rate", (0, 1001, None, "2", True, float("inf")), r"0\.001\.\.1000"),
    ],
)
def test_a_value_that_is_not_allowed_changes_nothing(bag, name, values, allowed):
    deck = Deck(bag)
    deck.play(3)
    state = deck.player.state()
    due_ns = deck.player.next_tick_ns()
    for value in values:
        with pytest.raises(
            RefusedError, match=rf"{name}: .* is not allowed \(allowed: {allowed}"
        ):
            deck.press(name, value)
    assert deck.player.state() == state
    assert deck.player.next_tick_ns() == due_ns
    assert [recorded(f) for f in deck.play(2)] == [3, 4]


def test_after_the_end_there_is_no_way_back(bag):
    deck = Deck(bag)
    deck.play(N_FRAMES)
    assert deck.player.exhausted
    with pytest.raises(
        RefusedError, match="seek: the recording has been played to its end"
    ):
        deck.press("seek", 0.1)


@pytest.mark.parametrize(("rate", "period_ns"), [(0.5, 20_000_000), (4.0, 2_500_000)])
def test_another_rate_counts_from_where_it_is(bag, rate, period_ns):
    deck = Deck(bag)
    deck.play(4)
    assert deck.press("rate", rate) == f"rate {rate:g}"
    assert deck.due_in_ns() == period_ns
    assert deck.player.state()["rate"] == rate
    deck.press("seek", 0.1)
    deck.play(1)
    assert deck.due_in_ns() == period_ns


def test_a_pause_takes_nothing_from_the_period(bag):
    deck = Deck(bag)
    deck.play(2)
    deck.clock.advance(PERIOD_NS // 4)
    deck.press("pause", True)
    deck.clock.advance(10**9)
    deck.press("pause", False)
    assert deck.due_in_ns() == PERIOD_NS * 3 // 4


def test_paused_it_seeks_without_playing_and_steps_from_there(bag):
    deck = Deck(bag, paused=True)
    deck.press("seek", 0.1)
    assert deck.player.next_tick_ns() is None
    assert deck.player.state()["position_s"] == pytest.approx(0.1)
    for k in (10, 11):
        assert deck.press("step") == "one frame"
        assert recorded(deck.play_one()) == k
        assert deck.player.next_tick_ns() is None
    deck.press("seek", 0.05)
    deck.press("pause", False)
    assert deck.due_in_ns() == 0
    assert [recorded(f) for f in deck.play(3)] == [5, 6, 7]
