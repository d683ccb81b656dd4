"""The stream to a page: whole frames, every figure, and nothing twice."""

import io
import math
import queue
import threading

import numpy as np
import pytest
from bags import MASK, N_COLS, N_ROWS
from exported import contacts
from feeds import BEGIN_S, FakeTime, Graph, graph_state, node_state, read_records
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from sparseskin.messages import (
    Labels,
    Measurements,
    Reason,
    Reconstruction,
    Taxels,
    Truth,
)
from sparseskin.nodes.monitor.live.feed import UNTRUSTED_S
from sparseskin.nodes.monitor.live.notices import Notices
from sparseskin.nodes.monitor.live.stream import MOST, StreamReader, record
from sparseskin.nodes.monitor.statistics import COLUMNS

VALUES = (
    st.none()
    | st.booleans()
    | st.integers(-(2**53), 2**53)
    | st.floats()
    | st.text(max_size=9)
)
HEADERS = st.dictionaries(
    st.text(max_size=9), VALUES | st.lists(VALUES, max_size=4), max_size=4
)
ARRAYS = st.dictionaries(
    st.text(max_size=8),
    st_numpy.arrays(
        st.sampled_from(("<f4", "<f8", "|u1", "<i8")),
        st_numpy.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=4),
    ),
    max_size=4,
)
PULL_S = 0.1  # a state record is due by then, so that no reader waits


@pytest.fixture
def clock(monkeypatch):
    return FakeTime(monkeypatch)


def parsed(data):
    return list(read_records(io.BytesIO(data).read))


class Page:
    """A page that reads whenever it is told to."""

    def __init__(self, graph, clock, patch="skin"):
        self._clock = clock
        self._records = StreamReader(graph.feed, Notices(graph.feed), patch).records()

    def pull(self):
        self._clock.advance(PULL_S)
        return parsed(next(self._records))

    def kinds(self):
        return [header["kind"] for header, _ in self.pull()]


def only(records, kind):
    (found,) = [
        (header, arrays) for header, arrays in records if header["kind"] == kind
    ]
    return found


def test_the_state_has_the_newest_label_and_since_when_none_has_come(clock):
    graph = Graph()
    page = Page(graph, clock)

    def stated():
        return only(page.pull(), "state")[0]["patches"]["skin"].get("label")

    graph.skin()
    graph.frame()
    assert stated() is None
    label = Labels(
        stamp_ns=1, patch="skin", label="peg", share=0.75, age_s=2.0, done_ns=1
    )
    graph.feed.frame("skin", label, None)
    shown = stated()
    assert shown.pop("silent_s") == pytest.approx(PULL_S)
    assert shown == {"label": "peg", "share": 0.75, "age_s": 2.0, "trusted": True}
    assert stated()["silent_s"] == pytest.approx(2 * PULL_S)
    graph.skin()
    assert stated() is None


@pytest.mark.parametrize("reason", Reason)
def test_the_state_explains_why_a_frame_is_not_trusted(clock, reason):
    graph = Graph()
    page = Page(graph, clock)

    def stated():
        state = only(page.pull(), "state")[0]["patches"]["skin"]
        return state["trusted"], state["reason"]

    graph.skin()
    graph.frame()
    assert stated() == (True, None)
    graph.frame(trusted=False, reason=reason)
    text = {"phrase": reason.phrase, "sentence": reason.sentence}
    assert stated() == (False, {"word": reason.value, **text})
    graph.frame()
    clock.advance(UNTRUSTED_S)
    assert stated() == (True, None)
    graph.frame(trusted=False)
    assert stated() == (False, None)


