"""Study `wiring`: its points and its page."""

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.plugins.wiring import study as wiring


def test_the_study_writes_its_page(tmp_path, monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setattr(wiring, "SHAPE", (16, 16))
    monkeypatch.setattr(wiring, "QUICK_FRAMES", 3)
    monkeypatch.setattr(wiring, "BODIES", ("gaussian",))
    words = ["--quick", "--executor", "serial", "--out", str(tmp_path)]
    assert main(["study", "wiring", *words]) == 0
    page = (tmp_path / "wiring.md").read_text()
    assert "| local:4 |" in page
    assert "nan" not in page
    assert (tmp_path / "wiring.csv").stat().st_size > 50
