"""Arguments that several commands share, and what they do with them."""

import argparse
import contextlib
import functools
import inspect
import json
import math
import os
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.launch.attach.text import formatted, typed_value
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError, SparseskinError
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
        made = kinds.add_parser(name, help=about, description=inspect.getdoc(run))
        made.set_defaults(run=run)
        return made

    return add


RARE = "rarely used options"
"""Title of the options that `--help` shows with `--all` alone."""


def rare(parser: argparse.ArgumentParser) -> argparse._ArgumentGroup:
    """The group of the options of a command that are rarely used."""
    found = (group for group in parser._action_groups if group.title == RARE)
    return next(found, None) or parser.add_argument_group(RARE)


def add_graph(parser: argparse.ArgumentParser, document: str = "") -> None:
    """Add --graph, as all commands beside a running graph have it, and --json, if it prints one."""
    if document:
        parser.add_argument("--json", action="store_true", help=f"print {document}")
    about = "which graph, where several run on this host"
    rare(parser).add_argument("--graph", metavar="NAME|PID", help=about)


def add_page(
    parser: argparse.ArgumentParser, about_open: str = "open the live page in a browser"
) -> None:
    """Add the options of the live page."""
    parser.add_argument("--open", action="store_true", help=about_open)
    about = "serve the live page to all users of this host, without a token"
    rare(parser).add_argument("--no-token", action="store_true", help=about)


TO_STATE = re.compile(r"\b(?:state|set) [^;]*")
"""The part of an error that says what has to be stated."""
USUAL_KEYS = ("n_rows", "n_cols", "unit", "rate_hz", "columns", "time", "topic")
"""Keys of a layout whose options `--help` shows without `--all`."""


@functools.cache
def _stated_key() -> re.Pattern[str]:
    """A key of a layout in the part of an error that says what has to be stated."""
    from sparseskin.nodes.sensor.layout.layout import KEYS

    return re.compile(rf"(?<!a )(?<!the )(?<!no )(?<![\w,'-])({'|'.join(KEYS)})\b(=?)")


def add_layout(parser: argparse.ArgumentParser, but: Sequence[str] = ()) -> None:
    """Add an option for each key of `Layout`, spelled as the settings of the sensor, `but` some."""
    from sparseskin.nodes.sensor.layout.layout import Layout  # with NumPy, which takes time

    more = rare(parser)
    for entry in Layout.described():
        key = entry["key"]
        if key in but:
            continue
        name = f"--{key.replace('_', '-')}"
        group = parser if key in USUAL_KEYS else more
        about = entry["doc"].partition(";")[0]
        if entry["choices"]:
            choices = [choice for choice in entry["choices"] if choice]
            group.add_argument(name, choices=choices, default=None, help=about)
        else:
            kind: Any = str
            if entry["type"].startswith("int"):
                kind = whole(int(entry["low"]))
            elif entry["type"].startswith("float"):
                kind = real(above_0=True)
            metavar = "TEXT" if kind is str else "N"
            group.add_argument(name, metavar=metavar, type=kind, default=None, help=about)


def layout_of(arguments: argparse.Namespace) -> "Layout":
    """The layout that options state. Raises SettingsError, with the option, if a value is wrong."""
    from sparseskin.nodes.sensor.layout.layout import KEYS, Layout

    stated = {key: getattr(arguments, key, None) for key in KEYS}
    try:
        return Layout(**{key: value for key, value in stated.items() if value is not None})
    except SettingsError as error:
        key, colon, rest = str(error).partition(":")
        raise SettingsError(f"--{key.replace('_', '-')}{colon}{rest}") from error


def as_options(text: str) -> str:
    """A line on a file in which the keys of a layout that are to be stated are options."""
    from sparseskin.nodes.sensor.files.recording import spelled

    def option(key: str) -> str:
        return f"--{key.replace('_', '-')} "

    def clause(match: re.Match[str]) -> str:
        return _stated_key().sub(
            lambda key: option(key[1]) if key[2] else option(key[1])[:-1], match[0]
        )

    return TO_STATE.sub(clause, spelled(text, option))


def bag_names(names: Sequence[str], out: str) -> list[str]:
    """Path of each bag that a command writes: `out`, or of its name in the folder `out`,
    which is made for several.

    Raises SettingsError if two have the same name, `out` is a bag for several, or no bag for one;
    OutputError if the folder cannot be made.
    """
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX

    folder = Path(out)
    if len(names) == 1 and not folder.is_dir():
        if not out.endswith(FILE_SUFFIX):
            raise SettingsError(f"--out {out}: expected a name that ends in {FILE_SUFFIX}")
        return [out]
    if twice := [name for name in names if names.count(name) > 1]:
        raise SettingsError(f"--out {out}: two of the files would become {twice[0]}")
    if not folder.is_dir():
        if folder.suffix == FILE_SUFFIX:
            raise SettingsError(f"--out {out}: several files need a folder, one recording each")
        with os_errors(folder):
            folder.mkdir()
    return [str(folder / name) for name in names]


def add_set(parser: argparse.ArgumentParser, about: str, metavar: str = "KEY=VALUE") -> None:
    """Add --set; `stated_values` reads KEY=VALUE, `load` of a launch file NODE.KEY=VALUE."""
    about = f"{about} (may be repeated)"
    parser.add_argument("--set", metavar=metavar, action="append", default=[], help=about)


