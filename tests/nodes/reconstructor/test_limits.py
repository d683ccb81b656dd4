"""Settings that nodes refuse, and warnings about settings that reconstruct badly."""

from typing import Any

import numpy as np
import pytest
from bags import chain

from sparseskin.nodes.compressor.node import compression_warnings
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.limits import (
    check_lambda,
    check_phi,
    reconstruction_warnings,
)
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver

SHAPE = (40, 40)
N = 1600
EVERYWHERE = np.ones(SHAPE, np.bool_)


def warnings_of(solver, basis="haar", n_per_m=3, **options):
    return reconstruction_warnings(solver, basis, N, N // n_per_m, options)


def test_of_presets_and_of_a_solvers_own_settings_nothing_is_said():
    for preset in PRESETS.values():
        assert warnings_of(**{k: v for k, v in preset.items() if k != "fast"}) == []
    phi = make_phi("sbhe", n=N, m=N // 3, seed=0)
    basis = make_basis("haar", *SHAPE)
    for name in ("skin", "fista"):
        solver = make_solver(name, phi, basis)
        own = {
            "iterations": solver.n_steps,
            "lambda_n": getattr(solver, "lambda_n", None),
        }
        assert (
            warnings_of(name, **{k: v for k, v in own.items() if v is not None}) == []
        )


@pytest.mark.parametrize(
    ("solver", "options", "said", "advised"),
    [
        (
            "fista",
            {"lambda_n": 0.1},
            "lambda_n = 0.1: forces are shrunk away",
            "0.0006 to 0.015",
        ),
        (
            "fista",
            {"lambda_n": 1e-4},
            "lambda_n = 0.0001: the noise is fitted",
            "0.0006 to 0.015",
        ),
        (
            "fista",
            {"iterations": 5},
            "iterations = 5: fista takes several frames",
            "15 or more",
        ),
        (
            "fista",
            {"basis": "identity"},
            "basis = identity with m = 533 of n = 1600",
            "haar",
        ),
        (
            "skin",
            {"iterations": 4},
            "iterations = 4: skin takes several frames",
            "5 or more",
        ),
        (
            "skin",
            {"basis": "identity"},
            "basis = identity: skin does",
            "haar, or a solver that uses it",
        ),
    ],
)
def test_settings_that_fail_are_said_in_a_line_with_what_is_advised(
    solver, options, said, advised
):
    (warning,) = warnings_of(solver, **options)
    assert warning.startswith(said)
    assert warning.endswith(f"advised: {advised}")
    assert "\n" not in warning


def test_a_setting_that_the_solver_does_not_have_is_refused_before_anything_starts():
    with pytest.raises(
        SettingsError, match=r"^lambda_n: solver skin has none; allowed: "
    ):
        Reconstructor.Settings(preset="skin", lambda_n=0.01).check()
    Reconstructor.Settings(preset="paper", lambda_n=0.01).check()
    Reconstructor.Settings(solver="fista", lambda_n=0.01, iterations=60).check()


def test_a_lambda_that_leaves_nothing_of_a_skin_pressed_all_over_is_refused():
    # On sides of a power of two the bound is met: such a skin is one coefficient.
    phi = make_phi("full", 1024, 1024, seed=0)
    basis = make_basis("haar", 32, 32)
    pressed = np.full(1024, 2.5, np.float32)
    assert make_solver("fista", phi, basis, lambda_n=79.0).solve(pressed).min() > 0.01
    assert not make_solver("fista", phi, basis, lambda_n=80.0).solve(pressed).any()
    check_lambda("fista", 79.9, 2.5, phi)
    check_lambda("skin", 1000.0, 2.5, phi)
    with pytest.raises(SolverError, match=r"lambda_n = 80: every .* allowed: below 80"):
        check_lambda("fista", 80.0, 2.5, phi)


class OwnPhi(SbhePhi):
    """A matrix of the user's own, with operators by other ones before and after those of `sbhe`."""

    times = np.float32(1)
    order_in: Any = slice(None)
    order_out: Any = slice(None)

    def _forward(self, x, out):
        super()._forward(np.ascontiguousarray(x[self.order_in]), out)
        out *= self.times

    def _adjoint(self, y, out):
        super()._adjoint(y, out)
        out[:] = self.times * out[self.order_out]


def own(n_per_m=3, **changes):
    phi = OwnPhi(N, N // n_per_m, seed=0)
    vars(phi).update(changes)
    return phi


ORDER = OwnPhi(N, N, seed=0).permutation


@pytest.mark.parametrize(
    "phi",
    [
        make_phi("sbhe", N, N // 3, seed=5),
        make_phi("gaussian", N, N // 8, seed=5),
        own(times=np.float32(1.1)),  # 4/3 of the eigenvalue is allowed
    ],
)
def test_a_matrix_that_a_solver_can_use_passes(phi):
    assert check_phi(phi, EVERYWHERE) == []


@pytest.mark.parametrize(
    ("phi", "fault"),
    [
        (
            own(times=np.float32(2**0.5)),
            r"lipschitz says 1 but the largest eigenvalue .* is 2,",
        ),
        (own(order_out=ORDER), "adjoint is not the transpose of forward"),
    ],
)
def test_a_matrix_that_would_give_wrong_forces_is_refused(phi, fault):
    with pytest.raises(SolverError, match=fault):
        check_phi(phi, EVERYWHERE)


def test_a_matrix_that_measures_contacts_unevenly_is_warned_of():
    """Taxels are dealt out in order: a pad falls into few of the blocks."""
    (warning,) = check_phi(
        own(4, order_in=np.argsort(ORDER), order_out=ORDER), EVERYWHERE
    )
    assert "some contacts are measured far better than others" in warning


def lines_of(phi="", **reconstructor):
    bus = chain(
        sensor={"source": "scene:path_40"},
        compressor={"phi": phi or "sbhe"},
        reconstructor={"phi": phi or "announced", **reconstructor},
    )
    bus.run(n_frames=2)
    return bus.lines


def test_a_reconstructor_logs_it_once_when_it_knows_skin_and_phi():
    assert lines_of() == []
    (line,) = lines_of(preset="paper", lambda_n=0.1)
    assert line.startswith("[reconstructor] lambda_n = 0.1: forces are shrunk away")


class Scaled(OwnPhi):
    """The largest eigenvalue is 32."""

    times = np.float32(32**0.5)


def test_users_own_matrix_is_checked_before_the_first_frame():
    lines = lines_of(phi=f"{__name__}:Scaled")
    assert any("lipschitz says 1 but the largest eigenvalue" in line for line in lines)


@pytest.mark.parametrize(
    ("kind", "m", "block", "bits", "message"),
    [
        ("sbhe", 533, 32, 5, ""),
        ("sbhe", 100, 8, None, ""),
        ("full", 1600, 32, None, ""),
        ("gaussian", 200, 1, None, ""),
        (
            "sbhe",
            99,
            32,
            None,
            "m = 99 of n = 1600 taxels: more than one small contact is not",
        ),
        ("sbhe", 533, 4, None, "block = 4: most measurements see no pressed taxel"),
        (
            "subsample",
            400,
            32,
            None,
            "phi = subsample: a contact of fewer than 4 taxels may touch",
        ),
        ("sbhe", 533, 32, 4, "bits = 4: the steps of the quantiser lose"),
    ],
)
def test_settings_that_reconstruct_badly_are_warned_of_in_a_line(
    kind, m, block, bits, message
):
    warnings = compression_warnings(kind, 1600, m, block, bits)
    assert len(warnings) == bool(message)
    for warning in warnings:
        assert warning.startswith(message)
        assert "advised: " in warning
        assert "\n" not in warning


def running(**compressor):
    bus = chain(sensor={"source": "scene:path_40"}, compressor=compressor)
    bus.run(n_frames=2)
    return bus


def test_a_compressor_logs_its_warnings_once_when_they_become_true():
    (line,) = running(ratio=40).lines
    assert line.startswith("[compressor] m = 40 of n = 1600 taxels")
    bus = running()
    assert bus.lines == []
    compressor = bus.hosts["compressor"].node
    list(compressor.change(compressor.settings.changed({"bits": 4})))
    (line,) = bus.lines
    assert line.startswith("[compressor] bits = 4: ")
