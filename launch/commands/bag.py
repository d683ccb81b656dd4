"""The commands `sparseskin recording ...`: look into recordings, repair and convert them."""

import argparse
import sys
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sparseskin.launch.attach.text import facts, flowing, size_text, table
from sparseskin.nodes.errors import SourceError, counted
from sparseskin.nodes.extensions import EXPORTS, loaded
from sparseskin.nodes.lookup import find_callable
from sparseskin.nodes.process.control import Document
from sparseskin.nodes.recorder.bag.format import (
    FILE_SUFFIX,
    PART_SUFFIX,
    BagError,
    span_ns,
)
from sparseskin.nodes.recorder.convert.export import OWN, export_names, find_export
from sparseskin.nodes.sensor.files.format import suffixes

from . import look
from .options import (
    add_commands,
    add_layout,
    add_rest,
    as_options,
    bag_names,
    layout_of,
    rare,
    show,
    whole,
)

if TYPE_CHECKING:
    from sparseskin.nodes.recorder.bag.reader import BagReader

_MAX_SHOWN = 2000  # some 25 lines
"""Characters of one value that the table shows at most."""
_OF_TOPIC = ("schema", "version", "n_messages", "first_ns", "last_ns", "rate_hz")


def configure(parser: argparse.ArgumentParser) -> None:
    add = add_commands(parser, "Work with recordings (.mcap).")
    # Commands that read a file, in the order of their use: look, import, export.
    look.configure(
        add("look", look.look, "show how a file would be read, and its first frame")
    )

    info = add("info", _info, "print what a recording holds")
    info.add_argument(
        "bag",
        metavar="F.mcap",
        type=Path,
        help=f"NAME{FILE_SUFFIX}",
    )
    info.add_argument(
        "--json", action="store_true", help="print JSON in place of a table"
    )

    recover = add("recover", _recover, "save the readable part of a broken recording")
    recover.add_argument(
        "bag",
        metavar="F.mcap",
        type=Path,
        help=f"NAME{FILE_SUFFIX}[{PART_SUFFIX}]",
    )
    recover.add_argument(
        "--out",
        metavar="NEW",
        type=Path,
        help=f"default: NAME_recovered{FILE_SUFFIX}",
    )

    _configure_import(add("import", _import, "make a recording of a file of frames"))
    about = "convert a recording to NumPy, CSV or the format of another tool"
    _configure_export(add("export", _export, about))


def _configure_export(export: argparse.ArgumentParser) -> None:
    export.add_argument(
        "bags",
        metavar="F.mcap",
        type=Path,
        nargs="+",
        help=f"NAME{FILE_SUFFIX}; several for lerobot, zarr: an episode each",
    )
    export.add_argument(
        "--to",
        choices=export_names(),
        required=True,
        help="the format",
    )
    names = "NAME.npz, NAME_csv, NAME_ros2"
    export.add_argument(
        "--out",
        metavar="PATH",
        type=Path,
        help=f"default: NAME and the ending of the format, as {names}",
    )
    export.add_argument(
        "--topics",
        metavar="TOPIC",
        nargs="+",
        help="only these topics; default: all with frames",
    )
    for name, option in _export_options().items():
        rare(export).add_argument(
            f"--{name}",
            metavar=option.metavar,
            type=option.kind,
            help=f"of {', '.join(option.exports)}: {option.about}",
        )


class _ExportOption(NamedTuple):
    """An option that exports have of their own, and the function that reads its text."""

    exports: list[str]
    metavar: str
    about: str
    kind: Any


def _export_options() -> dict[str, _ExportOption]:
    """Options that exports have of their own, by name."""
    options: dict[str, _ExportOption] = {}
    for name, export in {**loaded(EXPORTS), **OWN}.items():
        for option, (metavar, about, *kind) in export.options.items():
            # Several exports may have an option of one name: the first describes it.
            if option not in options:
                (read,) = kind or (whole(1),)
                options[option] = _ExportOption([], metavar, about, read)
            options[option].exports.append(name)
    return options


