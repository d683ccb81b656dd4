"""Text of others on its way to a terminal or a log file."""

import re

# Of an address "tcp://user:password@host", and of a path that has lost one of its two slashes.
_USER = re.compile(r"(://)\S*@|(:/)[^\s/@:]+:[^\s@]+@")


def printable(text: str) -> str:
    """The text as one line that moves no cursor, sets no colour and hides no order of characters.

    White space of any kind becomes a space; control characters (ESC, BEL, C1), bidirectional and
    other invisible ones are written as in Python, e.g. \\x1b.
    """
    # Nearly every text: a test in C.
    if text.isprintable():
        return text
    return "".join(map(_printable_character, text))


def _printable_character(character: str) -> str:
    if character.isprintable():
        return character
    if character.isspace():
        return " "
    return ascii(character)[1:-1]


def without_users(text: str) -> str:
    """The text without the users and passwords of its addresses, and of paths made of such."""
    return _USER.sub(lambda match: f"{match[1] or match[2]}***@", text)
