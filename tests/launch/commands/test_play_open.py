"""`sparseskin play --open`: what is played, and the page."""

import json
import signal
import urllib.request

import pytest
from bags import frames, make_bag, record_scene

from sparseskin.launch.commands.cli import main


@pytest.mark.parametrize("schemas", [(), ("skin", "taxels"), ("skin", "phi", "measurements")])
def test_too_little_to_show_is_one_line(tmp_path, capsys, schemas):
    path = tmp_path / "some.mcap"
    make_bag(path, [m for m in frames(3) if m.schema in schemas])
    assert main(["play", str(path), "--open"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"{path}: --open: has no reconstructions of all patches; ")


def test_the_page_shows_a_recording_again_and_again(start, tmp_path):
    record_scene(tmp_path / "some.mcap", "path_40", 300, 20, 1)
    play = start("play", "some.mcap", "--open")
    url = play.wait_for("live page: ").split()[0]
    play.wait_for("ready: player, monitor")
    with urllib.request.urlopen(url) as page:
        assert b"<title>sparseskin" in page.read()
    # More frames than the recording has.
    echo = start("topic", "echo", "/skin/reconstruction", "-n", "50", "--json")
    code, lines, _ = echo.finish()
    assert code == 0
    assert len({json.loads(line)["stamp_ns"] for line in lines.splitlines()}) == 50
    play.process.send_signal(signal.SIGINT)
    assert play.finish()[0] == 130
