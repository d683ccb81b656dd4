"""A graph in three threads offline: the messages, their order and the times are those of a bus."""

import threading
from contextlib import closing

import numpy as np
import pytest

from sparseskin.launch.offline.pipeline import Pipeline
from sparseskin.messages import Message, Truth
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.node import Node, SourceNode
from sparseskin.nodes.settings import Settings

N_FRAMES = 40


class Frames(SourceNode):
    """Frames of one taxel, a second apart; it fails at frame `fails_at`."""

    fails_at = -1

    @classmethod
    def outputs(cls, settings):
        return ("/skin/truth",)

    def tick(self, tick):
        if tick.index == self.fails_at:
            raise ZeroDivisionError("of the source")
        self.exhausted = tick.index == N_FRAMES - 1
        yield _frame("skin", (tick.index + 1) * 10**9)


class Again(Node):
    """Publishes each frame again, twice."""

    @classmethod
    def inputs(cls, settings):
        return ("/skin/truth",)

    @classmethod
    def outputs(cls, settings):
        return ("/again/truth",)

    def step(self, message):
        yield _frame("again", message.stamp_ns)
        yield _frame("again", message.stamp_ns)


class Listener(Node):
    """Notes what it receives, when, and in which thread."""

    @classmethod
    def inputs(cls, settings):
        return ("/again/truth", "/skin/truth")

    def __init__(self, settings, context):
        super().__init__(settings, context)
        self.notes, self.threads = [], set()

    def step(self, message: Message):
        now_ns = self.context.clock.now_ns()
        self.notes.append((message.topic, message.seq, message.stamp_ns, now_ns))
        self.threads.add(threading.current_thread())
        return ()


def _frame(patch, stamp_ns):
    return Truth(
        stamp_ns=stamp_ns, patch=patch, forces=np.ones((1, 1), dtype=np.float32)
    )


def _nodes(source=Frames):
    return {
        cls.__name__.lower(): (cls, Settings()) for cls in (source, Again, Listener)
    }


def test_listeners_receive_the_same_messages_at_the_same_times_in_a_thread_of_their_own():
    clock = ManualClock()
    bus = Bus(_nodes(), clock)
    for messages in bus.frames():
        clock.advance(messages[-1].stamp_ns - clock.now_ns())
    pipeline = Pipeline(_nodes())
    with closing(pipeline):
        n_frames = sum(1 for _ in pipeline.frames())
    expected = bus.hosts["listener"].node
    listener = pipeline.hosts["listener"].node
    assert n_frames == N_FRAMES
    assert len(listener.notes) == 3 * N_FRAMES
    assert listener.notes == expected.notes
    assert threading.current_thread() not in listener.threads
    assert (
        pipeline.hosts["listener"].counts.as_dict()
        == bus.hosts["listener"].counts.as_dict()
    )


def test_an_error_of_the_source_is_raised_and_no_thread_is_left():
    class Fails(Frames):
        fails_at = 3

    pipeline = Pipeline(_nodes(Fails))
    with closing(pipeline), pytest.raises(ZeroDivisionError, match="of the source"):
        for _ in pipeline.frames():
            pass
    assert not any(thread.is_alive() for thread in pipeline._threads)


def test_a_caller_that_stops_early_leaves_no_thread():
    pipeline = Pipeline(_nodes())
    with closing(pipeline):
        next(pipeline.frames())
    assert not any(thread.is_alive() for thread in pipeline._threads)
