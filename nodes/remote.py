"""Recordings at addresses, as s3://bucket/drag.mcap: read and written through fsspec."""

from __future__ import annotations

import atexit
import contextlib
import re
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from .errors import SettingsError, SparseskinError
from .files import TAKEN
from .lookup import nearest_of, one_line

SCHEMES = (
    *("abfs", "az", "ftp", "gcs", "gs", "hdfs", "hf", "http", "https", "memory", "oci", "s3"),
    *("sftp", "smb", "ssh", "webhdfs"),
)
"""Protocols of fsspec that name a file somewhere else. Chained addresses (zip::, reference::) are
refused: they open files that the address does not show."""
_ADDRESS = re.compile(r"([a-zA-Z0-9+.-]*)(::|://)")


class RemoteError(SparseskinError):
    """A file at an address cannot be read or written."""


def is_remote(name: str) -> bool:
    """True if a name is an address, as s3://bucket/drag.mcap, and no path."""
    return _ADDRESS.match(name) is not None


def check_address(address: str) -> None:
    """Raise SettingsError if the protocol of an address is not allowed, or a package is missing."""
    _filesystem(address)


def file_name(name: str) -> str:
    """The last part of a path or an address."""
    if not is_remote(name):
        return Path(name).name
    return name.partition("?")[0].rstrip("/").rpartition("/")[2]


def local_path(name: str) -> Path:
    """The file of a path, or a copy of that at an address, which is read once a process.

    Copies are in a folder of this process, removed at its end.

    Raises
    ------
    SettingsError
        As `check_address`.
    RemoteError
        If it cannot be read.
    """
    return _copied(name) if is_remote(name) else Path(name)


@cache
def _copied(address: str) -> Path:
    filesystem = _filesystem(address)
    folder = Path(tempfile.mkdtemp(prefix="sparseskin-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = folder / (file_name(address) or "recording")
    with _named(address):
        filesystem.get_file(address, str(path))
    return path


def check_free(address: str) -> None:
    """Check that there is no file at an address to write to; RemoteError if there is one."""
    with _named(address):
        taken = bool(_filesystem(address).exists(address))
    if taken:
        raise RemoteError(f"{address}: {TAKEN}")


def store(path: Path, address: str) -> None:
    """Write a file to an address; raises as `local_path`, and RemoteError if one is there."""
    check_free(address)
    filesystem = _filesystem(address)
    with _named(address):
        try:
            filesystem.put_file(str(path), address)
        except BaseException:
            # An object appears when it is complete; what other stores keep of a file is removed.
            with contextlib.suppress(Exception):
                filesystem.rm(address)
            raise


def _filesystem(address: str) -> Any:
    found = _ADDRESS.match(address)
    scheme = found[1].lower() if found else ""
    if "::" in address:
        raise SettingsError(f"{address[:200]}: a chained address is not allowed")
    if scheme not in SCHEMES:
        hint = nearest_of(scheme, SCHEMES)
        raise SettingsError(f"{address[:200]}: protocol {scheme[:40]!r} is not allowed{hint}")
    try:
        import fsspec
    except ImportError as error:
        raise SettingsError(
            f"{address}: needs the package fsspec; pip install 'sparseskin[scale]'"
        ) from error
    try:
        return fsspec.filesystem(scheme)
    except ImportError as error:
        raise SettingsError(f"{address}: {one_line(error)}") from error
    except Exception as error:
        raise RemoteError(f"{address}: {one_line(error)}") from error


@contextlib.contextmanager
def _named(address: str) -> Iterator[None]:
    """Turn an error of a file system of any kind into one line that names the address."""
    try:
        yield
    except SparseskinError:
        raise
    except FileNotFoundError as error:
        raise RemoteError(f"{address}: no such file") from error
    except Exception as error:
        raise RemoteError(f"{address}: {one_line(error)}") from error
