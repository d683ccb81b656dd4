"""Key files: the key pair of a host, and the public keys of its peers.

A key pair is two text files. NAME.pub is public; NAME.key is the secret of one host and is
refused if any other user can read or write it.
"""

import os
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import zmq

from sparseskin.messages.errors import MessageError
from sparseskin.messages.topics import check_name
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.files import TAKEN

SECRET_SUFFIX = ".key"
PUBLIC_SUFFIX = ".pub"
SECRET_MODE = 0o600
KEY_CHARACTERS = 40
"""Length of a CURVE key as text (Z85)."""
MAX_KEY_FILE_BYTES = 4096
"""Most that is read of a file: a key and some lines of comment are far shorter."""
_Z85 = re.compile(r"[0-9A-Za-z.\-:+=^!/*?&<>()\[\]{}@%$#]+")


class KeyFileError(SparseskinError):
    """A key file is missing, malformed or not private."""


@dataclass(frozen=True)
class KeyPair:
    """A CURVE key pair, both keys as 40 characters of Z85."""

    public: str
    secret: str

    def __repr__(self) -> str:
        return f"KeyPair(public={self.public!r})"  # no secret in logs


def make_key_files(name: str, folder: Path) -> tuple[Path, Path]:
    """Make a key pair; return its secret file (mode 0600) and its public file.

    KeyFileError if the name is not valid, a file exists, or the folder cannot be written to.
    """
    try:
        check_name("NAME", name)
    except MessageError as error:
        raise KeyFileError(str(error)) from error
    secret_file = folder / f"{name}{SECRET_SUFFIX}"
    public_file = folder / f"{name}{PUBLIC_SUFFIX}"
    for path in (secret_file, public_file):
        if os.path.lexists(path):
            raise KeyFileError(f"{path}: {TAKEN}")

    # The folder of new keys is this user's alone: whoever writes to it can replace them.
    public_bytes, secret_bytes = zmq.curve_keypair()
    public = public_bytes.decode()
    secret = secret_bytes.decode()
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        use = f"# the secret key of {name}: for this host alone"
        _write(secret_file, SECRET_MODE, use, secret)
        use = f"# the public key of {name}: for its peers"
        _write(public_file, 0o644, use, public)
    except OSError as error:
        raise KeyFileError(f"{error.filename or folder}: {error.strerror}") from error
    return secret_file, public_file


def read_key_pair(path: Path) -> KeyPair:
    """Read the key pair of a secret file.

    KeyFileError if it cannot be read, belongs to another user, can be read or written by others
    (allowed: mode 0600 or less), or holds no secret key.
    """

    def check(status: os.stat_result) -> None:
        if status.st_uid != os.geteuid():
            raise KeyFileError(f"{path}: belongs to user {status.st_uid}, not to you")
        mode = stat.S_IMODE(status.st_mode)
        if mode & ~SECRET_MODE:
            raise KeyFileError(
                f"{path}: mode {mode:04o} lets other users read the secret key "
                f"(allowed: {SECRET_MODE:04o}; chmod 600 {path})"
            )

    secret = _key_in(path, check)
    try:
        # The public key follows from the secret one.
        public = zmq.curve_public(secret.encode())
        return KeyPair(public.decode(), secret)
    except (zmq.ZMQError, ValueError) as error:
        raise KeyFileError(f"{path}: holds no secret key") from error


def read_public_key(path: Path) -> str:
    """Read the key of a public file, 40 characters.

    KeyFileError if it cannot be read, holds no key, or can be replaced by another user, who could
    then read the graph: it and its folder belong to this user or to root, and are not writable by
    all (a folder may be with the sticky bit).
    """

    def check(status: os.stat_result) -> None:
        _check_owner(path, status)
        _check_owner(path.parent, path.parent.stat())

    return _key_in(path, check)


def known_names(folder: Path) -> Mapping[str, str]:
    """Name of each public key in a folder; other files are ignored."""
    names = {}
    for path in sorted(folder.glob(f"*{PUBLIC_SUFFIX}")):
        try:
            names[read_public_key(path)] = path.stem
        except KeyFileError:
            # Where it is needed it is read by name, with the error.
            continue
    return names


def _check_owner(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in (0, os.geteuid()):
        raise KeyFileError(
            f"{path}: belongs to user {status.st_uid}, who can replace the key "
            "(allowed: files of your own or of root)"
        )
    # In a folder with the sticky bit, as /tmp, only the owner replaces a file.
    sticky = stat.S_ISDIR(status.st_mode) and status.st_mode & stat.S_ISVTX
    if status.st_mode & stat.S_IWOTH and not sticky:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(
            f"{path}: mode {mode:04o} lets other users replace the key (chmod o-w {path})"
        )


def _write(path: Path, mode: int, comment: str, key: str) -> None:
    # Created with its mode, so that others can at no moment read it.
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    fd = os.open(path, flags, mode)
    with os.fdopen(fd, "w") as file:
        file.write(f"{comment}\n{key}\n")


def _key_in(path: Path, check: Callable[[os.stat_result], None]) -> str:
    """The only key in a file that passes a check of its owner and mode."""
    try:
        with path.open("rb") as file:
            # Of the open file: the path may name another one a moment later.
            check(os.fstat(file.fileno()))
            content = file.read(MAX_KEY_FILE_BYTES)
    except OSError as error:
        hint = ""
        if not path.exists():
            hint = f" (make one: sparseskin keys make {path.stem})"
        raise KeyFileError(f"{path}: {error.strerror}{hint}") from error

    keys = []
    for line in content.decode(errors="replace").splitlines():
        key = line.strip()
        # A key of Z85 may begin with "#", a comment begins with "# ".
        if key and not key.startswith("# "):
            keys.append(key)
    if len(keys) == 1:
        (key,) = keys
        if len(key) == KEY_CHARACTERS and _Z85.fullmatch(key):
            return key
    raise KeyFileError(f"{path}: expected one key of {KEY_CHARACTERS} characters in it")
