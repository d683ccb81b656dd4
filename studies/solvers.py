"""Which of the project's solvers studies compare on the same measurements."""

from __future__ import annotations

from sparseskin.nodes.errors import SolverError
from sparseskin.nodes.lookup import find_class
from sparseskin.nodes.reconstructor.solver import SOLVERS


def _follows_choice(name: str) -> bool:
    """Whether a solver needs a phi which chooses its taxels anew in each frame."""
    return bool(getattr(find_class("solver", name, SOLVERS, SolverError), "follows_choice", False))


SUM_SOLVERS = tuple(name for name in SOLVERS if not _follows_choice(name))
