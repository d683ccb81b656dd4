"""A graph whose nodes are played by the tests of its launcher."""

import pytest
from played import Stage


@pytest.fixture
def stage(tmp_path, monkeypatch):
    stages = []

    def make(graph="", **options):
        stages.append(Stage(tmp_path, monkeypatch, graph, **options))
        return stages[-1]

    yield make
    for played in stages:
        played.close()
