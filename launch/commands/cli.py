"""The command `sparseskin`: its commands by name, each imported when it is named."""

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

from .options import RARE

EXIT_USAGE = 2

RUN = "Run"
LOOK = "Look"
DATA = "Data"
BUILD = "Build a skin"
MORE = "More"
OTHERS = "Plug-ins"
"""Groups of commands; `MORE` are rarely used, `OTHERS` of plug-ins that state no `GROUP`."""
COMMANDS = {
    "launch": (
        RUN,
        ".launch",
        "start a graph of nodes, watch it, print what was measured",
    ),
    "play": (RUN, ".play", "play a recording, on the live page too"),
    "scenes": (RUN, ".play", "list the graphs that launch knows by name"),
    "stop": (RUN, ".graph", "end a running graph"),
    "monitor": (
        LOOK,
        ".observers",
        "watch a running graph on the live page or in the terminal",
    ),
    "topic": (
        LOOK,
        ".topic",
        "list, print and measure the messages of a running graph",
    ),
    "node": (LOOK, ".graph", "list and describe the nodes of a running graph"),
    "param": (LOOK, ".graph", "list, get and set the settings of a running graph"),
    "sources": (LOOK, ".sources", "list what a sensor of this host can read"),
    "scope": (LOOK, ".sources", "show the frames of a source in the terminal"),
    "record": (DATA, ".observers", "record topics of a running graph"),
    "recording": (DATA, ".bag", "look into a recording, repair it, convert it"),
    "calibrate": (
        BUILD,
        ".calibrate",
        "make the file of a skin: from counts to newtons",
    ),
    "tare": (BUILD, ".calibrate", "make the readings of an untouched skin its zero"),
    "graph": (MORE, ".graph", "list the graphs that run on this host"),
    "keys": (
        MORE,
        ".launch",
        "make keys, so that only your hosts read and write a graph",
    ),
    "reprocess": (MORE, ".reprocess", "put recordings through other settings, offline"),
    "study": (MORE, "sparseskin.studies.command", "compute tables and charts anew"),
    "completion": (MORE, ".completion", "print the completion script of a shell"),
}
"""Of each command its group, the module that adds its arguments to a parser, by `configure_COMMAND`
or `configure`, and one line of help.
"""


def plugins() -> list[str]:
    """Commands of plug-ins; none replaces a command of `COMMANDS`."""
    return [*extensions.added(extensions.COMMANDS, COMMANDS)]


def about(name: str) -> tuple[str, str]:
    """Group of a command, and one line of help: the reason, if a plug-in cannot be imported."""
    if name in COMMANDS:
        group, _, line = COMMANDS[name]
        return group, line
    try:
        plugin = extensions.load(extensions.COMMANDS, name, SparseskinError)
        return str(getattr(plugin, "GROUP", OTHERS)), str(plugin.HELP)
    except (SparseskinError, AttributeError) as error:
        return OTHERS, printable(f"cannot be used: {error}")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    # `sparseskin` alone prints help, and `sparseskin help X` that of X.
    if argv is None:
        argv = sys.argv[1:]
    words = list(argv) or ["--help"]
    if words[0] == "help":
        words = [*words[1:], "--help"]
    asks_for_help = "-h" in words or "--help" in words
    everything = "--all" in words and asks_for_help
    if everything:
        words.remove("--all")

    try:
        arguments = make_parser(words, everything).parse_args(words)
        return int(arguments.run(arguments))
    except SparseskinError as error:
        print(error, file=sys.stderr)
    return EXIT_USAGE


def make_parser(words: Sequence[str], everything: bool = True) -> "_Parser":
    """The parser of a command line; only the command that is named there has its arguments.
    Without `everything`, help leaves out what is rarely used.
    """
    # Options of the command follow its name.
    command_word = next((word for word in words if not word.startswith("-")), None)
    names = [*COMMANDS]
    if command_word not in COMMANDS:
        # Where one of the core is named, no other is listed.
        names += plugins()
    # The overview stands in place of the list of commands that argparse makes.
    parser = _Parser(
        prog="sparseskin",
        usage="sparseskin COMMAND ...",
        description="" if command_word else _overview(names, everything),
        formatter_class=argparse.RawDescriptionHelpFormatter,
        epilog="sparseskin COMMAND --help describes a command. With --all, help names commands\n"
        "and options that are rarely used, too.",
    )
    parser.add_argument(
        "--version",
        action=_Version,
        nargs=0,
        help="print the version",
    )
    commands = parser.add_subparsers(
        prog="sparseskin",
        metavar="COMMAND",
        help=argparse.SUPPRESS,
    )
    commands.required = True
    for name in names:
        # The others are names alone: their modules are not imported.
        command = commands.add_parser(name)
        if name == command_word:
            _configure(name, command)
            if not everything:
                command.hide_rare()
    return parser


