"""Checks a launch file whole: all its faults at once, each with its place."""

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from sparseskin.launch.run.restarts import RestartPolicy
from sparseskin.nodes.errors import NotHereError, SparseskinError
from sparseskin.nodes.graph import Link, join
from sparseskin.nodes.lookup import did_you_mean
from sparseskin.nodes.node import Node
from sparseskin.nodes.process.scheduling import Scheduling
from sparseskin.nodes.registry import node_class
from sparseskin.nodes.settings import Settings, setting
from sparseskin.nodes.toml import toml_or_text

from .hosts import (
    Hosts,
    check_exposure,
    check_place,
    give_ports,
    read_hosts,
    read_security,
)
from .processes import Composition, check_processes
from .spec import LAUNCHER, LIVE_RECORDER, LaunchError, LaunchFile, NodeSpec
from .stated import as_words
from .tables import Place, Table, read_table, read_tables

RECORDER = "recorder"
SKIN = "skin"
"""Table of the patches of a body."""
GRAPH = "graph"
"""Table of what holds for all nodes."""
TO_NAME = "RECORDING"
"""Placeholder in a launch file for a recording that the user has to name."""
TABLES = (GRAPH, "nodes", "hosts", "security", SKIN)
MAX_NODES = 256
"""Nodes of a graph; chosen: each is a process as a rule."""
MAX_ERRORS = 50
"""Errors of one file that are reported."""
MAX_ERROR = 1000
"""Characters of one error that are reported."""


@dataclass(frozen=True)
class GraphTable(Settings):
    """The table [graph], beside the keys of `RestartPolicy`, `Scheduling` and `Composition`."""

    description: str = setting("", "one line about the graph")
    transport: str = setting("ipc", "how its nodes are joined", choices=("ipc", "tcp"))
    log_dir: str = setting("", "folder of the log files of each run")
    insecure: bool = setting(False, "true: whoever reaches its addresses may read it")


GRAPH_TABLES = (GraphTable, RestartPolicy, Scheduling, Composition)
"""Settings that the table [graph] states; all but the first also of each node."""


