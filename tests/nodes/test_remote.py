"""Recordings at addresses: read through a copy, stored, and refused in one line."""

import socket
import sys
from pathlib import Path

import pytest
from conftest import free_port
from damaged import refusal

from sparseskin.nodes import remote
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.remote import RemoteError, check_address, file_name, is_remote, local_path

fsspec = pytest.importorskip("fsspec")


@pytest.fixture(autouse=True)
def store():
    yield
    fsspec.filesystem("memory").store.clear()


def put(address, data):
    with fsspec.open(address, "wb") as file:
        file.write(data)


def test_addresses_are_copied_once_files_stored_once_and_paths_stay_paths(tmp_path):
    for path in ("drag.mcap", "a/b:c.mcap", "C:/drag.mcap", "/tmp/x"):
        assert not is_remote(path)
        assert local_path(path) == Path(path)
    assert file_name("a/b.mcap") == "b.mcap"
    assert file_name("https://host/a/b.mcap?version=3") == "b.mcap"
    put("memory://bucket/a.mcap", b"first")
    path = local_path("memory://bucket/a.mcap")
    assert (path.read_bytes(), path.name) == (b"first", "a.mcap")
    put("memory://bucket/a.mcap", b"second")
    assert local_path("memory://bucket/a.mcap") == path
    path = tmp_path / "a.mcap"
    path.write_bytes(b"forces")
    remote.store(path, "memory://out/a.mcap")
    assert local_path("memory://out/a.mcap").read_bytes() == b"forces"
    with pytest.raises(RemoteError, match="exists already"):
        remote.store(path, "memory://out/a.mcap")


@pytest.mark.parametrize(
    ("address", "text"),
    [
        ("s4://bucket/a.mcap", "protocol 's4' is not allowed"),
        ("htps://h/a.mcap", "did you mean 'https'"),
        ("file:///etc/passwd", "protocol 'file' is not allowed"),
        ("simplecache::s3://bucket/a.mcap", "a chained address is not allowed"),
    ],
)
def test_an_address_that_is_not_allowed_is_one_line(address, text):
    assert text in refusal(lambda: check_address(address), SettingsError)


def test_an_address_is_reached_with_its_password_and_no_error_shows_it():
    password, port = "hunter2@:tiger", free_port()
    for address in (
        f"ftp://alice:{password}@127.0.0.1:{port}/a.mcap",
        f"ftp://127.0.0.1:{port}/a.mcap?token={password}",
        f"ftp://127.0.0.1:{port}/a.mcap#{password}",
        f"s4://alice:{password}@bucket/a.mcap",
    ):
        with pytest.raises(SparseskinError) as raised:
            local_path(address)
        assert "***" in str(raised.value)
        assert not any(word in str(raised.value) for word in ("alice", "hunter2", "tiger"))
        assert "\n" not in str(raised.value)
        if address.startswith("ftp"):
            assert "ConnectionRefusedError" in str(raised.value)


def test_a_file_that_is_too_large_or_comes_too_slowly_is_given_up(monkeypatch):
    put("memory://bucket/large.mcap", bytes(100))
    monkeypatch.setattr(remote, "MAX_BYTES", 99)
    with pytest.raises(RemoteError, match="more than 99 bytes"):
        local_path("memory://bucket/large.mcap")
    monkeypatch.setattr(remote, "START_S", 0.05)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"ftp://127.0.0.1:{silent.getsockname()[1]}/a.mcap"
        with pytest.raises(RemoteError, match=r"not done within 0 s, after 0 bytes"):
            local_path(address)


def test_what_is_missing_is_named_and_no_error_shows_a_password(monkeypatch):
    with pytest.raises(RemoteError, match=r"memory://none/a.mcap: no such file"):
        local_path("memory://none/a.mcap")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "fsspec", None)
        with pytest.raises(SettingsError, match=r"needs the package fsspec; .*sparseskin\[scale\]"):
            check_address("memory://a/b.mcap")
    monkeypatch.setitem(sys.modules, "s3fs", None)
    with pytest.raises(SettingsError, match=r"a.mcap: needs a further package: Install s3fs"):
        check_address("s3://bucket/a.mcap")
    error = SparseskinError("--set source=http://me:key@h/x.npy: http:/me:key@h/x.npy: none")
    assert str(error) == "--set source=http://***@h/x.npy: http:/***@h/x.npy: none"
