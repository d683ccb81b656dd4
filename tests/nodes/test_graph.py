"""Links of a graph: one writer a topic, a writer for each reader; files that are written whole."""

from pathlib import Path
from typing import Any

import pytest
from damaged import refusal
from other_user import NOBODY, give

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.files import OutputError, overwrite, whole_folder
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
    line = refusal(
        lambda: links_of(sensor=SENSOR, desk=([], [reads], [])), SettingsError
    )
    assert line == f"desk: reads {said}"


def test_two_writers_of_a_topic_are_both_named():
    with pytest.raises(
        SettingsError, match=r"^two: writes /a/taxels, which sensor writes too$"
    ):
        links_of(sensor=SENSOR, two=(["/a/taxels"], [], []))


def test_files_are_written_over_links_of_ones_own_followed_and_folders_new(tmp_path):
    (tmp_path / "file").write_text("long before")
    (tmp_path / "link").symlink_to("file")
    for name, data in (("file", b"now"), ("link", b"then"), ("new", b"first")):
        overwrite(tmp_path / name, data)
        assert (tmp_path / name).read_bytes() == data
    assert (tmp_path / "file").read_bytes() == b"then"
    (folder := tmp_path / "folder").mkdir()
    (folder / "link").symlink_to(folder / "elsewhere")
    for path in (folder / "link", folder):
        with pytest.raises(OutputError, match="exists already"), whole_folder(path):
            pass
    assert [one.name for one in folder.iterdir()] == ["link"]


def test_a_link_of_another_user_is_not_followed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    Path("profile").write_text("mine\n")
    Path("out").symlink_to("profile")
    give(Path("out"), link=True)
    assert main(["launch", "path_40", "--summary", "out", "--frames", "1"]) == 2
    assert f"--summary out: is a link of user {NOBODY}\n" in capsys.readouterr().err
    assert Path("profile").read_text() == "mine\n"