def test_the_skin_comes_first_and_once(clock):
    graph = Graph()
    page = Page(graph, clock)
    assert page.kinds() == ["state"]
    graph.skin()
    graph.frame()
    records = page.pull()
    assert [header["kind"] for header, _ in records] == [
        "state",
        "skin",
        "maps",
        "rows",
    ]
    header, arrays = only(records, "skin")
    assert header["n_rows"] == N_ROWS
    assert header["n_cols"] == N_COLS
    assert header["f_max"] == 2.5
    assert header["unit"] == "N"
    assert header["source"] == "test"
    assert header["has_truth"]
    np.testing.assert_array_equal(arrays["mask"].astype(bool), MASK)
    graph.frame()
    assert page.kinds() == ["state", "maps", "rows"]
    graph.skin(mask=None, rate_hz=50.0)
    graph.frame()
    header, arrays = only(page.pull(), "skin")
    assert header["rate_hz"] == 50.0
    assert arrays == {}


def test_maps_that_go_together_are_of_one_frame(clock):
    graph = Graph()
    graph.skin()
    page = Page(graph, clock)
    graph.frame(upto=2)  # nothing is reconstructed yet
    _, maps = only(page.pull(), "maps")
    assert set(maps) == {"taxels", "truth"}
    for begun in (0, 1, 2, 3):
        whole = graph.frame()
        graph.frame(upto=begun)  # the next one is under way
        _, maps = only(page.pull(), "maps")
        by_name = {"taxels": Taxels, "truth": Truth, "reconstruction": Reconstruction}
        assert set(maps) == {*by_name, "measurements"}
        (y,) = next(m.y for m in whole if isinstance(m, Measurements))
        # For the eye: within half a step of 1/127 of the largest.
        largest = np.abs(y).max()
        np.testing.assert_allclose(
            maps["measurements"] / 127, y / largest, atol=0.501 / 127
        )
        for name, kind in by_name.items():
            (message,) = [m for m in whole if isinstance(m, kind)]
            np.testing.assert_array_equal(maps[name], message.forces[0])


def test_no_frame_is_left_out_and_all_come_in_order(clock):
    graph = Graph()
    graph.skin()
    page = Page(graph, clock)
    seen = []
    sent = []
    for n_frames in np.random.default_rng(0).integers(0, 40, 60):
        for _ in range(n_frames):
            clock.advance(0.001)
            graph.frame()
            sent.append(clock.now_s)
        for header, arrays in page.pull():
            if header["kind"] == "rows":
                assert header["columns"] == list(COLUMNS)
                seen += list(header["now_s"] + arrays["rows"][:, 0].astype(np.float64))
    assert len(seen) == len(sent)
    np.testing.assert_allclose(seen, sent, atol=1e-4)


def test_a_stalled_reader_holds_no_more_than_the_newest_frame(clock):
    graph = Graph()
    graph.skin()
    page = Page(graph, clock)
    page.pull()
    for _ in range(500):
        last = graph.frame()
    records = page.pull()
    assert [header["kind"] for header, _ in records] == ["state", "maps", "rows"]
    _, maps = only(records, "maps")
    np.testing.assert_array_equal(maps["reconstruction"], last[-1].forces[0])
    assert only(records, "rows")[1]["rows"].shape == (500, len(COLUMNS))
    assert page.kinds() == ["state"]


def test_an_overview_brings_the_reconstructed_maps_of_all_patches_and_no_rows(clock):
    graph = Graph("left", "right")
    last = {
        patch: (graph.skin(patch), graph.frame(patch))[1] for patch in ("left", "right")
    }
    records = Page(graph, clock, None).pull()
    assert [header["kind"] for header, _ in records] == [
        "state",
        "skin",
        "maps",
        "skin",
        "maps",
    ]
    maps = {h["patch"]: arrays for h, arrays in records if h["kind"] == "maps"}
    for patch, messages in last.items():
        assert list(maps[patch]) == ["reconstruction"]
        np.testing.assert_array_equal(
            maps[patch]["reconstruction"], messages[-1].forces[0]
        )


