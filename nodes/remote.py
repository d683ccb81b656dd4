"""Recordings at addresses, as s3://bucket/drag.mcap: read and written through fsspec."""

import atexit
import contextlib
import re
import shutil
import tempfile
import threading
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from sparseskin.messages.text import printable, without_users

from .errors import SettingsError, SparseskinError
from .files import TAKEN
from .lookup import nearest_of, one_line

SCHEMES = (
    *("abfs", "az", "ftp", "gcs", "gs", "hdfs", "hf", "http", "https", "memory", "oci", "s3"),
    *("sftp", "smb", "ssh", "webhdfs"),
)
"""Protocols of fsspec that name a file somewhere else. Chained addresses (zip::, reference::) are
refused: they open files that the address does not show."""
MAX_BYTES = 1 << 36
"""Largest file that is read; chosen: more than a day at 1 kHz."""
START_S, BYTES_PER_S = 60.0, 1e5
"""Time that an address has, in s: to answer, and by the bytes that have come or are to go. Chosen:
a radio link."""
_PART = 1 << 20
_ADDRESS = re.compile(r"([a-zA-Z0-9+.-]*)(::|://)")


class RemoteError(SparseskinError):
    """A file at an address cannot be read or written."""


def is_remote(name: str) -> bool:
    """True if a name is an address, as s3://bucket/drag.mcap, and no path."""
    return _ADDRESS.match(name) is not None


def shown(text: str) -> str:
    """A text without users, passwords, queries and fragments of its addresses, often keys."""
    return printable(without_users(re.sub(r"(://[^\s?#]*)[?#]\S+", r"\1?***", text)))


def check_address(address: str) -> None:
    """Raise SettingsError if the protocol of an address is not allowed, or a package is missing;
    nothing is connected.
    """
    found = _ADDRESS.match(address)
    scheme, place = (found[1].lower() if found else ""), shown(address[:200])
    if "::" in address:
        raise SettingsError(f"{place}: a chained address is not allowed")
    if scheme not in SCHEMES:
        hint = nearest_of(scheme, SCHEMES)
        raise SettingsError(f"{place}: protocol {scheme[:40]!r} is not allowed{hint}")
    try:
        import fsspec
    except ImportError as error:
        raise SettingsError(
            f"{place}: needs the package fsspec; pip install 'sparseskin[scale]'"
        ) from error
    try:
        fsspec.get_filesystem_class(scheme)
    except ImportError as error:
        raise SettingsError(f"{place}: needs a further package: {error}") from error


def file_name(name: str) -> str:
    """The last part of a path or an address."""
    if not is_remote(name):
        return Path(name).name
    return name.partition("?")[0].rstrip("/").rpartition("/")[2]


def local_path(name: str) -> Path:
    """The file of a path, or a copy of that at an address, which is read once a process. Copies are
    in a folder of this process, removed at its end.

    Raises SettingsError as `check_address`; RemoteError if it cannot be read, has more than
    `MAX_BYTES`, or takes longer than `START_S` and `BYTES_PER_S` allow.
    """
    return _copied(name) if is_remote(name) else Path(name)


@cache
def _copied(address: str) -> Path:
    check_address(address)
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = folder / (file_name(address) or "recording")
    n_bytes = 0

    def copy(filesystem: Any, place: str, late: threading.Event) -> None:
        nonlocal n_bytes
        with filesystem.open(place, "rb") as source, path.open("xb") as out:
            while not late.is_set() and (part := source.read(_PART)):
                n_bytes += len(part)
                if n_bytes > MAX_BYTES:
                    raise RemoteError(f"{shown(address)}: more than {MAX_BYTES} bytes")
                out.write(part)

    _in_time(address, copy, lambda: n_bytes)
    return path


def check_free(address: str) -> None:
    """Check that there is no file at an address to write to; RemoteError if there is one."""
    check_address(address)

    def check(filesystem: Any, place: str, late: threading.Event) -> None:
        if filesystem.exists(place):
            raise RemoteError(f"{shown(address)}: {TAKEN}")

    _in_time(address, check, lambda: 0)


def store(path: Path, address: str) -> None:
    """Write a file to an address; raises as `local_path`, and RemoteError if one is there."""
    check_free(address)

    def put(filesystem: Any, place: str, late: threading.Event) -> None:
        try:
            filesystem.put_file(str(path), place)
        except BaseException:
            # An object appears when it is complete; what other stores keep of a file is removed.
            with contextlib.suppress(Exception):
                filesystem.rm(place)
            raise

    n_bytes = path.stat().st_size
    _in_time(address, put, lambda: n_bytes)


def _in_time(
    address: str, action: Callable[[Any, str, threading.Event], None], n_bytes: Callable[[], int]
) -> None:
    """Run an action on a file system in a thread, and give it up (its event is set) if too slow."""
    from fsspec.core import url_to_fs

    late, failures = threading.Event(), list[BaseException]()

    def run() -> None:
        try:
            filesystem, place = url_to_fs(address)
            action(filesystem, str(place), late)
        except BaseException as error:
            failures.append(error)

    thread, begin_s = threading.Thread(target=run, daemon=True), time.monotonic()
    thread.start()
    while thread.is_alive() and not late.is_set():
        left_s = begin_s + START_S + n_bytes() / BYTES_PER_S - time.monotonic()
        thread.join(min(max(left_s, 0.0), 1.0))
        if left_s <= 0:
            late.set()
    if thread.is_alive():
        taken = f"not done within {time.monotonic() - begin_s:.0f} s"
        raise RemoteError(f"{shown(address)}: {taken}, after {n_bytes()} bytes")
    for error in failures:
        if isinstance(error, SparseskinError):
            raise error
        missing = isinstance(error, FileNotFoundError)
        text = "no such file" if missing else shown(one_line(error))
        raise RemoteError(f"{shown(address)}: {text}") from error
