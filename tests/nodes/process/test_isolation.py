"""A reader in a process of its own, and how its end is named."""

import pytest
from conftest import PATIENCE_S

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.process import isolation


def test_a_reader_that_is_ended_is_named_with_its_signal(tmp_path, monkeypatch):
    monkeypatch.setattr(isolation, "START_S", PATIENCE_S)
    (tmp_path / "dying.py").write_text("import os; os.kill(os.getpid(), 11)")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(
        SourceError, match=r"^any\.xml: its reader was ended by SIGSEGV; a damaged"
    ):
        isolation.output_of("dying", "any.xml", n_bytes=1)
