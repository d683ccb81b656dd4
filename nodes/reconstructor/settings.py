"""Settings of the reconstructor node, and its presets."""

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Self

from sparseskin.messages.ranges import is_real
from sparseskin.nodes.compressor.phi.base import is_built_in, phi_class, phi_fact
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import nearest_of
from sparseskin.nodes.numerics.compiled import FAST, check_fast
from sparseskin.nodes.reconstructor.bases.base import BASES, find_basis
from sparseskin.nodes.reconstructor.solvers.base import (
    SOLVERS,
    check_reads,
    solver_class,
    solver_fact,
)
from sparseskin.nodes.settings import PatchesSettings, naming, setting

from .contacts import Limits

ANNOUNCED = "announced"
#: Parameters of a solver that are no options: the node gives them, they have settings, or they are
#: no number, text or truth value.
_NO_OPTIONS = (
    *("phi", "basis", "mask", "fast", "rows", "tuning"),
    *("solver", "iterations", "lambda_n"),
)
#: Named sets of settings. "paper": exactly the method of the paper, sections IV and V-A, for a
#: "sbhe" phi with orthonormal rows "paper"; lambda_n is its 0.1 on rows of +1 and -1. "skin":
#: the most accurate one; it estimates noise and threshold from the measurements.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "solver": "fista",
        "basis": "haar",
        "iterations": 30,
        "lambda_n": 0.003125,
    },
    "skin": {"solver": "skin", "basis": "haar"},
}

_OF_PRESET = ("solver", "basis", "iterations", "lambda_n")
"""Settings that are stated in place of those of a preset."""
CONTACT_KEYS = (
    *("contact_force", "contact_area", "contact_low", "contact_high"),
    *("contact_over", "contact_slide"),
)
"""Settings that change contacts alone, and no solver."""


