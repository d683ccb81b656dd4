"""Recordings .db3 of ROS 2, which are databases of SQLite."""

import sqlite3
from collections.abc import Collection, Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.numerics.array_files import MAX_GROWN_BYTES
from sparseskin.nodes.sensor.layout.checks import unreadable

from .storage import Recorded, Storage, Topic

FORMS = {"ros2msg": "msg", "ros2idl": "idl"}


class Db3Storage(Storage):
    """A database, whose tables are no views and call nothing. It is not changed: one that a killed
    recorder left is a copy (`storage.with_log`), into which SQLite writes what its log holds.
    """

    def __init__(self, path: str, name: str, has_log: bool = False) -> None:
        super().__init__(path, name)
        self.is_closed = not has_log

    def read_index(self) -> None:
        with self._opened() as base:
            # Recorders before Iron write no definitions.
            texts = self._definitions(base)
            rows = base.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            )
            for number, name, kind, encoding in rows:
                form, text = texts.get(str(kind), ("msg", ""))
                described = Topic(str(encoding))
                if encoding in ("cdr", ""):
                    described = Topic(str(kind), text, form)
                self.connections[number] = (str(name), described)

    def messages(self, topics: Collection[str]) -> Iterator[Recorded]:
        self.losses.clear()
        if not self.connections:
            self.read_index()
        # Names are no part of the query: they come from the file.
        numbers = [
            number for number, (name, _) in self.connections.items() if name in topics
        ]
        marks = ",".join("?" * len(numbers))

        # As they were written: an index may be behind the place where a file is cut off.
        query = (
            "SELECT topic_id, timestamp, data FROM messages NOT INDEXED WHERE topic_id "
            f"IN ({marks})"
        )
        n = 0
        with self._opened() as base:
            try:
                for number, log_ns, data in base.execute(query, numbers):
                    n += 1
                    name, described = self.connections[number]
                    if not isinstance(log_ns, int):
                        raise SourceError(f"{self.name}: a message has no time")
                    # SQLite stores any type in any column; other types are no message.
                    payload = data if isinstance(data, bytes) else b""
                    yield Recorded(name, described.kind, log_ns, payload)
            except sqlite3.DatabaseError as error:
                # What was read before the damage remains.
                if not n:
                    raise
                reason = " ".join(str(error).split())[:80]
                self.losses.append(f"behind message {n} of the file ({reason})")

    def _definitions(self, base: sqlite3.Connection) -> dict[str, tuple[str, str]]:
        """Form and text of the definition of each type, of recorders that write them."""
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master")}
        if "message_definitions" not in tables:
            return {}
        rows = base.execute(
            "SELECT topic_type, encoding, encoded_message_definition FROM "
            "message_definitions"
        )
        return {
            str(kind): (FORMS[form], str(text))
            for kind, form, text in rows
            if form in FORMS
        }

    @contextmanager
    def _opened(self) -> Iterator[sqlite3.Connection]:
        mode = "mode=ro&immutable=1" if self.is_closed else "mode=rw"
        where = f"{Path(self.path).resolve().as_uri()}?{mode}"
        try:
            with closing(sqlite3.connect(where, uri=True)) as base:
                # The schema of a stranger's file must not call functions.
                base.execute("PRAGMA trusted_schema = OFF")
                # A file that is cut off is read, too; none is written.
                base.execute("PRAGMA writable_schema = ON")
                base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_GROWN_BYTES)
                query = "SELECT name FROM sqlite_master WHERE type = 'table'"
                tables = {name for (name,) in base.execute(query)}
                if not tables >= {"topics", "messages"}:
                    raise SourceError(
                        f"{self.name}: holds no tables topics and messages of a bag of "
                        "ROS 2"
                    )
                yield base
        except (sqlite3.Error, UnicodeError, OverflowError) as error:
            raise unreadable(self.name, error) from error
