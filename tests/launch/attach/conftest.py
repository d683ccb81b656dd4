"""A writer of topics, and the note by which observers find it."""

import pytest
from processes import announced
from publishing import Publisher


@pytest.fixture
def publisher(tmp_path, monkeypatch):
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path))
    made = Publisher()
    with announced(made.graph):
        yield made
    made.context.destroy(linger=0)
