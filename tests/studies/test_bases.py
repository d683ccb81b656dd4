"""Study `bases`: what its points compute, and the page that answers from them."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from sparseskin.launch.commands.cli import main
from sparseskin.nodes.reconstructor.bases.haar import HaarBasis
from sparseskin.nodes.reconstructor.bases.learned import check_atoms
from sparseskin.studies.bases.page import write
from sparseskin.studies.bases.study import (
    BODIES,
    LEARNED_BASES,
    REGISTERED,
    coefficients,
    learned,
    reconstructed,
    sampled,
    spread_frames,
    training_of,
)

SCENE = "lift_box_40"
BASES = {"haar": "haar", "identity": "identity"}


def test_no_basis_is_tried_on_frames_that_it_was_learned_from() -> None:
    for scene in BODIES:
        other, own = training_of(scene, seed=4)
        assert {BODIES[name] for name in other["scenes"]} == set(BODIES.values()) - {BODIES[scene]}
        assert {BODIES[name] for name in own["scenes"]} == {BODIES[scene]}
        # Of the one scene of a peg, other paths.
        assert scene not in own["scenes"] or own["seed"] != 4


def test_coefficients_are_those_above_rounding_and_energy_adds_up() -> None:
    point = {"scene": SCENE, "bases": BASES, "n_frames": 4, "seed": 0}
    found = coefficients(point)
    truths = [t for t, _ in spread_frames(SCENE, 0, 4) if t.max() > 0.01]
    assert found["identity"]["n_frames"] == len(truths) >= 2
    expected = np.mean([np.count_nonzero(t > 1e-6) for t in truths])
    assert found["identity"]["n_nonzero"] == pytest.approx(expected)
    in_haar = [np.count_nonzero(np.abs(HaarBasis(40, 40).analysis(t)) > 1e-6) for t in truths]
    assert found["haar"]["n_nonzero"] == pytest.approx(np.mean(in_haar))
    for figures in found.values():
        assert figures["missing"] == sorted(figures["missing"], reverse=True)
        assert 0 <= figures["missing"][-1] < figures["missing"][0] < 1


def test_haar_reconstructs_a_compressed_skin_and_the_taxels_themselves_do_not() -> None:
    point = {"scene": SCENE, "bases": BASES, "n_frames": 12, "seed": 0, "ratio": 4}
    found = reconstructed(point)
    assert max(found["haar"]["mean_db"]) > max(found["identity"]["mean_db"]) + 2
    for figures in found.values():
        assert (np.array(figures["min_db"]) <= figures["mean_db"]).all()
    assert reconstructed(point) == found


def test_adaptive_sampling_is_beside_the_others_on_the_same_frames() -> None:
    found = sampled({"scene": SCENE, "ratio": 8, "n_frames": 40, "seed": 0})
    assert set(found) == {"reading", "paper", "skin", "subsample", "acts"}
    assert found["acts"]["mean_db"] > found["subsample"]["mean_db"]


def test_a_learned_basis_is_orthonormal() -> None:
    atoms = np.array(learned({"scenes": [SCENE], "seed": 1})["atoms"])
    assert check_atoms(atoms) == 8


def made_up() -> dict[str, pd.DataFrame]:
    names = (*REGISTERED, "haar, tiles", *LEARNED_BASES)
    scenes = ("lift_box_40", "path_40", "drag_wrench_64")
    of_basis = [
        {"n_nonzero": 10.0 * k, "missing": [0.1 / k] * 6 + [0.0], "n_frames": 9}
        for k in range(1, len(names) + 1)
    ]
    by_lambda = {"mean_db": [40.0, 41.5, 42.5, 41.0, 40.0], "min_db": [31.0] * 5}
    kinds = ("reading", "paper", "skin", "subsample", "acts")
    return {
        "counted": pd.DataFrame(
            {"scene": scene, "basis": name, **figures}
            for scene in scenes
            for name, figures in zip(names, of_basis, strict=True)
        ),
        "reconstructed": pd.DataFrame(
            {"scene": scene, "ratio": ratio, "basis": name, **by_lambda}
            for scene, ratio, name in product(scenes, (3, 4), names)
        ),
        "sampled": pd.DataFrame(
            {"scene": scene, "ratio": ratio, "sampling": kind, "mean_db": 40.0, "min_db": 30.0}
            for scene, ratio, kind in product(scenes, (4, 16), kinds)
        ),
    }


def test_the_page_answers_in_words_and_leaves_tables_and_charts(tmp_path: Path) -> None:
    scenes = ("lift_box_40", "path_40", "drag_wrench_64")
    write(tmp_path, **made_up(), spacing=dict.fromkeys(scenes, (33.3, 0.1)))
    page = (tmp_path / "bases.md").read_text()
    assert "Haar (D2) needs fewer coefficients than D4 in 3 of 3 scenes; D4 needs 2.00" in page
    assert "42.5 (41.5)" in page
    assert "end of a scene: lift_box_40 33.3 ms apart, path_40" in page
    assert "first contact: lift_box_40 0.1 ms apart, path_40" in page
    assert "Learning from other bodies adds to Haar on the same tiles +0.0 dB" in page
    assert "acts is above paper in 0 of 3 scenes" in page
    for name in ("bases.csv", "sampling.csv", "energy.png", "reconstructed.svg", "sampling.png"):
        assert (tmp_path / name).stat().st_size > 100


def test_the_study_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["study", "--help"])
    assert "bases " in capsys.readouterr().out
