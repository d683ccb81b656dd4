"""Sources: by their addresses, of this package and another; paused, resumed, at another pace."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from damaged import refusal
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.messages import SkinState, Taxels
from sparseskin.nodes import extensions
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.sensor import sources
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout
from sparseskin.nodes.sensor.node import Sensor, SensorSettings

GLOVE = """
import numpy as np
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.source import Address, Skin, Source


class Glove(Source):
    name, skin, arrives, is_live = "glove", Skin(2, 3, 9.0, "raw"), True, True

    def __init__(self):
        self.waiting, self.lines, self.closed = [(7, 0.5), (8, 1.5)], ["connected"], False

    def __iter__(self):
        while (frame := self.next_frame(0.0)) is not None:
            yield frame

    def next_frame(self, wait_s, newest=False):
        if not self.waiting:
            return None
        stamp_ns, force = self.waiting.pop(0)
        return stamp_ns, np.full((2, 3), force, np.float32)

    def take_lines(self):
        lines, self.lines = self.lines, []
        return lines

    def dropped(self):
        return "2 packets"

    def report(self):
        return {"glove": {"packets": 4}}

    def close(self):
        self.closed = True


class GloveAddress(Address):
    own = ("n_rows", "n_cols")

    def check(self):
        if self.rest != "left":
            raise SourceError(f"{self.source}: allowed is left")

    def n_taxels(self):
        return 6

    def open(self):
        self.check()
        return Glove()
