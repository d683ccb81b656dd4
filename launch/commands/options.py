"""Arguments that several commands share, and what they do with them."""

import argparse
import contextlib
import inspect
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.launch.attach.text import formatted, typed_value
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError, SparseskinError, counted
from sparseskin.nodes.files import (
    NO_FOLDER,
    NO_WRITING,
    OutputError,
    check_link,
    os_errors,
    overwrite,
)
from sparseskin.nodes.lookup import did_you_mean

if TYPE_CHECKING:
    from sparseskin.nodes.sensor.layout.layout import Layout

Run = Callable[[argparse.Namespace], int]


def add_commands(
    parser: argparse.ArgumentParser, description: str
) -> Callable[[str, Run, str], argparse.ArgumentParser]:
    """Give a command further commands; return the function that adds one, by its name, the function
    that runs it, whose docstring is its description, and its line of help.
    """
    parser.description = description
    kinds = parser.add_subparsers(required=True, metavar="COMMAND")

    def add(name: str, run: Run, about: str) -> argparse.ArgumentParser:
        command = kinds.add_parser(name, help=about, description=inspect.getdoc(run))
        command.set_defaults(run=run)
        return command

    return add


RARE = "rarely used options"
"""Title of the options that `--help` shows with `--all` alone."""


def rare(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """The group of the options of a command that are rarely used."""
    for group in parser._action_groups:
        if group.title == RARE:
            return group
    return parser.add_argument_group(RARE)


def add_graph(parser: argparse.ArgumentParser, document: str = "") -> None:
    """Add --graph, as all commands beside a running graph have it, and --json, if it prints one."""
    if document:
        parser.add_argument("--json", action="store_true", help=f"print {document}")
    rare(parser).add_argument(
        "--graph",
        metavar="NAME|PID",
        help="which graph, where several run on this host",
    )


def add_page(
    parser: argparse.ArgumentParser, about_open: str = "open the live page in a browser"
) -> None:
    """Add the options of the live page."""
    parser.add_argument("--open", action="store_true", help=about_open)
    rare(parser).add_argument(
        "--no-token",
        action="store_true",
        help="serve the live page to all users of this host, without a token",
    )


def add_rest(parser: argparse.ArgumentParser) -> None:
    """Add the options on what an untouched skin reads: `tare` and `invert`."""
    # Imported here, as of `add_layout`.
    from sparseskin.nodes.sensor.calibration.chain import MAX_TARE_FRAMES

    about = (
        "first frames, of the untouched skin, whose median is the reading at rest, and which are "
        "left out; 0: readings are forces, whatever the untouched skin reads"
    )
    parser.add_argument(
        "--tare", metavar="N", type=whole(0, MAX_TARE_FRAMES), help=about
    )
    about = "readings fall with force: a force is the reading at rest less the reading"
    rare(parser).add_argument(
        "--invert", choices=("true", "false"), default="false", help=about
    )


USUAL_KEYS = ("n_rows", "n_cols", "unit", "rate_hz", "columns", "time", "topic")
"""Keys of a layout whose options `--help` shows without `--all`."""


def add_layout(parser: argparse.ArgumentParser, but: Sequence[str] = ()) -> None:
    """Add an option for each key of `Layout`, spelled as the settings of the sensor, `but` some."""
    # Imported here: with it comes numpy, for which other commands need not wait.
    from sparseskin.nodes.sensor.layout.layout import Layout

    rarely_used = rare(parser)
    for entry in Layout.described():
        key = entry["key"]
        if key in but:
            continue
        # Options that few people need are left out of the short help.
        group: argparse._ActionsContainer = rarely_used
        if key in USUAL_KEYS:
            group = parser
        # The first clause is enough for a line of help.
        about = entry["doc"].partition(";")[0]
        group.add_argument(
            _option_of(key),
            default=None,
            help=about,
            **_kind_of(entry),
        )


def _option_of(key: str) -> str:
    """The option of a key of a layout."""
    return f"--{key.replace('_', '-')}"


def _kind_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of `add_argument` for the values of a described setting."""
    if entry["choices"]:
        return {"choices": [choice for choice in entry["choices"] if choice]}
    if entry["type"].startswith("int"):
        return {"metavar": "N", "type": whole(int(entry["low"]))}
    if entry["type"].startswith("float"):
        return {"metavar": "N", "type": real(above_0=True)}
    return {"metavar": "TEXT", "type": str}


def layout_of(arguments: argparse.Namespace) -> "Layout":
    """The layout that options state. Raises SettingsError, with the option, if a value is wrong."""
    from sparseskin.nodes.sensor.layout.layout import KEYS, Layout

    # A command may leave out some of the keys.
    stated = {}
    for key in KEYS:
        value = getattr(arguments, key, None)
        if value is not None:
            stated[key] = value
    try:
        return Layout(**stated)
    except SettingsError as error:
        key, colon, reason = str(error).partition(":")
        raise SettingsError(f"{_option_of(key)}{colon}{reason}") from error


def as_options(text: str) -> str:
    """A line on a file in which the keys of a layout that are to be stated are options."""
    from sparseskin.launch.launchfile.stated import as_words

    return as_words(text, lambda key: f"{_option_of(key)} ")


def bag_names(names: Sequence[str], out: str) -> list[str]:
    """Path of each bag that a command writes: `out`, or of its name in the folder `out`,
    which is made for several, or where `out` ends in "/".

    Raises SettingsError if two have the same name, `out` is a bag for several, or no bag for one;
    OutputError if the folder cannot be made.
    """
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX

    # One recording may have any name; several get theirs from the files.
    folder = Path(out)
    if len(names) == 1 and not folder.is_dir() and not out.endswith("/"):
        if not out.endswith(FILE_SUFFIX):
            raise SettingsError(
                f"--out {out}: expected a name that ends in {FILE_SUFFIX}, or {out}/ for a folder"
            )
        return [out]
    for name in names:
        if names.count(name) > 1:
            raise SettingsError(f"--out {out}: two of the files would become {name}")
    if not folder.is_dir():
        # It would be made as a folder with the name of a recording.
        if folder.suffix == FILE_SUFFIX:
            raise SettingsError(
                f"--out {out}: several files need a folder, one recording each"
            )
        with os_errors(folder):
            folder.mkdir()
    return [str(folder / name) for name in names]


def add_set(
    parser: argparse.ArgumentParser, about: str, metavar: str = "KEY=VALUE"
) -> None:
    """Add --set; `stated_values` reads KEY=VALUE, `load` of a launch file NODE.KEY=VALUE."""
    about = f"{about} (may be repeated)"
    parser.add_argument(
        "--set",
        metavar=metavar,
        action="append",
        default=[],
        help=about,
    )


def stated_values(
    words: Iterable[str], entries: Iterable[Mapping[str, Any]]
) -> dict[str, Any]:
    """Settings that --set KEY=VALUE states, typed as those of a launch file.

    `entries` describe the settings that are allowed, as `Settings.described`. Raises SettingsError
    if a text has no `=`, or the key is none of them.
    """
    allowed = {entry["key"]: entry for entry in entries}
    values: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise SettingsError(f"--set {word}: expected KEY=VALUE")
        if key not in allowed:
            raise SettingsError(
                f"--set {word}: unknown key{did_you_mean(key, allowed)}"
            )
        values[key] = typed_value(text, allowed[key])
    return values


def add_summary(parser: argparse.ArgumentParser) -> None:
    """Add --summary."""
    rare(parser).add_argument(
        "--summary",
        metavar="OUT.json",
        type=Path,
        help="write the summary as JSON",
    )


def check_summary(path: Path | None) -> None:
    """Check before a run that its summary can be written, or raise OutputError."""
    if path is None:
        return
    try:
        check_link(path)
    except OSError as error:
        raise OutputError(f"--summary {path}: {error.strerror}") from error
    # A link is followed to where the file will be.
    folder = path.resolve().parent
    if path.is_dir():
        raise OutputError(f"--summary {path}: is a folder")
    if not folder.is_dir():
        raise OutputError(f"--summary {path}: {NO_FOLDER}")
    # A new file needs the right to write to its folder.
    written = folder
    if path.exists():
        written = path
    if not os.access(written, os.W_OK):
        raise OutputError(f"--summary {path}: {NO_WRITING}")


def write_summary(path: Path | None, name: str, summary: Mapping[str, Any]) -> None:
    """Write the summary of a run in the format `name` where one is wanted, or raise
    SettingsError.
    """
    from importlib.metadata import version

    if path is None:
        return
    # Which version wrote it is part of the document.
    document = formatted(name, {"sparseskin": version("sparseskin"), **summary})
    text = json.dumps(document, indent=2) + "\n"
    try:
        overwrite(path, text.encode())
    except OSError as error:
        raise SettingsError(f"--summary {path}: {error.strerror}") from error


@contextlib.contextmanager
def naming_options(options: Mapping[str, str]) -> Iterator[None]:
    """Let an error that begins with the name of a setting name the option that states it."""
    try:
        yield
    except SparseskinError as error:
        key, colon, reason = str(error).partition(":")
        if key not in options:
            raise
        raise SettingsError(f"{options[key]}{colon}{reason}") from error


def print_ends(nodes: Mapping[str, Mapping[str, Any]]) -> None:
    """Print, from the reports of nodes, which were restarted, and what sensors clipped, recorders
    wrote and players played.
    """
    for name, node in nodes.items():
        for line in _end_lines(name, node):
            print(line)


def _end_lines(name: str, node: Mapping[str, Any]) -> Iterator[str]:
    """Lines about one node, by its report."""
    # What went wrong comes before what was done.
    n_restarts = node.get("restarts", 0)
    if n_restarts:
        times = counted(n_restarts, "time")
        failure = printable(node["failures"][-1])
        yield f"{name}: restarted {times} after a failure; the last: {failure}"
    for line in node.get("lines", ()):
        yield f"{name}: {line}"
    if node.get("missing"):
        yield f"{name}: {node['missing']} readings were missing"

    kind = node["type"]
    if kind == "sensor" and node.get("clipped"):
        from sparseskin.nodes.sensor.saturation import clipped_text

        yield f"{name}: {clipped_text(node)}"
    elif kind == "sensor" and node.get("invalid"):
        invalid = node["invalid"]
        yield (
            f"{name}: of the file's readings {invalid['not_finite']} were not finite and "
            f"{invalid['negative']} below 0 ({invalid['masked_taxels']} taxels masked)"
        )
    elif kind == "recorder" and node.get("recording"):
        if not node["recording"]["error"]:
            yield _recording_line(node)
    elif node.get("bridge"):
        bridge = node["bridge"]
        n_dropped = bridge["dropped"] + _n_lost(node)
        where = printable(bridge["where"])
        yield f"{name}: {bridge['sent']} frames published at {where}, {n_dropped} dropped"
    elif kind == "player" and "played" in node:
        played = node["played"]
        yield f"{printable(played['file'])}: {played['frames']} frames played"


def _recording_line(node: Mapping[str, Any]) -> str:
    """What a recorder wrote."""
    recording = node["recording"]
    n_messages = recording["n_messages"]
    n_dropped = _n_lost(node)
    text = "no message came, so there is no file"
    if n_messages:
        text = f"{n_messages} messages recorded"
    if n_messages or n_dropped:
        text += f", {n_dropped} dropped"
    return f"{printable(recording['out'])}: {text}"


def _n_lost(node: Mapping[str, Any]) -> int:
    """Number of messages that a node lost, of all topics."""
    return sum(node.get("lost", {}).values())


def show(
    arguments: argparse.Namespace,
    name: str,
    document: Mapping[str, Any],
    lines: Iterable[str],
) -> int:
    """Print a document of the format `name` as JSON where that is asked for, else lines; return the
    exit code.
    """
    if arguments.json:
        print(json.dumps(formatted(name, document), indent=2))
    else:
        print("\n".join(lines))
    return 0


def whole(low: int, high: int | None = None) -> Callable[[str], int]:
    """The type of an option: a whole number of at most 15 digits, `low` or more, up to `high`."""
    allowed = f"{low} or more"
    if high is not None:
        allowed = f"{low}..{high}"

    def read(text: str) -> int:
        # int() would also read other digits, spaces and underscores.
        is_number = text.isascii() and text.isdigit() and len(text) < 16
        number = int(text) if is_number else -1
        if number < low or (high is not None and number > high):
            raise argparse.ArgumentTypeError(
                f"{text!r}: expected a whole number, {allowed}"
            )
        return number

    return read


def real(above_0: bool) -> Callable[[str], float]:
    """The type of an option: a finite number above 0, or of 0 or more."""

    def read(text: str) -> float:
        with contextlib.suppress(ValueError):
            value = float(text)
            if 0 <= value < math.inf and (value or not above_0):
                return value
        allowed = "a number, 0 or more"
        if above_0:
            allowed = "a number above 0"
        raise argparse.ArgumentTypeError(f"{text!r}: expected {allowed}")

    return read
