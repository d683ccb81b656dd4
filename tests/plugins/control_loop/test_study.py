"""The study of ages in a control loop: its figures, and that each way delivers ages."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.plugins.control_loop import study


@given(
    echo_ms=st.lists(st.floats(1, 1000), min_size=1, max_size=4),
    share=st.floats(0.01, 2),
    n=st.integers(1, 9),
)
def test_ways_are_compared_with_echo_in_their_own_round(echo_ms, share, n):
    rows = [
        {"round": number, "way": way, "age_ms": age_ms * (share if way == "cpp" else 1)}
        for number, age_ms in enumerate(echo_ms)
        for way in ("echo", "cpp")
        for _ in range(n)
    ]
    table = study.summary(pd.DataFrame(rows)).set_index("way")
    assert list(table.index) == [study.WAYS["cpp"], study.WAYS["echo"]]
    assert table["p50 to echo"].to_list() == pytest.approx([share, 1])
    assert table["p50, ms"].iloc[1] == pytest.approx(np.median(echo_ms))
    assert table["messages"].to_list() == [n * len(echo_ms)] * 2


@pytest.mark.slow
def test_each_way_delivers_ages(tmp_path, monkeypatch):
    monkeypatch.setattr(study, "QUICK_ROUNDS", 1)
    monkeypatch.setattr(study, "QUICK_MESSAGES", 30)
    monkeypatch.setattr(study, "N_WARM_UP", 10)
    lines = study.run(tmp_path, True, 0, "serial")
    assert any(line.startswith("`subscribe(newest=True)`: p50 ") for line in lines)
    assert any(line.startswith("`topic echo --json`") for line in lines)
    rows = pd.read_csv(tmp_path / "ages.csv")
    assert (rows["age_ms"] > 0).all()
    assert set(rows["way"].value_counts()) == {20}
    assert "| way | p50, ms |" in (tmp_path / "control-loop.md").read_text()
