"""The current directory is searched for modules that are not installed, alone."""

import subprocess
import sys

import pytest


def searched(code, folder):
    """True if code that runs in a folder lets modules of that folder be found."""
    end = "; import os, sys; print(os.getcwd() in sys.path)"
    command = [sys.executable, "-P", "-c", code + end]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    return done.stdout.strip() == "True"


@pytest.mark.parametrize(
    ("name", "found"),
    [("sparseskin.nodes.compressor.node:Compressor", False), ("own_package.node:Own", True)],
)
def test_the_current_directory_is_searched_for_a_module_that_is_not_installed_alone(
    name, found, tmp_path
):
    text = "from sparseskin.nodes.node import Node\nclass Own(Node): pass\n"
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package/node.py").write_text(text)
    code = f"from sparseskin.nodes.registry import node_class; node_class({name!r})"
    assert searched(code, tmp_path) == found


@pytest.mark.parametrize(
    ("source", "found"), [("sparseskin.studies.looped:path_40", False), ("own_driver:frames", True)]
)
def test_a_driver_is_looked_for_in_the_current_directory_where_it_is_not_installed(
    source, found, tmp_path
):
    (tmp_path / "own_driver.py").write_text("def frames(): yield\n")
    code = "from sparseskin.nodes.sensor.sources import find_address; "
    code += f"find_address({source!r}).check()"
    assert searched(code, tmp_path) == found
