"""Files that are written: no link of another user chooses which."""

from pathlib import Path

import pytest
from other_user import NOBODY, give

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.files import OutputError, overwrite, whole_folder


def test_a_file_is_written_over_and_a_link_of_ones_own_followed(tmp_path):
    (tmp_path / "file").write_text("long before")
    (tmp_path / "link").symlink_to("file")
    for name, data in (("file", b"now"), ("link", b"then"), ("new", b"first")):
        overwrite(tmp_path / name, data)
        assert (tmp_path / name).read_bytes() == data
    assert (tmp_path / "file").read_bytes() == b"then"


def test_a_folder_is_a_new_one_and_no_link(tmp_path):
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    for path in (tmp_path / "link", tmp_path):
        with pytest.raises(OutputError, match="exists already"), whole_folder(path):
            pass
    assert [one.name for one in tmp_path.iterdir()] == ["link"]


def test_a_link_of_another_user_is_not_followed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    Path("profile").write_text("mine\n")
    Path("out").symlink_to("profile")
    give(Path("out"), link=True)
    assert main(["launch", "path_40", "--summary", "out", "--frames", "1"]) == 2
    assert f"--summary out: is a link of user {NOBODY}\n" in capsys.readouterr().err
    assert Path("profile").read_text() == "mine\n"