"""


@pytest.fixture
def offered(monkeypatch, tmp_path, offering):
    """A package that brings the kind `glove`, and one, `broken`, that cannot be imported."""
    monkeypatch.syspath_prepend(tmp_path)
    broken = "no_such_package:Address"
    offering(extensions.ADDRESSES, glove="glove_package:GloveAddress", broken=broken)
    (tmp_path / "glove_package.py").write_text(GLOVE)
    yield
    sys.modules.pop("glove_package", None)


@pytest.mark.usefixtures("offered")
def test_a_sensor_reads_a_kind_of_source_that_another_package_brings():
    settings = SensorSettings(source="glove:left")
    settings.check()
    assert Sensor.facts(settings) == {"/skin/skin": 6}
    logged = []
    clock = ManualClock(100)
    sensor = Sensor(settings, Context("sensor", clock, log=logged.append))
    messages = [*sensor.start()]
    for number in range(3):
        clock.advance(10)
        messages += sensor.acquire(Tick(clock.now_ns(), number))
    assert logged == ["connected"]
    assert [type(message) for message in messages] == [SkinState, Taxels, Taxels]
    assert [m.forces[0, 0, 0] for m in messages if isinstance(m, Taxels)] == [0.5, 1.5]
    assert not sensor.follows_readers
    assert not sensor.acquired  # at the third tick
    assert sensor.status() == "glove: frame 2; dropped: 2 packets"
    assert sensor.report() == {"clipped": 0, "glove": {"packets": 4}}
    sensor.close({})


def test_a_part_of_a_recording_is_read_at_its_part_of_the_rate(tmp_path):
    path = tmp_path / "a.npz"
    forces = np.arange(10, dtype=np.float32)[:, None, None] * np.ones(
        (2, 3), np.float32
    )
    np.savez(path, forces=forces, rate_hz=200.0)
    stated = {"source": f"file:{path}", "unit": "N", "every": 4}
    sensor = Sensor(SensorSettings(**stated, first=1), Context("sensor", ManualClock()))
    ticks = [sensor.acquire(Tick(k, k)) for k in range(3)]
    taxels = [
        m.forces[0, 0, 0] for tick in ticks for m in tick if isinstance(m, Taxels)
    ]
    assert taxels == [1, 5, 9]
    assert sensor.exhausted
    assert sensor.rate_hz == 50
    assert sensor.status() == "a: frame 3 of 3"
    with pytest.raises(SourceError, match=r"a: first: 10: allowed: 0\.\.9"):
        Sensor(SensorSettings(**stated, first=10), Context("sensor", ManualClock()))


@given(st.integers(2, 40), st.integers(2, 40))
def test_patches_of_a_body_are_64_x_64_unless_their_sides_are_stated(n_rows, n_cols):
    simulated = {"n_rows": n_rows, "n_cols": n_cols}
    stated = sources.find_address("scene:hug", simulated=simulated)
    assert stated.n_taxels() == n_rows * n_cols
    assert sources.find_address("scene:hug").n_taxels() == 64 * 64


@pytest.mark.usefixtures("offered")
def test_what_such_a_kind_refuses_is_refused_before_a_graph_starts():
    with pytest.raises(SettingsError, match="source: glove:right: allowed is left"):
        SensorSettings(source="glove:right").check()
    with pytest.raises(SettingsError, match="n_rows: a glove has its own"):
        SensorSettings(source="glove:left", n_rows=2).check()
    with pytest.raises(
        SourceError, match=r"broken:x: plug-in no_such_package:Address: ModuleNot"
    ):
        sources.find_address("broken:x").check()


def test_a_source_that_computes_its_frames_is_read_a_frame_at_a_time_and_ends():
    source = sources.open_source("scene:lift_box_40", seed=0)
    first = source.next_frame(0.0)
    second = source.next_frame(0.0)
    assert first is not None
    assert second is not None
    for (stamp_ns, forces), read in zip(source, (first, second), strict=False):
        assert read[0] == stamp_ns
        np.testing.assert_array_equal(read[1], forces)
    while source.next_frame(0.0) is not None:
        assert not source.ended
    assert source.ended


def test_a_recording_that_loops_begins_again_and_its_stamps_go_on(tmp_path):
    frames = np.arange(4, dtype=np.float32).reshape(2, 1, 2)
    np.savez(tmp_path / "r.npz", forces=frames, stamp_ns=np.array([0, 10]))
    source = open_file(tmp_path / "r.npz")
    source.loops = True
    source.period_s = 1e-8
    read = [source.next_frame(0.0) for _ in range(5)]
    assert [(ns, forces[0, 0]) for ns, forces in filter(None, read)] == [
        *((0, 0), (10, 2), (20, 0), (30, 2), (40, 0))
    ]


def test_no_address_is_refused_and_any_other_is_of_a_driver(
    tmp_path, monkeypatch, offering
):
    address = sources.find_address("my_skin:frames", layout=Layout(n_rows=2, n_cols=3))
    assert isinstance(address, sources.DriverAddress)
    assert address.n_taxels() == 6
    assert sources.find_address("my_skin:frames").n_taxels() is None
    monkeypatch.chdir(tmp_path)
    (tmp_path / "press.csv").touch()
    with pytest.raises(SourceError, match=r'did you mean "file:press.csv"\?'):
        sources.find_address("press.csv")
    shown = refusal(lambda: sources.find_address("path_40"), SourceError)
    assert shown.startswith('source "path_40": expected scene:NAME, file:PATH')
    assert shown.endswith('or module:callable (did you mean "scene:path_40"?)')
    offering(extensions.ADDRESSES)
    with pytest.raises(
        SourceError, match="no plug-in for sources serial: is installed; expected"
    ):
        sources.find_address("serial:/dev/ttyUSB0?baud=9600")


def sensor(clock):
    made = Sensor(
        Sensor.Settings(source="scene:path_40", rate_hz=100.0), Context("s", clock)
    )
    made.begin(clock.now_ns())
    return made


def test_a_driver_has_its_own_pace_and_no_rate_is_reported(tmp_path, monkeypatch):
    (tmp_path / "paced_skin.py").write_text(
        "import numpy as np\n\n\ndef frames():\n    yield 1, np.zeros((4, 4))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    settings = Sensor.Settings(source="paced_skin:frames")
    made = Sensor(settings, Context("s", ManualClock()))
    assert "rate_hz" not in made.state()
    assert (
        Sensor(replace(settings, rate_hz=20.0), made.context).state()["rate_hz"] == 20.0
    )


def test_a_new_rate_counts_from_the_moment_of_the_change():
    clock = ManualClock()
    source = sensor(clock)
    for k in range(7):
        list(source.acquire(Tick(k, k)))
    clock.advance(75_000_000)
    (state,) = source.change(source.settings.changed({"rate_hz": 20.0}))
    assert state.rate_hz == 20.0
    assert source.next_tick_ns() == 125_000_000
    list(source.change(source.settings.changed({"noise": 0.5})))
    assert source.next_tick_ns() == 125_000_000


def test_a_sensor_logs_a_rate_that_is_not_reached():
    clock = ManualClock(5_000)
    lines = list[str]()
    settings = Sensor.Settings(source="scene:path_40", rate_hz=100.0)
    source = Sensor(settings, Context("s", clock, lines.append))
    source.begin(clock.now_ns())
    for k in range(300):
        clock.advance(round(1e9 / 60))
        list(source.acquire(Tick(clock.now_ns(), k)))
    assert lines == ["100 Hz asked, 60.0 Hz reached"]
