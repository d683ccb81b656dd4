"""The base of nodes: what they are by default, and the schedule of a source."""

import pytest

from sparseskin.nodes.clock import SAME_CLOCK, ManualClock
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.node import KEPT_RATE, RATE_S, Context, Node, SourceNode, Tick
from sparseskin.nodes.settings import Settings

START_NS = 5_000
S = 1_000_000_000


class Paced(SourceNode[Settings]):
    """A source of 100 frames per second, whose frames hold nothing."""

    rate_hz = 100.0

    def tick(self, tick):
        self._watch_rate(tick.stamp_ns)
        return ()


class Bench:
    """A source, its clock and the lines of its log."""

    def __init__(self, rate_hz=100.0):
        self.lines = []
        self.clock = ManualClock(START_NS)
        self.source = Paced(
            Settings(), Context("sensor", self.clock, self.lines.append)
        )
        self.source.rate_hz = rate_hz
        self.source.begin(START_NS)

    def run(self, n_ticks, rate_hz):
        """Acquire frames at a rate, from now on."""
        for k in range(1, n_ticks + 1):
            self.clock.advance(round(k * S / rate_hz) - round((k - 1) * S / rate_hz))
            list(self.source.acquire(Tick(self.clock.now_ns(), k)))


def test_a_context_of_a_name_and_a_clock_is_that_of_a_node_alone():
    context = Context("n", ManualClock())
    assert context.ask is None
    assert context.late is False
    assert context.live is True
    assert context.clock_of("/skin/taxels") == SAME_CLOCK
    assert context.page_token == ""
    assert context.page_file == ""


def test_a_seed_gives_the_same_numbers_wherever_the_node_runs():
    here = Context("a", ManualClock()).rng(7).normal(size=5)
    there = Context("b", ManualClock(9)).rng(7).normal(size=5)
    assert here.tolist() == there.tolist()


def test_a_node_that_states_nothing_reads_and_writes_nothing_and_the_graph_needs_it():
    assert Node.inputs(Settings()) == ()
    assert Node.outputs(Settings()) == ()
    assert Node.optional_inputs(Settings()) == ()
    assert Node.required is True
    assert Node.observes is False
    assert Node.watches is False
    assert Node.patience_s == 0.0
    assert Node(Settings(), Context("n", ManualClock())).depth == 0


def test_the_kth_tick_is_due_after_k_periods():
    bench = Bench()
    for k in range(1, 50):
        assert bench.source.next_tick_ns() == START_NS + round(k * S / 100)
        list(bench.source.acquire(Tick(START_NS, k)))


def test_a_source_without_a_rate_is_always_due_and_follows_its_readers():
    bench = Bench(rate_hz=0.0)
    assert bench.source.next_tick_ns() == 0
    assert bench.source.follows_readers
    assert not Bench().source.follows_readers


def test_a_source_is_not_exhausted_and_its_ticks_find_frames_until_it_says_otherwise():
    source = Bench().source
    assert source.exhausted is False
    assert source.acquired is True
    assert source.min_readers == 0
    assert source.window == 32


def test_a_pause_holds_the_source_until_it_is_resumed():
    bench = Bench()
    bench.run(3, 100.0)
    assert bench.source.command("pause", True) == "paused"
    assert bench.source.next_tick_ns() is None
    assert bench.source.state() == {"paused": True}
    bench.clock.advance(S)
    assert bench.source.command("pause", True) == "paused"
    assert bench.source.command("pause", False) == "runs"
    # One period from now, not all that were missed.
    assert bench.source.next_tick_ns() == bench.clock.now_ns() + S // 100
    assert bench.source.state() == {"paused": False}


def test_a_source_that_runs_is_not_started_anew_by_a_command_to_run():
    bench = Bench()
    bench.run(3, 100.0)
    bench.clock.advance(1_000)
    assert bench.source.command("pause", False) == "runs"
    assert bench.source.next_tick_ns() == START_NS + 4 * S // 100


def test_a_pause_without_a_value_toggles():
    source = Bench().source
    assert [source.command("pause", None) for _ in range(3)] == [
        "paused",
        "runs",
        "paused",
    ]


@pytest.mark.parametrize(
    ("name", "value", "line"),
    [
        ("pause", 1, "pause: 1 is not allowed (allowed: true, false)"),
        ("pauze", True, "sensor: knows no command 'pauze' (did you mean 'pause'?)"),
    ],
)
def test_other_commands_are_refused(name, value, line):
    source = Bench().source
    with pytest.raises(RefusedError) as refused:
        source.command(name, value)
    assert str(refused.value) == line
    assert not source.paused


@pytest.mark.parametrize(
    ("part", "n_lines"), [(1.0, 0), (KEPT_RATE + 0.01, 0), (0.6, 1)]
)
def test_a_rate_that_is_not_reached_is_logged_once(part, n_lines):
    bench = Bench()
    bench.run(300, part * 100)
    assert bench.lines == n_lines * ["100 Hz asked, 60.0 Hz reached"]


def test_a_slow_start_is_not_logged():
    bench = Bench()
    bench.run(int(RATE_S * 50) - 1, 50.0)
    assert bench.lines == []
    bench.run(1, 50.0)
    assert bench.lines == ["100 Hz asked, 50.0 Hz reached"]


def test_each_new_rate_that_is_not_reached_is_logged():
    bench = Bench()
    bench.run(300, 60.0)
    bench.source.rate_hz = 80.0
    bench.source.begin(bench.clock.now_ns())
    bench.run(300, 40.0)
    assert bench.lines == [
        "100 Hz asked, 60.0 Hz reached",
        "80 Hz asked, 40.0 Hz reached",
    ]


def test_a_source_that_has_not_begun_has_no_rate_to_compare():
    bench = Bench()
    bench.source = Paced(Settings(), bench.source.context)
    bench.run(300, 60.0)
    assert bench.lines == []


@pytest.mark.parametrize("rate_hz", [1.0, 2.0])
def test_a_low_rate_that_is_not_reached_is_logged_too(rate_hz):
    bench = Bench(rate_hz)
    bench.run(20, rate_hz / 2)
    assert bench.lines == [f"{rate_hz:g} Hz asked, {rate_hz / 2:.1f} Hz reached"]
