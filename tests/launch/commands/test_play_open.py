"""`sparseskin play --open`: what is played, what is computed anew, and the page."""

import json
import signal
import urllib.request
from pathlib import Path

import pytest
from bags import frames, make_bag

from sparseskin.launch.commands.play import shown
from sparseskin.nodes.errors import SettingsError

FRAME = {"taxels", "truth", "measurements", "reconstruction"}
STATES = {"skin", "phi", "solver"}


MEASURED = {"skin", "phi", "measurements"}
TAXELS = {"skin", "taxels", "truth"}


@pytest.mark.parametrize(
    ("by_patch", "played", "made"),
    [
        ([FRAME | STATES | {"resultant"}], FRAME | STATES | {"resultant"}, []),
        ([MEASURED], MEASURED, ["reconstructor"]),
        # What was computed from another reconstruction is not shown beside this one.
        ([MEASURED | {"resultant", "truth"}], MEASURED | {"truth"}, ["reconstructor"]),
        ([{"skin", "taxels"}], {"skin", "taxels"}, ["compressor", "reconstructor"]),
        # Several patches are shown as far as all of them can be.
        ([FRAME | STATES, TAXELS], TAXELS, ["compressor", "reconstructor"]),
    ],
)
def test_what_was_recorded_is_played_and_the_rest_computed(by_patch, played, made):
    found = shown(Path("a.mcap"), {f"p{k}": each for k, each in enumerate(by_patch)})
    assert (set(found[0]), found[1]) == (played, made)


@pytest.mark.parametrize("has", [set(), {"taxels"}, {"skin", "truth"}, {"skin", "measurements"}])
def test_too_little_to_show_is_one_line(has):
    with pytest.raises(SettingsError, match="--open: has neither taxels nor measurements"):
        shown(Path("a.mcap"), {"skin": has})


def test_the_page_shows_a_recording_of_taxels_again_and_again(start, tmp_path):
    messages = [m for m in frames(20) if m.schema in ("skin", "taxels")]
    make_bag(tmp_path / "some.mcap", messages)
    play = start("play", "some.mcap", "--open")
    url = play.wait_for("live page: ").split()[0]
    play.wait_for("ready: player, compressor, reconstructor, monitor")
    with urllib.request.urlopen(url) as page:
        assert b"<title>sparseskin" in page.read()
    # More frames than the recording has.
    echo = start("topic", "echo", "/skin/reconstruction", "-n", "50", "--json")
    code, lines, _ = echo.finish()
    assert code == 0
    assert len({json.loads(line)["stamp_ns"] for line in lines.splitlines()}) == 50
    play.process.send_signal(signal.SIGINT)
    assert play.finish()[0] == 130
