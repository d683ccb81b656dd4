"""Commands of plug-ins: found by their entry points, in this package or another."""

import sys

import pytest

from sparseskin.launch.commands import cli
from sparseskin.nodes import extensions


@pytest.fixture
def plugged(monkeypatch, tmp_path, offering):
    """A folder of modules that are plug-ins `greet`, `broken` and, by another name, `launch`."""
    monkeypatch.syspath_prepend(tmp_path)
    greet = "greeting_plugin"
    offering(extensions.COMMANDS, greet=greet, broken="no_such_plugin", launch=greet)
    (tmp_path / "greeting_plugin.py").write_text(
        'HELP = "greet 100 %"\n'
        "def configure(parser):\n"
        '    parser.add_argument("--name", required=True)\n'
        "    parser.set_defaults(run=lambda a: print('hello', a.name) or 0)\n"
    )
    yield tmp_path
    sys.modules.pop("greeting_plugin", None)


@pytest.mark.usefixtures("plugged")
def test_a_command_of_another_package_runs(capsys):
    assert cli.main(["greet", "--name", "you"]) == 0
    assert capsys.readouterr().out == "hello you\n"


@pytest.mark.usefixtures("plugged")
def test_a_plugin_that_cannot_be_imported_is_named_and_stops_no_other_command(capsys):
    assert cli.main(["broken"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("broken: plug-in no_such_plugin: ModuleNotFoundError")
    assert error.count("\n") == 1
    with pytest.raises(SystemExit) as ended:
        cli.main(["--help"])
    assert ended.value.code == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "greet greet 100 %" in shown
    assert "broken cannot be used: broken: plug-in no_such_plugin: ModuleNotFoundError" in shown


@pytest.mark.usefixtures("plugged")
def test_a_plugin_does_not_replace_a_command_of_the_core():
    assert sorted(cli.plugins()) == ["broken", "greet"]
    assert cli.about("launch") == cli.COMMANDS["launch"][::2]
