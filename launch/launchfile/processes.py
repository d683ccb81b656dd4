"""The key `process` of a launch file: nodes that share one process."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import Settings, setting

from .spec import NodeSpec
from .tables import Fault, Table, bad_name


@dataclass(frozen=True)
class Composition(Settings):
    """Key of [graph], for all nodes, and of [nodes.NAME]."""

    process: str = setting(
        "", 'name of the process that nodes which state it share; "": one of its own'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.process:
            reason = bad_name(self.process)
            if reason:
                raise SettingsError(f"process: {reason}")


def by_process(specs: Iterable[NodeSpec]) -> list[list[NodeSpec]]:
    """The nodes of each process, in the order of the launch file; a process is on one host."""
    groups: dict[tuple[str, ...], list[NodeSpec]] = {}
    for spec in specs:
        key: tuple[str, ...] = (spec.process, spec.host)
        # Without a process of a name, a node has one of its own.
        if not spec.process:
            key = ("", "", spec.name)
        groups.setdefault(key, []).append(spec)
    return list(groups.values())


def check_processes(
    specs: Mapping[str, NodeSpec], stated: Collection[str], fault: Fault
) -> None:
    """Check that the nodes of a process can share it: one host, one schedule, one policy.

    `stated` are the nodes that state the key themselves. That of [graph] is one process a host.
    """
    # The first node of each name leads: the others are compared with it.
    leaders: dict[str, NodeSpec] = {}
    for name in stated:
        spec = specs[name]
        if not spec.process:
            continue
        leader = leaders.setdefault(spec.process, spec)
        if spec.host != leader.host:
            place = f"{leader.host} ({leader.name})"
            fault(
                ("nodes", spec.name, "process"),
                f"{spec.process!r} is on {place}, this node on {spec.host}",
            )

    for leader, *followers in by_process(specs.values()):
        # That of [graph] may be of a host with a single node.
        if leaders.get(leader.process) is leader and not followers:
            problem = f"{leader.process!r} has this node alone"
            fault(
                ("nodes", leader.name, "process"),
                f"{problem} (allowed: a process that other nodes state too)",
            )
        for spec in followers:
            _check_same(leader, spec, fault)


def _check_same(leader: NodeSpec, spec: NodeSpec, fault: Fault) -> None:
    """Check that two nodes agree in what is of their process rather than of a node."""
    of_process = _settings_of_process(leader)
    for key, value in _settings_of_process(spec).items():
        if value == of_process[key]:
            continue
        difference = f"{value!r} here, {of_process[key]!r} of {leader.name}"
        fault(
            ("nodes", spec.name, key),
            f"{difference} in process {spec.process!r} (allowed: the same)",
        )


def _settings_of_process(spec: NodeSpec) -> Table:
    # A list, as the file states it: that is how the difference is reported.
    scheduling = asdict(spec.scheduling)
    scheduling["cpus"] = list(spec.scheduling.cpus)
    return scheduling | asdict(spec.restart)
