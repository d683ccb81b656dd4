"""A solver's estimate of its own error is published with each frame, and doubts are logged."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from doubting import DOUBTING, ERROR
from watched import Desk, N

from sparseskin.messages import Reconstruction, decode, encode
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import RefusedError
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.reconstructor.estimates.trust import EVERY_NS, FIXED_ADVICE, TrustLog

FORCES = np.full(10, 0.5, np.float32)
PHI = make_phi("sbhe", N, N // 3, seed=0)
S = 1_000_000_000


def untouched(n_frames: int) -> Floats:
    """Measurements of the noise of a skin that nothing touches, float32 (n_frames, m)."""
    found = np.random.default_rng(0).normal(scale=0.01, size=(n_frames, PHI.m))
    return found.astype(np.float32)


def reconstructions(desk: Desk, n_frames: int) -> list[Reconstruction]:
    found = desk.messages(untouched(n_frames))
    return [message for message in found if isinstance(message, Reconstruction)]


def test_the_message_carries_what_the_solver_estimates() -> None:
    options = {"n_doubted": 2, "period": 3}
    # Every other row without noise looks stuck.
    desk = Desk(PHI, solver=DOUBTING, options=options, watch_taxels=False)
    found = reconstructions(desk, 6)
    assert [message.trusted for message in found] == [(False,), (False,), (True,)] * 2
    assert {message.error for message in found} == {(ERROR,)}
    for message in found:
        assert decode(*encode(message)) == message


@pytest.mark.parametrize("wrong", [{"error": -0.1}, {"error": float("nan")}, {"trusted": 1}])
def test_an_estimate_that_is_none_is_refused(
    wrong: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    desk = Desk(PHI, solver=DOUBTING)
    solver = desk.node._patches[0].solver
    assert solver is not None
    finish = solver.finish

    def finish_wrongly() -> Any:
        forces = finish()
        for name, value in wrong.items():
            setattr(solver, name, value)
        return forces

    monkeypatch.setattr(solver, "finish", finish_wrongly)
    with pytest.raises(RefusedError, match=rf"doubting: {next(iter(wrong))} = .*; allowed: "):
        reconstructions(desk, 1)


def test_one_line_a_run_of_doubts_and_one_every_10_s() -> None:
    lines: list[str] = []
    log = TrustLog(lines.append)

    def feed(stamps_s: list[float], trusted: bool) -> int:
        before = len(lines)
        for stamp_s in stamps_s:
            stamp_ns = round(stamp_s * S)
            log.update(stamp_ns, FORCES, 0.31, "" if trusted else "error", n=10, unit="N")
        return len(lines) - before

    assert feed([0, 1, 2], trusted=True) == 0
    assert feed([2.8, 2.9], trusted=False) == 0
    assert feed([3], trusted=False) == 1
    assert feed([4, 5, 6], trusted=False) == 0
    assert feed([7], trusted=True) == 0
    assert feed([8, 3 + EVERY_NS / S - 1e-3], trusted=False) == 0
    assert feed([3 + EVERY_NS / S], trusted=False) == 1
    assert feed([20, 40, 60], trusted=True) == 0
    assert feed([61, 62], trusted=False) == 1
    assert feed([3, 4], trusted=False) == 1  # the recording is played again
    first, second, *_ = lines
    estimate = "frames not to be trusted: estimated error 62 % of the forces"
    assert first == estimate + FIXED_ADVICE
    assert second == f"{estimate} (6 of the last 7 frames){FIXED_ADVICE}"
