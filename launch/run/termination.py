"""SIGTERM as an exception that ends the command."""

import signal
from types import FrameType


class Terminated(KeyboardInterrupt):
    """SIGTERM has come. CPython's compiler discards exceptions that signal handlers raise while it
    folds constants, but none of this kind; nor is it an `Exception` that a library would catch.
    """

    exit_code = 128 + signal.SIGTERM


class _Termination:
    """`has_come` stays True where the exception was lost, as in a destructor."""

    has_come = False

    def handle(self, number: int, _frame: FrameType | None) -> None:
        """Handler of SIGTERM; the exception ends workers and removes unfinished files."""
        # The command timeout sends it twice.
        signal.signal(number, signal.SIG_IGN)
        self.has_come = True
        raise Terminated

    def check(self) -> None:
        """Raise again what was lost; called before a part that handles SIGTERM by itself."""
        if self.has_come:
            raise Terminated


TERMINATION = _Termination()
