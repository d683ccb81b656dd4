"""The command `sparseskin study`: what it refuses, in one line."""

import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.studies import command


def test_an_unknown_study_is_refused_with_the_one_that_was_meant(capsys):
    assert main(["study", "paper-table"]) == 2
    error = capsys.readouterr().err
    assert "did you mean 'paper-tables'" in error
    assert error.count("\n") == 1


def test_without_a_package_of_the_extra_one_line_names_it_and_the_extra(monkeypatch, capsys):
    package = command.EXTRA[-1]
    monkeypatch.setattr(command, "find_spec", lambda name: None if name == package else name)
    assert main(["study", "paper-tables"]) == 2
    error = capsys.readouterr().err
    assert f"{package} is not installed" in error
    assert "pip install 'sparseskin[charts]'" in error
    assert error.count("\n") == 1


@pytest.mark.parametrize("seed", ["-1", "4294967296"])
def test_a_seed_that_no_generator_takes_is_refused(seed):
    with pytest.raises(SystemExit) as ended:
        main(["study", "paper-tables", "--seed", seed])
    assert ended.value.code == 2


@pytest.mark.parametrize("options", [("--recordings", "."), ("--constants",)])
def test_an_option_that_a_study_has_not_is_refused_with_those_that_have(options, tmp_path, capsys):
    assert main(["study", "stability", "--out", str(tmp_path / "out"), *options]) == 2
    error = capsys.readouterr().err
    assert f"{options[0]}: study 'stability' takes none; allowed: accuracy" in error
    assert error.count("\n") == 1
