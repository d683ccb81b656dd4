"""The command `sparseskin`: its commands by name, each imported when it is named."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any, NoReturn

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SparseskinError

EXIT_USAGE = 2

_HERE = "sparseskin.launch.commands"
COMMANDS = {
    "launch": (f"{_HERE}.launch:configure", "start a graph of nodes from a launch file"),
    "keys": (
        f"{_HERE}.keys:configure",
        "make keys, so that only your hosts read and write a graph",
    ),
    "monitor": (f"{_HERE}.beside:configure_monitor", "watch a running graph"),
    "node": (f"{_HERE}.node:configure", "list the nodes of a running graph, describe one"),
    "param": (
        f"{_HERE}.node:configure_param",
        "list, get and set the settings of a running graph's nodes",
    ),
    "topic": (
        f"{_HERE}.topic:configure",
        "list the topics of a running graph, print and measure the messages of one",
    ),
    "record": (f"{_HERE}.beside:configure_record", "record topics of a running graph"),
    "play": (f"{_HERE}.beside:configure_play", "play a recording"),
    "bag": (f"{_HERE}.bag:configure", "look into a recording, repair it, convert it"),
    "reprocess": (f"{_HERE}.reprocess:configure", "put recordings through other settings, offline"),
    "learn-basis": (f"{_HERE}.learn_basis:configure", "learn a basis from a recording"),
    "scenes": (f"{_HERE}.scenes:configure", "list the scenes, make short recordings of them"),
    "study": ("sparseskin.studies.command:configure", "compute tables and charts anew"),
    "completion": (
        f"{_HERE}.completion:configure",
        "print a script that completes words in a shell",
    ),
}
"""Of each command the function that adds its arguments to a parser, as "module:function", and one
line of help.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = sys.argv[1:] if argv is None else argv
    arguments = make_parser(words).parse_args(words)
    try:
        return int(arguments.run(arguments))
    except SparseskinError as error:
        print(error, file=sys.stderr)
    return EXIT_USAGE


def make_parser(words: Sequence[str]) -> argparse.ArgumentParser:
    """The parser of a command line; only the command that is named there has its arguments."""
    parser = _Parser(prog="sparseskin", description="Compressed sensing for robot tactile skins.")
    parser.add_argument("--version", action=_Version, nargs=0, help="print the version")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    named = next((word for word in words if not word.startswith("-")), None)
    for name, (target, about) in COMMANDS.items():
        command = commands.add_parser(name, help=about)
        if name == named:
            module, _, function = target.partition(":")
            configure: Callable[[argparse.ArgumentParser], None]
            configure = getattr(import_module(module), function)
            configure(command)
    return parser


class _Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, as all commands do; its subparsers are of this class."""

    def error(self, message: str) -> NoReturn:
        self.exit(EXIT_USAGE, f"{self.prog}: {printable(message)} (see {self.prog} --help)\n")


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        from importlib.metadata import version

        print(f"sparseskin {version('sparseskin')}")
        parser.exit()


def complete() -> NoReturn:
    """Print what the word under the cursor of a shell can become, as argcomplete asks for it."""
    import argcomplete

    from .completion import candidates

    line, point = os.environ.get("COMP_LINE", ""), os.environ.get("COMP_POINT", "")
    typed = line[: int(point)] if point.isdecimal() else line
    parser = make_parser(typed.split()[1:])
    argcomplete.autocomplete(
        parser,
        always_complete_options=False,
        default_completer=candidates,  # type: ignore[arg-type]
    )
    sys.exit(1)  # the environment was not one of argcomplete: it has returned
