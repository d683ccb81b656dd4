"""The tables [hosts.NAME] and [security] of a launch file, and the keys of one host."""

from __future__ import annotations

import ipaddress
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sparseskin.messages.errors import MessageError
from sparseskin.messages.topics import check_name
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.network.keys import (
    PUBLIC_SUFFIX,
    SECRET_SUFFIX,
    KeyPair,
    known_names,
    read_key_pair,
    read_public_key,
)

HOST_KEYS = ("address", "base_port", "key")
SECURITY_KEYS = ("keys", "key", "allow")
BASE_PORT = 5700
PORTS = range(1024, 65536)
MAX_HOSTS = 32
HOST_KEY, PORT_KEY = "host", "publish_port"
"""Keys of [nodes.NAME] for its host and its port, in a graph of several hosts."""

Fault = Callable[[tuple[str, ...], str], None]


@dataclass(frozen=True)
class Host:
    """One host of a graph: nodes that others read are bound to `address`, from `base_port` on."""

    name: str
    address: str
    base_port: int = BASE_PORT
    key: str = ""

    @property
    def is_loopback(self) -> bool:
        """True if nothing outside this computer can reach it."""
        return ipaddress.ip_address(self.address).is_loopback


@dataclass(frozen=True)
class Security:
    """Folder of the keys, name of the own key of a graph of one host, names of readers' keys."""

    folder: Path
    key: str
    allow: tuple[str, ...]


def read_hosts(tree: Mapping[str, Any], fault: Fault) -> dict[str, Host]:
    """The hosts of a launch file; none where it has no [hosts.NAME]."""
    tables = tree.get("hosts", {})
    if not isinstance(tables, dict) or not all(isinstance(t, dict) for t in tables.values()):
        fault(("hosts",), "expected tables [hosts.NAME]")
        return {}
    if len(tables) > MAX_HOSTS:
        fault(("hosts",), f"{len(tables)} hosts, at most {MAX_HOSTS}")
        return {}
    hosts = {}
    for name, table in tables.items():
        try:
            check_name("name", name)
            host = Host(name, _address(table), _port(table, "base_port", BASE_PORT), name)
        except MessageError as error:
            fault(("hosts", name), str(error))
            continue
        except _KeyedError as error:
            fault(("hosts", name, error.key), str(error))
            continue
        for key in table:
            if key not in HOST_KEYS:
                fault(("hosts", name, key), f"unknown key{did_you_mean(key, HOST_KEYS)}")
        hosts[name] = Host(name, host.address, host.base_port, str(table.get("key", name)))
    return hosts


def read_security(
    tree: Mapping[str, Any], hosts: Mapping[str, Host], folder: Path, fault: Fault
) -> Security | None:
    """The table [security], its folder of keys relative to that of the launch file; or None."""
    if "security" not in tree:
        return None
    table = tree["security"]
    if not isinstance(table, dict):
        fault(("security",), "expected a table [security]")
        return None
    for key in table:
        if key not in SECURITY_KEYS:
            fault(("security", key), f"unknown key{did_you_mean(key, SECURITY_KEYS)}")
    keys = table.get("keys")
    if not isinstance(keys, str):
        fault(("security", "keys"), "expected the folder of the key files, a text")
        return None
    own = table.get("key", "")
    if hosts and own:
        fault(("security", "key"), "with several hosts each has its own: hosts.NAME.key")
    elif not hosts and not _is_name(own):
        fault(("security", "key"), "expected the name of this graph's key, a text")
        return None
    listed = table.get("allow", [host.key for host in hosts.values()] or [own])
    if not isinstance(listed, list) or not all(_is_name(name) for name in listed):
        fault(("security", "allow"), "expected a list of names of keys")
        return None
    return Security(folder / keys, own if isinstance(own, str) else "", tuple(listed))


def check_exposure(
    hosts: Iterable[Host], security: Security | None, insecure: bool, fault: Fault
) -> None:
    """Refuse hosts whose topics anyone on the network could read, unless the file states it."""
    for host in hosts:
        if not host.is_loopback and security is None and not insecure:
            fault(
                ("hosts", host.name, "address"),
                f"{host.address} can be reached from other computers, and there are no keys "
                "(state [security] keys, or insecure = true in [graph])",
            )


