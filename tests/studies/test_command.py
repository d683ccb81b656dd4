"""The command `sparseskin study`: what it refuses, in one line."""

from sparseskin.launch.commands.cli import main
from sparseskin.studies import command


def test_without_a_package_of_the_extra_one_line_names_it_and_the_extra(monkeypatch, capsys):
    package = command.EXTRA[-1]
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == package else name)
    assert main(["study", "paper-tables"]) == 2
    error = capsys.readouterr().err
    assert f"{package} is not installed" in error
    assert "pip install 'sparseskin[charts]'" in error
    assert error.count("\n") == 1
