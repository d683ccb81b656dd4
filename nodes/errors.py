"""Errors of nodes; the text of each is one sentence for the user."""


class SparseskinError(Exception):
    """An error that a user can correct: the text names the place, the fault and what is allowed."""


class SettingsError(SparseskinError):
    """A setting is unknown, of the wrong type or out of its range."""


class SourceError(SparseskinError):
    """A sensor source (scene, file or driver) is missing, malformed or delivered a bad frame."""


class PhiError(SparseskinError):
    """A measurement matrix cannot be made as asked."""


class SolverError(SparseskinError):
    """A solver or a basis cannot be made as asked."""


class RefusedError(SparseskinError):
    """A message that a node cannot use: it is counted and dropped, and the node continues."""
