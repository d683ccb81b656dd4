"""Errors of nodes; the text of each is one sentence for the user."""

from sparseskin.messages.text import printable, without_users


class SparseskinError(Exception):
    """An error that a user can correct: the text names the place, the fault and what is allowed.

    Each argument is a line. What files and devices put into it is made printable; users and
    passwords of addresses are left out.
    """

    def __str__(self) -> str:
        # Here, so that no place that raises or shows an error can leave it out.
        lines = [without_users(str(line)) for line in self.args]
        return "\n".join(map(printable, lines))


def counted(n: int, noun: str) -> str:
    """A number of things for a sentence: "1 frame", "2 frames"."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def not_installed(package: str, extra: str) -> str:
    """The fault that a package is missing, and the command that installs it: that of an extra."""
    return f"{package} is not installed: pip install 'sparseskin[{extra}]'"


class SettingsError(SparseskinError):
    """A setting is unknown, of the wrong type or out of its range."""


class SourceError(SparseskinError):
    """A sensor source (scene, file or driver) is missing, malformed or delivered a bad frame."""


class NotHereError(SourceError):
    """A device, or the package that opens it, is not on this host; it may be on another."""


class PhiError(SparseskinError):
    """A measurement matrix cannot be made as asked."""


class SolverError(SparseskinError):
    """A solver or a basis cannot be made as asked."""


class RefusedError(SparseskinError):
    """A message that a node cannot use: it is counted and dropped, and the node continues."""
