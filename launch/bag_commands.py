"""The commands `sparseskin bag ...`: look into recordings, repair and convert them."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from sparseskin.nodes.recorder.bag import FILE_SUFFIX, PART_SUFFIX, BagError
from sparseskin.nodes.recorder.bag_reader import BagReader
from sparseskin.nodes.recorder.export_csv import export_csv
from sparseskin.nodes.recorder.export_npz import export_npz
from sparseskin.nodes.recorder.export_ros2 import export_ros2
from sparseskin.nodes.recorder.import_file import import_file
from sparseskin.nodes.recorder.recover import recover_bag
from sparseskin.nodes.sensor.formats import SUFFIXES

from .bag_info import info_json, info_table

EXPORTS = {
    "npz": (".npz", export_npz),
    "csv": ("_csv", export_csv),
    "ros2": ("_ros2", export_ros2),
}
"""Kind of export: what the default name of its output ends in, and who writes it."""


def add_bag_parser(commands: Any) -> None:
    """Add `bag` and its commands to the subparsers of the command line."""
    bag = commands.add_parser(
        "bag",
        help="look into a recording, repair it, convert it",
        description="Work with bags, the recordings that a recorder node writes (.mcap).",
    )
    kinds = bag.add_subparsers(required=True, metavar="COMMAND")
    _add_info(kinds)
    _add_recover(kinds)
    _add_import(kinds)
    _add_export(kinds)


def _add_info(kinds: Any) -> None:
    info = kinds.add_parser(
        "info", help="what a bag holds", description="Print what a bag holds; check all of it."
    )
    info.add_argument("bag", metavar="BAG", type=Path, help=f"NAME{FILE_SUFFIX}")
    info.add_argument("--json", action="store_true", help="print JSON in place of a table")
    info.set_defaults(run=_info)


def _add_recover(kinds: Any) -> None:
    recover = kinds.add_parser(
        "recover",
        help="save what can be read of a broken bag",
        description="Write every message before the break of a bag into a new, whole bag.",
    )
    recover.add_argument("bag", metavar="BAG", type=Path, help=f"NAME{FILE_SUFFIX}[{PART_SUFFIX}]")
    recover.add_argument(
        "--out", metavar="NEW", type=Path, help=f"default: NAME_recovered{FILE_SUFFIX}"
    )
    recover.set_defaults(run=_recover)


def _add_import(kinds: Any) -> None:
    taken = kinds.add_parser(
        "import",
        help="make a bag of a file of frames",
        description="Make a bag of a recording in another format, as if a sensor had played it: "
        + "; ".join(f"{suffix}: {what}" for suffix, what in SUFFIXES.items())
        + ".",
    )
    taken.add_argument("files", metavar="FILE", nargs="+", type=Path, help="the recording")
    taken.add_argument(
        "--out",
        metavar="PATH",
        type=Path,
        required=True,
        help=f"the bag, NAME{FILE_SUFFIX}; or a folder, for one bag a FILE",
    )
    taken.add_argument("--n-rows", metavar="N", type=int, help="rows of a plain .csv's frame")
    taken.add_argument("--n-cols", metavar="N", type=int, help="columns of a plain .csv's frame")
    taken.add_argument("--unit", help="unit of the readings, where the file does not state it")
    taken.add_argument("--f-max", metavar="X", type=float, help="upper end of the range")
    taken.add_argument("--rate-hz", metavar="X", type=float, help="frames a second")
    taken.set_defaults(run=_import)


def _add_export(kinds: Any) -> None:
    export = kinds.add_parser(
        "export",
        help="convert a bag to NumPy, CSV or ROS 2",
        description="Convert the frames of a bag: npz (one file a patch, which `file:` sources "
        "read again), csv (a folder, one file a topic, one frame a line), or ros2 (a folder with "
        "CDR messages and metadata.yaml).",
    )
    export.add_argument("bag", metavar="BAG", type=Path, help=f"NAME{FILE_SUFFIX}")
    export.add_argument("--to", choices=tuple(EXPORTS), required=True, help="the format")
    export.add_argument(
        "--out", metavar="PATH", type=Path, help="default: NAME.npz, NAME_csv or NAME_ros2"
    )
    export.add_argument(
        "--topics", metavar="TOPIC", nargs="+", help="only these topics; default: all with frames"
    )
    export.set_defaults(run=_export)


def _info(arguments: argparse.Namespace) -> int:
    with BagReader(arguments.bag) as bag:
        print(info_json(bag) if arguments.json else info_table(bag))
    return 0


def _recover(arguments: argparse.Namespace) -> int:
    with BagReader(arguments.bag) as bag:
        out = arguments.out or arguments.bag.with_name(f"{_stem(bag.path)}_recovered{FILE_SUFFIX}")
        n_messages = recover_bag(bag, out)
        print(f"{bag.path}: {bag.recovered or 'is whole'}")
    print(f"{out}: {_count(n_messages, 'message')}")
    return 0


def _import(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    pairs = [(file, out) for file in arguments.files]
    if len(pairs) > 1 or out.is_dir():
        pairs = [(file, out / f"{file.stem}{FILE_SUFFIX}") for file in arguments.files]
        twice = [bag for _, bag in pairs if [other for _, other in pairs].count(bag) > 1]
        if twice:
            raise BagError(f"{twice[0]}: two of the files would become this bag")
        if not out.is_dir():
            if out.suffix == FILE_SUFFIX:
                raise BagError(f"{out}: several files need a folder, one bag each")
            _make_folder(out)
    for file, bag in pairs:
        n_frames = import_file(
            file,
            bag,
            n_rows=arguments.n_rows,
            n_cols=arguments.n_cols,
            unit=arguments.unit,
            f_max=arguments.f_max,
            rate_hz=arguments.rate_hz,
        )
        print(f"{bag}: {_count(n_frames, 'frame')}")
    return 0


def _export(arguments: argparse.Namespace) -> int:
    ending, export = EXPORTS[arguments.to]
    with BagReader(arguments.bag) as bag:
        out = arguments.out or bag.path.with_name(_stem(bag.path) + ending)
        if bag.recovered:
            print(f"{bag.path}: {bag.recovered}", file=sys.stderr)
        for path in export(bag, out, arguments.topics):
            print(path)
    return 0


def _make_folder(path: Path) -> None:
    try:
        path.mkdir()
    except OSError as error:
        raise BagError(f"{path}: {error.strerror}") from error


def _stem(path: Path) -> str:
    return path.name.removesuffix(PART_SUFFIX).removesuffix(FILE_SUFFIX)


def _count(n: int, what: str) -> str:
    return f"{n} {what}" if n == 1 else f"{n} {what}s"
