"""A launch file that has been checked: its nodes, links, hosts and keys."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

from sparseskin.launch.run.restarts import RestartPolicy
from sparseskin.messages.text import printable
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.graph import Link
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.network.keys import KeyFileError
from sparseskin.nodes.node import Node
from sparseskin.nodes.process.scheduling import Scheduling

from .hosts import Credentials, Host, Security, read_credentials
from .tables import Table

LAUNCHER = "launch"
"""Name of the launcher itself, as the receiver of requests and in the log."""
LIVE_RECORDER = "live_recorder_"
"""Begin of the names of recorders that are started while a graph runs."""


class LaunchError(SparseskinError):
    """A launch file that cannot be used; `lines` holds one line an error, each with its place."""

    def __init__(self, lines: Sequence[str]) -> None:
        self.lines = [printable(line) for line in lines]
        super().__init__(*self.lines)


@dataclass(frozen=True)
class NodeSpec:
    """One node of a launch file; `public` is where other hosts find what it publishes, `process`
    the name of the process that it shares with others, "" for none.
    """

    name: str
    type_name: str
    cls: type[Node[Any]]
    values: Table
    settings: Any
    restart: RestartPolicy = RestartPolicy()
    scheduling: Scheduling = Scheduling()
    host: str = ""
    public: str = ""
    process: str = ""

    @property
    def outputs(self) -> tuple[str, ...]:
        """Topics that it publishes."""
        return self.cls.outputs(self.settings)

    def with_live(self, values: Table) -> Self:
        """The same node with what was changed while it ran."""
        live = self.settings.live_values()
        changed = {}
        for key, value in values.items():
            if value != live[key]:
                changed[key] = value
        # TOML has no null: what is not stated is left out.
        stated = self.values | changed
        for key, value in changed.items():
            if value is None:
                del stated[key]
        settings = replace(self.settings, **changed)
        return replace(self, values=stated, settings=settings)

    def again(self, n_restarts: int) -> Self:
        """The same node as it is started again after its n-th failure."""
        values = self.cls.values_again(self.settings, n_restarts)
        settings = replace(self.settings, **values)
        return replace(self, values=self.values | values, settings=settings)


@dataclass(frozen=True)
class LaunchFile:
    """A checked launch file; `text` is the file as it stands, with the changes of --set, `folder`
    the one in which its nodes search modules, "" for none, `shown` its path for error lines.

    Of a graph of several hosts, `host` is the one whose part this is, `nodes` are those that run
    there and `elsewhere` the others; "" and none as long as no host was chosen.
    """

    name: str
    description: str
    transport: str
    nodes: dict[str, NodeSpec]
    links: list[Link]
    text: str = ""
    hosts: dict[str, Host] = field(default_factory=dict)
    security: Security | None = None
    insecure: bool = False
    host: str = ""
    elsewhere: dict[str, NodeSpec] = field(default_factory=dict)
    credentials: Credentials | None = None
    log_dir: str = ""
    folder: str = ""
    title: str = ""

    def part(self, host: str | None) -> Self:
        """The part of a graph that runs on one host, with the keys that it needs there; `host` is
        None where the graph has but one.
        Raises LaunchError if the host is missing, unknown or one too many, its keys cannot be used,
        or a node may not be scheduled there as stated.
        """
        problem = self._host_problem(host)
        if problem:
            raise LaunchError([problem])
        host_name = host or ""
        credentials = self._credentials(host_name)
        nodes: dict[str, NodeSpec] = {}
        elsewhere: dict[str, NodeSpec] = {}
        for name, spec in self.nodes.items():
            # A recorder that was asked for on the command line is of this host, too.
            if spec.host in ("", host_name):
                nodes[name] = spec
            else:
                elsewhere[name] = spec
        links = []
        for link in self.links:
            if link.reader in nodes or link.writer in nodes:
                links.append(link)

        # One line for all nodes that state the same.
        refused: dict[str, list[str]] = {}
        for spec in nodes.values():
            try:
                spec.scheduling.check_permitted()
            except SettingsError as error:
                refused.setdefault(str(error), []).append(spec.name)
        if refused:
            lines = []
            for problem, names in refused.items():
                lines.append(f"{self.title}: {', '.join(names)}: {problem}")
            raise LaunchError(lines)
        return replace(
            self,
            nodes=nodes,
            links=links,
            elsewhere=elsewhere,
            host=host_name,
            credentials=credentials,
        )

    def _host_problem(self, host: str | None) -> str:
        """Why a graph has no part of a host, None: none is stated; "" if it has one."""
        if host is None:
            if not self.hosts:
                return ""
            names = ", ".join(self.hosts)
            return f"{self.name}: several hosts: choose one with --host ({names})"
        if not self.hosts:
            return f"--host {host}: {self.name} has no tables [hosts.NAME]"
        if host not in self.hosts:
            hint = did_you_mean(host, self.hosts)
            return f"--host {host}: {self.name} has no such host{hint}"
        return ""

    def _credentials(self, host_name: str) -> Credentials | None:
        """The keys of one host ("": the graph has but one), read from their files; or None."""
        # Read here and not with the file: each host has the secret of its own key alone.
        if self.security is None:
            return None
        key = self.security.key
        if host_name:
            key = self.hosts[host_name].key
        try:
            return read_credentials(self.security, key, self.hosts)
        except KeyFileError as error:
            raise LaunchError([str(error)]) from error
