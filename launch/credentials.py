"""The keys that one host of a graph needs: its own, and those that it believes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from sparseskin.nodes.keys import (
    PUBLIC_SUFFIX,
    SECRET_SUFFIX,
    KeyPair,
    known_names,
    read_key_pair,
    read_public_key,
)

from .hosts import Host, Security


@dataclass(frozen=True)
class Credentials:
    """The keys of one host.

    Attributes
    ----------
    own : KeyPair
        Its own.
    file : str
        Where its secret lies.
    allowed : mapping of str to str
        Public key and name of each peer that may read here.
    known : mapping of str to str
        All public keys that lie beside it, and their names.
    servers : mapping of str to str
        Public key of each other host, by the host's name.
    """

    own: KeyPair
    file: str
    allowed: Mapping[str, str]
    known: Mapping[str, str]
    servers: Mapping[str, str]


def read_credentials(security: Security, key: str, hosts: Mapping[str, Host]) -> Credentials:
    """Read the key files that the host with a key needs.

    Raises
    ------
    KeyFileError
        If one is missing or cannot be used.
    """
    folder = security.folder
    file = folder / f"{key}{SECRET_SUFFIX}"
    own = read_key_pair(file)
    allowed = {_public(folder, name): name for name in security.allow}
    servers = {name: _public(folder, host.key) for name, host in hosts.items() if host.key != key}
    # The nodes of this host read from each other with its own key.
    return Credentials(
        own, str(file.resolve()), {**allowed, own.public: key}, known_names(folder), servers
    )


def _public(folder: Path, name: str) -> str:
    return read_public_key(folder / f"{name}{PUBLIC_SUFFIX}")
