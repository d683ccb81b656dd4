"""Text of others on its way to a terminal or a log file."""

import re

_USER = re.compile(r"(://)\S*@|(:/)[^\s/@:]+:[^\s@]+@")


def printable(text: str) -> str:
    """The text as one line that moves no cursor, sets no colour and hides no order of characters.

    White space of any kind becomes a space; control characters (ESC, BEL, C1), bidirectional and
    other invisible ones are written as in Python, e.g. \\x1b.
    """
    if text.isprintable():
        return text
    return "".join(
        char if char.isprintable() else " " if char.isspace() else ascii(char)[1:-1]
        for char in text
    )


def without_users(text: str) -> str:
    """The text without the users and passwords of its addresses, and of paths made of such."""
    return _USER.sub(lambda found: f"{found[1] or found[2]}***@", text)
