"""Keys of a layout in an error about a source, spelled as the words that state them."""

import re
from collections.abc import Callable

from sparseskin.nodes.sensor.layout.checks import spelled
from sparseskin.nodes.sensor.layout.layout import KEYS, Layout

_TO_STATE = re.compile(r"\b(?:state|set) [^;]*")
"""The part of an error that says what has to be stated."""
_KEY = re.compile(rf"(?<!a )(?<!the )(?<!no )(?<![\w,'-])({'|'.join(KEYS)})\b(=?)")
"""A key there, rather than the word of a sentence ("a field", "the unit") or a part of another."""
_NUMBERS = {
    entry["key"]
    for entry in Layout.described()
    if entry["type"].startswith(("int", "float"))
}


def as_words(text: str, word_of: Callable[[str], str]) -> str:
    """An error in which the keys that are to be stated are words of a command line.

    `word_of` returns what stands before the value of a key: "--n-rows ", or
    "--set sensor.n_rows=", behind which N or TEXT stands where the error names no value.
    """

    def word(match: re.Match[str]) -> str:
        key, equals = match.groups()
        begin = word_of(key)
        if equals:
            return begin
        if not begin.endswith("="):
            return begin.rstrip()
        # "--set unit=" alone would be read as an empty value.
        if key in _NUMBERS:
            return f"{begin}N"
        return f"{begin}TEXT"

    def clause(match: re.Match[str]) -> str:
        return _KEY.sub(word, match[0])

    # Keys behind "add" come last: what stands there then is spelled already.
    return spelled(_TO_STATE.sub(clause, text), word_of)
