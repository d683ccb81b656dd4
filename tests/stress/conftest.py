"""Sizes of stress tests, small with all other tests and large with `make stress`; figures."""

from typing import Any

import pytest
from stress.graphs import FULL

_FIGURES = pytest.StashKey[dict[str, list[dict[str, Any]]]]()


def pytest_configure(config):
    config.stash[_FIGURES] = {}


@pytest.fixture(scope="session")
def full():
    """True if the tests run at the sizes whose figures stand in the documents."""
    return FULL


@pytest.fixture
def note(request):
    """Note a line of figures, under the name of the test module; all are printed at the end."""
    rows = request.config.stash[_FIGURES].setdefault(request.path.stem, [])
    return lambda **figures: rows.append(figures)


def pytest_terminal_summary(terminalreporter, config):
    for name, rows in config.stash[_FIGURES].items() if FULL else ():
        columns = list(dict.fromkeys(key for row in rows for key in row))
        terminalreporter.section(name)
        for cells in (
            columns,
            ["---"] * len(columns),
            *([row.get(c, "") for c in columns] for row in rows),
        ):
            terminalreporter.write_line("| " + " | ".join(map(str, cells)) + " |")
