"""Text of messages and files in lines for a person."""

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SparseskinError


@given(st.text())
@example("".join(map(chr, range(0x110000))))
def test_every_text_becomes_one_printable_line_and_stays_it(text):
    shown = printable(text)
    assert shown.isprintable()
    assert printable(shown) == shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("\x1b]0;owned\x07", r"\x1b]0;owned\x07"),
        ("a\r\nb\tc", "a  b c"),
        ("\x9b31m", r"\x9b31m"),
        ("\u202eevil\u2066", r"\u202eevil\u2066"),
        ("\u2028a\u200b", r" a\u200b"),
        ("\ud800 \U000e0001", r"\ud800 \U000e0001"),
    ],
)
def test_what_would_act_on_a_terminal_is_spelt_out(text, shown):
    assert printable(text) == shown


def test_an_error_names_what_a_file_holds_without_acting_it_out():
    assert str(SparseskinError("a\x1b[2J\nb", "c\x07")) == "a\\x1b[2J b\nc\\x07"
