"""Links of a graph: one writer a topic, a writer for each reader."""

from typing import Any

import pytest
from damaged import refusal

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.graph import Link, join
from sparseskin.nodes.node import Node


class Station(Node[Any]):
    """A node whose settings are its topics: written, read, read if written."""

    @classmethod
    def outputs(cls, settings):
        return tuple(settings[0])

    @classmethod
    def inputs(cls, settings):
        return tuple(settings[1])

    @classmethod
    def optional_inputs(cls, settings):
        return tuple(settings[2])


def links_of(**topics):
    return join({name: (Station, settings) for name, settings in topics.items()})


SENSOR = (["/a/skin", "/a/taxels"], [], [])


def test_each_reader_has_a_link_from_each_of_its_writers():
    assert links_of(
        sensor=SENSOR,
        other=(["/b/taxels"], ["/a/skin"], ["/a/taxels", "/c/taxels"]),
        monitor=([], ["*/taxels"], ["/a/skin"]),
    ) == [
        Link("/a/skin", "sensor", "other"),
        Link("/a/taxels", "sensor", "other"),
        Link("/a/taxels", "sensor", "monitor"),
        Link("/b/taxels", "other", "monitor"),
        Link("/a/skin", "sensor", "monitor"),
    ]


@pytest.mark.parametrize(
    ("reads", "said"),
    [
        ("/b/skin", "/b/skin, which no node writes (did you mean '/a/skin'?)"),
        ("/a/phi", "/a/phi, which no node writes (written: /a/skin, /a/taxels)"),
        ("*/phi", "*/phi, which matches no written topic"),
    ],
)
def test_a_topic_that_no_node_writes_is_named_with_those_written(reads, said):
    assert (
        refusal(lambda: links_of(sensor=SENSOR, desk=([], [reads], [])), SettingsError)
        == f"desk: reads {said}"
    )


def test_two_writers_of_a_topic_are_both_named():
    with pytest.raises(SettingsError, match=r"^two: writes /a/taxels, which sensor writes too$"):
        links_of(sensor=SENSOR, two=(["/a/taxels"], [], []))
