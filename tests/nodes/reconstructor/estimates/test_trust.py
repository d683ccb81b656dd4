"""A solver's estimate of its own error is published with each frame."""

import numpy as np
import pytest
from doubting import DOUBTING, ERROR
from watched import Desk, N

from sparseskin.messages import Reconstruction, decode, encode
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.errors import RefusedError

PHI = make_phi("sbhe", N, N // 3, seed=0)


def untouched(n_frames):
    """Measurements of the noise of a skin that nothing touches, float32 (n_frames, m)."""
    found = np.random.default_rng(0).normal(scale=0.01, size=(n_frames, PHI.m))
    return found.astype(np.float32)


def reconstructions(desk, n_frames):
    found = desk.messages(untouched(n_frames))
    return [message for message in found if isinstance(message, Reconstruction)]


def test_the_message_carries_what_the_solver_estimates():
    options = {"n_doubted": 2, "period": 3}
    # Every other row without noise looks stuck.
    desk = Desk(PHI, solver=DOUBTING, options=options, watch_taxels=False)
    found = reconstructions(desk, 6)
    assert [message.trusted for message in found] == [(False,), (False,), (True,)] * 2
    assert {message.error for message in found} == {(ERROR,)}
    for message in found:
        assert decode(*encode(message)) == message


@pytest.mark.parametrize("wrong", [{"error": -0.1}, {"error": float("nan")}, {"trusted": 1}])
def test_an_estimate_that_is_none_is_refused(wrong, monkeypatch):
    desk = Desk(PHI, solver=DOUBTING)
    solver = desk.node._patches[0].solver
    finish = solver.finish

    def finish_wrongly():
        forces = finish()
        for name, value in wrong.items():
            setattr(solver, name, value)
        return forces

    monkeypatch.setattr(solver, "finish", finish_wrongly)
    with pytest.raises(RefusedError, match=rf"doubting: {next(iter(wrong))} = .*; allowed: "):
        reconstructions(desk, 1)