def test_contacts_come_with_their_frame_and_each_event_once(clock, monkeypatch):
    graph = Graph()
    graph.skin()
    page = Page(graph, clock)
    graph.frame()
    assert "contacts" not in only(page.pull(), "maps")[0]
    for k in (1, 2):
        graph.frame()
        graph.take(contacts(k))
    records = page.pull()
    found = only(records, "maps")[0]["contacts"]
    assert found["n"] == 2
    assert found["id"] == [1, 2]
    assert found["sum"] == 5.0
    assert found["trusted"]
    assert only(records, "events")[1]["rows"][:, 1:].tolist() == [
        [1, 0, 0, 0, 0],
        [2, 0, 0, 0, 0],
    ]
    assert page.kinds() == ["state"]
    graph.frame()
    graph.take(contacts(3))
    woken = []
    graph.feed.n_waiting = 1
    monkeypatch.setattr(graph.feed.changed, "notify_all", lambda: woken.append(True))
    graph.frame()
    assert not woken
    graph.take(contacts(4, n=100))
    assert len(woken) == 1
    found = only(page.pull(), "maps")[0]["contacts"]
    assert found["n"] == 100
    assert found["id"] == list(range(1, MOST + 1))
    for _ in range(30):  # 0.3 s without
        graph.frame()
    assert "contacts" not in only(page.pull(), "maps")[0]


def test_answers_are_sent_once_to_every_page_that_is_open(clock):
    graph = Graph()
    graph.answer("early")
    pages = [Page(graph, clock), Page(graph, clock)]
    graph.answer("a")
    for page in pages:
        assert only(page.pull(), "answer")[0]["id"] == "a"
        assert page.kinds() == ["state"]


def test_the_end_is_reported_at_once_and_ends_the_stream(clock):
    graph = Graph()
    graph.skin()
    graph.frame()
    records = StreamReader(graph.feed, Notices(graph.feed), "skin").records()
    clock.advance(PULL_S)
    next(records)
    graph.frame()
    graph.answer()
    graph.close()  # at the same moment: nothing else is due
    headers = parsed(next(records))
    assert [header["kind"] for header, _ in headers] == [
        "answer",
        "state",
        "maps",
        "rows",
    ]
    assert headers[1][0]["closed"] is True
    assert list(records) == []


def test_a_reader_that_waits_is_woken_by_a_frame_an_answer_and_the_end():
    graph = Graph()
    graph.skin()
    kinds = queue.Queue()

    def read():
        for data in StreamReader(graph.feed, Notices(graph.feed), "skin").records():
            for header, _ in parsed(data):
                kinds.put(header["kind"])
        kinds.put("end")

    threading.Thread(target=read, daemon=True).start()
    while kinds.get(timeout=60.0) != "skin":
        pass
    for news, kind in (
        (graph.frame, "rows"),
        (graph.answer, "answer"),
        (graph.close, "end"),
    ):
        news()
        while kinds.get(timeout=60.0) != kind:
            pass


def test_the_state_has_the_age_of_every_map_and_graph_and_summaries_once(clock):
    graph = Graph()
    graph.skin(rate_hz=5.0)
    graph.frame()
    page = Page(graph, clock)
    graph.feed.update(graph=graph_state(node_state("sensor")))
    graph.summarise()
    state = page.pull()[0][0]
    patch = state["patches"]["skin"]
    age_s = pytest.approx(PULL_S, abs=1e-6)
    assert patch["age_s"] == {"taxels": age_s, "reconstruction": age_s, "truth": age_s}
    assert patch["stale_s"] == 0.5
    assert state["now_s"] == BEGIN_S + PULL_S
    assert state["graph"]["nodes"][0]["name"] == "sensor"
    assert patch["summary"]["frames"]["sensed"] == 1
    state = page.pull()[0][0]
    assert "graph" not in state
    assert "summary" not in state["patches"]["skin"]


def without_nan(value):
    if isinstance(value, list):
        return [without_nan(part) for part in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@given(HEADERS.filter(lambda header: "arrays" not in header), ARRAYS)
def test_decoding_a_record_returns_its_header_and_arrays(header, arrays):
    ((found, back),) = parsed(record(header, arrays))
    assert found == {key: without_nan(value) for key, value in header.items()}
    assert list(back) == list(arrays)
    for name, array in arrays.items():
        assert back[name].dtype == array.dtype
        assert back[name].shape == array.shape
        assert back[name].tobytes() == array.tobytes()