def _configure_import(parser: argparse.ArgumentParser) -> None:
    formats = "; ".join(f"{suffix}: {about}" for suffix, about in suffixes().items())
    # Plug-ins add formats, so that the list is made here.
    parser.description = f"{parser.description} Formats: {formats}."
    parser.add_argument(
        "files",
        metavar="FILE",
        nargs="+",
        type=_path,
        help="the recording",
    )
    parser.add_argument(
        "--out",
        metavar="PATH",
        required=True,
        help=f"the recording, NAME{FILE_SUFFIX}; or a folder, for one a FILE",
    )
    add_layout(parser)
    add_rest(parser)
    rare(parser).add_argument(
        "--keep",
        metavar="CHANNELS",
        default="",
        help="further channels, as x,y: each becomes a patch of its own, skin_x",
    )


def _path(text: str) -> Path:
    """The path of a file, or of a source as a sensor names it."""
    return Path(text.removeprefix("file:"))


def _info(arguments: argparse.Namespace) -> int:
    """Print what a recording holds; check all of it. Of a topic: its messages, their rate, the
    seconds from the first to the last, and how many the recorder lost.
    """
    from sparseskin.nodes.recorder.bag.reader import BagReader

    with BagReader(arguments.bag) as bag:
        return show(arguments, "recording-info", info_document(bag), info_lines(bag))


def _recover(arguments: argparse.Namespace) -> int:
    """Write every message before the break of a recording into a new, whole one."""
    from sparseskin.nodes.recorder.bag.reader import BagReader
    from sparseskin.nodes.recorder.convert.to_bag import recover_bag

    with BagReader(arguments.bag) as bag:
        # The broken recording stays as it is.
        out = arguments.out or arguments.bag.with_name(
            f"{_stem(bag.path)}_recovered{FILE_SUFFIX}"
        )
        n_messages = recover_bag(bag, out)
        print(f"{bag.path}: {bag.recovered or 'is whole'}")
    print(f"{out}: {counted(n_messages, 'message')}")
    return 0


def _import(arguments: argparse.Namespace) -> int:
    """Make a recording (.mcap) of a file of another format, as if a sensor had played it."""
    from sparseskin.nodes.recorder.convert.to_bag import import_file

    # Names are checked before the first file is read.
    names = [f"{file.stem}{FILE_SUFFIX}" for file in arguments.files]
    outs = bag_names(names, arguments.out)
    bags = [Path(out) for out in outs]
    # One layout for all files: they are of one skin.
    layout = layout_of(arguments)
    channels = [channel for channel in arguments.keep.split(",") if channel]
    for file, bag in zip(arguments.files, bags, strict=True):
        # A default binds the file of this turn of the loop.
        def log(line: str, file: Path = file) -> None:
            print(f"{file}: {as_options(line)}", file=sys.stderr)

        try:
            n_frames = import_file(
                file,
                bag,
                layout=layout,
                keep=channels,
                tare=arguments.tare,
                invert=arguments.invert == "true",
                log=log,
            )
        except SourceError as error:
            raise SourceError(as_options(str(error))) from error
        print(f"{bag}: {counted(n_frames, 'frame')}")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    """Convert the frames of a recording: npz (a file per patch, which a source file:PATH reads),
    csv (a folder, a file per topic, a frame per line), ros2 (a folder with CDR messages and
    metadata.yaml), foxglove (an .mcap with Foxglove's schemas), lerobot (a folder, a dataset of
    codebase version v3.0), zarr (a folder, a tactile dataset), or skin (the file skin.toml of a
    calibrated skin). The patches of a body that were recorded in batches are exported one by one.
    """
    from sparseskin.nodes.recorder.bag.patches import split_bag
    from sparseskin.nodes.recorder.bag.reader import BagReader

    # The function of a format is imported when it is asked for.
    export = find_export(arguments.to)
    write = find_callable(export.target, BagError)
    options = _stated_options(arguments)
    # Only some formats hold several episodes.
    if len(arguments.bags) > 1 and not export.several:
        raise BagError(f"{arguments.bags[1]}: --to {arguments.to} takes one recording")
    with ExitStack() as stack:
        bags = []
        for path in arguments.bags:
            bag = stack.enter_context(BagReader(path))
            bags.append(bag)
            # What a broken recording lacks is said before its frames are exported.
            if bag.recovered:
                print(f"{bag.path}: {bag.recovered}", file=sys.stderr)
        first_path = bags[0].path
        out = arguments.out or first_path.with_name(_stem(first_path) + export.ending)
        parts: Any = [split_bag(bag) for bag in bags]
        if not export.several:
            (parts,) = parts
        for path in write(parts, out, arguments.topics, **options):
            print(path)
    return 0


