"""The command `scenes`."""

from sparseskin.launch.commands.cli import main
from sparseskin.launch.launchfile import bundled_names


def test_the_list_names_every_launch_file(capsys):
    assert main(["scenes"]) == 0
    out = capsys.readouterr().out
    assert all(f"  {name} " in out for name in bundled_names())
    assert max(map(len, out.splitlines())) <= 80
