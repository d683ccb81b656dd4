"""Key files: private or refused, and never written over."""

from pathlib import Path

import pytest
from other_user import NOBODY, give

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.network.keys import (
    KeyFileError,
    known_names,
    make_key_files,
    read_key_pair,
    read_public_key,
)


def test_what_is_made_can_be_read_and_belongs_together(tmp_path):
    secret, public = make_key_files("edge", tmp_path / "keys")
    pair = read_key_pair(secret)
    assert (pair.public, secret.stat().st_mode & 0o777) == (read_public_key(public), 0o600)
    assert pair.secret not in public.read_text()
    assert pair.secret not in repr(pair)
    assert known_names(secret.parent) == {pair.public: "edge"}


def test_the_command_names_both_files(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["keys", "make", "desk"]) == 0
    assert sorted(path.name for path in Path("keys").iterdir()) == ["desk.key", "desk.pub"]
    before = Path("keys/desk.key").read_text()
    assert main(["keys", "make", "desk"]) == 2
    assert "keys/desk.key: exists already, and is not written over" in capsys.readouterr().err
    assert Path("keys/desk.key").read_text() == before


@pytest.mark.parametrize("name", ["", "Edge", "../edge", "a" * 40])
def test_what_is_no_name_makes_no_key(tmp_path, name):
    with pytest.raises(KeyFileError, match="NAME"):
        make_key_files(name, tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_a_secret_that_others_can_get_at_or_own_is_refused(tmp_path):
    secret, _ = make_key_files("edge", tmp_path)
    for mode in (0o640, 0o620):
        secret.chmod(mode)
        with pytest.raises(KeyFileError, match=rf"edge.key: mode {mode:04o} .*allowed: 0600"):
            read_key_pair(secret)
    secret.chmod(0o600)
    give(secret)
    with pytest.raises(KeyFileError, match=rf"edge.key: belongs to user {NOBODY}, not to you"):
        read_key_pair(secret)


@pytest.mark.parametrize(("what", "mode"), [("file", 0o646), ("folder", 0o777)])
def test_a_public_key_that_others_can_replace_or_own_is_refused(tmp_path, what, mode):
    _, public = make_key_files("edge", tmp_path)
    given = public if what == "file" else tmp_path
    before = given.stat().st_mode
    given.chmod(mode)
    with pytest.raises(KeyFileError, match=rf": mode {mode:04o} lets other users replace the key"):
        read_public_key(public)
    assert known_names(tmp_path) == {}
    given.chmod(before)
    give(given)
    with pytest.raises(KeyFileError, match=rf"^{given}: belongs to user {NOBODY}, who can"):
        read_public_key(public)


def test_a_public_key_that_others_cannot_replace_is_read(tmp_path):
    secret, public = make_key_files("edge", tmp_path)
    tmp_path.chmod(0o1777)
    public.chmod(0o664)
    assert read_public_key(public) == read_key_pair(secret).public


@pytest.mark.parametrize(
    "text", ["", "# nothing\n", "short\n", "a" * 40 + "\n" + "b" * 40, "é" * 40, "\0" * 40]
)
def test_what_holds_no_key_is_refused_by_name(tmp_path, text):
    path = tmp_path / "edge.key"
    path.write_text(text)
    path.chmod(0o600)
    with pytest.raises(KeyFileError, match=r"edge.key: (expected one key of 40|holds no secret)"):
        read_key_pair(path)


def test_the_error_of_a_missing_key_names_the_command_that_makes_it(tmp_path):
    with pytest.raises(KeyFileError, match=r"edge.key: No such file.*sparseskin keys make edge"):
        read_key_pair(tmp_path / "edge.key")
