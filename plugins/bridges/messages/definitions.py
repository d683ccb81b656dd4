"""Definitions of messages: of a recording, of ROS itself, and of packages of ROS on this host."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SourceError
from sparseskin.plugins.bridges.cdr import types

BASES = {
    "bool": "?",
    "byte": "u1",
    "octet": "u1",
    "char": "u1",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float32": "f4",
    "float64": "f8",
}
"""Dtype of each base type that is a number."""
STRING = "string"
TIME = "builtin_interfaces/msg/Time"
HEADER = "std_msgs/msg/Header"
SEQUENCE = -1
"""`Member.n_entries` of a list whose length is in the message."""
MAX_TEXT_BYTES = 1 << 20
"""Longest definition that is parsed; chosen: ten times the longest one of ROS."""
MAX_PLAIN_BYTES = 1 << 16
"""Longest one .msg without comments; chosen: 19 times the longest of ROS, in about a second."""
MAX_COUNT = 1 << 26
"""Most entries of a list of fixed length; chosen: more than any message holds."""
EMPTY = "structure_needs_at_least_one_member"
"""The member of a message without members, as ROS 2 sends it."""
PREFIXES = "AMENT_PREFIX_PATH"
"""Variable of a terminal of ROS 2 with the folders of its packages."""
MAX_TYPES = 1000
CONSTANT = re.compile(r"\S+[ \t]+\w+[ \t]*=")
"""The begin of a line of a definition .msg that defines a constant."""


class Member(NamedTuple):
    """A member of a message: its name, its type, and None or the length of a list, or SEQUENCE."""

    name: str
    kind: str
    n_entries: int | None = None


Members = tuple[Member, ...]


class Definitions:
    """Types of messages of ROS 1 or 2: those that are added, and those of ROS itself."""

    def __init__(self, ros: int = 2) -> None:
        self.ros = ros
        # One store for ROS 2: of the cache of `types`, too.
        self._store = types() if ros == 2 else types(ros)
        self._added: dict[str, Members] = {}

    def add(self, kind: str, text: str, form: str = "msg") -> None:
        """Add the types of a definition, in the form "msg" or "idl". Those that were added before
        remain. Raises SourceError if it cannot be read.
        """
        # The time of the parser grows with the text.
        if len(text) > MAX_TEXT_BYTES:
            limit = f"at most {MAX_TEXT_BYTES}"
            raise SourceError(
                f"the definition of {printable(kind)} has {len(text)} bytes; {limit}"
            )

        types_of_text = {}
        for name, (_, members) in _parsed(kind, text, form).items():
            types_of_text[name] = tuple(_of_store(members, self.ros))
            # A message of ROS 2 is never without a byte.
            if not members and self.ros == 2:
                types_of_text[name] = (Member(EMPTY, "uint8"),)
        if kind not in types_of_text:
            raise SourceError(f"the definition of {printable(kind)} does not define it")
        self._added = types_of_text | self._added

    def is_of_ros(self, kind: str) -> bool:
        """True if ROS itself has a type of that name."""
        return kind in self._store.fielddefs

    def members(self, kind: str) -> Members:
        """The members of a type. Raises SourceError if it is not known."""
        # The definition in the recording goes before that of the installed ROS: it wrote the bytes.
        if kind in self._added:
            return self._added[kind]
        if self.is_of_ros(kind):
            return tuple(_of_store(self._store.fielddefs[kind][1], self.ros))
        raise SourceError(f"the definition of {printable(kind)} is not known")


def full_name(kind: str) -> str:
    """The name of a type as ROS 2 has it: "pkg/Name" is "pkg/msg/Name"."""
    package, _, name = kind.rpartition("/")
    if not package or "/" in package:
        return kind
    return f"{package}/msg/{name}"


def _parsed(kind: str, text: str, form: str = "msg") -> dict[str, Any]:
    """The types in a definition, as rosbags has them, and in those of its members that follow it,
    each behind a line of = and its name. Raises SourceError if it cannot be read.
    """
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    types: dict[str, Any] = {}
    try:
        if form == "idl":
            # What is included follows in the text itself.
            lines = re.sub(r"^[ \t]*(#include|//).*", "", text, flags=re.MULTILINE)
            for part in re.split(
                r"^={3,}[ \t]*\r?\nIDL:.*\n", lines, flags=re.MULTILINE
            ):
                if part.strip():
                    types |= get_types_from_idl(part)
        else:
            lines = "".join(f"{line}\n" for line in _plain_lines(text))
            if len(lines) > MAX_PLAIN_BYTES:
                raise ValueError(f"{len(lines)} characters, at most {MAX_PLAIN_BYTES}")
            types = get_types_from_msg(lines, kind)
    except Exception as error:
        # The parser may raise anything at a text of another program.
        reason = printable(" ".join(str(error).split())[:100])
        fault = f"the definition of {printable(kind)}, .{form}, cannot be read"
        raise SourceError(f"{fault}: {reason}") from error
    return types


def _plain_lines(text: str) -> Iterator[str]:
    """Lines of a definition .msg without comments, annotations, constants and defaults."""
    for full_line in text.splitlines():
        line = full_line.partition("#")[0].strip()
        if line.startswith("==="):
            # As long as the parser expects it.
            yield "=" * 80
        elif line.startswith("MSG:"):
            yield line
        elif line and not line.startswith("@") and not CONSTANT.match(line):
            yield " ".join(line.split()[:2])


def _of_store(members: Any, ros: int = 2) -> Iterator[Member]:
    """Members as rosbags has them: (name, (node, what it is of))."""
    from rosbags.interfaces import Nodetype

    for name, (node, detail) in members:
        count = None
        if node == Nodetype.ARRAY:
            (node, detail), count = detail
        elif node == Nodetype.SEQUENCE:
            node, detail = detail[0]
            count = SEQUENCE

        kind = detail if node == Nodetype.NAME else detail[0]
        # A byte of ROS 1 has a sign.
        if ros == 1 and kind in ("byte", "octet"):
            kind = "int8"
        yield Member(name, kind, count)


def learn(kind: str) -> None:
    """Add a type, and those of its members, to the types of ROS 2 that are known, if it is none of
    them. Raises SourceError if it is not installed, or its definition cannot be read.
    """
    store = types()
    new_types: dict[str, Any] = {}
    waiting = [kind]
    while waiting:
        name = waiting.pop()
        if name in store.fielddefs or name in new_types or len(new_types) > MAX_TYPES:
            continue

        types_of_text = _parsed(name, _text_of(name))
        new_types |= types_of_text

        # The types of its members, and of the entries of its lists.
        _, members = types_of_text[name]
        for member in _of_store(members):
            if "/" in member.kind:
                waiting.append(member.kind)

    # All at once: types refer to each other.
    if new_types:
        store.register(new_types)


def _text_of(kind: str) -> str:
    """The definition of a type, as its package has it."""
    package, _, name = kind.partition("/msg/")
    prefixes: list[str] = []
    if package.isidentifier() and name.isidentifier():
        # A name from the network must not lead out of these folders.
        prefixes = os.environ.get(PREFIXES, "").split(os.pathsep)
    for prefix in prefixes:
        path = Path(prefix) / "share" / package / "msg" / f"{name}.msg"
        if prefix and path.is_file():
            return path.read_text("utf-8", "replace")
    hint = f"source the setup.bash of its package, which sets {PREFIXES}"
    raise SourceError(f"the definition of {printable(kind[:80])} is not known; {hint}")
