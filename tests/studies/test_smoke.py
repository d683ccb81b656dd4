"""One run of each study, as small as it can be: its page, tables and charts are there."""

import re
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from sparseskin.launch.commands.cli import main
from sparseskin.studies import command, frames, harness, needs
from sparseskin.studies.accuracy import constants, contacts, rules
from sparseskin.studies.accuracy import experiments as accuracy
from sparseskin.studies.paper import tables as paper
from sparseskin.studies.presses import N_BEFORE
from sparseskin.studies.speed import beside, latency, matrices, offline, processes
from sparseskin.studies.speed import tables as speed
from sparseskin.studies.speed_accuracy import charts as speed_accuracy
from sparseskin.studies.speed_accuracy import experiments
from sparseskin.studies.stability import phase, sweeps
from sparseskin.studies.stability import tables as stability
from sparseskin.studies.tasks import classifier, touch
from sparseskin.studies.tasks import tables as tasks

N_FRAMES = 9
SOLVERS = {"fista": "fista", "skin": "skin"}
SHORT_SCENES = ("lift_box_40",)
SIZES = (
    (accuracy, {"ACTIVE": (0.3,), "QUICK_SIZES": (((4, 4), None),)}),
    (accuracy, {"BODIES": ("peg",), "QUICK_BODIES": ("peg",)}),
    (accuracy, {"SCENES": SHORT_SCENES, "RATED_SCENES": SHORT_SCENES, "SIDES": (12,)}),
    (beside, {"QUICK_RATES_HZ": (100,), "SECONDS": 0.5, "SLICES": 1}),
    (processes, {"QUICK_RATES_HZ": (100,), "SECONDS": 0.5, "SLICES": 1}),
    (processes, {"PROCESSES": dict(list(processes.PROCESSES.items())[:2])}),
    (constants, {"VALUES": {"damping": 0.5}}),
    (contacts, {"CONTACT_RATIOS": (2,)}),
    (experiments, {"QUICK_RATIOS": (3, 8), "SUM_KINDS": ("sbhe",)}),
    (experiments, {"SUM_SOLVERS": SOLVERS, "QUICK_SCENES": SHORT_SCENES}),
    (experiments, {"find_spec": lambda name: None}),  # no compiled loops
    (frames, {"_kept": lru_cache(frames._kept.__wrapped__)}),  # simulated once
    (harness, {"TIMED_ON": "serial"}),
    (latency, {"WARM_UP": 50, "SCENES": {"64 x 64": "drag_wrench_64"}}),
    (matrices, {"QUICK_SIDES": (8,)}),
    (needs, {"QUICK_SCENES": ("lift_box_40",), "QUICK_STEPS": 350}),
    (offline, {"SLICES": 1, "QUICK_N_FRAMES": 20, "FIRST": 0, "ITERATIONS": (8,)}),
    (paper, {"BEFORE_MAPS": 0}),
    (phase, {"SUM_SOLVERS": SOLVERS, "N_STATIC": 6, "N_JUDGED": 2}),
    (stability, {"QUICK_KINDS": {"load": ("box",), "fault": ("zeros", "stuck blob")}}),
    (
        rules,
        {
            "QUICK_WORLDS": 1,
            "RULES": {name: rules.RULES[name] for name in ("bias", "offset")},
        },
    ),
    (speed, {"TIMED_ON": "serial", "QUICK_SIDES": (20,)}),
    (speed_accuracy, {"TIMED_ON": "serial"}),
    (classifier, {"GRID": {"gamma": (1.0,), "alpha": (0.01,)}}),
    (tasks, {"QUICK_TRAIN": 60, "QUICK_TEST": 24}),
    (
        touch,
        {
            "WAYS": (*list(touch.MEASURED)[:1], touch.RASTER, touch.SHUFFLED),
            "MEASURED": dict(list(touch.MEASURED.items())[:1]),
            "QUICK_FORCES_N": (0.5,),
            "QUICK_PRESSES": 4,
            "QUICK_COUNTED": 2000,
        },
    ),
    (sweeps, {"SUM_SOLVERS": {"fista": "fista"}, "EXCERPTS": sweeps.EXCERPTS[:1]}),
)
"""Sizes that are smaller than those of a quick run, by module."""
TEXTS = {
    "paper-tables": "## Table III: PSNR by M, 30 iterations",
    "speed-accuracy": "| fista, preset paper | sbhe | 3 |",
    "stability": "| lambda_n | fista |",
    "scene-needs": "| without damping of the skin |",
    "accuracy": "| press | 114 | kPa |",
    "speed": "## Beside lean nodes",
    "tasks": "set: the user's files, read by `--data`.",
    "train": "Noise of a known deviation",
}
"""A text on each page."""
PACKAGES = {"tasks": "sklearn", "train": "torch"}
"""A package that a study needs beside those of all."""

