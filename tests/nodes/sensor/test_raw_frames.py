"""Raw frames for a calibration: parts of a recording, and of what a live source delivers."""

import queue
from types import SimpleNamespace

import numpy as np
import pytest

from sparseskin.messages.skin import Skin
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.sensor import raw_frames
from sparseskin.nodes.sensor.raw_frames import (
    POLL_S,
    SILENT_S,
    Live,
    Recorded,
    open_frames,
)

SKIN = Skin(n_rows=2, n_cols=3, f_max=100.0, unit="counts")


class Glove:
    """A live source that delivers a frame whenever the test lets time pass, from a time on."""

    name = "glove:left"
    skin = SKIN

    def __init__(self, monkeypatch, first_s=100.0):
        self.now_s = 100.0
        self.first_s = first_s
        self.closed = False
        self._numbers = queue.Queue()
        clock = SimpleNamespace(monotonic=lambda: self.now_s, sleep=self.wait)
        monkeypatch.setattr(raw_frames, "time", clock)

    def __iter__(self):
        while (number := self._numbers.get()) is not None:
            yield 0, np.full((2, 3), number, dtype=np.float32)
            self._numbers.task_done()

    def wait(self, seconds):
        self.now_s += seconds
        if self.now_s >= self.first_s:
            self._numbers.put(self.now_s)
            # Until it has been read, and the next is waited for.
            self._numbers.join()

    def end(self):
        self._numbers.put(None)

    def close(self):
        self.closed = True


def test_a_part_has_the_frames_that_come_from_then_on(monkeypatch):
    glove = Glove(monkeypatch)
    live = Live(glove)
    for _ in range(7):
        glove.wait(POLL_S)
    began_s = glove.now_s
    frames = live.part(2.0, 2.0 + 10 * POLL_S)
    times_s = began_s + POLL_S * np.arange(1, 11)
    np.testing.assert_allclose(frames[:, 1, 2], times_s, rtol=1e-6)
    glove.end()
    live.close()


def test_the_first_frame_is_waited_for_longer(monkeypatch):
    glove = Glove(monkeypatch, first_s=104.9)
    live = Live(glove)
    assert len(live.part(0.0, 1.0)) == 1
    glove.end()
    live.close()


def test_a_source_without_a_frame_is_given_up(monkeypatch):
    glove = Glove(monkeypatch, first_s=1e9)
    live = Live(glove)
    with pytest.raises(SparseskinError, match="glove:left"):
        live.part(0.0, 1.0)
    assert glove.now_s == pytest.approx(101.0 + SILENT_S, abs=2 * POLL_S)
    glove.end()
    live.close()


def test_a_source_that_has_ended_is_not_waited_for_and_closed(monkeypatch):
    glove = Glove(monkeypatch)
    live = Live(glove)
    glove.end()
    live._thread.join()
    with pytest.raises(SparseskinError, match="ended"):
        live.part(0.0, 1.0)
    assert glove.now_s == 100.0
    live.close()
    assert glove.closed


def test_a_part_of_a_recording_has_its_begin_and_not_its_end():
    frames = np.arange(30, dtype=np.float32).reshape(5, 2, 3)
    recorded = Recorded(SKIN, [0, 10**9, 2 * 10**9, 3 * 10**9, 4 * 10**9], frames)
    np.testing.assert_array_equal(recorded.part(1.0, 3.0), frames[1:3])
    np.testing.assert_array_equal(recorded.part(0.0, 9.0), frames)
    with pytest.raises(SparseskinError, match="lasts 4 s"):
        recorded.part(4.5, 9.0)


def test_true_forces_need_no_calibration():
    with pytest.raises(SparseskinError, match="scene:path_40"):
        open_frames("scene:path_40")
