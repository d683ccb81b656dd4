"""Settings: typed, ranged, every fault named; changed between two frames, whole, or not at all."""

from dataclasses import dataclass

import numpy as np
import pytest
from bags import launched, only

from sparseskin.launch.launchfile.load import load
from sparseskin.messages import (
    Measurements,
    PhiState,
    Reconstruction,
    SolverState,
    Taxels,
    Truth,
)
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.reconstructor.settings import PRESETS
from sparseskin.nodes.settings import PatchSettings, Settings, setting


@dataclass(frozen=True)
class Fixed(Settings):
    iterations: int = setting(30, "how many", low=1, high=1000)
    rate_hz: float = setting(100.0, "how often", low=0.0)
    basis: str = setting("haar", "which", choices=("haar", "dct"))
    unit: str | None = setting(None, "of what")
    names: tuple[str, ...] = setting((), "whose")
    loud: bool = setting(False, "whether")


def test_values_take_their_declared_type():
    made = Fixed.from_mapping(
        {"rate_hz": 5, "names": ["a", "b"], "unit": "N", "loud": True}
    )
    assert made == Fixed(rate_hz=5.0, names=("a", "b"), unit="N", loud=True)
    assert isinstance(made.rate_hz, float)


@pytest.mark.parametrize(
    ("values", "text"),
    [
        ({"itertions": 3}, r"itertions: unknown key \(did you mean 'iterations'\?\)"),
        ({"zzz": 3}, r"zzz: unknown key \(known: basis, "),
        ({"iterations": 0}, r"iterations: 0 is outside 1\.\.1000"),
        ({"iterations": 3.0}, "iterations: expected a whole number, got 3.0"),
        ({"rate_hz": float("nan")}, "rate_hz: nan is outside"),
        ({"basis": "har"}, r"basis: 'har' is not allowed \(did you mean 'haar'\?\)"),
        ({"unit": 3}, "unit: expected a text or nothing, got 3"),
        ({"names": "ab"}, "names: expected a list of texts, got 'ab'"),
        ({"loud": 1}, "loud: expected true or false, got 1"),
    ],
)
def test_a_wrong_value_is_named_with_what_is_allowed(values, text):
    with pytest.raises(SettingsError, match=text):
        Fixed.from_mapping(values)


@pytest.mark.parametrize("patch", ["", "Left", "left hand", "9", "a" * 33])
def test_a_patch_needs_a_name(patch):
    with pytest.raises(SettingsError, match="patch"):
        PatchSettings(patch=patch)


OVERRIDES = ("reconstructor.iterations=5",)
CONTACT = 340
"""By this frame of path_40 the peg is on the skin."""


@dataclass(frozen=True)
class Example(Settings):
    rate_hz: float = setting(100.0, "how often", low=1.0, high=1000.0, live=True)
    basis: str = setting("haar", "which", known=("haar", "dct"), live=True)
    tail: str | None = setting(None, "which end", choices=("left", "right"), live=True)
    seed: int = setting(0, "which numbers", low=0)

    def check(self):
        if self.rate_hz == 13.0:
            raise SettingsError("rate_hz: 13 brings bad luck")


def graph(*overrides):
    return launched("path_40", *OVERRIDES, *overrides)


def run(bus, n_frames, at=-1, node="", changes=None):
    """Messages frame by frame; a change falls between frame `at` - 1 and frame `at`."""
    frames, said = (
        [],
        bus._deliver(bus.hosts[node].change(changes or {})) if at == 0 else [],
    )
    for k, messages in enumerate(bus.frames(n_frames), start=1):
        frames.append([*said, *messages])
        said = bus._deliver(bus.hosts[node].change(changes or {})) if k == at else []
    return frames


def forces(frames, kind=Reconstruction):
    return [
        m.forces.tobytes()
        for messages in frames
        for m in messages
        if isinstance(m, kind)
    ]


def test_live_settings_change_and_the_others_stay():
    before = Example(seed=3)
    after = before.changed({"rate_hz": 50, "basis": "dct"})
    assert (after, before) == (
        Example(rate_hz=50.0, basis="dct", seed=3),
        Example(seed=3),
    )
    assert after.live_values() == {"rate_hz": 50.0, "basis": "dct", "tail": None}


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"rate": 5}, r"rate: unknown key \(did you mean 'rate_hz'\?\)"),
        (
            {"seed": 5},
            r"seed: cannot be changed while the graph runs \(allowed: rate_hz, basis",
        ),
        ({"rate_hz": 0.5}, r"rate_hz: 0.5 is outside 1.0..1000.0"),
        ({"rate_hz": 13}, "rate_hz: 13 brings bad luck"),
        (
            {"basis": "os:system"},
            "basis: 'os:system' is not allowed while the graph runs",
        ),
        ({"rate_hz": 50, "seed": 5}, "seed: cannot be changed"),
    ],
)
def test_a_change_that_is_not_allowed_is_named(changes, text):
    with pytest.raises(SettingsError, match=text):
        Example().changed(changes)


