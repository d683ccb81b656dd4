"""Definitions of messages: those of a recording, and those of ROS itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
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
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"
SHORT = {"time": TIME, "duration": DURATION, "Header": HEADER}
"""Names that a definition uses without a package."""
SEQUENCE = -1
"""`Member.n_entries` of a list whose length is in the message."""
MAX_TEXT_BYTES = 1 << 20
"""Longest definition that is parsed; chosen: ten times the longest one of ROS."""
MAX_COUNT = 1 << 26
"""Most entries of a list of fixed length; chosen: more than any message holds."""
EMPTY = "structure_needs_at_least_one_member"
"""The member of a message without members, as ROS 2 sends it."""
LINE = re.compile(
    r"(?P<type>[A-Za-z]\w*(?:/\w+){0,2})(?:<=\d+)?"
    r"(?:(?P<list>\[)(?P<limit><=)?(?P<count>\d*)\])?[ \t]+"
    r"(?P<name>[A-Za-z]\w*)(?P<rest>[ \t]*=.*|[ \t]+\S.*)?"
)
"""A line of a definition: a type, [] of a list, a name, and what follows it."""


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
        if len(text) > MAX_TEXT_BYTES:
            limit = f"at most {MAX_TEXT_BYTES}"
            raise SourceError(
                f"the definition of {printable(kind)} has {len(text)} bytes; {limit}"
            )

        is_idl = form == "idl"
        types_of_text = _of_idl(text) if is_idl else dict(_of_msg(kind, text, self.ros))
        if kind not in types_of_text:
            raise SourceError(f"the definition of {printable(kind)} does not define it")
        self._added = types_of_text | self._added

    def is_of_ros(self, kind: str) -> bool:
        """True if ROS itself has a type of that name."""
        return kind in self._store.fielddefs

    def members(self, kind: str) -> Members:
        """The members of a type. Raises SourceError if it is not known."""
        if kind in self._added:
            return self._added[kind]
        if self.is_of_ros(kind):
            return tuple(_of_store(self._store.fielddefs[kind][1]))
        raise SourceError(f"the definition of {printable(kind)} is not known")


def full_name(kind: str) -> str:
    """The name of a type as ROS 2 has it: "pkg/Name" is "pkg/msg/Name"."""
    package, _, name = kind.rpartition("/")
    if not package or "/" in package:
        return kind
    return f"{package}/msg/{name}"


def _of_msg(kind: str, text: str, ros: int) -> Iterator[tuple[str, Members]]:
    """The types in a definition .msg, and in those that follow it after lines of =."""
    parts = re.split(r"^={3,}[ \t]*\r?\n", text, flags=re.MULTILINE)
    for number, part in enumerate(parts):
        name = kind
        if number:
            heading, _, part = part.partition("\n")
            if not heading.startswith("MSG:"):
                raise SourceError(
                    f"the definition of {printable(kind)} has a part without a name"
                )
            name = full_name(heading.removeprefix("MSG:").strip())

        members = tuple(_members(name, part, ros))
        # A message of ROS 2 is never without a byte.
        if not members and ros == 2:
            members = (Member(EMPTY, "uint8"),)
        yield name, members


def _members(kind: str, text: str, ros: int) -> Iterator[Member]:
    """The members in a definition .msg, whose constants and defaults are not read."""
    for number, full_line in enumerate(text.splitlines(), start=1):
        line = full_line.partition("#")[0].strip()
        if not line or line.startswith("@"):
            continue
        match = LINE.fullmatch(line)
        if match is None:
            place = f"the definition of {printable(kind)}, line {number}"
            raise SourceError(f"{place}: {printable(line[:60])!r} is no member")
        is_constant = (match["rest"] or "").lstrip().startswith("=")
        if is_constant:
            continue

        count = None
        if match["count"] and not match["limit"]:
            count = int(match["count"][:12])
        elif match["list"]:
            count = SEQUENCE
        yield Member(match["name"], _type(match["type"], kind, ros), count)


def _type(name: str, owner: str, ros: int) -> str:
    """The full name of a type that a definition of `owner` uses."""
    if name == "byte" and ros == 1:
        return "int8"
    if name in BASES or name in (STRING, "wstring"):
        return name
    if name in SHORT:
        return SHORT[name]
    if "/" in name:
        return full_name(name)
    return f"{owner.rpartition('/')[0]}/{name}"


def _of_idl(text: str) -> dict[str, Members]:
    """The types in a definition .idl."""
    from rosbags.typesys import get_types_from_idl

    types: dict[str, Any] = {}
    try:
        # Those of its members follow it, each behind a line of = and its name.
        lines = re.sub(r"^[ \t]*(#include|//).*", "", text, flags=re.MULTILINE)
        parts = re.split(r"^={3,}[ \t]*\r?\nIDL:.*\n", lines, flags=re.MULTILINE)
        for part in parts:
            if part.strip():
                types |= get_types_from_idl(part)
    except Exception as error:
        # The parser may raise anything at a text of another program.
        reason = " ".join(str(error).split())[:100]
        raise SourceError(
            f"a definition .idl cannot be read: {printable(reason)}"
        ) from error
    return {kind: tuple(_of_store(members)) for kind, (_, members) in types.items()}


def _of_store(members: Any) -> Iterator[Member]:
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
        yield Member(name, kind, count)
