"""A graph by blocks of frames: the messages, their order and the times are those of a bus."""

from contextlib import closing

import numpy as np
import pytest

from sparseskin.launch.offline import blocks
from sparseskin.launch.offline.blocks import BlockBus
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
    """Notes what it receives, and when."""

    @classmethod
    def inputs(cls, settings):
        return ("/again/truth", "/skin/truth")

    def __init__(self, settings, context):
        super().__init__(settings, context)
        self.notes = []

    def step(self, message: Message):
        now_ns = self.context.clock.now_ns()
        self.notes.append((message.topic, message.seq, message.stamp_ns, now_ns))
        return ()


def _frame(patch, stamp_ns):
    return Truth(
        stamp_ns=stamp_ns, patch=patch, forces=np.ones((1, 1), dtype=np.float32)
    )


def _nodes(source=Frames):
    return {
        cls.__name__.lower(): (cls, Settings()) for cls in (source, Again, Listener)
    }


@pytest.mark.parametrize("n_frames", [1, 7, N_FRAMES, N_FRAMES + 1])
def test_of_blocks_of_any_size_listeners_receive_the_same_messages_at_the_same_times(
    monkeypatch, n_frames
):
    monkeypatch.setattr(blocks, "BLOCK_FRAMES", n_frames)
    clock = ManualClock()
    bus = Bus(_nodes(), clock)
    for messages in bus.frames():
        clock.advance(messages[-1].stamp_ns - clock.now_ns())
    block_bus = BlockBus(_nodes())
    with closing(block_bus):
        assert sum(1 for _ in block_bus.frames()) == N_FRAMES
    expected = bus.hosts["listener"]
    listener = block_bus.hosts["listener"]
    assert len(listener.node.notes) == 3 * N_FRAMES
    assert listener.node.notes == expected.node.notes
    assert listener.counts.as_dict() == expected.counts.as_dict()


def test_a_block_holds_no_more_than_a_number_of_bytes(monkeypatch):
    """Of frames of 4 bytes here: the source is 3 frames ahead at most."""
    monkeypatch.setattr(blocks, "BLOCK_BYTES", 12)
    block_bus = BlockBus(_nodes())
    source = block_bus.hosts["frames"]
    n_ahead = []
    for k, _ in enumerate(block_bus.frames()):
        n_ahead.append(source.counts.published["/skin/truth"] - k)
    assert max(n_ahead) == 3


def test_an_error_of_the_source_is_raised():
    class Fails(Frames):
        fails_at = 3

    block_bus = BlockBus(_nodes(Fails))
    with closing(block_bus), pytest.raises(ZeroDivisionError, match="of the source"):
        for _ in block_bus.frames():
            pass
