"""What a reconstructor can be told."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sparseskin.nodes.compressor.phi import KINDS
from sparseskin.nodes.compressor.rotation import FIXED, ROWS
from sparseskin.nodes.errors import PhiError, SettingsError, SolverError
from sparseskin.nodes.fast import FAST, check_fast
from sparseskin.nodes.lookup import did_you_mean, find_class
from sparseskin.nodes.settings import PatchSettings, naming, setting

from .basis import BASES, find_basis
from .presets import PRESETS
from .resultant import RESULTANT_SOLVERS
from .solver import SOLVERS

ANNOUNCED = "announced"


@dataclass(frozen=True)
class ReconstructorSettings(PatchSettings):
    """What a reconstructor can be told."""

    preset: str = setting(
        "skin",
        f"named set of the settings below: {', '.join(PRESETS)}",
        known=PRESETS,
        live=True,
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
        "how many measurements may wait, the newest: older ones are skipped and counted, so that "
        "what is restored is never old; 0: every frame is restored. Nothing is skipped where the "
        "source waits for its readers",
        low=0,
        high=1000,
        live=True,
    )
    uncertainty: bool = setting(
        False, "publish a standard deviation with each force; twice as many bytes"
    )
    resultant: bool = setting(
        False, "publish total force and centre of pressure before the frame is restored"
    )
    watch_rows: bool = setting(
        True,
        "leave out measurements that read 0, a constant or garbage, on a skin that states its "
        "noise",
    )
    fast: str = setting(
        "auto",
        "compiled loops: auto (where numba is installed), on or off; but for rounding the same",
        choices=FAST,
    )
    watch_taxels: bool = setting(
        True, "leave out taxels that are stuck, on a skin that states its noise"
    )
    phi: str = setting(
        ANNOUNCED,
        "measurement matrix: announced (what the compressor says), a kind or module:Class",
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
                f"resultant: is not told with solver {chosen['solver']}, whose frames are biased; "
                f"allowed: {', '.join(RESULTANT_SOLVERS)}"
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
        """The preset with what is stated beside it."""
        stated = {
            "solver": self.solver,
            "basis": self.basis,
            "iterations": self.iterations,
            "lambda_n": self.lambda_n,
        }
        preset = PRESETS[self.preset]
        if self.solver not in (None, preset["solver"]):
            # A preset's numbers belong to its solver; another one has settings of its own.
            preset = {"basis": preset["basis"]}
        return preset | {k: v for k, v in stated.items() if v is not None}
