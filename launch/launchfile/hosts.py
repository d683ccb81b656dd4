"""The tables [hosts.NAME] and [security] of a launch file, and the keys of one host."""

import ipaddress
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from sparseskin.nodes.settings import Settings, setting

from .tables import Fault, bad_name, read_table, read_tables

PORTS = range(1024, 65536)
"""Ports that a program may bind without the rights of root."""
MAX_HOSTS = 32
"""Hosts of a graph; chosen: each node connects to all that it reads."""


@dataclass(frozen=True)
class Host(Settings):
    """The table [hosts.NAME]: nodes that other hosts read are bound there."""

    address: str = setting("", "IPv4 address of the host")
    base_port: int = setting(
        5700, "port of its first node", low=PORTS.start, high=PORTS.stop - 1
    )
    key: str = setting("", "name of its key; that of the host by default")

    def __post_init__(self) -> None:
        super().__post_init__()
        # That none is stated is reported as missing.
        if self.address and not _is_of_a_host(self.address):
            raise SettingsError(
                f"address: {self.address!r} is no address of a host (allowed: the IPv4 "
                "address of one host, as 192.168.1.10)"
            )


Hosts = Mapping[str, Host]
"""The hosts of a graph by their names."""


def _is_of_a_host(address: str) -> bool:
    try:
        # A name would have to be looked up, by each host its own way.
        parsed = ipaddress.IPv4Address(address)
    except ValueError:
        return False
    return not parsed.is_unspecified and not parsed.is_multicast


@dataclass(frozen=True)
class Security(Settings):
    """The table [security]."""

    keys: str = setting("", "folder of the key files")
    key: str = setting("", "name of the own key of a graph of one host")
    allow: tuple[str, ...] = setting(
        (), "names of the keys of readers; by default all hosts'"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(map(bad_name, self.allow)):
            raise SettingsError(
                f"allow: expected a list of names of keys, got {self.allow}"
            )


def read_hosts(tree: Mapping[str, Any], fault: Fault) -> dict[str, Host]:
    """The hosts of a launch file; none where it has no [hosts.NAME]."""
    hosts = {}
    for name, table in read_tables(tree, "hosts", MAX_HOSTS, fault).items():
        if "address" not in table:
            fault(("hosts", name), "the key 'address' is missing")
        default = Host(key=name)
        (host,), _ = read_table(table, ("hosts", name), fault, default)
        # Without an address nothing can be placed there: it is reported above.
        if host.address:
            hosts[name] = host
    return hosts


def read_security(
    tree: Mapping[str, Any], hosts: Hosts, folder: Path, fault: Fault
) -> Security | None:
    """The table [security], its folder of keys relative to that of the launch file; or None."""
    if "security" not in tree:
        return None
    place = ("security",)
    table = tree["security"]
    (security,), _ = read_table(table, place, fault, Security())
    if isinstance(table, dict) and "keys" not in table:
        fault((*place, "keys"), "expected the folder of the key files, a text")
    if hosts and security.key:
        fault((*place, "key"), "with several hosts each has its own: hosts.NAME.key")
    elif not hosts and bad_name(security.key):
        fault((*place, "key"), "expected the name of this graph's key, a text")
    # All hosts of the graph may read each other; a graph of one host is read with its own key.
    allow = security.allow
    if not allow:
        allow = tuple(host.key for host in hosts.values() if host.key)
    if not allow and security.key:
        allow = (security.key,)
    keys = str(folder / security.keys)
    with_folder: Security = replace(security, keys=keys, allow=allow)
    return with_folder


def check_exposure(
    hosts: Hosts, security: Security | None, insecure: bool, fault: Fault
) -> None:
    """Refuse hosts whose topics anyone on the network could read, unless the file states it."""
    for name, host in hosts.items():
        is_loopback = ipaddress.ip_address(host.address).is_loopback
        if not is_loopback and security is None and not insecure:
            fault(
                ("hosts", name, "address"),
                f"{host.address} can be reached from other computers, and there are no keys "
                "(state [security] keys, or insecure = true in [graph])",
            )


def check_place(name: str, host: str, hosts: Hosts, fault: Fault) -> None:
    """Check that the host of a node is one of the graph."""
    if not host:
        fault(("nodes", name), f"the key 'host' is missing (hosts: {', '.join(hosts)})")
    elif host not in hosts:
        fault(
            ("nodes", name, "host"), f"{host!r} is no host{did_you_mean(host, hosts)}"
        )


def give_ports(places: Mapping[str, str], hosts: Hosts, fault: Fault) -> dict[str, str]:
    """Public endpoint of each node that publishes, by the name of its host; the n-th node of a
    host, in the order of the launch file, gets its base port + n.
    """
    endpoints: dict[str, str] = {}
    # Ports follow from the file alone, so that all hosts agree on them.
    next_port = {name: host.base_port for name, host in hosts.items()}
    for node, host in places.items():
        port = next_port[host]
        next_port[host] += 1
        endpoint = f"tcp://{hosts[host].address}:{port}"
        place = ("nodes", node)
        if port not in PORTS:
            fault(place, f"port {port} is outside {PORTS.start}..{PORTS.stop - 1}")
        # Two hosts of one address may have ranges of ports that overlap.
        for other_node, taken in endpoints.items():
            if endpoint == taken:
                fault(place, f"publishes at {endpoint}, where {other_node} does too")
        endpoints[node] = endpoint
    return endpoints


@dataclass(frozen=True)
class Credentials:
    """The keys of one host: its own and the file of its secret; name by public key of the peers
    that may read here, and of all that are known; public key of each other host by its name.
    """

    key_pair: KeyPair
    file: str
    allowed: Mapping[str, str]
    names: Mapping[str, str]
    servers: Mapping[str, str]


def read_credentials(security: Security, key: str, hosts: Hosts) -> Credentials:
    """Read the key files that the host with a key needs.
    Raises KeyFileError if one is missing or cannot be used.
    """
    folder = Path(security.keys)

    def public(name: str) -> str:
        return read_public_key(folder / f"{name}{PUBLIC_SUFFIX}")

    file = folder / f"{key}{SECRET_SUFFIX}"
    key_pair = read_key_pair(file)
    # ZeroMQ names a peer by its key alone.
    allowed = {public(name): name for name in security.allow}
    # The nodes of this host read from each other with its own key.
    allowed[key_pair.public] = key
    servers = {}
    for name, host in hosts.items():
        # Hosts may share a key.
        if host.key != key:
            servers[name] = public(host.key)
    names = known_names(folder)
    return Credentials(key_pair, str(file.resolve()), allowed, names, servers)