def _stated_options(arguments: argparse.Namespace) -> Document:
    """Options of the export alone that are stated; BagError if one goes with another export."""
    stated = {}
    for name, option in _export_options().items():
        value = getattr(arguments, name)
        if value is None:
            continue
        if arguments.to not in option.exports:
            raise BagError(f"--{name}: goes with --to {' or '.join(option.exports)}")
        stated[name] = value
    return stated


def _stem(path: Path) -> str:
    return path.name.removesuffix(PART_SUFFIX).removesuffix(FILE_SUFFIX)


def info_document(bag: "BagReader") -> Document:
    """The file, its topics, counts of its recorder and its metadata in full."""
    topics = {}
    for topic, info in bag.topics.items():
        topics[topic] = {key: getattr(info, key) for key in _OF_TOPIC}
    return {
        "recording": str(bag.path),
        "size_bytes": bag.path.stat().st_size,
        "recovered": bag.recovered,
        "duration_s": _seconds(span_ns(bag.topics.values())),
        "topics": topics,
        "states": _states(bag),
        "counts": bag.counts,
        "metadata": bag.metadata,
    }


def info_lines(bag: "BagReader") -> list[str]:
    """The same for a terminal, long values cut."""
    n_messages = sum(info.n_messages for info in bag.topics.values())
    size = size_text(bag.path.stat().st_size)
    duration_s = _seconds(span_ns(bag.topics.values()))
    properties = {
        "recording": str(bag.path),
        "size": f"{size}, {n_messages} messages",
        "duration": f"{duration_s:.3f} s",
        "state": bag.recovered or "whole",
    }
    lines = [*facts(properties), ""]
    lines += table(["MESSAGES", "HZ", "SECONDS", "LOST", "TOPIC"], _topic_rows(bag))
    if bag.counts is None:
        lines.append(
            "lost messages are not known: the recorder did not get to write them"
        )

    # Names and texts of these are of the file, and may be long.
    states = {}
    for topic, state in _states(bag).items():
        states[topic] = _state_text(state)
    metadata = {key: value for key, value in bag.metadata.items() if value}
    return [*lines, "", *_entries(states), *_entries(metadata)]


def _topic_rows(bag: "BagReader") -> list[list[Any]]:
    """A row for each topic; what is not known is None."""
    lost: Any = None
    if bag.counts is not None:
        # The recorder writes its counts last: a broken recording has none.
        lost = bag.counts.get("lost", {})
    rows = []
    for topic, info in bag.topics.items():
        n_lost = None
        if isinstance(lost, dict):
            n_lost = lost.get(topic, 0)
        seconds = _seconds((info.first_ns, info.last_ns))
        rows.append([info.n_messages, info.rate_hz or None, seconds, n_lost, topic])
    return rows


def _states(bag: "BagReader") -> dict[str, Document]:
    """The last state of each kind of each patch, by topic; none where one cannot be read."""
    from sparseskin.nodes.recorder.bag.frames import last_states

    try:
        return last_states(bag, bag.topics)
    except BagError:
        return {}


def _state_text(state: Document) -> str:
    """Fields of a state that are no arrays, and state something, in one line."""
    parts = []
    for key, value in state.items():
        # Arrays are in the document of --json alone.
        is_empty = value is None or value == ""
        if not isinstance(value, list) and not is_empty:
            parts.append(f"{key} {value}")
    return ", ".join(parts)


def _seconds(span: tuple[int, int] | None) -> float:
    if span is None:
        return 0.0
    begin_ns, end_ns = span
    return (end_ns - begin_ns) / 1e9


def _entries(entries: Mapping[str, str]) -> list[str]:
    """Entries of a file, whose names and texts may be long."""
    texts: dict[str, str] = {}
    for key, text in entries.items():
        # A launch file that was recorded would fill the screen.
        n_lines = len(text.splitlines())
        if n_lines > 1:
            text = f"{n_lines} lines (--json shows them)"
        elif len(text) > _MAX_SHOWN:
            text = f"{text[:_MAX_SHOWN]}... ({len(text)} characters, --json shows them)"
        texts[flowing(key[:32])] = text
    return facts(texts)
