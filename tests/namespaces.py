"""Two hosts, made of network namespaces, joined by one wire."""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

ADDRESSES = {"edge": "10.203.7.1", "desk": "10.203.7.2"}


def ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    if done.returncode:
        raise OSError(f"ip {' '.join(arguments)}: {done.stderr.strip()}")


class TwoHosts:
    """Namespaces "edge" and "desk", joined by one wire."""

    def __init__(self) -> None:
        self.names = {host: f"skin{os.getpid()}{host}" for host in ADDRESSES}

    def build(self) -> None:
        edge, desk = self.names.values()
        for name in (edge, desk):
            ip("netns", "add", name)
        ip(*f"-n {edge} link add wire type veth peer name wire netns {desk}".split())
        for host, name in self.names.items():
            ip("-n", name, "addr", "add", f"{ADDRESSES[host]}/24", "dev", "wire")
            for device in ("lo", "wire"):
                ip("-n", name, "link", "set", device, "up")

    def set_wire(self, state: str) -> None:
        ip("-n", self.names["edge"], "link", "set", "wire", state)

    def remove(self) -> None:
        for name in self.names.values():
            with contextlib.suppress(OSError):
                ip("netns", "del", name)

    def prefix(self, host: str) -> list[str]:
        return ["ip", "netns", "exec", self.names[host]]


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Build both hosts, and remove them; the test is skipped where that is not permitted."""
    if shutil.which("ip") is None:
        pytest.skip("needs the command ip (iproute2)")
    made = TwoHosts()
    try:
        made.build()
    except OSError as error:
        made.remove()
        pytest.skip(f"network namespaces are not permitted here: {error}")
    try:
        yield made
    finally:
        made.remove()
