"""A graph as text for a terminal."""

from sparseskin.launch.attach.text import table
from sparseskin.messages.text import printable

from .spec import LaunchFile


def graph_text(launch: LaunchFile) -> str:
    """Nodes with their settings, then hosts, then topics with those that write and read them."""
    nodes = []
    for node in launch.nodes.values():
        stated = {
            "host": node.host,
            **{key: value for key, value in node.values.items() if key != "launch"},
            "cpus": list(node.scheduling.cpus),
            "priority": node.scheduling.priority,
        }
        shown = [  # of the keys of all nodes those that are stated
            f"{key} = {value!r}" for key, value in stated.items() if value or key in node.values
        ]
        nodes.append([node.name, node.type_name, ", ".join(shown)])
    hosts = [
        [name, host.address, ", ".join(f"{n.name} at {n.public}" for n in here if n.public)]
        for name, host in launch.hosts.items()
        for here in ([n for n in launch.nodes.values() if n.host == name],)
    ]
    topics = [
        [topic, links[0].writer, ", ".join(link.reader for link in links)]
        for topic in dict.fromkeys(link.topic for link in launch.links)
        for links in ([link for link in launch.links if link.topic == topic],)
    ]
    lines = [f"{launch.name}: {launch.description}", f"transport {launch.transport}", ""]
    lines += table(["NODE", "TYPE", "SETTINGS"], nodes)
    lines += ["", *table(["HOST", "ADDRESS", "NODES"], hosts)] if hosts else []
    lines += ["", *table(["TOPIC (/PATCH/SCHEMA)", "PUBLISHER", "SUBSCRIBERS"], topics)]
    return "\n".join(map(printable, lines))