LONG = (
    "accuracy",
    "paper-tables",
    "speed",
    "speed-accuracy",
    "stability",
    "tasks",
    "train",
)
"""Studies that take more than some seconds even so."""


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make all sizes small, and let studies see few frames around the first contact of a scene."""
    for module, sizes in SIZES:
        for name, value in sizes.items():
            monkeypatch.setattr(module, name, value)
    # Charts are drawn, but not laid out, which takes longer than all else.
    engine = "matplotlib.layout_engine.ConstrainedLayoutEngine.execute"
    monkeypatch.setattr(engine, lambda self, figure: None)
    windows = frames.SceneFrames.windows

    def few(self, seed):
        begin = frames.first_contact(self.scene, seed) - 3 * self.every
        for first, stop in windows(self, seed):
            first = max(first, begin)
            yield first, min(stop or first + 1000, first + N_FRAMES * self.every)

    monkeypatch.setattr(frames.SceneFrames, "windows", few)
    for kind, n_frames in (
        ("PressFrames", N_BEFORE + N_FRAMES),
        ("UntouchedFrames", N_FRAMES),
    ):
        cls = getattr(frames, kind)

        def opened(self, seed, n=n_frames, whole=cls.open):
            return whole(replace(self, n_frames=min(self.n_frames, n)), seed)

        monkeypatch.setattr(cls, "open", opened)

    # Of the points that start real graphs, the last alone.
    for module, n_frames in ((latency, 200), (beside, 50)):

        def last(quick, seed, n_frames=n_frames, whole=module.points):
            return [whole(quick, seed)[-1] | {"n_frames": n_frames}]

        monkeypatch.setattr(module, "points", last)


@pytest.fixture
def recordings(tmp_path):
    """A folder with a recording of a press that comes and goes, and one of five taxels."""
    folder = tmp_path / "recordings"
    folder.mkdir()
    i, j = np.indices((12, 10))
    presses = np.zeros((40, 12, 10), dtype=np.float32)
    presses[10:30] = 50 * np.exp(-((i - 5) ** 2 + (j - 5) ** 2) / 6)
    mask = np.ones((12, 10), dtype=np.bool_)
    mask[:3, :2] = False
    np.savez(folder / "press.npz", forces=presses * mask, mask=mask, unit="kPa")
    np.save(folder / "tiny.npy", np.ones((12, 1, 5), dtype=np.float32))
    return folder


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] if name in LONG else [])
        for name in command.STUDIES
    ],
)
def test_a_study_writes_its_page_with_all_tables_and_charts(
    name, tmp_path, recordings, capsys
):
    if name in PACKAGES:
        pytest.importorskip(PACKAGES[name])
    out = tmp_path / "out"
    options = []
    if name == "accuracy":
        options = ["--recordings", str(recordings), "--seeds", "1", "--constants"]
    if name == "tasks":
        frames_of_12 = np.random.default_rng(0).uniform(0, 1, (12, 16, 16))
        np.savez(
            tmp_path / "set.npz", frames=frames_of_12, labels=np.array(["a", "b"] * 6)
        )
        options = ["--data", str(tmp_path)]
    options += ["--quick", "--executor", "serial", "--out", str(out)]
    assert main(["study", name, *options]) == 0
    printed = capsys.readouterr().out.splitlines()
    page = (out / f"{name}.md").read_text()
    assert printed[-1] == str(out / f"{name}.md")
    assert len(printed) > 1
    assert all(line in page for line in printed[:-1])
    assert TEXTS[name] in page
    assert "A quick run" in page
    assert "nan" not in page
    links = set(re.findall(r"\]\(([^)]+)\)", page))
    assert links == {path.name for path in out.iterdir()} - {
        f"{name}.md",
        "points.jsonl",
    }
    assert all((out / link).stat().st_size > 50 for link in links)