@dataclass(frozen=True)
class ReconstructorSettings(PatchesSettings):
    """Settings of the reconstructor node."""

    preset: str = setting(
        "skin",
        f"named set of the settings below: {', '.join(PRESETS)}",
        known=PRESETS,
        live=True,
        decides=True,
    )
    solver: str | None = setting(
        None,
        "solver, in place of the preset's; or module:Class",
        known=SOLVERS,
        live=True,
        decides=True,
    )
    basis: str | None = setting(
        None,
        "basis Psi, in place of the preset's; or module:Class",
        known=BASES,
        live=True,
    )
    iterations: int | None = setting(
        None,
        "iterations a frame, in place of the preset's or of what the budget allows",
        low=1,
        high=1000,
        live=True,
    )
    lambda_n: float | None = setting(
        None,
        "weight of the l1 norm in place of the preset's, in newtons for orthonormal rows and a "
        "range of 2.5 N; scaled with the range of the skin",
        low=0.0,
        high=1e6,
        live=True,
    )
    options: dict[str, Any] | None = setting(
        None,
        "further parameters of the solver, by name; those here have none, one of your own may",
        live=True,
    )
    budget_ms: float | None = setting(
        None,
        "time of a frame, in milliseconds, that the number of iterations is chosen for: more where "
        "fewer taxels are pressed; default: half the time between frames, for solver skin alone",
        low=0.05,
        high=60_000.0,
        live=True,
    )
    depth: int | None = setting(
        None,
        "most measurements that may wait: older ones are skipped and counted, so that no old frame "
        "is reconstructed; 0: every frame is reconstructed; not stated: 1 where a clock sets the "
        "pace (a board, a driver, a scene), 0 for recordings. Nothing is skipped where the source "
        "waits for its readers",
        low=0,
        high=1000,
        live=True,
    )
    uncertainty: bool = setting(
        False, "publish a standard deviation with each force; twice as many bytes"
    )
    contacts: bool = setting(
        False, "publish the contacts of each frame, followed by their ids"
    )
    contact_force: float = setting(
        0.0,
        "least total force of a contact, in the skin's unit; it ends below half of that",
        low=0.0,
        high=1e9,
        live=True,
    )
    contact_area: int = setting(
        1,
        "least number of taxels of a contact when it begins",
        low=1,
        high=2**20,
        live=True,
    )
    contact_low: float = setting(
        Limits.low,
        "threshold of the taxels of a contact, in units of their error: of the estimated one, at "
        "least the stated noise, or 0.4 % of the range where none is stated",
        low=0.0,
        high=1e6,
        live=True,
    )
    contact_high: float = setting(
        Limits.high,
        "threshold, in the same units, that one taxel of a contact exceeds in two frames in a row, "
        "or twice as much in one, when it begins",
        low=0.0,
        high=1e6,
        live=True,
    )
    contact_over: float | None = setting(
        None,
        "total force above which a contact is reported by an event, in the skin's unit; again once "
        "it was below half of that",
        low=0.0,
        high=1e9,
        live=True,
    )
    contact_slide: float | None = setting(
        None,
        "speed of its centre above which a contact is reported as sliding, in mm/s, or in taxels/s "
        "where no pitch is known; again once it was below half of that",
        low=0.0,
        high=1e6,
        live=True,
    )
    skip_idle: bool = setting(
        False,
        "publish the frame of a patch as unchanged, without solving it, where its measurements "
        "changed by no more than the skin's stated noise explains",
        live=True,
    )
    watch_rows: bool = setting(
        True,
        "give no weight to measurements that repeat alone, on a skin with noise; subtract an "
        "offset of all, where the noise is stated",
    )
    fast: str = setting(
        "auto",
        "compiled loops: auto (where numba is installed), on or off; the same but for rounding",
        choices=FAST,
    )
    phi: str = setting(
        ANNOUNCED,
        "kind of the measurement matrix, where it is not built in: module:Class or file:PATH, as "
        "of the compressor, which announces the rest",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.uncertainty and (self.n_patches > 1 or self.skip_idle):
            raise SettingsError(
                "uncertainty: is not available with several patches or skip_idle"
            )
        if self.contact_high < self.contact_low:
            raise SettingsError(
                f"contact_high: {self.contact_high:g} is below contact_low = {self.contact_low:g}"
            )

    @property
    def limits(self) -> Limits:
        """What counts as a contact, and as an event."""
        limits = Limits(
            low=self.contact_low,
            high=self.contact_high,
            force=self.contact_force,
            area=self.contact_area,
        )
        if self.contact_over is not None:
            limits = replace(limits, over=self.contact_over)
        if self.contact_slide is not None:
            limits = replace(limits, slide=self.contact_slide)
        return limits

    @property
    def solver_class(self) -> Callable[..., Any]:
        """Class of the solver in force. Raises SolverError if there is none."""
        return solver_class(self.chosen()["solver"])

    def check(self) -> None:
        check_fast(self.fast)
        if self.phi != ANNOUNCED:
            with naming("phi"):
                phi_class(self.phi)
        if self.preset not in PRESETS:
            hint = nearest_of(self.preset, PRESETS)
            raise SettingsError(f"preset: '{self.preset}' is not known{hint}")
        in_force = self.chosen()
        name = in_force["solver"]
        with naming("basis"):
            find_basis(in_force["basis"])
        with naming("solver"):
            solver = solver_class(name)
        self._check_known_to(name, solver)
        if self.uncertainty and solver_fact(solver, "calibrated") is None:
            fault = f"is not available with solver {name}, whose error is not known"
            calibrated = [
                solver_name
                for solver_name in SOLVERS
                if solver_fact(solver_class(solver_name), "calibrated")
            ]
            allowed = ", ".join(calibrated)
            raise SettingsError(f"uncertainty: {fault}; allowed: {allowed}")

    def _check_known_to(self, name: str, solver: Callable[..., Any]) -> None:
        parameters = inspect.signature(solver).parameters
        takes_any = any(p.kind is p.VAR_KEYWORD for p in parameters.values())
        for key in ("iterations", "lambda_n"):
            is_unknown = key not in parameters and not takes_any
            if is_unknown and getattr(self, key) is not None:
                raise SettingsError(
                    f"{key}: solver {name} has none; allowed: to leave it out, "
                    "or a solver that has it (preset paper)"
                )
        names = []
        for key, parameter in parameters.items():
            if key not in _NO_OPTIONS and parameter.kind is not parameter.VAR_KEYWORD:
                names.append(key)
        self._check_options(name, names, takes_any)

    def _check_options(self, name: str, options: list[str], takes_any: bool) -> None:
        """Raise SettingsError for an option that a solver, by name, does not take."""
        for key, value in (self.options or {}).items():
            if key in ("iterations", "lambda_n"):
                raise SettingsError(
                    f"options.{key}: is a setting of its own; allowed: {key}"
                )
            is_unknown = key not in options and not takes_any
            if key in _NO_OPTIONS or is_unknown:
                allowed = "; it has none beside the settings iterations and lambda_n"
                if options:
                    allowed = nearest_of(key, options)
                raise SettingsError(
                    f"options.{key}: is no option of solver {name}{allowed}"
                )
            if not (isinstance(value, str | bool) or is_real(value)):
                raise SettingsError(
                    f"options.{key}: {value!r} is not allowed; allowed: a finite number, a text, "
                    "true or false"
                )

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """As in `Settings`; a preset replaces what was stated in place of an earlier one's."""
        if "preset" in changes:
            of_preset = dict.fromkeys((*_OF_PRESET, "options"))
            changes = {**of_preset, **changes}
        return super().changed(changes)

    def check_phi(self, kind: str) -> None:
        """Check that measurements by an announced kind of phi can be reconstructed.
        Raises SettingsError.
        """
        kind = self.kind_of(kind)
        # Nothing that is named over the wire is ever imported.
        if self.phi == ANNOUNCED and not is_built_in(kind):
            raise SettingsError(
                f"phi: the compressor's '{kind}' is not built in, and is not imported because a "
                f"message names it; state phi = '{kind}' here too"
            )
        solver_name = self.chosen()["solver"]
        solver = self.solver_class
        phi = phi_class(kind)
        # A function that makes a Phi shows what it is only once it is called.
        if isinstance(phi, type):
            with naming("solver"):
                check_reads(solver_name, solver, kind, phi)
            if self.uncertainty and phi_fact(phi, "choice"):
                raise SettingsError(
                    f"uncertainty: is not available with phi {kind}, whose rows change "
                    "each frame; allowed: sbhe"
                )

    def kind_of(self, announced: str) -> str:
        """The kind of phi that is made: the stated one, or that which the compressor announces."""
        return announced if self.phi == ANNOUNCED else self.phi

    def chosen(self) -> dict[str, Any]:
        """Return the preset with the settings that are stated in place of its own."""
        preset = PRESETS[self.preset]
        # The numbers of a preset belong to its solver.
        if self.solver not in (None, preset["solver"]):
            preset = {"basis": preset["basis"]}
        settings = {**(self.options or {}), **preset}
        for key in _OF_PRESET:
            stated = getattr(self, key)
            if stated is not None:
                settings[key] = stated
        return settings


def alike_but_for_contacts(
    settings: ReconstructorSettings, others: ReconstructorSettings
) -> bool:
    """True if settings differ in `CONTACT_KEYS` at most."""
    of_contacts = {key: getattr(others, key) for key in CONTACT_KEYS}
    return replace(settings, **of_contacts) == others
