"""Settings that a reconstructor refuses, and warnings about settings that reconstruct little."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from sparseskin.nodes.bus import Bus
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import Phi, make_phi
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi
from sparseskin.nodes.errors import SettingsError, SolverError
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.limits import (
    LAMBDAS_N,
    MIN_ITERATIONS,
    OWN_BASIS,
    check_lambda,
    check_phi,
    pad_spread,
    reconstruction_warnings,
)
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.reconstructor.solvers.base import make_solver
from sparseskin.nodes.sensor.node import Sensor

SHAPE = (40, 40)
N = 1600
EVERYWHERE = np.ones(SHAPE, np.bool_)


class Stretched(SbhePhi):
    """Rows `times` as long as they say."""

    times = 1.0

    def _forward(self, x: npt.NDArray[np.float32], out: npt.NDArray[np.float32]) -> None:
        super()._forward(x, out)
        out *= np.float32(self.times)

    def _adjoint(self, y: npt.NDArray[np.float32], out: npt.NDArray[np.float32]) -> None:
        super()._adjoint(y, out)
        out *= np.float32(self.times)


class SlightlyLong(Stretched):
    times = 1.1


class Long(Stretched):
    """The largest eigenvalue is 2, where `lipschitz` says 1."""

    times = 2**0.5


class NotTransposed(SbhePhi):
    """An adjoint that forgets to undo the scrambling."""

    def _adjoint(self, y: npt.NDArray[np.float32], out: npt.NDArray[np.float32]) -> None:
        super()._adjoint(y, out)
        out[:] = out[self.permutation]


class OneStrip(SbhePhi):
    """Taxels dealt out in order: a pad falls into few of the blocks."""

    def _forward(self, x: npt.NDArray[np.float32], out: npt.NDArray[np.float32]) -> None:
        super()._forward(np.ascontiguousarray(x[np.argsort(self.permutation)]), out)

    def _adjoint(self, y: npt.NDArray[np.float32], out: npt.NDArray[np.float32]) -> None:
        super()._adjoint(y, out)
        out[:] = out[self.permutation]


def test_of_the_presets_nothing_is_said() -> None:
    for preset in PRESETS.values():
        options = {k: v for k, v in preset.items() if k not in ("solver", "basis")}
        assert reconstruction_warnings(preset["solver"], preset["basis"], N, N // 3, options) == []


def test_of_a_solvers_own_settings_nothing_is_said() -> None:
    for name in MIN_ITERATIONS:
        phi = make_phi("sbhe", n=N, m=N // 3, seed=0)
        solver = make_solver(name, phi, make_basis("haar", 40, 40))
        known = ("iterations", "lambda_n")
        options = {key: getattr(solver, key) for key in known if hasattr(solver, key)}
        assert "iterations" in options
        assert reconstruction_warnings(name, "haar", N, N // 3, options) == []


@pytest.mark.parametrize("name", LAMBDAS_N)
def test_a_lambda_is_warned_of_outside_its_solvers_range(name: str) -> None:
    low, high = LAMBDAS_N[name]
    for lambda_n in (low / 2, high * 2):
        (warning,) = reconstruction_warnings(name, "haar", N, N // 3, {"lambda_n": lambda_n})
        assert f"advised: {low:g} to {high:g}" in warning


@pytest.mark.parametrize("name", MIN_ITERATIONS)
def test_too_few_iterations_are_warned_of(name: str) -> None:
    options = {"iterations": MIN_ITERATIONS[name] - 1}
    (warning,) = reconstruction_warnings(name, "haar", N, N // 3, options)
    assert warning.endswith(f"advised: {MIN_ITERATIONS[name]} or more")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"lambda_n": 0.1}, "lambda_n = 0.1: forces are shrunk away"),
        ({"lambda_n": 1e-4}, "lambda_n = 0.0001: the noise is fitted"),
        ({"iterations": 5}, "iterations = 5: fista takes several frames to follow a sudden"),
    ],
)
def test_settings_of_fista_that_fail_are_said_with_what_is_advised(
    options: dict[str, Any], said: str
) -> None:
    (warning,) = reconstruction_warnings("fista", "haar", N, N // 3, options)
    assert warning.startswith(said)
    assert "advised: " in warning
    assert "\n" not in warning


def test_a_setting_that_the_solver_does_not_have_is_refused_before_anything_starts() -> None:
    with pytest.raises(SettingsError, match=r"^lambda_n: solver skin has none; allowed: "):
        Reconstructor.Settings(preset="skin", lambda_n=0.01).check()
    Reconstructor.Settings(preset="paper", lambda_n=0.01).check()
    Reconstructor.Settings(solver="ista", lambda_n=0.01, iterations=60).check()


def test_a_basis_that_the_solver_does_not_use_is_said() -> None:
    for name in OWN_BASIS:
        (warning,) = reconstruction_warnings(name, "db2", N, N // 3, {})
        assert warning.startswith(f"basis = db2: {name} does not use it")
        assert reconstruction_warnings(name, "haar", N, N // 3, {}) == []


def test_the_identity_is_no_basis_for_a_compressed_skin() -> None:
    (warning,) = reconstruction_warnings("fista", "identity", N, 400, {})
    assert "no more than 100 pressed taxels" in warning
    assert reconstruction_warnings("fista", "identity", N, N, {}) == []


def test_a_lambda_that_leaves_nothing_of_a_skin_pressed_all_over_is_refused() -> None:
    # On sides of a power of two the bound is met: such a skin is one coefficient.
    phi, basis = make_phi("full", 1024, 1024, seed=0), make_basis("haar", 32, 32)
    pressed = np.full(1024, 2.5, np.float32)
    assert make_solver("fista", phi, basis, lambda_n=79.0).solve(pressed).min() > 0.01
    assert not make_solver("fista", phi, basis, lambda_n=80.0).solve(pressed).any()
    check_lambda("fista", 79.9, 2.5, phi)
    check_lambda("own_solver:Class", 1000.0, 2.5, phi)
    with pytest.raises(SolverError, match=r"lambda_n = 80: every .* allowed: below 80"):
        check_lambda("fista", 80.0, 2.5, phi)


@pytest.mark.parametrize(
    ("kind", "ratio"), [("sbhe", 3), ("sbhe", 8), ("gaussian", 3), ("gaussian", 8), ("full", 1)]
)
def test_built_in_matrices_pass_the_check_of_users_own(kind: str, ratio: int) -> None:
    phi = make_phi(kind, N, N // ratio, seed=5)
    assert check_phi(phi, EVERYWHERE) == []


def test_a_matrix_whose_lipschitz_is_too_small_by_little_still_converges_and_passes() -> None:
    assert check_phi(SlightlyLong(N, N // 3, seed=0), EVERYWHERE) == []


def test_a_matrix_whose_lipschitz_is_too_small_is_refused() -> None:
    with pytest.raises(SolverError, match=r"lipschitz says 1 but the largest eigenvalue .* is 2,"):
        check_phi(Long(N, N // 3, seed=0), EVERYWHERE)


def test_a_matrix_whose_adjoint_is_not_its_transpose_is_refused() -> None:
    with pytest.raises(SolverError, match="adjoint is not the transpose of forward"):
        check_phi(NotTransposed(N, N // 3, seed=0), EVERYWHERE)


def test_a_matrix_that_measures_contacts_unevenly_is_warned_of() -> None:
    (warning,) = check_phi(OneStrip(N, N // 4, seed=0), EVERYWHERE)
    assert "some contacts are measured far better than others" in warning


def test_pads_are_measured_more_evenly_by_scrambled_blocks_than_by_random_numbers() -> None:
    def spread(phi: Phi) -> float:
        return pad_spread(phi, EVERYWHERE, np.random.default_rng(1))

    gaussian, scrambled = (
        np.mean([spread(make_phi(kind, N, 400, seed)) for seed in range(4)])
        for kind in ("gaussian", "sbhe")
    )
    assert gaussian == pytest.approx(1.0, abs=0.15)
    # Rows are spread over the blocks, and these sum as many taxels of a pad, but for chance.
    assert scrambled < 0.85 * gaussian


def lines_of(phi: str = "", **reconstructor: Any) -> list[str]:
    nodes = {
        "sensor": (Sensor, Sensor.Settings(source="scene:path_40")),
        "compressor": (Compressor, Compressor.Settings(phi=phi or "sbhe")),
        "reconstructor": (
            Reconstructor,
            Reconstructor.Settings(phi=phi or "announced", **reconstructor),
        ),
    }
    bus = Bus(nodes)
    bus.run(n_frames=2)
    return bus.lines


def test_a_reconstructor_logs_it_once_when_it_knows_skin_and_phi() -> None:
    assert lines_of() == []
    (line,) = lines_of(preset="paper", lambda_n=0.1)
    assert line.startswith("[reconstructor] lambda_n = 0.1: forces are shrunk away")


def test_a_reconstructor_fails_by_name_where_the_forces_would_be_wrong() -> None:
    line = lines_of(preset="paper", lambda_n=1000.0)[0]
    assert line.startswith("[reconstructor] failed: lambda_n = 1000: every frame would be 0")


def test_users_own_matrix_is_checked_before_the_first_frame(
    tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "scaled_phi.py").write_text(
        "from sparseskin.nodes.compressor.phi.sbhe import SbhePhi\n"
        "class Scaled(SbhePhi):\n"
        "    def _forward(self, x, out):\n"
        "        super()._forward(x, out)\n"
        "        out *= 5.656854\n"
        "    def _adjoint(self, y, out):\n"
        "        super()._adjoint(y, out)\n"
        "        out *= 5.656854\n"
    )
    lines = lines_of(phi="scaled_phi:Scaled")
    assert any("lipschitz says 1 but the largest eigenvalue" in line for line in lines)