@dataclass
class Checker:
    """Turns a TOML tree into a LaunchFile, or all its errors into a LaunchError."""

    title: str
    text: str
    tree: Table
    name: str
    folder: Path = Path()
    launched: str = ""
    errors: list[str] = field(default_factory=list)
    overridden: dict[Place, str] = field(default_factory=dict)
    templates: dict[str, str] = field(default_factory=dict)
    supervision: list[Settings] = field(default_factory=list)
    places: dict[str, str] = field(default_factory=dict)

    def check(self, overrides: Sequence[str], record: str | None) -> LaunchFile:
        for key in self.tree:
            if key not in TABLES:
                self.fault((key,), f"unknown table{did_you_mean(key, TABLES)}")
        tables = self.node_tables()
        # Changes come first: each value is checked as it will be used.
        for override in overrides:
            self.override(override, tables)

        defaults = [cls() for cls in GRAPH_TABLES]
        (graph, *self.supervision), _ = read_table(
            self.tree.get(GRAPH, {}), (GRAPH,), self.fault, *defaults
        )

        # Hosts, and who may read what they send.
        hosts = read_hosts(self.tree, self.fault)
        security = read_security(self.tree, hosts, self.folder, self.fault)
        check_exposure(hosts, security, graph.insecure, self.fault)

        # What a recording keeps: the file with the changes as comments.
        changes = "".join(f"# --set {override}\n" for override in overrides)
        self.launched = changes + self.text

        tables = self.expanded(tables)
        if record is None:
            self.take_places(tables, hosts)
        else:
            self.add_recorder(tables, hosts, record)

        # Even with faults in some nodes: all that is wrong is reported at once.
        nodes = self.nodes(tables)
        links = self.connected(nodes, tables, hosts)
        if self.errors:
            raise LaunchError(self.errors[:MAX_ERRORS])
        return LaunchFile(
            self.name,
            graph.description,
            graph.transport,
            nodes,
            links,
            self.launched,
            hosts,
            security,
            graph.insecure,
            log_dir=graph.log_dir,
            title=self.title,
        )

    def add_recorder(self, tables: dict[str, Table], hosts: Hosts, record: str) -> None:
        """Add a recorder in place of that of the file, and take the hosts of the other nodes."""
        tables.pop(RECORDER, None)
        # It has no place: it runs wherever --record was typed.
        self.take_places(tables, hosts)
        # A process of its own: that it writes a file holds up no other node.
        tables[RECORDER] = {
            "type": "recorder",
            "out": record,
            "process": "",
        }
        self.overridden[RECORDER, "out"] = "--record"

    def take_places(self, tables: dict[str, Table], hosts: Hosts) -> None:
        """Take the host of each node out of its table, in a graph of several hosts."""
        if not hosts:
            return
        for name, table in tables.items():
            self.places[name] = str(table.pop("host", ""))
            check_place(name, self.places[name], hosts, self.fault)

    def nodes(self, tables: dict[str, Table]) -> dict[str, NodeSpec]:
        """The nodes whose tables have no fault, each checked against what the others state."""
        nodes: dict[str, NodeSpec] = {}
        for name, table in tables.items():
            spec = self.node(name, table)
            if spec is not None:
                nodes[name] = spec

        # What others state has to be known first, whatever their order.
        facts: Table = {}
        for spec in nodes.values():
            facts |= spec.cls.facts(spec.settings)
        for spec in nodes.values():
            try:
                spec.cls.check_inputs(spec.settings, facts)
            except SparseskinError as error:
                self.node_fault(spec.name, spec.values, error)
        return nodes

    def connected(
        self,
        nodes: dict[str, NodeSpec],
        tables: Mapping[str, Table],
        hosts: Hosts,
    ) -> list[Link]:
        """The links of the graph, whose nodes are put on their hosts; none if there is an error."""
        # Of a part of the nodes, faults would be found that the whole graph does not have.
        if self.errors:
            return []
        links = self.joined(nodes)
        self.place(nodes, hosts)
        stated = [name for name, table in tables.items() if "process" in table]
        check_processes(nodes, stated, self.fault)
        return links

    def joined(self, nodes: dict[str, NodeSpec]) -> list[Link]:
        """The links of the graph; none, and a fault noted, where they cannot be made."""
        specs = {}
        for name, spec in nodes.items():
            specs[name] = (spec.cls, spec.settings)
        try:
            return join(specs)
        except SparseskinError as error:
            self.errors.append(f"{self.title}: {error}")
            return []

    def place(self, nodes: dict[str, NodeSpec], hosts: Hosts) -> None:
        """Put nodes on their hosts, with the ports at which they publish there."""
        # All that publish, read or not: a recorder more on one host moves no port of another.
        places = self.places
        publish = {}
        for name, place in places.items():
            if nodes[name].outputs:
                publish[name] = place
        endpoints = give_ports(publish, hosts, self.fault)
        for name, place in places.items():
            public = endpoints.get(name, "")
            nodes[name] = replace(nodes[name], host=place, public=public)

    def node_tables(self) -> dict[str, Table]:
        if not self.tree.get("nodes"):
            self.errors.append(
                f"{self.title}: nodes: expected at least one table [nodes.NAME]"
            )
            return {}
        tables = read_tables(self.tree, "nodes", MAX_NODES, self.fault)
        for name in [*tables]:
            if name == LAUNCHER or name.startswith(LIVE_RECORDER):
                names = f"'{LAUNCHER}' and '{LIVE_RECORDER}...'"
                self.fault(("nodes", name), f"{names} are names of the launcher's own")
                del tables[name]
        return tables

    def expanded(self, tables: dict[str, Table]) -> dict[str, Table]:
        """The tables with the nodes that serve the body of the table [skin], where there is one."""
        if SKIN not in self.tree:
            return tables
        # Imported here: with it come simulated scenes.
        from .body import expand, read_skin

        # A file that --set names is found from where the command was typed.
        folder = self.folder
        if (SKIN, "body") in self.overridden:
            folder = Path()
        batches = read_skin(self.tree[SKIN], folder, self.fault)
        if not batches:
            raise LaunchError(self.errors[:MAX_ERRORS])
        node_tables: dict[str, Table] = {}
        for name, table in tables.items():
            try:
                fields = _setting_names(node_class(table["type"]))
            except (SparseskinError, KeyError, TypeError):
                # Reported with the node.
                fields = set()
            of_batches = expand(name, table, fields, batches)
            self.templates |= dict.fromkeys(of_batches, name)
            for node in of_batches:
                if node in node_tables or (node != name and node in tables):
                    self.fault(
                        ("nodes", name), f"makes a node '{node}', of which there is one"
                    )
            node_tables |= of_batches
        if len(node_tables) > MAX_NODES:
            self.errors.append(
                f"{self.title}: {len(node_tables)} nodes; at most {MAX_NODES} are "
                "allowed"
            )
            raise LaunchError(self.errors[:MAX_ERRORS])
        return node_tables

    def override(self, text: str, tables: dict[str, Table]) -> None:
        match = re.fullmatch(r"([^.=]+)\.([^.=]+)(?:\.([^.=]+))?=(.*)", text, re.DOTALL)
        if match is None:
            self.errors.append(f"--set {text}: expected NODE.KEY=VALUE")
            return
        node, key, part, raw = match.groups()
        if node == SKIN and isinstance(self.tree.get(SKIN), dict):
            tables = {SKIN: self.tree[SKIN]}
        elif node == GRAPH and node not in tables:
            graph = self.tree.setdefault(GRAPH, {})
            if not isinstance(graph, dict):
                # Reported with the table.
                return
            tables = {GRAPH: graph}
        if node not in tables:
            hint = did_you_mean(node, [*tables, GRAPH])
            self.errors.append(f"--set {text}: unknown node '{node}'{hint}")
            return
        value = toml_or_text(raw)
        place: Place = (node, key)
        if part is not None:
            # One value of a table: the others stay.
            table = tables[node].get(key)
            if not isinstance(table, dict):
                table = {}
            value = {**table, part: value}
            # Tables of [graph] are checked as a whole.
            if node != GRAPH:
                place = (node, key, part)
        tables[node][key] = value
        self.overridden[place] = f"--set {text}"

    def node(self, name: str, table: Table) -> NodeSpec | None:
        values = dict(table)
        type_name = values.pop("type", None)
        if not isinstance(type_name, str):
            self.fault(("nodes", name), "the key 'type' is missing or not a text")
            return None
        try:
            cls = node_class(type_name)
        except SparseskinError as error:
            self.fault(("nodes", name, "type"), str(error))
            return None
        (restart, scheduling, composition), values = read_table(
            values, ("nodes", name), self.fault, *self.supervision, more=True
        )
        # A recorder, recognised by its settings: importing its class loads the writers of files.
        if {"launch", "source", "out"} <= _setting_names(cls):
            values = {"launch": self.launched, "source": self.name} | values
        settings = self.settings(name, cls, values)
        if settings is None:
            return None
        return NodeSpec(
            name,
            type_name,
            cls,
            values,
            settings,
            restart,
            scheduling,
            process=composition.process,
        )

    def settings(
        self, name: str, cls: type[Node[Any]], values: Table
    ) -> Settings | None:
        """The settings of a node without the values that are faulty, each of which is noted; None
        where the node cannot be checked any further.
        """
        deciding = []
        for each in dataclasses.fields(cls.Settings):
            if each.metadata["range"].decides:
                deciding.append(each.name)
        right = dict(values)
        decided = True
        while True:
            try:
                settings: Settings = cls.Settings.from_mapping(right)
                if not decided:
                    return None
                self.check_settings(name, settings)
                return settings
            except SparseskinError as error:
                # A value that was left out has to be stated.
                begin, _, _ = str(error).partition(":")
                if begin in values and begin not in right:
                    return None
                key, part = self.node_fault(name, right, error)
                if not key:
                    return None
                # With the fault left out, the others are found, but for those that follow from it.
                decided = decided and not get_close_matches(key, deciding)
                if part:
                    right[key] = dict(right[key])
                    del right[key][part]
                else:
                    del right[key]

    def check_settings(self, name: str, settings: Settings) -> None:
        """Check settings; a device that is not on this host is looked for by the node itself where
        nodes are placed on hosts.
        """
        try:
            settings.check()
        except SparseskinError as error:
            cause: BaseException | None = error
            while cause is not None and not isinstance(cause, NotHereError):
                cause = cause.__cause__
            if cause is None or name not in self.places:
                raise

    def node_fault(self, name: str, values: Table, error: Exception) -> tuple[str, str]:
        """Note an error that begins with the key of a node; return the key and, of a table, its
        part; "" where it names none.
        """
        begin, _, text = str(error).partition(":")
        key, _, part = begin.partition(".")
        if key in values:
            problem = text.strip()
        else:
            # The line may begin with a value, as the name of a file.
            problem = str(error)
            equal = [k for k, value in values.items() if value and value == begin]
            key = next(iter(equal), "")
            part = ""
        if part and part not in values[key]:
            part = ""
        # Not all of them are known.
        place = tuple(filter(None, ("nodes", name, key, part)))
        problem = as_words(problem, lambda key: f"--set {name}.{key}=")
        if TO_NAME in problem:
            problem += _to_name(name, values)
        self.fault(place, problem)
        return key, part

    def fault(self, place: Place, problem: str) -> None:
        """Note an error at a place, with the line of the file or the --set it comes from."""
        # The file has the table from which the nodes of a body are made.
        if place[0] == "nodes" and len(place) > 1:
            _, name, *keys = place
            place = ("nodes", self.templates.get(name, name), *keys)
        stated = place[1:]
        if place[0] in (SKIN, GRAPH):
            stated = place
        if stated in self.overridden:
            self.errors.append(f"{self.overridden[stated]}: {problem}")
            return
        # A file that a program made, or a missing table, has no line.
        line = _line_of(self.text, place)
        where = self.title
        if line:
            where += f":{line}"
        key = ".".join(place)[:MAX_ERROR]
        self.errors.append(f"{where}: {key}: {one_line_of(problem)}")
        if len(self.errors) >= MAX_ERRORS:
            raise LaunchError(
                [*self.errors, f"{self.title}: perhaps more; these come first"]
            )


