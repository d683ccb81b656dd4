"""Nodes that serve several equal patches, with one message each way."""

from dataclasses import replace

import numpy as np
import pytest

from sparseskin.messages import Measurements, PhiState
from sparseskin.messages.frames import Frames
from sparseskin.nodes.bus import Bus
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.errors import RefusedError, SettingsError
from sparseskin.nodes.monitor.node import Monitor
from sparseskin.nodes.node import Context, Tick
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.patch_log import PatchLog
from sparseskin.nodes.sensor.node import Sensor

NAMES = ("hand", "arm", "back")
SIDE = 32
BATCH = {"patch": "body", "patches": NAMES}
SKIN = {"rows": SIDE, "cols": SIDE}
WALK = {"source": "scene:walk"}
SENSOR = BATCH | {"simulated": SKIN, "source": "scene:walk", "active": 0.5}
HEAD = {"stamp_ns": 5, "patch": "body", "names": NAMES}


def context(log=lambda line: None):
    return Context("node", ManualClock(1), log=log)


def graph(**reconstructor):
    return {
        "sensor": (Sensor, Sensor.Settings(**SENSOR)),
        "compressor": (Compressor, Compressor.Settings(**BATCH)),
        "reconstructor": (Reconstructor, Reconstructor.Settings(**BATCH, **reconstructor)),
        "monitor": (Monitor, Monitor.Settings(patches=(), batches={"body": NAMES})),
    }


def test_several_patches_have_the_same_bits_as_one_by_one():
    bus = Bus(graph(skip_idle=False, iterations=8))
    batches = [
        {m.schema: m for m in messages if isinstance(m, Frames)} for messages in bus.frames(30)
    ]
    (skin,) = Sensor(Sensor.Settings(**SENSOR), context()).start()
    for k, name in enumerate(NAMES):
        compressor = Compressor(Compressor.Settings(patch=name), context())
        single = Reconstructor(Reconstructor.Settings(patch=name, iterations=8), context())
        (phi,) = compressor.step(replace(skin, patch=name))
        assert isinstance(phi, PhiState)
        list(single.step(replace(skin, patch=name)))
        list(single.step(phi))
        held = {}
        for batch in batches:
            (y,) = compressor.step(batch["taxels"].split()[k])
            assert y == replace(batch["measurements"].split()[k], run_id="", seq=0)
            (found,) = single.step(y)
            same = next(p for p in batch["reconstruction"].split(held) if p.patch == name)
            assert found.forces.tobytes() == same.forces.tobytes()
            assert (found.phi, found.iterations) == (same.phi, same.iterations)
    patches = bus.reports()["monitor"]["patches"]
    assert list(patches) == list(NAMES)
    for patch in patches.values():
        assert patch["frames"] == {
            **{"sensed": 30, "reconstructed": 30, "skipped": 0},
            **{"lost": 0, "unpaired": 0},
        }


def test_settings_change_for_all_patches():
    bus = Bus(graph())
    list(bus.frames(2))
    host = bus.hosts["reconstructor"]
    (state,) = host.change({"iterations": 7})
    assert (state.topic, getattr(state, "iterations", None)) == ("/body/solver", 7)
    assert [patch.settings.iterations for patch in host.node._patches] == [7, 7, 7]
    with pytest.raises(SettingsError, match="iterations"):
        host.change({"iterations": 0})


def test_frames_that_newer_ones_overtook_are_counted_for_each_patch():
    made = [m for messages in Bus(graph()).frames(3) for m in messages]
    ys = [m for m in made if isinstance(m, Measurements)]
    bus = Bus(graph())
    (first,) = bus.frames(1)
    node = bus.hosts["reconstructor"].node
    node.overtaken(ys[1])
    (batch,) = node.step(ys[2])
    assert [part.skipped for part in batch.split()] == [1, 1, 1]
    assert first


def test_measurements_of_other_patches_are_refused():
    bus = Bus(graph())
    list(bus.frames(1))
    node = bus.hosts["reconstructor"].node
    other = Measurements(**{**HEAD, "names": NAMES[:2]}, y=np.zeros((2, 4), np.float32),
                              phi="0" * 16)  # fmt: skip
    with pytest.raises(RefusedError, match="of other patches than this node serves"):
        list(node.step(other))


@pytest.mark.parametrize(
    ("cls", "values", "line"),
    [
        (Compressor, {"phi": "acts"}, "phi: acts chooses other rows for each patch"),
        (Compressor, {"bits": 8}, "bits: are not available for several patches"),
        (Compressor, {"patches": ["a", "a"]}, r"patches\[1\]: 'a' occurs twice"),
        (Reconstructor, {"patches": [], "skip_idle": True, "resultant": True}, "resultant: is not"),
        (Sensor, WALK | {"simulated": {"rows": 1024, "cols": 1024}}, "at most 1048576 cells"),
        (Sensor, WALK | {"simulated": SKIN | {"mask": ["01"]}}, "source: simulated: mask"),
        (
            Sensor,
            {"source": "sparseskin.studies.looped:path_40"},
            "not available for several patches",
        ),
    ],
)
def test_settings_that_are_not_allowed_are_one_line(cls, values, line):
    with pytest.raises(SettingsError, match=line) as caught:
        cls.Settings(**{**BATCH, **values}).check()
    assert "\n" not in str(caught.value)


def test_a_masked_cell_reads_nothing_on_any_patch():
    rows = ["1" * 8] * 7 + ["0" * 8]
    values = {**SENSOR, "simulated": {"rows": 8, "cols": 8, "mask": rows}}
    sensor = Sensor(Sensor.Settings(**values), context())
    assert sensor.skin.n_taxels == 56
    for k in range(30):
        for message in sensor.acquire(Tick(k + 1, k)):
            assert not message.forces[:, 7].any()


def test_the_stated_noise_of_a_skin_is_that_of_its_sensor():
    sensor = Sensor(
        Sensor.Settings(**SENSOR | {"simulated": SKIN | {"noise": 0.02}}, noise=2.0), context()
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
