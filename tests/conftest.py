"""Fixtures of several tests: real processes, and waiting for them without guessing how long."""

import contextlib
import importlib.metadata
import os
import socket
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import hypothesis
import pytest
from processes import COMMAND, PATIENCE_S, SENSOR, Program, note_of_graph, wait_until

from sparseskin.nodes import extensions
from sparseskin.nodes.network.sockets import make_context

__all__ = ["COMMAND", "PATIENCE_S", "note_of_graph", "wait_until"]

# No test fails because the host is busy. Few examples of each property, and in CI more.
hypothesis.settings.register_profile(
    "busy host",
    deadline=None,
    max_examples=int(os.environ.get("SPARSESKIN_EXAMPLES", "25")),
)
hypothesis.settings.load_profile("busy host")


def free_port(kind=socket.SOCK_STREAM):
    """A port of the loopback interface that nothing listens to now."""
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture(autouse=True)
def _own_environment():
    """Variables that a command sets in its process end with the test: other tests read them."""
    before = {*os.environ}
    yield
    for name in {*os.environ} - before:
        del os.environ[name]


COMPILE = (
    "from sparseskin.nodes.numerics.warm_up import compile_loops as c; c('auto', id)"
)


def pytest_sessionstart(session):
    """Begin to compile all loops, where they are not yet: tests that need one wait for it."""
    if not hasattr(session.config, "workerinput"):
        session.config.compiling = subprocess.Popen([sys.executable, "-c", COMPILE])


def pytest_sessionfinish(session):
    if not hasattr(session.config, "workerinput"):
        session.config.compiling.wait()


def pytest_collection_modifyitems(items):
    """Run slow tests first, so that none is left for the end of a parallel run."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


ONE_BY_ONE = (
    "tests/docs/test_examples",
    "tests/launch/run/",
    "tests/nodes/recorder/",
    "tests/studies/",
)
"""Tests that take long and share no fixture of their module. Faults are caused one at a time, as
each needs the processors for itself to recover within the limits of the study."""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Distribute tests over processes by their modules, and those of `ONE_BY_ONE` singly."""
    from xdist.scheduler import LoadScopeScheduling

    class Scheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid):
            alone = nodeid.startswith(ONE_BY_ONE) and "test_faults" not in nodeid
            return nodeid if alone else nodeid.partition("::")[0]

    return Scheduling(config, log) if config.getoption("dist") == "loadscope" else None


EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def forget_user_modules(tmp_path_factory):
    """Remove what a test imports from its folder or the examples, and restore `sys.path`."""
    path, modules = list(sys.path), set(sys.modules)
    folders = EXAMPLES, tmp_path_factory.getbasetemp()
    yield
    sys.path[:] = path
    for name in set(sys.modules) - modules:
        file = getattr(sys.modules[name], "__file__", None)
        if file is not None and any(
            Path(file).is_relative_to(folder) for folder in folders
        ):
            del sys.modules[name]


@pytest.fixture
def start(tmp_path):
    """Start `sparseskin ARGUMENTS` in an empty folder; nothing outlives the test."""
    with contextlib.ExitStack() as stack:
        yield lambda *a, **kw: stack.enter_context(Program(*a, cwd=tmp_path, **kw))


@pytest.fixture
def context():
    """A context of ZeroMQ."""
    made = make_context()
    yield made
    made.destroy(linger=0)


@pytest.fixture
def sensor(tmp_path):
    """A launch file of a sensor alone."""
    (tmp_path / "sensor.toml").write_text(SENSOR)
    return "sensor.toml"


@pytest.fixture
def mount_disk(tmp_path):
    """Mount a disk of a stated size ("400k", "1m"); the test is skipped where that is forbidden."""
    folders = []

    def mount(size):
        folder = tmp_path / f"disk-{size}"
        folder.mkdir()
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)],
            capture_output=True,
            text=True,
            check=False,
        )
        if mounted.returncode:
            pytest.skip(
                f"no small disk: mounting is not permitted ({mounted.stderr.strip()})"
            )
        folders.append(folder)
        return folder

    yield mount
    for folder in folders:
        subprocess.run(["umount", str(folder)], check=True)


@pytest.fixture
def offering(monkeypatch):
    """Install plug-ins for a test alone: called with a group, and targets by name."""
    offers = {}

    def offer(group, **targets):
        offers[group] = [
            EntryPoint(name, target, group) for name, target in targets.items()
        ]
        extensions.forget()

    real = importlib.metadata.entry_points
    monkeypatch.setattr(
        "importlib.metadata.entry_points",
        lambda *, group: offers[group] if group in offers else real(group=group),
    )
    yield offer
    extensions.forget()
