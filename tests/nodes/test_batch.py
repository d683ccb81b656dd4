"""Batches: equal patches in one message, and nodes that serve them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sparseskin.messages import (
    FieldError,
    Measurements,
    MeasurementsBatch,
    Message,
    OversizedError,
    PhiState,
    Reconstruction,
    ReconstructionBatch,
    ShapeError,
    SkinState,
    Taxels,
    TaxelsBatch,
    TruthBatch,
)
from sparseskin.messages.batches import BATCHES
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.batch import CompressorBatch
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.reconstructor.batch.node import ReconstructorBatch
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.sensor.batch import SensorBatch

NAMES = ("hand", "arm", "back")
SIDE = 32
BATCH: dict[str, Any] = {"patch": "body", "patches": NAMES}
SENSOR = BATCH | {"n_rows": SIDE, "n_cols": SIDE, "source": "scene:walk", "active": 0.5}
HEAD: dict[str, Any] = {"stamp_ns": 5, "patch": "body", "names": NAMES}


def context(log: Any = lambda line: None) -> Context:
    return Context("node", ManualClock(1), log=log)


def graph(**reconstructor: Any) -> dict[str, tuple[Any, Any]]:
    return {
        "sensor": (SensorBatch, SensorBatch.Settings(**SENSOR)),
        "compressor": (CompressorBatch, CompressorBatch.Settings(**BATCH)),
        "reconstructor": (
            ReconstructorBatch,
            ReconstructorBatch.Settings(**BATCH, **reconstructor),
        ),
        "monitor": (Monitor, Monitor.Settings(patches=(), batches={"body": NAMES})),
    }


def reconstruction(name: str, unchanged: bool) -> Reconstruction:
    return Reconstruction(
        stamp_ns=5,
        patch=name,
        forces=np.full((2, 3), len(name), np.float32),
        phi="0" * 16,
        iterations=len(name),
        residual=0.5,
        solve_ns=7,
        done_ns=9,
        skipped=2,
        error=0.25 if name == "arm" else None,
        trusted=name != "arm",
        unchanged=unchanged,
    )


def test_splitting_undoes_joining() -> None:
    parts: list[Message] = [
        Taxels(stamp_ns=5, patch=name, forces=np.full((2, 3), k, np.float32))
        for k, name in enumerate(NAMES)
    ]
    assert TaxelsBatch.join("body", parts).split({}) == parts
    parts = [
        Measurements(stamp_ns=5, patch=name, y=np.full(4, k, np.float32), phi="0" * 16)
        for k, name in enumerate(NAMES)
    ]
    assert MeasurementsBatch.join("body", parts).split({}) == parts
    parts = [reconstruction(name, unchanged=False) for name in NAMES]
    assert ReconstructionBatch.join("body", parts).split({}) == parts


def test_forces_of_an_unchanged_patch_are_not_sent_and_are_those_of_its_last_frame() -> None:
    before = [reconstruction(name, unchanged=False) for name in NAMES]
    now = [reconstruction(name, unchanged=name == "arm") for name in NAMES]
    held: dict[str, Any] = {}
    ReconstructionBatch.join("body", before).split(held)
    batch = ReconstructionBatch.join("body", now)
    assert batch.forces is not None
    assert len(batch.forces) == 2
    assert batch.split(held) == now
    # A reader that came later has not seen them.
    assert batch.split({}) == [now[0], now[2]]
    idle = ReconstructionBatch.join("body", [replace(part, unchanged=True) for part in now])
    assert idle.forces is None
    assert [part.patch for part in idle.split(held)] == list(NAMES)


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"names": ("hand", "arm")}, ShapeError),
        ({"names": ("hand", "hand", "arm")}, FieldError),
        ({"names": ("hand", "Arm", "back")}, FieldError),
        ({"names": ("hand arm", "back", "leg")}, ShapeError),
        ({"names": ()}, FieldError),
        ({"names": tuple(f"p{k}" for k in range(257))}, OversizedError),
        ({"names": tuple(f"p{k:030d}" for k in range(256))}, OversizedError),
    ],
)
def test_names_that_do_not_fit_are_refused(changes: Any, error: type[Exception]) -> None:
    forces = np.zeros((3, 2, 2), np.float32)
    with pytest.raises(error):
        TruthBatch(**{**HEAD, "forces": forces, **changes})


def test_as_many_forces_as_patches_that_changed() -> None:
    good = ReconstructionBatch.join("body", [reconstruction(name, False) for name in NAMES])
    with pytest.raises(ShapeError, match="of 2 patches, but 3 have changed"):
        replace(good, forces=good.forces[:2])  # type: ignore[index]
    with pytest.raises(FieldError, match="below 0"):
        replace(good, iterations=np.array([1, -1, 1], np.int32))


def test_a_batch_gives_the_same_bits_as_its_patches_one_by_one() -> None:
    bus = Bus(graph(skip_idle=False))
    batches = [
        {m.schema: m for m in messages if m.schema in {b.schema for b in BATCHES.values()}}
        for messages in bus.frames(30)
    ]
    sensor = SensorBatch(SensorBatch.Settings(**SENSOR), context())
    (skin,) = sensor.start()
    for k, name in enumerate(NAMES):
        compressor = Compressor(Compressor.Settings(patch=name), context())
        single = Reconstructor(Reconstructor.Settings(patch=name), context())
        (phi,) = compressor.step(replace(skin, patch=name))
        assert isinstance(phi, PhiState)
        list(single.step(replace(skin, patch=name)))
        list(single.step(phi))
        held: dict[str, Any] = {}
        for batch in batches:
            (y,) = compressor.step(batch["taxels_batch"].split({})[k])
            assert y == replace(batch["measurements_batch"].split({})[k], run_id="", seq=0)
            (found,) = single.step(y)
            same = next(p for p in batch["reconstruction_batch"].split(held) if p.patch == name)
            assert isinstance(found, Reconstruction)
            assert found.forces.tobytes() == same.forces.tobytes()
            assert (found.phi, found.iterations) == (same.phi, same.iterations)
    patches = bus.reports()["monitor"]["patches"]
    assert list(patches) == list(NAMES)
    for patch in patches.values():
        assert patch["frames"] == {
            **{"sensed": 30, "reconstructed": 30, "skipped": 0},
            **{"lost": 0, "unpaired": 0},
        }


def test_settings_change_for_all_patches() -> None:
    bus = Bus(graph())
    list(bus.frames(2))
    host = bus.hosts["reconstructor"]
    (state,) = host.change({"iterations": 7})
    assert (state.topic, getattr(state, "iterations", None)) == ("/body/solver", 7)
    assert isinstance(host.node, ReconstructorBatch)
    for node in host.node.nodes.values():
        assert node.settings.iterations == 7
    with pytest.raises(SettingsError, match="iterations"):
        host.change({"iterations": 0})


def test_frames_that_newer_ones_overtook_are_counted_for_each_patch() -> None:
    made = [m for messages in Bus(graph()).frames(3) for m in messages]
    ys = [m for m in made if isinstance(m, MeasurementsBatch)]
    bus = Bus(graph())
    (first,) = bus.frames(1)
    node = bus.hosts["reconstructor"].node
    node.overtaken(ys[1])
    (batch,) = node.step(ys[2])
    assert isinstance(batch, ReconstructionBatch)
    assert [part.skipped for part in batch.split({})] == [1, 1, 1]
    assert first


def test_measurements_of_other_patches_are_refused() -> None:
    node = ReconstructorBatch(ReconstructorBatch.Settings(**BATCH), context())
    other = MeasurementsBatch(**{**HEAD, "names": NAMES[:2]}, y=np.zeros((2, 4), np.float32),
                              phi="0" * 16)  # fmt: skip
    with pytest.raises(RefusedError, match="of other patches than this node serves"):
        list(node.step(other))


@pytest.mark.parametrize(
    ("cls", "values", "line"),
    [
        (CompressorBatch, {"phi": "acts"}, "phi: acts chooses other rows for each patch"),
        (CompressorBatch, {"bits": 8}, "bits: are not available for a batch"),
        (CompressorBatch, {"patches": ["a", "a"]}, r"patches\[1\]: 'a' occurs twice"),
        (CompressorBatch, {"patches": []}, "patches: 0 names; allowed: 1..256"),
        (ReconstructorBatch, {"resultant": True}, "resultant: is not available for a batch"),
        (ReconstructorBatch, {"uncertainty": True}, "uncertainty: is not available for a batch"),
        (SensorBatch, {"n_rows": 4096, "n_cols": 4096}, "cells; at most 1048576 in one batch"),
        (SensorBatch, {"mask": ["01"]}, "mask: expected 64 texts of 64 characters 0 and 1"),
        (SensorBatch, {"source": "scene:huge"}, "'scene:huge' is not available for a batch"),
        (SensorBatch, {"source": "file:a.npz"}, "'file:a.npz' is not available for a batch"),
    ],
)
def test_settings_that_are_not_allowed_are_one_line(cls: Any, values: Any, line: str) -> None:
    with pytest.raises(SettingsError, match=line) as caught:
        cls.Settings(**{**BATCH, **values}).check()
    assert "\n" not in str(caught.value)


def test_a_masked_cell_reads_nothing_on_any_patch() -> None:
    rows = ["1" * 8] * 7 + ["0" * 8]
    values = {**SENSOR, "n_rows": 8, "n_cols": 8, "mask": rows}
    sensor = SensorBatch(SensorBatch.Settings(**values), context())
    assert sensor.skin.n_taxels == 56
    for k in range(30):
        for message in sensor.acquire(Tick(k + 1, k)):
            assert isinstance(message, TaxelsBatch | TruthBatch)
            assert not message.forces[:, 7].any()


def test_the_stated_noise_of_a_skin_is_that_of_its_sensor() -> None:
    sensor = SensorBatch(SensorBatch.Settings(**SENSOR, sigma_end=0.02, noise=2.0), context())
    (skin,) = sensor.start()
    assert isinstance(skin, SkinState)
    assert (skin.sigma_end, skin.sigma_mid) == (0.04, 0.04)


def test_a_kind_of_line_is_logged_for_few_patches() -> None:
    lines: list[str] = []
    names = tuple(f"p{k}" for k in range(12))
    settings = CompressorBatch.Settings(patch="body", patches=names)
    node = CompressorBatch(settings, context(lines.append))
    for name, each in node.nodes.items():
        each.context.log(f"row {name[1:]} is constant")
    assert lines == [
        *(f"p{k}: row {k} is constant" for k in range(3)),
        "p9: row 9 is constant (10 such lines)",
    ]
