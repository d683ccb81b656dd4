"""A source that is paused, goes on, and changes its pace: when its next frame is due."""

from dataclasses import replace

import pytest

from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.sensor.node import Sensor


def sensor(clock):
    made = Sensor(Sensor.Settings(source="scene:path_40", rate_hz=100.0), Context("s", clock))
    made.begin(clock.now_ns())
    return made


def test_a_pause_holds_the_source_until_it_is_resumed():
    clock = ManualClock(5_000)
    source = sensor(clock)
    assert source.next_tick_ns() == 10_005_000
    assert source.command("pause", True) == "paused"
    assert (source.next_tick_ns(), source.state()["paused"]) == (None, True)
    clock.advance(10**9)
    assert source.command("pause", True) == "paused"
    assert source.command("pause", False) == "runs"
    assert source.next_tick_ns() == 1_010_005_000  # one period from now, not all that were missed
    assert source.state()["paused"] is False
    assert [source.command("pause", None) for _ in range(3)] == ["paused", "runs", "paused"]
    with pytest.raises(RefusedError, match=r"pause: 1 is not allowed \(allowed: true, false\)"):
        source.command("pause", 1)


def test_a_driver_has_its_own_pace_and_no_rate_is_reported(tmp_path, monkeypatch):
    (tmp_path / "paced_skin.py").write_text(
        "import numpy as np\n\n\ndef frames():\n    yield 1, np.zeros((4, 4))\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    settings = Sensor.Settings(source="paced_skin:frames")
    made = Sensor(settings, Context("s", ManualClock()))
    assert "rate_hz" not in made.state()
    assert Sensor(replace(settings, rate_hz=20.0), made.context).state()["rate_hz"] == 20.0


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


@pytest.mark.parametrize(("reached_hz", "n_lines"), [(100.0, 0), (91.0, 0), (60.0, 1)])
def test_a_rate_that_is_not_reached_is_logged_once(reached_hz, n_lines):
    clock, lines = ManualClock(5_000), list[str]()
    settings = Sensor.Settings(source="scene:path_40", rate_hz=100.0)
    source = Sensor(settings, Context("s", clock, lines.append))
    source.begin(clock.now_ns())
    for k in range(300):
        clock.advance(round(1e9 / reached_hz))
        list(source.acquire(Tick(clock.now_ns(), k)))
    assert lines == n_lines * ["100 Hz asked, 60.0 Hz reached"]