def _setting_names(cls: type[Node[Any]]) -> set[str]:
    return {setting.name for setting in dataclasses.fields(cls.Settings)}


def _to_name(node: str, values: Table) -> str:
    """The --set that names a recording in place of a placeholder; "" where there is none."""
    for key, value in values.items():
        if isinstance(value, str) and TO_NAME in value:
            return f"; name yours: --set {node}.{key}={value.replace(TO_NAME, 'PATH')}"
    return ""


def _line_of(text: str, place: Place) -> int:
    """Number of the line of a key, or of the header of its table, or the first in it; 0: none."""
    header = re.compile(r"\s*\[\s*([^\]]+?)\s*\]")
    table: Place = ()
    nearest = 0
    for number, line in enumerate(text.splitlines(), start=1):
        match = header.match(line)
        if match:
            # A part of a name may be in quotes.
            parts = match[1].split(".")
            table = tuple(part.strip(" \"'") for part in parts)
            if table == place:
                return number
            if table == place[:-1] or table[: len(place)] == place:
                nearest = nearest or number
        else:
            key, equals, _ = line.partition("=")
            key = key.strip(" \"'\t")
            if key and equals and (*table, *key.split(".")) == place:
                return number
    return nearest


def one_line_of(problem: object) -> str:
    """A text or an error in one line of at most `MAX_ERROR` characters."""
    text = " ".join(str(problem).split())
    if len(text) <= MAX_ERROR:
        return text
    return f"{text[:MAX_ERROR]}..."