def test_a_ratio_or_preset_that_is_stated_last_counts():
    settings = load("path_40", ["compressor.m=400"]).nodes["compressor"].settings
    assert settings.changed({"ratio": 4}).rows_and_m(1600)[1] == 400
    assert settings.changed({"ratio": 8}).rows_and_m(1600)[1] == 200
    assert settings.changed({"ratio": 8, "m": 300}).rows_and_m(1600)[1] == 300
    assert settings.changed({"ratio": 8}).changed({"m": 100}).rows_and_m(1600)[1] == 100
    settings = (
        load("path_40", ["reconstructor.solver=fista"]).nodes["reconstructor"].settings
    )
    assert settings.changed({"preset": "paper"}).chosen() == PRESETS["paper"]
    both = settings.changed({"preset": "paper", "iterations": 5})
    assert both.chosen() == PRESETS["paper"] | {"iterations": 5}


@pytest.mark.parametrize("changes", [{"ratio": 8.0}, {"m": 700}])
def test_a_new_phi_is_announced_before_what_is_measured_with_it(changes):
    key, value = next(iter(changes.items()))
    fixed = "compressor.rows=fixed"  # the Phi of a frame is then the one announced
    bus = graph(fixed)
    frames = run(bus, 6, 3, "compressor", changes)
    kinds = [type(message) for message in frames[3]]
    assert kinds.index(PhiState) < kinds.index(Measurements)
    phi = only(frames[3], PhiState)
    for k, messages in enumerate(frames):
        made, restored = only(messages, Measurements), only(messages, Reconstruction)
        assert (made.phi == phi.fingerprint, restored.phi) == (k >= 3, made.phi)
    assert bus.hosts["reconstructor"].counts.refused == {}
    # From then on it measures as if it had been launched that way.
    fresh = run(graph(fixed, f"compressor.{key}={value}"), 6)
    for old, new in zip(frames[3:], fresh[3:], strict=True):
        assert only(old, Measurements) == only(new, Measurements)


def test_a_solver_that_is_changed_goes_on_from_what_the_last_one_found():
    bus = graph("reconstructor.iterations=20")
    frames = run(bus, CONTACT + 1, CONTACT, "reconstructor", {"iterations": 1})
    solver = only(frames[-1], SolverState)
    assert (solver.iterations, solver.preset) == (1, "")
    truth = only(frames[-1], Truth).forces
    assert truth.max() > 0.01
    cold = graph("reconstructor.iterations=1").hosts["reconstructor"]
    (restored,) = cold.receive(only(frames[-1], Measurements).published("1" * 16, 0))
    errors = [
        float(np.square(m.forces - truth).sum()) for m in (frames[-1][-1], restored)
    ]
    assert errors[0] < 0.5 * errors[1]


@pytest.mark.parametrize(
    ("node", "changes"),
    [
        ("compressor", {"ratio": 4.0, "m": 5000}),
        ("reconstructor", {"iterations": 20, "lambda_n": -1.0}),
        ("sensor", {"noise": 0.0, "rate_hz": 1e9}),
    ],
)
def test_a_refused_change_leaves_everything_as_it_was(node, changes):
    bus = graph()
    host, settings = bus.hosts[node], bus.hosts[node].node.settings
    frames = []
    for messages in bus.frames(5):
        frames.append(messages)
        with pytest.raises(SparseskinError):
            host.change(changes)
        assert host.node.settings == settings
    untouched = run(graph(), 5)
    for kind in (Taxels, Truth, Reconstruction):
        assert forces(frames, kind) == forces(untouched, kind)


def test_noise_follows_its_setting_and_the_skin_reports_it_first():
    frames = run(graph(), 8, 4, "sensor", {"noise": 0.0})
    assert (frames[4][0].sigma_mid, frames[4][0].sigma_end) == (0.0, 0.0)
    for messages in frames[:4]:
        assert not np.array_equal(
            only(messages, Taxels).forces, only(messages, Truth).forces
        )
    # The frame after the change was made ready before it.
    for messages in frames[5:]:
        assert np.array_equal(
            only(messages, Taxels).forces, only(messages, Truth).forces
        )


def test_what_was_changed_stays_when_the_node_is_started_again():
    spec = load("path_40", ["compressor.m=400"]).nodes["compressor"]
    again = spec.with_live(spec.settings.changed({"ratio": 8}).live_values())
    assert again.settings == type(again.settings).from_mapping(again.values)
    assert again.settings.rows_and_m(1600)[1] == 200
    assert spec.with_live(spec.settings.live_values()) == spec
