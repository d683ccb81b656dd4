"""Settings: typed, ranged, and every fault named."""

from dataclasses import dataclass

import pytest

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.settings import PatchSettings, Settings, setting


@dataclass(frozen=True)
class Example(Settings):
    iterations: int = setting(30, "how many", low=1, high=1000)
    rate_hz: float = setting(100.0, "how often", low=0.0)
    basis: str = setting("haar", "which", choices=("haar", "dct"))
    unit: str | None = setting(None, "of what")
    names: tuple[str, ...] = setting((), "whose")
    loud: bool = setting(False, "whether")


def test_values_take_their_declared_type():
    made = Example.from_mapping({"rate_hz": 5, "names": ["a", "b"], "unit": "N", "loud": True})
    assert made == Example(rate_hz=5.0, names=("a", "b"), unit="N", loud=True)
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
        Example.from_mapping(values)


@pytest.mark.parametrize("patch", ["", "Left", "left hand", "9", "a" * 33])
def test_a_patch_needs_a_name(patch):
    with pytest.raises(SettingsError, match="patch"):
        PatchSettings(patch=patch)
