"""Players that end with their test."""

import pytest

from sparseskin.nodes.player import node
from sparseskin.nodes.recorder.bag.reader import BagReader


@pytest.fixture(autouse=True)
def close_recordings(monkeypatch):
    """Close what players of a test have opened: few are run to their end, which closes it."""
    opened = []

    class Tracked(BagReader):
        def __init__(self, *arguments, **how):
            super().__init__(*arguments, **how)
            opened.append(self)

    monkeypatch.setattr(node, "BagReader", Tracked)
    yield
    for bag in opened:
        bag.close()
