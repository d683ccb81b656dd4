"""The graph in one process, of one patch and of several."""

import re
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from bags import chain
from damaged import refusal

from sparseskin.messages import (
    End,
    Measurements,
    PhiState,
    Reconstruction,
    Taxels,
    Truth,
)
from sparseskin.messages.frames import Frames
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.patch_log import PatchLog
from sparseskin.nodes.sensor.node import Sensor


def graph(scene="path_40", clock=None, phi="sbhe", **reconstructor):
    settings = {"compressor": {"seed": 1, "phi": phi}, "monitor": {}}
    settings["reconstructor"] = {"iterations": 5} | reconstructor
    return chain(clock, sensor={"source": f"scene:{scene}", "seed": 3}, **settings)


def test_a_frame_passes_all_stations_with_one_stamp():
    clock = ManualClock(1_000)
    bus = graph(clock=clock)
    for messages in bus.frames(3):
        assert Counter(type(m) for m in messages) == dict.fromkeys(
            (Taxels, Truth, Measurements, Reconstruction), 1
        )
        assert len({m.stamp_ns for m in messages}) == 1
        clock.advance(5)
    frames = bus.reports()["monitor"]["patches"]["skin"]["frames"]
    nothing = {"skipped": 0, "quiet": 0, "lost": 0, "unpaired": 0}
    assert frames == {"sensed": 3, "reconstructed": 3, **nothing}


def test_stamps_differ_on_a_clock_that_stands_still_and_a_source_ends_every_stream():
    stamps = [
        messages[0].stamp_ns for messages in graph(clock=ManualClock(7)).frames(4)
    ]
    assert stamps == [7, 8, 9, 10]
    bus = graph("lift_box_40", preset="paper", iterations=1)
    kinds = Counter(type(m) for messages in bus.frames() for m in messages)
    assert kinds[Taxels] == kinds[Reconstruction] == 700
    assert kinds[End] == 4  # taxels, truth, measurements, reconstruction
    assert all(host.finished for host in bus.hosts.values())


def test_messages_that_do_not_fit_the_skin_or_the_phi_are_refused_by_name():
    bus = graph()
    measured = [m for m in next(bus.frames(1)) if isinstance(m, Measurements)]
    other = replace(measured[0], phi="0" * 16)
    shown = refusal(
        lambda: list(bus.hosts["reconstructor"].node.step(other)), RefusedError
    )
    assert f"made by Phi {other.phi}, this reconstructor inverts Phi " in shown
    assert shown.endswith("and 2 other row subsets")
    bus = graph()
    host = bus.hosts["compressor"]
    wrong = Taxels(
        stamp_ns=0, patch="skin", run_id="f" * 16, forces=np.ones((40, 39), np.float32)
    )
    assert list(host.receive(wrong)) == []
    assert "forces of shape (40, 39), but the skin has (40, 40)" in bus.lines[-1]


def test_an_announced_phi_is_proved_by_its_fingerprint():
    bus = graph()
    host = bus.hosts["reconstructor"]
    fields = {
        "run_id": "f" * 16,
        "kind": "sbhe",
        "n": 1600,
        "m": 533,
        "block": 32,
        "seed": 1,
    }
    announced = PhiState(stamp_ns=0, patch="skin", fingerprint="0" * 16, **fields)
    assert list(host.receive(announced)) == []
    assert "its program differs" in bus.lines[-1]
    for change in ({"kind": "os:system"}, {"n": 1599}, {"m": 1601}, {"block": 7}):
        seq = host.counts.inputs["/skin/phi"].expected
        assert list(host.receive(replace(announced, seq=seq, **change))) == []
    assert (host.counts.refused, host.failure) == ({"refused": 5}, "")


def test_the_full_matrix_and_no_shrinkage_give_back_the_taxels():
    for messages in graph(phi="full", preset="paper", lambda_n=0.0).frames(3):
        by_type = {type(m): m for m in messages}
        np.testing.assert_allclose(
            by_type[Reconstruction].forces, by_type[Taxels].forces, atol=1e-5
        )


NAMES = ("hand", "arm", "back")
SIDE = 32
BATCH = {"patch": "body", "patches": NAMES}
SKIN = {"n_rows": SIDE, "n_cols": SIDE}
WALK = {"source": "scene:walk"}
SENSOR = BATCH | {"simulated": SKIN, "source": "scene:walk", "active": 0.5}
HEAD = {"stamp_ns": 5, "patch": "body", "names": NAMES}


def context(log=lambda line: None):
    return Context("node", ManualClock(1), log=log)


def patches_of(**reconstructor):
    monitor = {"patches": (), "batches": {"body": NAMES}}
    return chain(
        sensor=SENSOR,
        compressor=BATCH,
        reconstructor=BATCH | reconstructor,
        monitor=monitor,
    )