def read_place(
    name: str, values: dict[str, Any], hosts: Mapping[str, Host], fault: Fault
) -> tuple[str, int]:
    """Remove a node's host and its port, 0 where none is stated, from its values; return them."""
    host = values.pop(HOST_KEY, None)
    try:
        port = _port(values, PORT_KEY, 0) if PORT_KEY in values else 0
    except _KeyedError as error:
        fault(("nodes", name, error.key), str(error))
        port = 0
    values.pop(PORT_KEY, None)
    if host is None:
        fault(("nodes", name), f"the key 'host' is missing (hosts: {', '.join(hosts)})")
    elif host not in hosts:
        fault(("nodes", name, HOST_KEY), f"{host!r} is no host{did_you_mean(str(host), hosts)}")
    return str(host), port


def give_ports(
    places: Mapping[str, tuple[str, int]], hosts: Mapping[str, Host], fault: Fault
) -> dict[str, str]:
    """Public endpoint of each node that publishes, by its host and stated port (0: none); the n-th
    node of a host without a stated port, in the order of the launch file, gets its base port + n.
    """
    endpoints: dict[str, str] = {}
    next_port = {name: host.base_port for name, host in hosts.items()}
    for node, (host, stated) in places.items():
        port = stated or next_port[host]
        next_port[host] += not stated
        endpoint = f"tcp://{hosts[host].address}:{port}"
        if port not in PORTS:
            fault(("nodes", node, PORT_KEY), f"port {port} is outside {_PORTS_TEXT}")
        for other, taken in endpoints.items():
            if endpoint == taken:
                fault(("nodes", node), f"publishes at {endpoint}, where {other} does too")
        endpoints[node] = endpoint
    return endpoints


_PORTS_TEXT = f"{PORTS.start}..{PORTS.stop - 1}"


class _KeyedError(SettingsError):
    """A value of one key that is not allowed."""

    def __init__(self, key: str, text: str) -> None:
        super().__init__(text)
        self.key = key


def _address(table: Mapping[str, Any]) -> str:
    address = table.get("address")
    allowed = "(allowed: the IPv4 address of one host, as 192.168.1.10)"
    try:
        parsed = ipaddress.IPv4Address(address if isinstance(address, str) else "")
    except ValueError as error:
        raise _KeyedError("address", f"{address!r} is no address {allowed}") from error
    if parsed.is_unspecified or parsed.is_multicast:
        raise _KeyedError("address", f"{address!r} is not the address of a host {allowed}")
    return str(parsed)


def _port(table: Mapping[str, Any], key: str, default: int) -> int:
    port = table.get(key, default)
    if type(port) is not int or port not in PORTS:
        raise _KeyedError(key, f"{port!r} is not allowed (allowed: {_PORTS_TEXT})")
    return port


def _is_name(name: object) -> bool:
    try:
        check_name("key", name)
    except MessageError:
        return False
    return True


@dataclass(frozen=True)
class Credentials:
    """The keys of one host: its own and the file of its secret; name by public key of the peers
    that may read here, and of all that are known; public key of each other host by its name.
    """

    own: KeyPair
    file: str
    allowed: Mapping[str, str]
    known: Mapping[str, str]
    servers: Mapping[str, str]


def read_credentials(security: Security, key: str, hosts: Mapping[str, Host]) -> Credentials:
    """Read the key files that the host with a key needs.
    Raises KeyFileError if one is missing or cannot be used.
    """
    folder = security.folder

    def public(name: str) -> str:
        return read_public_key(folder / f"{name}{PUBLIC_SUFFIX}")

    file = folder / f"{key}{SECRET_SUFFIX}"
    own = read_key_pair(file)
    allowed = {public(name): name for name in security.allow}
    servers = {name: public(host.key) for name, host in hosts.items() if host.key != key}
    # The nodes of this host read from each other with its own key.
    return Credentials(
        own, str(file.resolve()), {**allowed, own.public: key}, known_names(folder), servers
    )
