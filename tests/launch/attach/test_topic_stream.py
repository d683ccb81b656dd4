"""An observer of a topic: it reads the messages, no node waits for it; rates that it shows."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from processes import announced
from publishing import RUN_ID, TOPIC, Publisher

from sparseskin.launch.attach.rates import MAX_KEPT, Samples, figures_of, text_of
from sparseskin.launch.attach.stream import Arrival, Losses, TopicStream
from sparseskin.launch.commands.cli import main
from sparseskin.messages import decode, size_bytes
from sparseskin.nodes.network.keys import KeyFileError, make_key_files
from sparseskin.nodes.network.sockets import QUEUE_FRAMES


def take(stream, n):
    """The next n messages."""
    found = []
    for arrivals in stream.batches(60):
        found += arrivals
        if len(found) >= n:
            break
    return found


def test_it_sees_the_messages_as_they_are_sent_and_when(publisher):
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        assert publisher.writer.present == set()  # no writer waits for it
        assert not publisher.writer.awaits(publisher.writer.ask())
        publisher.send(3)
        publisher.end()
        *frames, end = take(stream, 4)
    assert [(f.seq, f.run_id, f.ends) for f in frames] == [
        (k, RUN_ID, False) for k in range(3)
    ]
    assert end.seq == 3
    assert end.ends
    for one in frames:
        assert decode(one.topic, one.payload).stamp_ns == one.stamp_ns < one.at_ns
        assert one.n_bytes == size_bytes(decode(one.topic, one.payload))


def test_one_that_does_not_read_holds_up_nobody_and_learns_what_it_lost(publisher):
    n = 6 * QUEUE_FRAMES
    losses = Losses()
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        publisher.send(n, n_rows=64)  # this returns only if nobody waits
        found = []
        for arrivals in stream.batches(60):
            found += arrivals
            if not arrivals:
                break
        publisher.send(1)
        found += take(stream, 1)
    for one in found:
        losses.add(one)
    assert found[-1].seq == n
    assert 0 < losses.n == n + 1 - len(found)


def test_a_patient_reader_receives_what_is_queued_at_the_writer(publisher):
    with TopicStream(publisher.graph, TOPIC, patience_s=0.01) as stream:
        publisher.wait_for_subscription()
        publisher.send(1)
        found = take(stream, 1)
        publisher.send(QUEUE_FRAMES // 2, n_rows=64)  # far more than it reads ahead
        found += take(stream, QUEUE_FRAMES // 2)
    assert [one.seq for one in found] == list(range(QUEUE_FRAMES // 2 + 1))


def test_invalid_messages_are_counted_and_skipped(publisher):
    with TopicStream(publisher.graph, TOPIC) as stream:
        publisher.wait_for_subscription()
        for payload in (b"", b"nonsense", b"\x81\xa6schema\xa3end"):
            publisher.writer.socket.send(TOPIC.encode() + b"\0" + payload)
        publisher.send(1)
        assert [one.seq for one in take(stream, 1)] == [0]
        assert stream.unreadable == 3


def test_where_keys_are_asked_for_it_has_that_of_the_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    key_file, _ = make_key_files("own", tmp_path)
    guarded = Publisher(key_file)
    with announced(guarded.graph), TopicStream(guarded.graph, TOPIC) as stream:
        guarded.wait_for_subscription()
        guarded.send(2)
        assert [one.seq for one in take(stream, 2)] == [0, 1]
    guarded.context.destroy(linger=0)
    key_file.chmod(0o644)
    with pytest.raises(KeyFileError, match=r"own\.key"):
        TopicStream(guarded.graph, TOPIC)


def test_it_ends_with_its_graph(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    gone = Publisher()
    with TopicStream(gone.graph, TOPIC) as stream:
        assert [one for arrivals in stream.batches(None) for one in arrivals] == []
    gone.context.destroy(linger=0)


def test_echo_for_a_person_shows_some_and_counts_the_others(
    publisher, monkeypatch, capsys
):
    monkeypatch.setattr("sparseskin.launch.commands.topic.give_way", lambda: None)

    def publish():
        publisher.wait_for_subscription()
        publisher.send(30, period_ns=100_000_000)
        publisher.end()

    with ThreadPoolExecutor(1) as pool:
        published = pool.submit(publish)
        assert main(["topic", "echo", "skin/taxels", "--max-hz", "4"]) == 0
        published.result()
    printed = capsys.readouterr()
    assert printed.out.count("---\n") == 1
    assert printed.out.count("--- (2 not shown)\n") == 9
    assert printed.err.endswith(f"{TOPIC}: 10 shown, 20 not shown, 0 lost\n")


MS = 1_000_000


def arrival(seq, at_ms, *, stamp_ms=None, n=92, run="a"):
    """A message of n + 8 bytes that came at a time; stamped 2 ms earlier by default."""
    stamp_ms = at_ms - 2 if stamp_ms is None else stamp_ms
    return Arrival(
        b"/skin/x",
        bytes(n),
        round(at_ms * MS),
        run,
        seq,
        round(stamp_ms * MS),
        ends=False,
    )


def end(n_messages, run="a"):
    return Arrival(b"/skin/x", b"", 0, run, n_messages, 0, ends=True)


def samples(*arrivals):
    made = Samples()
    for one in arrivals:
        made.add(one)
    return made


def test_rates_are_those_of_numbers_and_arrivals_however_late_they_are_read():
    # 100 Hz sent, two of three messages lost.
    made = samples(*(arrival(3 * k, 30 * k) for k in range(11)))
    figures = figures_of(made.last(1000))
    assert figures["sent_hz"] == pytest.approx(100)
    assert figures["arrives_hz"] == pytest.approx(100 / 3)
    assert figures["interval_ms"] is None
    assert made.lost == 20
    assert (
        text_of(figures) == "100 Hz, 33.33 here | 3.33 kB/s | p50 2.00, p99 2.00 ms old"
    )
    # 1 kHz, every 50 ms what has come since, but for half a second in which nothing is taken in.
    at_ms = [50 * (k // 50 + 1) if not 400 <= k < 900 else 900 for k in range(1000)]
    made = samples(*(arrival(k, at_ms[k], stamp_ms=k) for k in range(1000)))
    for window in (2, 50, 990):
        figures = figures_of(made.last(window))
        assert figures["arrives_hz"] == pytest.approx(1000)
        assert figures["bytes_per_s"] == pytest.approx(100_000)


def test_intervals_are_between_messages_with_none_lost_and_delays_from_stamp_to_arrival():
    stamps_ms = {0: 0, 1: 10, 2: 22, 5: 50, 6: 58}
    made = samples(
        *(arrival(seq, 99 * seq, stamp_ms=ms) for seq, ms in stamps_ms.items())
    )
    between = figures_of(made.last(1000))["interval_ms"]
    assert (between["min"], between["max"]) == pytest.approx((8, 12))
    assert between["mean"] == pytest.approx(10)
    assert between["std"] == pytest.approx(np.sqrt(8 / 3))
    made = samples(*(arrival(k, 10 * k, stamp_ms=9 * k) for k in range(101)))
    figures = figures_of(made.last(1000))["delay_ms"]
    assert (figures["p50"], figures["p99"], figures["max"]) == pytest.approx(
        (50, 99, 100)
    )
    late = made.last(1000)
    late[1:, 4] = 0  # all but the first may have waited
    assert figures_of(late)["delay_ms"]["max"] == 0


def test_bytes_a_second_leave_out_what_came_before_the_first_interval_and_few_have_no_figure():
    made = samples(arrival(0, 0, n=9_992), arrival(1, 500), arrival(2, 1000, n=192))
    figures = figures_of(made.last(1000))
    assert figures["bytes_per_s"] == pytest.approx(300)
    assert figures["size_bytes"]["max"] == 10_000
    assert text_of(figures_of(samples().last(9))) == ""
    assert (
        text_of(figures_of(samples(arrival(0, 1)).last(9)))
        == "p50 2.00, p99 2.00 ms old"
    )


B = {"run": "b"}


@pytest.mark.parametrize(
    ("arrivals", "lost", "kept"),
    [
        # None before the first.
        ([arrival(70, 1), arrival(71, 2), arrival(75, 3)], 3, [70, 71, 75]),
        ([arrival(70, 1), end(75)], 4, [70]),
        ([end(75)], 0, []),
        (
            [arrival(8, 1), arrival(9, 2), arrival(3, 50, **B), arrival(5, 60, **B)],
            1,
            [3, 5],
        ),
        # Played in a loop.
        ([arrival(8, 1), arrival(9, 2), arrival(0, 3), arrival(1, 4)], 0, [0, 1]),
    ],
)
def test_gaps_in_the_numbers_of_one_run_are_losses(arrivals, lost, kept):
    made = samples(*arrivals)
    assert made.lost == lost
    assert made.last(1000)[:, 2].tolist() == kept


def test_a_long_run_is_bounded_and_its_last_messages_are_kept():
    made = samples(*(arrival(k, k) for k in range(MAX_KEPT + 10)))
    seqs = made.last(2 * MAX_KEPT)[:, 2]
    assert made.n == MAX_KEPT + 10
    assert len(seqs) == MAX_KEPT
    assert seqs[-1] == MAX_KEPT + 9
    assert np.all(np.diff(seqs) == 1)
