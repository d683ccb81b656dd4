"""The part of a graph that runs on one host, with the keys that it needs there."""

from __future__ import annotations

from dataclasses import replace

from sparseskin.nodes.keys import KeyFileError
from sparseskin.nodes.lookup import did_you_mean

from .credentials import read_credentials
from .launchspec import LaunchError, LaunchFile


def part_of(launch: LaunchFile, host: str | None) -> LaunchFile:
    """What of a launch file is to run here.

    Parameters
    ----------
    launch : LaunchFile
        The whole graph.
    host : str or None
        Which host this is; None where the graph has but one.

    Raises
    ------
    LaunchError
        If the host is missing, unknown or one too many, or its keys cannot be used.
    """
    names = ", ".join(launch.hosts)
    if launch.hosts and host is None:
        raise LaunchError([f"{launch.name}: several hosts: choose one with --host ({names})"])
    if host is not None and not launch.hosts:
        raise LaunchError([f"--host {host}: {launch.name} has no tables [hosts.NAME]"])
    if host is not None and host not in launch.hosts:
        hint = did_you_mean(host, launch.hosts)
        raise LaunchError([f"--host {host}: {launch.name} has no such host{hint}"])
    here = host or ""
    key = launch.hosts[here].key if here else launch.security.key if launch.security else ""
    try:
        found = read_credentials(launch.security, key, launch.hosts) if launch.security else None
    except KeyFileError as error:
        raise LaunchError([str(error)]) from error
    # A recorder that was asked for on the command line is of this host, too.
    nodes = {n: spec for n, spec in launch.nodes.items() if spec.host in ("", here)}
    links = [link for link in launch.links if link.reader in nodes or link.writer in nodes]
    elsewhere = {n: spec for n, spec in launch.nodes.items() if n not in nodes}
    return replace(
        launch, nodes=nodes, links=links, elsewhere=elsewhere, host=here, credentials=found
    )
