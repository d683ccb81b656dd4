"""Settings of the reconstructor node, and its presets."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sparseskin.nodes.compressor.phi.base import KINDS
from sparseskin.nodes.compressor.phi.rotation import FIXED, ROWS
from sparseskin.nodes.errors import PhiError, SettingsError, SolverError
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.numerics.compiled import FAST, check_fast
from sparseskin.nodes.reconstructor.bases.base import BASES, find_basis
from sparseskin.nodes.reconstructor.estimates.resultant import RESULTANT_SOLVERS
from sparseskin.nodes.reconstructor.solvers.base import SOLVERS
from sparseskin.nodes.settings import PatchSettings, naming, setting

ANNOUNCED = "announced"
#: Named sets of settings. "paper": exactly the method of the paper, sections IV and V-A, for a
#: "sbhe" phi with orthonormal rows of block 32; lambda_n is its 0.1 on rows of +1 and -1. "skin":
#: the most accurate one; it estimates noise and threshold from the measurements.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {"solver": "fista", "basis": "haar", "iterations": 30, "lambda_n": 0.003125},
    "skin": {"solver": "skin", "basis": "haar"},
}


@dataclass(frozen=True)
class ReconstructorSettings(PatchSettings):
    """Settings of the reconstructor node."""

    preset: str = setting(
        "skin", f"named set of the settings below: {', '.join(PRESETS)}", known=PRESETS, live=True
    )
    solver: str | None = setting(
        None, "solver, in place of the preset's; or module:Class", known=SOLVERS, live=True
    )
    basis: str | None = setting(
        None,
        "basis Psi, in place of the preset's; or learned:FILE.npz, or module:Class",
        known=BASES,
        live=True,
    )
    iterations: int | None = setting(
        None, "iterations a frame, in place of the preset's", low=1, high=1000, live=True
    )
    lambda_n: float | None = setting(
        None,
        "weight of the l1 norm in place of the preset's, in newtons for orthonormal rows and a "
        "range of 2.5 N; scaled with the range of the skin",
        low=0.0,
        high=1e6,
        live=True,
    )
    budget_ms: float | None = setting(
        None,
        "most time for a frame's iterations, in milliseconds: when it is over, the best "
        "estimate so far is published",
        low=0.05,
        high=60_000.0,
        live=True,
    )
    depth: int = setting(
        0,
        "most measurements that may wait: older ones are skipped and counted, so that no old frame "
        "is reconstructed; 0: every frame is reconstructed. Nothing is skipped where the source "
        "waits for its readers",
        low=0,
        high=1000,
        live=True,
    )
    uncertainty: bool = setting(
        False, "publish a standard deviation with each force; twice as many bytes"
    )
    resultant: bool = setting(
        False, "publish total force and centre of pressure before the frame is reconstructed"
    )
    watch_rows: bool = setting(
        True,
        "exclude measurements that read 0, a constant or garbage, on a skin that states its noise",
    )
    fast: str = setting(
        "auto",
        "compiled loops: auto (where numba is installed), on or off; the same but for rounding",
        choices=FAST,
    )
    watch_taxels: bool = setting(
        True, "exclude taxels that are stuck, dead or saturated, on a skin that states its noise"
    )
    phi: str = setting(
        ANNOUNCED, "measurement matrix: announced (by the compressor), a kind or module:Class"
    )
    phi_m: int | None = setting(None, "M of a stated phi; N // 3 by default", low=1, high=2**20)
    phi_block: int = setting(32, "block size of a stated phi", low=1, high=2**20)
    phi_seed: int = setting(0, "seed of a stated phi", low=0, high=2**32 - 1)
    phi_rows: str = setting(FIXED, "rows of a stated phi: fixed or rotating", choices=ROWS)

    def check(self) -> None:
        if self.preset not in PRESETS:
            raise SettingsError(
                f"preset: '{self.preset}' is not known{did_you_mean(self.preset, PRESETS)}; "
                f"allowed: {', '.join(PRESETS)}"
            )
        check_fast(self.fast)
        chosen = self.chosen()
        with naming("solver"):
            solver = find_class("solver", chosen["solver"], SOLVERS, SolverError)
        self._check_known_to(solver)
        with naming("basis"):
            find_basis(chosen["basis"])
        if self.resultant and chosen["solver"] not in RESULTANT_SOLVERS:
            raise SettingsError(
                f"resultant: is not available with solver {chosen['solver']}, whose frames are "
                f"biased; allowed: {', '.join(RESULTANT_SOLVERS)}"
            )
        if self.phi != ANNOUNCED:
            with naming("phi"):
                find_class("phi", self.phi, KINDS, PhiError)

    def _check_known_to(self, solver: Callable[..., Any]) -> None:
        parameters = inspect.signature(solver).parameters
        if any(p.kind is p.VAR_KEYWORD for p in parameters.values()):
            return
        for name in ("iterations", "lambda_n"):
            if getattr(self, name) is not None and name not in parameters:
                raise SettingsError(
                    f"{name}: solver {self.chosen()['solver']} has none; allowed: to leave it out, "
                    "or a solver that has it (preset paper)"
                )

    def chosen(self) -> dict[str, Any]:
        """Return the preset with the settings that are stated in place of its own."""
        stated = {
            "solver": self.solver,
            "basis": self.basis,
            "iterations": self.iterations,
            "lambda_n": self.lambda_n,
        }
        preset = PRESETS[self.preset]
        if self.solver not in (None, preset["solver"]):
            # The numbers of a preset belong to its solver.
            preset = {"basis": preset["basis"]}
        return preset | {k: v for k, v in stated.items() if v is not None}