def _overview(names: Sequence[str], everything: bool) -> str:
    """Commands in groups, a line each."""
    # In this order; a plug-in may add a group.
    order = (RUN, LOOK, DATA, BUILD, OTHERS, MORE)
    groups: dict[str, list[str]] = {group: [] for group in order}
    for name in names:
        group, line = about(name)
        groups.setdefault(group, []).append(f"  {name:<10}  {line}")

    parts = ["Compressed sensing for robot tactile skins."]
    for group, lines in groups.items():
        if lines and (everything or group != MORE):
            parts.append("\n".join([group, *lines]))
    return "\n\n".join(parts)


def _configure(name: str, parser: argparse.ArgumentParser) -> None:
    """Add the arguments of a command to its parser."""
    if name in COMMANDS:
        _, module_name, _ = COMMANDS[name]
        module = import_module(module_name, __package__)
        # A module may have several commands.
        configure = getattr(module, f"configure_{name}", None) or module.configure
        configure(parser)
        return

    plugin = extensions.load(extensions.COMMANDS, name, SparseskinError)
    try:
        plugin.configure(parser)
    except SparseskinError:
        raise
    except Exception as error:
        # A plug-in may raise anything.
        raise SparseskinError(
            f"{name}: plug-in {plugin.__name__}: {one_line(error)}"
        ) from error


class _Parser(argparse.ArgumentParser):
    """A parser that refuses in one line, as all commands do, with the nearest allowed word, and
    takes no abbreviated option. Its subparsers are of this class.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(**options, allow_abbrev=False)
        self._n_hidden = 0

    def hide_rare(self) -> None:
        """Leave options that are rarely used out of help, here and in the commands below."""
        for group in self._action_groups:
            if group.title != RARE:
                continue
            self._n_hidden = len(group._group_actions)
            for action in group._group_actions:
                action.help = argparse.SUPPRESS
        for action in self._actions:
            if isinstance(action, argparse._SubParsersAction):
                for parser in action.choices.values():
                    parser.hide_rare()

    def format_help(self) -> str:
        """Help, and how many options it leaves out."""
        # So that nobody takes the short help for the whole.
        text = super().format_help()
        if self._n_hidden:
            text += f"\n{self._n_hidden} more options: {self.prog} --help --all\n"
        return text

    def parse_known_args(self, *words: Any, **options: Any) -> Any:
        """Refuse unknown words here, where the command that they belong to is known."""
        # argparse itself would report them for the command `sparseskin`.
        namespace, unknown = super().parse_known_args(*words, **options)
        if not unknown:
            return namespace, unknown
        wrong_options = [word for word in unknown if word.startswith("-")]
        if wrong_options:
            # Words beside it that are unknown may be its value.
            allowed = {name for name in self._option_string_actions if name[:2] == "--"}
            hint = suggestion(wrong_options[0].partition("=")[0], allowed)
            self.error(f"unrecognized arguments: {wrong_options[0]}{hint}")
        self.error(f"unrecognized arguments: {' '.join(unknown)}")

    def error(self, message: str) -> NoReturn:
        # argparse lists all choices; the nearest one is of more use.
        refused = _CHOICE.fullmatch(message)
        if refused:
            place, word, listing = refused.groups()
            allowed = [choice.strip("'") for choice in listing.split(", ")]
            hint = nearest_of(word, allowed)
            message = f"{place}: invalid choice: '{word}'{hint}"
        self.exit(
            EXIT_USAGE, f"{self.prog}: {printable(message)} (see {self.prog} --help)\n"
        )


_CHOICE = re.compile(
    r"(argument .+): invalid choice: '(.*)' \(choose from (.*)\)", re.DOTALL
)
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

    line = os.environ.get("COMP_LINE", "")
    point = os.environ.get("COMP_POINT", "")
    # Only what stands before the cursor is completed.
    typed = line[: int(point)] if point.isdecimal() else line
    parser = make_parser(typed.split()[1:])
    argcomplete.autocomplete(
        parser,
        always_complete_options=False,
        default_completer=candidates,  # type: ignore[arg-type]
    )
    # The environment was not one of argcomplete: it has returned.
    sys.exit(1)
