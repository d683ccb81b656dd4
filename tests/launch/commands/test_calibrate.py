"""The commands calibrate and tare: scripted, guided, on recordings and on running graphs."""

import io
import json
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import PATIENCE_S, wait_until

from sparseskin.launch.commands import calibrate
from sparseskin.launch.commands.cli import main
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.description import SkinDescription
from sparseskin.nodes.sensor.skin_file import load_skin, save_skin

SHAPE = (4, 6)
RNG = np.random.default_rng(0)
BASELINE = np.round(RNG.uniform(30, 60, SHAPE))
GAIN = RNG.uniform(50, 150, SHAPE)


def counts(force, n):
    return BASELINE + GAIN * force + RNG.normal(0, 1, (n, *SHAPE))


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A recording at 100 Hz: 3 s untouched, 2 s at 0.5 N and 2 s at 1 N a taxel."""
    monkeypatch.chdir(tmp_path)
    np.save(
        "all.npy", np.concatenate([counts(0, 300), counts(0.5, 200), counts(1.0, 200)])
    )
    np.save("more.npy", counts(1.0, 50))
    return tmp_path


def assert_calibrated(path):
    """Newtons within 3 %: of 200 frames, noise of 1 in 50 counts leaves 0.2 %."""
    skin = load_skin(path)
    slope = 1.0 if skin.response is None else skin.response.slopes[-1]
    np.testing.assert_allclose(skin.gains * slope * GAIN, 1.0, rtol=0.03)
    assert skin.baseline is not None
    np.testing.assert_allclose(skin.baseline, BASELINE, atol=0.5)


def test_options_alone_calibrate_a_recording(folder, capsys):
    loads = ("--press", "12N@all:3.2-4.8s", "--press", "24N@all:more.npy")
    done = main(
        ["calibrate", "file:all.npy", "--out", "palm.toml", *loads, "--pitch-mm", "2.5"]
    )
    printed = capsys.readouterr().out
    assert done == 0
    assert_calibrated("palm.toml")
    assert load_skin("palm.toml").pitch_mm == 2.5
    assert "palm: 4 x 6 taxels, 0..1.3 N" in printed
    assert "12N@all" in printed
    assert "--set sensor.source=file:all.npy --set sensor.skin=palm.toml" in printed


def test_a_person_is_asked_and_wrong_answers_are_asked_again(
    folder, capsys, monkeypatch
):
    answers = ["heavy", "24N", "everywhere", "all", "9-8s", "5.2-6.8s", ""]
    monkeypatch.setattr("sys.stdin", io.StringIO("\n".join(answers) + "\n"))
    assert main(["calibrate", "file:all.npy", "--out", "palm.toml"]) == 0
    printed = capsys.readouterr().out
    assert "'heavy' is no load; allowed are" in printed
    assert "'everywhere' is no area" in printed
    assert "9-8s: the part is empty" in printed
    assert_calibrated("palm.toml")


@pytest.mark.parametrize("answers", ["", "24N\nall\n5.2-6.8s\n"])
def test_the_end_of_the_input_is_no_answer(folder, answers, capsys, monkeypatch):
    before = sorted(folder.iterdir())
    monkeypatch.setattr("sys.stdin", io.StringIO(answers))
    assert main(["calibrate", "file:all.npy", "--out", "palm.toml"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        "the input ended before the questions; nothing is written (--press, "
    )
    assert sorted(folder.iterdir()) == before


def test_without_presses_readings_keep_their_unit(folder, capsys):
    options = ("--no-questions", "--f-max", "200", "--keep-noise")
    assert main(["calibrate", "file:all.npy", "--out", "raw.toml", *options]) == 0
    skin = load_skin("raw.toml")
    assert skin.gains is None
    assert skin.f_max == 200.0
    assert skin.unit == "raw"
    assert skin.noise == pytest.approx(1.0, rel=0.1)
    assert skin.f_min == pytest.approx(-4, rel=0.1)


LIVE_SKIN = """
import time, numpy as np

def frames():
    rng = np.random.default_rng(0)
    k = 0
    while True:
        time.sleep(0.002)
        k += 1
        yield time.monotonic_ns(), 40 + rng.normal(0, 1, (4, 6))
"""


@pytest.mark.slow
def test_a_live_source_is_calibrated_and_tared_while_its_graph_runs(
    start, tmp_path, monkeypatch
):
    (tmp_path / "live_skin.py").write_text(LIVE_SKIN)
    words = ("--untouched", "0.2s", "--no-questions", "--f-max", "50")
    code, out, err = start(
        "calibrate", "live_skin:frames", "--out", "p.toml", *words
    ).finish()
    assert code == 0
    assert err == ""
    assert "p: 4 x 6 taxels" in out
    assert "press Enter" not in out
    np.testing.assert_allclose(load_skin(tmp_path / "p.toml").baseline, 40, atol=1.5)
    # A baseline that has become old, by 5.
    old = SkinDescription(
        "old", *SHAPE, 50.0, unit="N", baseline=np.full(SHAPE, 35.0), noise=1.0
    )
    save_skin(tmp_path / "old.toml", old)
    graph = start(
        *("launch", "replay", "--record", "run.mcap", "--set", "monitor.port=0"),
        *("--set", "sensor.source=live_skin:frames", "--set", "sensor.skin=old.toml"),
        *("--set", "sensor.rate_hz=100"),
    )
    graph.wait_for("[launch] ready")
    monkeypatch.setenv("SPARSESKIN_RUNTIME_DIR", str(tmp_path / "graphs"))
    monkeypatch.setattr("sparseskin.launch.attach.client.PATIENCE_S", PATIENCE_S)
    wait_until(lambda: main(["node", "list"]) == 0, "the note of the graph")
    code, out, err = start("tare", "--frames", "50", "--json").finish()
    assert code == 0
    assert err == ""
    document = json.loads(out)
    assert document["format"] == "sparseskin/tare-result/1"
    assert document["tared"]["sensor"].startswith("forces changed by at most ")
    code, _, err = start("tare", "compressor").finish()
    assert code == 2
    assert err == "compressor: has no command 'tare' (known: set)\n"
    assert main(["stop"]) == 0
    graph.finish()
    with BagReader(tmp_path / "run.mcap") as bag:
        assert bag.topics["/skin/calibration"].n_messages == 2
    # Its taxels are no raw readings any more.
    code, _, err = start(
        "calibrate", "file:run.mcap", "--out", "again.toml", *words
    ).finish()
    assert code == 2
    assert (
        err
        == "run.mcap: its taxels are forces, of a calibrated skin; expected raw readings\n"
    )


def test_a_graph_without_a_calibration_is_not_tared(monkeypatch, capsys):
    nodes = [{"name": "sensor", "type": "sensor", "state": {"paused": False}}]
    monkeypatch.setattr(
        calibrate, "choose_graph", lambda name: SimpleNamespace(label="a (7)")
    )
    monkeypatch.setattr(calibrate, "describe", lambda graph: {"nodes": nodes})
    assert main(["tare"]) == 2
    assert capsys.readouterr().err == (
        "a (7): has no sensor with a calibration; state sensor.skin, or sensor.tare, in the launch "
        "file\n"
    )
