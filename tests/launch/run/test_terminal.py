"""The launcher's terminal: keys, log lines above a status, and output that is no terminal."""

import io
import os
import sys
import termios
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.launch.run import terminal as terminals
from sparseskin.launch.run.terminal import Terminal, _fitted

NOW_S = 1_700_000_000.125


class Screen(io.StringIO):
    """A stderr that is a terminal, or none."""

    def __init__(self, is_terminal):
        super().__init__()
        self._is_terminal = is_terminal

    def isatty(self):
        return self._is_terminal


@pytest.fixture
def keyboard(monkeypatch):
    """The end of a terminal at which a test types; the program reads at the other one."""
    controller, terminal = os.openpty()
    with os.fdopen(terminal, "rb", buffering=0) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield controller
    os.close(controller)


def typed(controller, text):
    """Keys that a launcher reads once a text was typed."""
    terminal = Terminal()
    with terminal.keyboard(True):
        os.write(controller, text)
        return terminal.pressed() + terminal.pressed()


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (b"q", ["q"]),
        (b"pq ", ["p", "q", " "]),
        (b"\x1b[A\x1b[B\x1b[C\x1b[D", ["up", "down", "right", "left"]),
        (b"a\x1b[Cb", ["a", "right", "b"]),
        (b"\n", ["\n"]),
        (b"", []),
    ],
)
def test_each_key_is_read_at_once_and_once(keyboard, text, keys):
    assert typed(keyboard, text) == keys


def test_keys_are_read_only_within_their_block_and_the_mode_is_restored(keyboard):
    mode = termios.tcgetattr(sys.stdin)
    terminal = Terminal()
    with terminal.keyboard(True):
        assert termios.tcgetattr(sys.stdin) != mode
    assert termios.tcgetattr(sys.stdin) == mode
    os.write(keyboard, b"q\n")
    assert terminal.pressed() == []
    with terminal.keyboard(False):
        assert terminal.pressed() == []


def test_without_a_terminal_there_are_no_keys(monkeypatch):
    monkeypatch.setattr(sys, "stdin", io.StringIO("q"))
    terminal = Terminal()
    with terminal.keyboard(True):
        assert terminal.pressed() == []


def stood(monkeypatch, is_terminal, **size):
    """A terminal on a screen of a size, under a clock that a test sets."""
    screen = Screen(is_terminal)
    monkeypatch.setattr(sys, "stderr", screen)
    clock = SimpleNamespace(now_s=100.0, time=lambda: NOW_S)
    clock.monotonic = lambda: clock.now_s
    monkeypatch.setattr(terminals, "time", clock)
    for name, value in size.items():
        monkeypatch.setenv(name, str(value))
    return Terminal(now_s=lambda: NOW_S), screen, clock


def test_where_the_output_is_no_terminal_the_status_comes_each_ten_seconds(monkeypatch):
    terminal, screen, clock = stood(monkeypatch, False)
    for now_s in range(100, 131):
        clock.now_s = float(now_s)
        terminal.status(f"at {now_s}")
    assert screen.getvalue() == "at 110\nat 120\nat 130\n"
    clock.now_s = 150.0
    terminal.status("")
    assert screen.getvalue().count("\n") == 3


def test_a_log_line_comes_above_the_status(monkeypatch):
    terminal, screen, _ = stood(monkeypatch, True, COLUMNS=40, LINES=10)
    terminal.log("first")
    assert "\x1b" not in screen.getvalue()
    terminal.status("busy")
    terminal.log("second")
    before, after = screen.getvalue().split("\r\x1b[J")
    assert before.endswith("busy")
    assert after.splitlines()[0].endswith(" second")
    assert after.splitlines()[1] == "busy"


@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_all_lines_of_a_status_are_erased(monkeypatch, n):
    terminal, screen, _ = stood(monkeypatch, True, COLUMNS=40, LINES=10)
    terminal.status("\n".join(f"line {k}" for k in range(n)))
    drawn = len(screen.getvalue())
    terminal.status("")
    up = f"\x1b[{n - 1}A" if n > 1 else ""
    assert screen.getvalue()[drawn:] == f"\r{up}\x1b[J"


def test_a_status_leaves_one_line_of_the_screen_and_one_column_free(monkeypatch):
    terminal, screen, _ = stood(monkeypatch, True, COLUMNS=8, LINES=4)
    terminal.status("\n".join("x" * 20 for _ in range(9)))
    assert screen.getvalue() == "\n".join(["x" * 7] * 3)


class Closed(Screen):
    """A stderr that another program has closed."""

    def write(self, text):
        raise BrokenPipeError


def test_a_graph_goes_on_where_nobody_reads_its_output(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Closed(True))
    terminal = Terminal()
    terminal.log("one")
    screen = Screen(True)
    monkeypatch.setattr(sys, "stderr", screen)
    terminal.log("two")
    assert screen.getvalue() == ""
    monkeypatch.setattr(sys, "stderr", None)
    nowhere = Terminal()
    nowhere.log("three")
    nowhere.status("busy")


PARTS = st.lists(st.text("ab ", min_size=1, max_size=9), min_size=1, max_size=6)


@given(parts=PARTS, width=st.integers(1, 60))
def test_as_many_parts_of_a_line_are_shown_as_fit(parts, width):
    line = " | ".join(parts)
    shown = _fitted(line, width)
    assert len(shown) <= width
    fitting = [
        k for k in range(1, len(parts) + 1) if len(" | ".join(parts[:k])) <= width
    ]
    if fitting:
        assert shown == " | ".join(parts[: fitting[-1]])
    else:
        assert shown == parts[0][:width]
