"""The recogniser: its models, its labels, and their training from recordings."""

import os

import numpy as np
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.messages import (
    Labels,
    Measurements,
    MessageError,
    PhiState,
    Reconstruction,
)
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.errors import RefusedError, SettingsError, SparseskinError
from sparseskin.nodes.node import Context
from sparseskin.nodes.registry import node_class
from sparseskin.plugins.recogniser.models import load_model
from sparseskin.plugins.recogniser.node import Recogniser

SHAPE = (2, 3)
PHI = "0" * 16


class Halves:
    """A model: the share of the force on each row of taxels."""

    classes_ = np.array(["above", "below"])
    n_features_in_ = 6

    def predict_proba(self, inputs):
        rows = inputs.reshape(-1, *SHAPE).sum(axis=2)
        return rows / rows.sum(axis=1, keepdims=True)


class Faulty(Halves):
    def predict_proba(self, inputs):
        raise ZeroDivisionError("no")


class NoNumbers(Halves):
    def predict_proba(self, inputs):
        return np.full((1, 2), np.nan)


@pytest.fixture(autouse=True)
def models_here(monkeypatch, tmp_path):
    """Modules `my_models` and a folder of this test, which names of models refer to."""
    import sys
    import types

    module = types.ModuleType("my_models")
    vars(module).update(Halves=Halves, Faulty=Faulty, NoNumbers=NoNumbers, Nothing=dict)
    monkeypatch.setitem(sys.modules, "my_models", module)
    monkeypatch.chdir(tmp_path)


def node(model="my_models:Halves", **settings):
    return Recogniser(
        Recogniser.Settings(model=model, **settings),
        Context("recogniser", ManualClock(1), live=False),
    )


def frame(forces, stamp_ns=1, **others):
    fields = {
        "iterations": (1,),
        "residual": (0.0,),
        "solve_ns": (1,),
        "done_ns": stamp_ns,
    }
    forces = np.asarray(forces, np.float32).reshape(SHAPE)
    return Reconstruction(
        stamp_ns=stamp_ns, patch="skin", forces=forces, phi=PHI, **fields | others
    )


def labels_of(one, *frames):
    return [message for message in frames for message in one.step(message)]


def test_the_node_is_found_by_its_type():
    assert node_class("recogniser") is Recogniser


def test_a_frame_gets_the_label_with_the_largest_share_and_its_age():
    one = node()
    above = [3, 0, 0, 1, 0, 0]
    below = [0, 0, 1, 3, 1, 0]
    stamps = (10**9, 2 * 10**9, 4 * 10**9, 5 * 10**9)
    found = labels_of(
        one,
        *(
            frame(f, t)
            for f, t in zip((above, above, below, below), stamps, strict=True)
        ),
    )
    assert [each.label for each in found] == ["above", "above", "below", "below"]
    assert [each.share for each in found] == pytest.approx([0.75, 0.75, 0.8, 0.8])
    assert [each.age_s for each in found] == [0, 1, 0, 1]
    assert [each.stamp_ns for each in found] == list(stamps)
    assert {each.topic for each in found} == {"/skin/labels"}
    assert one.report() == {"frames": 4, "labels": {"above": 2, "below": 2}}


def test_a_frame_of_nothing_or_of_a_small_share_has_no_label():
    one = node(least=0.7)
    empty, even, clear = labels_of(
        one, frame([0] * 6), frame([3, 0, 0, 2, 0, 0]), frame([1] + [0] * 5)
    )
    assert empty.label == ""
    assert empty.share == 0.0
    assert even.label == ""
    assert even.share == pytest.approx(0.6)
    assert clear.label == "above"


def test_a_label_of_a_frame_that_is_not_trusted_states_that():
    doubtful, sure = labels_of(node(), frame([1] * 6, trusted=(False,)), frame([1] * 6))
    assert not doubtful.trusted
    assert sure.trusted