def stated_values(words: Iterable[str], entries: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Settings that --set KEY=VALUE states, typed as those of a launch file.

    `entries` describe the settings that are allowed, as `Settings.described`. Raises SettingsError
    if a text has no `=`, or the key is none of them.
    """
    known = {entry["key"]: entry for entry in entries}
    values: dict[str, Any] = {}
    for word in words:
        key, equals, text = word.partition("=")
        if not equals:
            raise SettingsError(f"--set {word}: expected KEY=VALUE")
        if key not in known:
            raise SettingsError(f"--set {word}: unknown key{did_you_mean(key, known)}")
        values[key] = typed_value(text, known[key])
    return values


def add_summary(parser: argparse.ArgumentParser) -> None:
    """Add --summary."""
    about = "write the summary as JSON"
    rare(parser).add_argument("--summary", metavar="OUT.json", type=Path, help=about)


def check_summary(path: Path | None) -> None:
    """Check before a run that its summary can be written, or raise OutputError."""
    if path is None:
        return
    try:
        check_link(path)
    except OSError as error:
        raise OutputError(f"--summary {path}: {error.strerror}") from error
    folder = path.resolve().parent
    if path.is_dir():
        raise OutputError(f"--summary {path}: is a folder")
    if not folder.is_dir():
        raise OutputError(f"--summary {path}: {NO_FOLDER}")
    if not os.access(path if path.exists() else folder, os.W_OK):
        raise OutputError(f"--summary {path}: {NO_WRITING}")


def write_summary(path: Path | None, name: str, summary: Mapping[str, Any]) -> None:
    """Write the summary of a run in the format `name` where one is wanted, or raise
    SettingsError.
    """
    from importlib.metadata import version

    if path is not None:
        document = formatted(name, {"sparseskin": version("sparseskin"), **summary})
        try:
            overwrite(path, (json.dumps(document, indent=2) + "\n").encode())
        except OSError as error:
            raise SettingsError(f"--summary {path}: {error.strerror}") from error


@contextlib.contextmanager
def naming_options(options: Mapping[str, str]) -> Iterator[None]:
    """Let an error that begins with the name of a setting name the option that states it."""
    try:
        yield
    except SparseskinError as error:
        key, colon, rest = str(error).partition(":")
        if key not in options:
            raise
        raise SettingsError(f"{options[key]}{colon}{rest}") from error


def print_ends(nodes: Mapping[str, Mapping[str, Any]]) -> None:
    """Print, from the reports of nodes, which were restarted, and what sensors clipped, recorders
    wrote and players played.
    """
    for name, node in nodes.items():
        if n := node.get("restarts", 0):
            times = "time" if n == 1 else "times"
            last = printable(node["failures"][-1])
            print(f"{name}: restarted {n} {times} after a failure; the last: {last}")
        for line in node.get("lines", ()):
            print(f"{name}: {line}")
        if n := node.get("missing"):
            print(f"{name}: {n} readings were missing")
        if node["type"] == "sensor" and node.get("clipped"):
            from sparseskin.nodes.sensor.saturation import clipped_text

            print(f"{name}: {clipped_text(node)}")
        elif node["type"] == "sensor" and (invalid := node.get("invalid")):
            print(
                f"{name}: of the file's readings {invalid['not_finite']} were not finite and "
                f"{invalid['negative']} below 0 ({invalid['masked_taxels']} taxels masked)"
            )
        elif node["type"] == "recorder" and (recording := node.get("recording")):
            dropped = sum(node.get("lost", {}).values())
            if not recording["error"]:
                n = recording["n_messages"]
                count = f"{n} messages recorded" if n else "no message came, so there is no file"
                count += f", {dropped} dropped" if n or dropped else ""
                print(f"{printable(recording['out'])}: {count}")
        elif bridge := node.get("bridge"):
            dropped = bridge["dropped"] + sum(node.get("lost", {}).values())
            where = printable(bridge["where"])
            print(f"{name}: {bridge['sent']} frames published at {where}, {dropped} dropped")
        elif node["type"] == "player" and "played" in node:
            print(f"{printable(node['played']['file'])}: {node['played']['frames']} frames played")


def show(
    arguments: argparse.Namespace, name: str, document: Mapping[str, Any], lines: Iterable[str]
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
    allowed = f"{low} or more" if high is None else f"{low}..{high}"

    def read(text: str) -> int:
        is_number = text.isascii() and text.isdigit() and len(text) < 16
        if not is_number or int(text) < low or (high is not None and int(text) > high):
            raise argparse.ArgumentTypeError(f"{text!r}: expected a whole number, {allowed}")
        return int(text)

    return read


def real(above_0: bool) -> Callable[[str], float]:
    """The type of an option: a finite number above 0, or of 0 or more."""

    def read(text: str) -> float:
        with contextlib.suppress(ValueError):
            value = float(text)
            if 0 <= value < math.inf and (value or not above_0):
                return value
        allowed = "a number above 0" if above_0 else "a number, 0 or more"
        raise argparse.ArgumentTypeError(f"{text!r}: expected {allowed}")

    return read
