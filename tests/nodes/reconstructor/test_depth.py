"""A reconstructor that is behind: of a live source it takes the newest frame, of others each one.

Sockets within the process deliver at once, so that a burst is what came while a frame was solved.
"""

import os

import numpy as np
import pytest
from bags import skin_state
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from processes import wait_for_reader

from sparseskin.messages import Measurements, Reconstruction, Taxels
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.network.sockets import Reader, Writer
from sparseskin.nodes.node import Context
from sparseskin.nodes.node_host import NodeHost
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.settings import ReconstructorSettings
from sparseskin.nodes.sensor.node import Sensor

SHAPE = {"n_rows": 8, "n_cols": 8, "mask": None}
MEASUREMENTS = "/skin/measurements"
ASK = "ask"


class Behind:
    """A compressor that sends, and a reconstructor that works only when it is told to."""

    def __init__(self, context, live, **stated):
        clock = ManualClock(1)
        self._compressor = Compressor(
            Compressor.Settings(), Context("compressor", clock)
        )
        chosen = {"preset": "paper", "iterations": 1, "fast": "off", **stated}
        self.node = Reconstructor(
            ReconstructorSettings(**chosen), Context("reconstructor", clock)
        )
        self.host = NodeHost(self.node, "1" * 16, print)
        endpoint = f"inproc://{os.urandom(8).hex()}"
        self.writer = Writer(context, endpoint, "compressor")
        self.reader = Reader(context, "reconstructor", [endpoint], self.host.inputs)
        wait_for_reader(self.writer, "reconstructor")
        self.n_sent = 0
        self._n_states = 0
        skin = skin_state(**SHAPE, live=live).published("0" * 16, 0)
        self.writer.send(skin)
        self._send(self._compressor.step(skin))
        self.work()

    def _send(self, messages):
        for message in messages:
            if isinstance(message, Measurements):
                self.writer.send(message.published("0" * 16, self.n_sent))
                self.n_sent += 1
            else:
                self.writer.send(message.published("0" * 16, self._n_states))
                self._n_states += 1

    def send(self, n):
        for _ in range(n):
            forces = np.full((8, 8), 0.5, np.float32)
            frame = Taxels(stamp_ns=self.n_sent + 1, patch="skin", forces=forces)
            self._send(self._compressor.step(frame))

    def work(self):
        """Process what waits; numbers of the frames that were reconstructed, from 0 on."""
        found = []
        streams = frozenset(topic.encode() for topic in self.host.streams)
        while (waiting := self.reader.take(self.node.depth, streams)) is not None:
            topic, payload, overtaken = waiting
            if self.reader.is_ask(topic):
                found.append(ASK)
                continue
            for message in self.host.receive_bytes(topic, payload, overtaken):
                if isinstance(message, Reconstruction):
                    self.skipped = message.skipped
                    found.append(message.stamp_ns - 1)
        return found

    @property
    def counted(self):
        return self.host.counts.as_dict()["skipped"].get(MEASUREMENTS, 0)

    def close(self):
        self.reader.socket.close()
        self.writer.socket.close()


@pytest.fixture
def behind(context):
    made = []

    def make(*arguments, **stated):
        made.append(Behind(context, *arguments, **stated))
        return made[-1]

    yield make
    for each in made:
        each.close()


bursts = st.lists(st.integers(1, 40), min_size=1, max_size=6)
with_fixture = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@with_fixture
@given(bursts=bursts)
@example(bursts=[1, 1, 1])
def test_of_a_live_source_the_newest_frame_is_reconstructed_and_the_others_are_counted(
    behind, bursts
):
    slow = behind(True)
    for size in bursts:
        slow.send(size)
        assert slow.work() == [slow.n_sent - 1]  # no frame has a newer one behind it
        assert slow.skipped == size - 1  # as the monitor is told
    assert slow.counted == slow.n_sent - len(bursts)
    assert slow.node.state()["depth"] == 1
    assert slow.host.counts.as_dict()["lost"][MEASUREMENTS] == 0


@with_fixture
@given(bursts=bursts, live=st.booleans(), depth=st.none() | st.integers(0, 5))
def test_of_others_each_frame_is_reconstructed_and_what_is_stated_comes_first(
    behind, bursts, live, depth
):
    slow = behind(live, **({} if depth is None else {"depth": depth}))
    if depth is None:
        depth = int(live)
    reconstructed = []
    for size in bursts:
        slow.send(size)
        found = slow.work()
        reconstructed += found
        newest = range(slow.n_sent - size, slow.n_sent)
        assert found == list(newest if depth == 0 else newest[-depth:])
    assert len(reconstructed) + slow.counted == slow.n_sent


@with_fixture
@given(bursts=bursts)
def test_no_frame_is_skipped_for_a_writer_that_waits_for_its_readers(behind, bursts):
    slow = behind(True)
    expected = []
    for size in bursts:
        for _ in range(size):
            slow.send(1)
            expected += [slow.n_sent - 1, ASK]
            slow.writer.ask()
    assert slow.work() == expected
    assert slow.counted == 0


PAD = """
import itertools
import numpy as np

def frames():
    for k in itertools.count():
        yield k, np.full((8, 8), 0.5)
"""


@pytest.mark.parametrize(
    ("source", "rate_hz", "live"),
    [
        ("pad:frames", None, True),
        ("scene:path_40", None, True),
        ("scene:path_40", 0.0, False),  # its readers set the pace
        ("file:log.npy", None, False),
        ("file:log.npy", 50.0, False),
    ],
)
def test_a_skin_is_live_where_a_clock_sets_the_pace(
    source, rate_hz, live, tmp_path, monkeypatch
):
    (tmp_path / "pad.py").write_text(PAD)
    np.save(tmp_path / "log.npy", np.full((3, 8, 8), 0.5, np.float32))
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    unit = {"unit": "N"} if source.startswith("file") else {}
    chosen = Sensor.Settings.from_mapping(
        {"source": source, "rate_hz": rate_hz, **unit}
    )
    sensor = Sensor(chosen, Context("sensor", ManualClock(1)))
    (skin,) = sensor.start()
    assert skin.live is live
    if source.startswith("scene"):
        (again,) = sensor.change(chosen.changed({"rate_hz": 0.0 if live else 50.0}))
        assert again.live is not live
    sensor.close({})