def test_what_the_model_is_not_of_is_refused_and_the_next_frame_labelled():
    one = node()
    wide = Reconstruction(
        **{**vars(frame([1] * 6)), "forces": np.ones((1, 3, 3), np.float32)}
    )
    with pytest.raises(RefusedError, match="9 numbers, but the model was trained on 6"):
        list(one.step(wide))
    several = frame([1] * 6)
    several = Reconstruction(
        **{
            **vars(several),
            **{
                name: getattr(several, name) * 2
                for name in ("iterations", "residual", "solve_ns")
            },
            "names": ("left", "right"),
            "forces": np.ones((2, *SHAPE), np.float32),
            **dict.fromkeys(("error", "trusted", "unchanged", "reason"), ()),
        }
    )
    with pytest.raises(RefusedError, match="holds several patches"):
        list(one.step(several))
    assert labels_of(one, frame([1, 0, 0, 0, 0, 0]))[0].label == "above"


@pytest.mark.parametrize(
    ("model", "text"),
    [("Faulty", "ZeroDivisionError: no"), ("NoNumbers", "expected 2 finite shares")],
)
def test_a_model_that_fails_is_named_and_ends_nothing(model, text):
    with pytest.raises(RefusedError, match=rf"model my_models:{model}: {text}"):
        list(node(f"my_models:{model}").step(frame([1] * 6)))


def test_measurements_of_rows_that_rotate_are_refused_with_what_to_set():
    one = node(reads="measurements")
    assert one.inputs(one.settings) == ("/skin/phi", "/skin/measurements")
    phi = {
        "stamp_ns": 1,
        "patch": "skin",
        "kind": "sbhe",
        "n": 6,
        "m": 6,
        "block": 2,
        "seed": 0,
    }
    list(one.step(PhiState(**phi, fingerprint=PHI)))
    y = Measurements(
        stamp_ns=2, patch="skin", y=np.array([1, 0, 0, 0, 0, 0], np.float32), phi=PHI
    )
    assert labels_of(one, y)[0].label == "above"
    with pytest.raises(
        SettingsError, match='set its rows = "fixed", or reads = "reconstruction"'
    ):
        list(one.step(PhiState(**phi, fingerprint=PHI, rows="rotating")))


@pytest.mark.parametrize(
    ("model", "text"),
    [
        ("halves", 'expected "module:Class", or a file .joblib'),
        ("nowhere.joblib", "nowhere.joblib: No such file"),
        ("my_models:Nothing", "dict has no predict_proba and classes_"),
        ("my_models:Half", "my_models has no 'Half'"),
        (".joblib", ".joblib: is no file"),
        ("cut.joblib", "cut.joblib: no model can be read"),
        ("open.joblib", "open.joblib: others can write it, and a joblib file is code"),
    ],
)
def test_a_model_that_cannot_be_had_gets_one_line(model, text, tmp_path):
    pytest.importorskip("joblib")
    (tmp_path / ".joblib").mkdir()
    for name in ("cut.joblib", "open.joblib"):
        (tmp_path / name).write_bytes(b"not a model")
        os.chmod(tmp_path / name, 0o666 if name == "open.joblib" else 0o600)
    with pytest.raises(SettingsError) as caught:
        load_model(model)
    assert text in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_label_has_bounds():
    head = {"stamp_ns": 1, "patch": "skin", "age_s": 0.0, "done_ns": 1}
    for wrong in (
        {"share": 1.5},
        {"share": float("nan")},
        {"label": "a\nb"},
        {"age_s": -1.0},
    ):
        with pytest.raises(MessageError):
            Labels(**{"label": "a", "share": 0.5, **head, **wrong})


def line_of(words, capsys):
    """The one line with which a command ends whose input is wrong."""
    capsys.readouterr()
    assert main(words) != 0
    (line,) = capsys.readouterr().err.splitlines()
    return line


def written(folder, name, above):
    """A recording of 40 frames that press one half of 6 x 4 taxels, with untouched ones before."""
    rng = np.random.default_rng(above)
    frames = np.zeros((60, 6, 4), np.float32)
    half = slice(0, 3) if above else slice(3, 6)
    frames[20:, half] = rng.uniform(0.5, 1.0, (40, 3, 4))
    np.savez(
        folder / f"{name}.npz",
        forces=frames,
        f_max=2.5,
        rate_hz=10.0,
        unit=np.array("N"),
    )


