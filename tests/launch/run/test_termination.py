"""SIGTERM as an exception: what discards exceptions does not lose it."""

import os
import signal

import pytest

from sparseskin.launch.commands import cli, entry
from sparseskin.launch.launchfile.load import load
from sparseskin.launch.run.launcher import Launcher
from sparseskin.launch.run.terminal import Terminal
from sparseskin.launch.run.termination import TERMINATION, Terminated
from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.lookup import find_callable


@pytest.fixture
def handled(monkeypatch):
    """The handler of SIGTERM as the command installs it; afterwards nothing is left of it."""
    monkeypatch.setattr(TERMINATION, "has_come", False)
    before = signal.signal(signal.SIGTERM, TERMINATION.handle)
    yield
    signal.signal(signal.SIGTERM, before)


def end():
    os.kill(os.getpid(), signal.SIGTERM)


class Loses:
    """An object whose destructor receives SIGTERM: Python prints and discards what it raises."""

    def __del__(self):
        end()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_one_that_a_destructor_lost_ends_the_command_all_the_same(monkeypatch, handled):
    def run():
        Loses()
        return 0

    monkeypatch.setattr(cli, "main", run)
    assert entry.main() == 143


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_one_that_was_lost_before_the_nodes_starts_none(handled):
    launcher = Launcher(load("path_40", []), Terminal())
    Loses()
    with pytest.raises(Terminated):
        launcher.run()


def test_a_module_that_is_being_imported_is_not_blamed_for_it(
    tmp_path, monkeypatch, handled
):
    (tmp_path / "interrupted_driver.py").write_text(
        "import os\nos.kill(os.getpid(), 15)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(Terminated):
        find_callable("interrupted_driver:frames", SourceError)