def test_several_patches_have_the_same_bits_as_one_by_one():
    bus = patches_of(skip_idle=False, iterations=8)
    batches = [
        {m.schema: m for m in sent if isinstance(m, Frames)} for sent in bus.frames(30)
    ]
    (skin,) = Sensor(Sensor.Settings(**SENSOR), context()).start()
    for k, name in enumerate(NAMES):
        compressor = Compressor(Compressor.Settings(patch=name), context())
        single = Reconstructor(
            Reconstructor.Settings(patch=name, iterations=8), context()
        )
        (phi,) = compressor.step(replace(skin, patch=name))
        assert isinstance(phi, PhiState)
        list(single.step(replace(skin, patch=name)))
        list(single.step(phi))
        held = {}
        for batch in batches:
            (y,) = compressor.step(batch["taxels"].split()[k])
            assert y == replace(batch["measurements"].split()[k], run_id="", seq=0)
            (found,) = single.step(y)
            same = next(
                p for p in batch["reconstruction"].split(held) if p.patch == name
            )
            assert found.forces.tobytes() == same.forces.tobytes()
            assert (found.phi, found.iterations) == (same.phi, same.iterations)
    patches = bus.reports()["monitor"]["patches"]
    assert list(patches) == list(NAMES)
    for patch in patches.values():
        assert patch["frames"] == {
            **{"sensed": 30, "reconstructed": 30, "skipped": 0, "quiet": 0},
            **{"lost": 0, "unpaired": 0},
        }


def test_settings_change_for_all_patches_and_measurements_of_others_are_refused():
    bus = patches_of()
    list(bus.frames(2))
    host = bus.hosts["reconstructor"]
    (state,) = host.change({"iterations": 7})
    assert (state.topic, getattr(state, "iterations", None)) == ("/body/solver", 7)
    assert [patch.settings.iterations for patch in host.node._patches] == [7, 7, 7]
    with pytest.raises(SettingsError, match="iterations"):
        host.change({"iterations": 0})
    bus = patches_of()
    list(bus.frames(1))
    node = bus.hosts["reconstructor"].node
    other = Measurements(**{**HEAD, "names": NAMES[:2]}, y=np.zeros((2, 4), np.float32),
                              phi="0" * 16)  # fmt: skip
    with pytest.raises(RefusedError, match="of other patches than this node serves"):
        list(node.step(other))


def test_frames_that_newer_ones_overtook_are_counted_for_each_patch():
    made = [m for messages in patches_of().frames(3) for m in messages]
    ys = [m for m in made if isinstance(m, Measurements)]
    bus = patches_of()
    (first,) = bus.frames(1)
    node = bus.hosts["reconstructor"].node
    node.overtaken(ys[1])
    (batch,) = node.step(ys[2])
    assert [part.skipped for part in batch.split()] == [1, 1, 1]
    assert first


@pytest.mark.parametrize(
    ("cls", "values", "line"),
    [
        (Compressor, {"bits": 8}, "bits: are not available for several patches"),
        (Compressor, {"patches": ["a", "a"]}, r"patches\[1\]: 'a' occurs twice"),
        (
            Reconstructor,
            {"patches": [], "skip_idle": True, "uncertainty": True},
            "uncertainty: is not",
        ),
        (
            Sensor,
            WALK | {"simulated": {"n_rows": 1024, "n_cols": 1024}},
            "at most 1048576 cells",
        ),
        (
            Sensor,
            WALK | {"simulated": SKIN | {"mask": ["01"]}},
            "source: simulated: mask",
        ),
        (
            Sensor,
            {"source": "sparseskin.studies.looped:path_40"},
            "not available for several patches",
        ),
    ],
)
def test_settings_that_are_not_allowed_are_one_line(cls, values, line):
    made = lambda: cls.Settings(**{**BATCH, **values}).check()  # noqa: E731
    assert re.search(line, refusal(made, SettingsError))


def test_masks_and_noise_of_a_simulated_skin_are_those_stated():
    rows = ["1" * 8] * 7 + ["0" * 8]
    values = {**SENSOR, "simulated": {"n_rows": 8, "n_cols": 8, "mask": rows}}
    sensor = Sensor(Sensor.Settings(**values), context())
    assert sensor.skin.n_taxels == 56
    for k in range(30):
        for message in sensor.acquire(Tick(k + 1, k)):
            assert not message.forces[:, 7].any()
    sensor = Sensor(
        Sensor.Settings(**SENSOR | {"simulated": SKIN | {"noise": 0.02}}, noise=2.0),
        context(),
    )
    (skin,) = sensor.start()
    assert (skin.sigma_end, skin.sigma_mid) == (0.04, 0.04)


def test_a_kind_of_line_is_logged_for_few_patches():
    lines = []
    names = tuple(f"p{k}" for k in range(12))
    log = PatchLog(names, lines.append)
    for name in names:
        log.of(name)(f"row {name[1:]} is constant")
    assert lines == [
        *(f"p{k}: row {k} is constant" for k in range(3)),
        "p9: row 9 is constant (10 such lines)",
    ]
    log.setting_up = True
    for name in names:
        log.of(name)("numba is missing")
    assert lines[4:] == ["numba is missing"]


def test_a_kind_of_line_of_one_patch_thins_out():
    lines = []
    log = PatchLog(("skin",), lines.append).of("skin")
    for k in range(1000):
        log(f"taxel {k} works again")
    assert (len(lines), lines[-1]) == (12, "taxel 999 works again (1000 such lines)")