def test_a_model_is_trained_from_recordings_and_labels_and_used_by_the_node(
    tmp_path, capsys
):
    pytest.importorskip("sklearn")
    written(tmp_path, "up", True)
    written(tmp_path, "down", False)
    (tmp_path / "labels.csv").write_text("recording,label\nup,upper\ndown.npz,lower\n")
    words = ["tasks", "train", "up.npz", "down.npz", "--labels", "labels.csv"]
    assert main(words) == 0
    out = capsys.readouterr().out
    assert "80 frames of 24 numbers: lower 40, upper 40" in out
    assert "100 % of the frames held out" in out
    assert os.stat("model.joblib").st_mode & 0o077 == 0
    one = node("model.joblib")
    pressed = np.zeros((1, 6, 4), np.float32)
    pressed[0, :3] = 0.1
    message = Reconstruction(**{**vars(frame([1] * 6)), "forces": pressed})
    assert labels_of(one, message)[0].label == "upper"
    with pytest.raises(SettingsError, match="trained on reconstruction, state that"):
        node("model.joblib", reads="measurements")
    assert line_of(words, capsys).startswith("model.joblib: exists already")


@pytest.mark.parametrize(
    ("table", "text"),
    [
        ("recording\nup\n", "labels.csv: expected columns recording, label"),
        ("recording,label\nup,\n", "labels.csv:2: label ''"),
        ("recording,label,begin_s\nup,a,x\n", "labels.csv:2: begin_s 'x' is no number"),
        (
            "recording,label,begin_s,end_s\nup,a,3,2\n",
            "labels.csv:2: begin_s 3 is not in 0 .. end_s 2",
        ),
        ("recording,label\ndown,a\n", "up.npz: no row of the table of labels names it"),
        (
            "recording,label\nup,a\ndown,b\n",
            "labels of 'down': no such recording is stated",
        ),
        ("recording,label\nup,a\n", "examples of 1 labels"),
    ],
)
def test_labels_that_are_wrong_get_one_line(table, text, tmp_path, capsys):
    pytest.importorskip("sklearn")
    written(tmp_path, "up", True)
    (tmp_path / "labels.csv").write_text(table)
    assert text in line_of(
        ["tasks", "train", "up.npz", "--labels", "labels.csv"], capsys
    )


def test_spans_of_one_recording_have_labels_of_their_own(tmp_path, capsys):
    pytest.importorskip("sklearn")
    written(tmp_path, "up", True)
    table = "recording,label,begin_s,end_s\nup,first,2,4\nup,second,4,\n"
    (tmp_path / "labels.csv").write_text(table)
    assert main(["tasks", "train", "up.npz", "--labels", "labels.csv"]) == 0
    assert "first 20, second 20" in capsys.readouterr().out


def test_a_graph_labels_the_frames_of_a_recording(tmp_path):
    pytest.importorskip("sklearn")
    import sparseskin

    written(tmp_path, "up", True)
    written(tmp_path, "down", False)
    (tmp_path / "labels.csv").write_text("recording,label\nup,upper\ndown,lower\n")
    assert main(["tasks", "train", "up.npz", "down.npz", "--labels", "labels.csv"]) == 0
    (tmp_path / "graph.toml").write_text(
        '[nodes.sensor]\ntype = "sensor"\nsource = "file:down.npz"\n'
        '[nodes.compressor]\ntype = "compressor"\nratio = 2\n'
        '[nodes.reconstructor]\ntype = "reconstructor"\nfast = "off"\n'
        '[nodes.recogniser]\ntype = "recogniser"\nmodel = "model.joblib"\n'
    )
    frames = list(sparseskin.run_launch("graph.toml"))
    assert [frame.label.label for frame in frames[30:]] == ["lower"] * 30
    with pytest.raises(SparseskinError, match=r"gone\.joblib: No such file"):
        sparseskin.load_launch("graph.toml", ["recogniser.model=gone.joblib"])
