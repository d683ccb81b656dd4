"""What other packages bring, and modules of the user."""

import subprocess
import sys

import numpy as np
import pytest

from sparseskin.launch.commands import cli
from sparseskin.nodes import extensions
from sparseskin.nodes.errors import SettingsError, SolverError, SourceError
from sparseskin.nodes.reconstructor.bases.base import BASES, make_basis
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.convert.export import export_names, find_export
from sparseskin.nodes.registry import node_class
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.files.format import suffixes
from sparseskin.nodes.sensor.points import point_skins

BROUGHT = """
import numpy as np
from sparseskin.nodes.node import Node
from sparseskin.nodes.recorder.convert.export import Export
from sparseskin.nodes.sensor.files.format import Format
from sparseskin.nodes.sensor.files.recording import (Parsed, WholeRecording)


class Counted(WholeRecording):
    def __init__(self, file):
        super().__init__()
        self.numbers = np.loadtxt(list(file.lines)[1:], ndmin=2)

    def read(self):
        return Parsed(self.numbers[:, None, :], "N")


class Own(Node):
    pass


COUNTED = Format({".csv": "counts"}, Counted, lambda begin: begin.startswith(b"counts"))
TEXT = Export(".txt", "brought:write")
HELP = "greet 100 %"


def configure(parser):
    parser.add_argument("--name", required=True)
    parser.set_defaults(run=lambda chosen: print("hello", chosen.name) or 0)
"""


@pytest.fixture
def brought(monkeypatch, tmp_path, offering):
    """A package that brings one of each, and in each group one that cannot be imported."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "brought.py").write_text(BROUGHT)
    suffixes.cache_clear()
    for group, name in (
        (extensions.NODES, "Own"),
        (extensions.FILES, "COUNTED"),
        (extensions.EXPORTS, "TEXT"),
        (extensions.POINTS, ""),
    ):
        one = {name.lower(): f"brought:{name}"} if name else {"points": "absent:POINTS"}
        offering(group, broken="absent:THING", **one)
    offering(extensions.COMMANDS, greet="brought", broken="absent", launch="brought")
    yield
    sys.modules.pop("brought", None)
    suffixes.cache_clear()


@pytest.mark.usefixtures("brought")
def test_what_another_package_brings_is_used(tmp_path, capsys):
    assert cli.main(["greet", "--name", "you"]) == 0
    assert capsys.readouterr().out == "hello you\n"
    # none replaces a command of the core
    assert sorted(cli.plugins()) == [
        "broken",
        "greet",
    ]
    assert cli.about("launch") == cli.COMMANDS["launch"][::2]
    assert node_class("own").__module__ == "brought"
    (tmp_path / "own.csv").write_text("counts\n1 2 3\n4 5 6\n")
    read = open_file(tmp_path / "own.csv")
    np.testing.assert_array_equal(read.frames, [[[1, 2, 3]], [[4, 5, 6]]])
    assert suffixes()[".csv"].endswith(" or counts")
    assert find_export("text").ending == ".txt"
    assert "text" in export_names()


BASIS = "sparseskin.nodes.reconstructor.bases.base:IdentityBasis"


def test_parts_of_a_method_have_names_that_replace_none_of_the_core(offering):
    offering(extensions.BASES, own=BASIS, haar="absent:THING", broken="absent:THING")
    assert list(BASES) == ["haar", "identity", "broken", "own"]
    assert len(BASES) == 4
    assert type(make_basis("own", 4, 4)).__name__ == "IdentityBasis"
    assert type(make_basis("haar", 4, 4)).__name__ == "HaarBasis"
    with pytest.raises(SolverError, match="there is no module 'absent'"):
        make_basis("broken", 4, 4)
    with pytest.raises(
        SolverError, match=r'basis "haer" is not known \(did you mean \'haar\'\?\)'
    ):
        make_basis("haer", 4, 4)


@pytest.mark.usefixtures("brought")
def test_what_cannot_be_imported_is_named_in_one_line_and_stops_no_other(tmp_path):
    with pytest.raises(SettingsError, match="there is no module 'absent'"):
        node_class("broken")
    (tmp_path / "own.xyz").write_text("1")
    with pytest.raises(
        SourceError, match=r"suffix '\.xyz' .*; cannot be imported: absent:THING"
    ):
        open_file(tmp_path / "own.xyz")
    with pytest.raises(
        BagError, match=r"--to broken: plug-in absent:THING: ModuleNotFoundError"
    ):
        find_export("broken")
    with pytest.raises(
        SourceError, match=r"points: plug-in absent:POINTS: ModuleNotFoundError"
    ):
        point_skins()


def test_without_the_plug_in_skins_of_points_are_refused(offering):
    offering(extensions.POINTS)
    with pytest.raises(
        SourceError, match="need the plug-in points, which is not installed"
    ):
        point_skins()


@pytest.mark.usefixtures("brought")
def test_a_command_that_cannot_be_imported_is_named_and_stops_no_other(capsys):
    assert cli.main(["broken"]) == 2
    assert capsys.readouterr().err.startswith(
        "broken: plug-in absent: ModuleNotFoundError"
    )
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "greet greet 100 %" in shown
    assert "broken cannot be used: broken: plug-in absent: ModuleNotFoundError" in shown


NODE = "from sparseskin.nodes.registry import node_class as use; use({!r})"
DRIVER = (
    "from sparseskin.nodes.sensor.sources import find_address as use; use({!r}).check()"
)


@pytest.mark.parametrize(
    ("use", "name", "found"),
    [
        (NODE, "sparseskin.nodes.compressor.node:Compressor", False),
        (NODE, "own_package.node:Own", True),
        (DRIVER, "sparseskin.studies.looped:path_40", False),
        (DRIVER, "own_package.node:frames", True),
    ],
)
def test_the_current_directory_has_modules_that_are_not_installed(
    use, name, found, tmp_path
):
    text = "from sparseskin.nodes.node import Node\nclass Own(Node): pass\ndef frames(): yield\n"
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package/node.py").write_text(text)
    code = use.format(name) + "; import os, sys; print(os.getcwd() in sys.path)"
    command = [sys.executable, "-P", "-c", code]
    done = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert done.stdout.strip() == str(found)
