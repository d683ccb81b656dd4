"""The errors that nodes raise; each one's message is a sentence fit for a user."""


class SparseskinError(Exception):
    """Something a person can mend: the text names the place, what is wrong and what is allowed."""


class SettingsError(SparseskinError):
    """A node's setting is unknown, of the wrong type or out of its range."""


class SourceError(SparseskinError):
    """A sensor source (scene, file or driver) is missing, malformed or delivered a bad frame."""


class PhiError(SparseskinError):
    """A measurement matrix cannot be made as asked."""


class SolverError(SparseskinError):
    """A solver or a basis cannot be made as asked."""


class RefusedError(SparseskinError):
    """A message that a node cannot use; it is counted and dropped, and the node goes on."""
