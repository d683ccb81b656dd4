"""The key `process` of a launch file: nodes that share one process."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import Settings, setting

from .spec import NodeSpec
from .tables import Fault, bad_name


@dataclass(frozen=True)
class Composition(Settings):
    """Key of [graph], for all nodes, and of [nodes.NAME]."""

    process: str = setting(
        "", 'name of the process that nodes which state it share; "": one of its own'
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        why = bad_name(self.process) if self.process else ""
        if why:
            raise SettingsError(f"process: {why}")


def by_process(specs: Iterable[NodeSpec]) -> list[list[NodeSpec]]:
    """The nodes of each process, in the order of the launch file; a process is on one host."""
    groups: dict[tuple[str, ...], list[NodeSpec]] = {}
    for spec in specs:
        key = (spec.process, spec.host) if spec.process else ("", "", spec.name)
        groups.setdefault(key, []).append(spec)
    return list(groups.values())


def check_processes(specs: Mapping[str, NodeSpec], stated: Collection[str], fault: Fault) -> None:
    """Check that the nodes of a process can share it: one host, one schedule, one policy.

    `stated` are the nodes that state the key themselves. That of [graph] is one process a host.
    """
    leaders: dict[str, NodeSpec] = {}
    for spec in (specs[name] for name in stated if specs[name].process):
        leader = leaders.setdefault(spec.process, spec)
        if spec.host != leader.host:
            what = f"{spec.process!r} is on {leader.host} ({leader.name}), this node on {spec.host}"
            fault(("nodes", spec.name, "process"), what)
    for first, *others in by_process(specs.values()):
        name = first.process
        if leaders.get(name) is first and not others:
            what = f"{name!r} has this node alone (allowed: a process that other nodes state too)"
            fault(("nodes", first.name, "process"), what)
        for spec in others:
            of_first = _of_process(first)
            for key, value in _of_process(spec).items():
                if value != of_first[key]:
                    what = f"{value!r} here, {of_first[key]!r} of {first.name} in process {name!r}"
                    fault(("nodes", spec.name, key), f"{what} (allowed: the same)")


def _of_process(spec: NodeSpec) -> dict[str, Any]:
    """Settings of the whole process of a node."""
    scheduling = asdict(spec.scheduling) | {"cpus": list(spec.scheduling.cpus)}
    return scheduling | asdict(spec.restart)
