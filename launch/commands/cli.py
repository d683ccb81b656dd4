"""The command `sparseskin`: its commands by name, each imported when it is named."""

from __future__ import annotations

import argparse
import os
import re
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any, NoReturn

from sparseskin.messages.text import printable
from sparseskin.nodes import extensions
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.lookup import nearest_of, one_line, suggestion

EXIT_USAGE = 2

COMMANDS = {
    "launch": (".launch", "start a graph of nodes from a launch file"),
    "keys": (".launch", "make keys, so that only your hosts read and write a graph"),
    "graph": (".graph", "list the running graphs"),
    "stop": (".graph", "end a running graph"),
    "monitor": (".observers", "watch a running graph"),
    "node": (".graph", "list the nodes of a running graph, describe one"),
    "param": (".graph", "list, get and set the settings of a running graph's nodes"),
    "topic": (".topic", "list the topics of a running graph, print and measure their messages"),
    "record": (".observers", "record topics of a running graph"),
    "play": (".play", "play a recording"),
    "bag": (".bag", "look into a recording, repair it, convert it"),
    "reprocess": (".reprocess", "put recordings through other settings, offline"),
    "sources": (".sources", "list what a sensor of this host can read"),
    "scope": (".sources", "show the frames of a source in the terminal"),
    "calibrate": (".calibrate", "make the file of a skin: from counts to newtons"),
    "tare": (".calibrate", "take the readings of the untouched skin of a running graph for zero"),
    "scenes": (".play", "list the scenes, make short recordings of them"),
    "study": ("sparseskin.studies.command", "compute tables and charts anew"),
    "completion": (".completion", "print the completion script of a shell"),
    "help": (".cli", "describe a command"),
}
"""Of each command the module that adds its arguments to a parser, by `configure_COMMAND` or
`configure`, and one line of help.
"""


def plugins() -> list[str]:
    """Commands of plug-ins; none replaces a command of `COMMANDS`."""
    return [*extensions.added(extensions.COMMANDS, COMMANDS)]


def about(name: str) -> str:
    """One line of help of a command; of a plug-in that cannot be imported, the reason."""
    if name in COMMANDS:
        return COMMANDS[name][1]
    try:
        return str(extensions.load(extensions.COMMANDS, name, SparseskinError).HELP)
    except (SparseskinError, AttributeError) as error:
        return printable(f"cannot be used: {error}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    words = sys.argv[1:] if argv is None else argv
    try:
        arguments = make_parser(words).parse_args(words)
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
    # Where one of the core is named, no other is listed.
    for name in COMMANDS if named in COMMANDS else (*COMMANDS, *plugins()):
        # argparse takes a percent sign of the help for a format.
        command = commands.add_parser(name, help=about(name).replace("%", "%%"))
        if name == named:
            _configure(name, command)
    return parser


def _configure(name: str, parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a command to its parser."""
    if name in COMMANDS:
        module = import_module(COMMANDS[name][0], __package__)
        (getattr(module, f"configure_{name}", None) or module.configure)(parser)
        return
    plugin = extensions.load(extensions.COMMANDS, name, SparseskinError)
    try:
        plugin.configure(parser)
    except SparseskinError:
        raise
    except Exception as error:  # a plug-in may raise anything
        raise SparseskinError(f"{name}: plug-in {plugin.__name__}: {one_line(error)}") from error


def configure_help(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `help`."""
    parser.description = "Describe a command, as its --help does."
    words = parser.add_argument(
        "words", metavar="COMMAND", nargs="*", help="as launch, or bag info"
    )
    words.completer = _commands  # type: ignore[attr-defined]
    parser.set_defaults(run=_help)


def _commands(*, prefix: str, parsed_args: argparse.Namespace, **_: Any) -> dict[str, str]:
    """Commands that begin with what has been typed, and their lines of help."""
    if parsed_args.words:
        return {}
    return {name: about(name) for name in (*COMMANDS, *plugins()) if name.startswith(prefix)}


def _help(arguments: argparse.Namespace) -> NoReturn:
    words = [*arguments.words, "--help"]
    make_parser(words).parse_args(words)
    raise AssertionError("--help has ended the program")


class _Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, as all commands do, with the nearest allowed word, and
    takes no abbreviated option. Its subparsers are of this class.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)

    def parse_known_args(self, *given: Any, **more: Any) -> Any:
        """Refuse unknown words here, where the command that they belong to is known."""
        namespace, unknown = super().parse_known_args(*given, **more)
        if unknown:
            options = [word for word in unknown if word.startswith("-")]
            if options:  # what else is unknown may be the value of one
                known = {*_OPTION.findall(self.format_usage()), "--help"}
                hint = suggestion(options[0].partition("=")[0], known)
                self.error(f"unrecognized arguments: {options[0]}{hint}")
            self.error(f"unrecognized arguments: {' '.join(unknown)}")
        return namespace, unknown

    def error(self, message: str) -> NoReturn:
        if refused := _CHOICE.fullmatch(message):
            place, word, allowed = refused.groups()
            hint = nearest_of(word, [one.strip("'") for one in allowed.split(", ")])
            message = f"{place}: invalid choice: '{word}'{hint}"
        self.exit(EXIT_USAGE, f"{self.prog}: {printable(message)} (see {self.prog} --help)\n")


_OPTION = re.compile(r"(?<![\w-])--[a-z][\w-]*")
_CHOICE = re.compile(r"(argument .+): invalid choice: '(.*)' \(choose from (.*)\)", re.DOTALL)
"""The message of argparse for a word that is not among those allowed."""


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
