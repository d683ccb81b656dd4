"""Settings of nodes: each declared once, with type, range and meaning."""

import dataclasses
import math
import types
import typing
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, Self

from sparseskin.messages.errors import MessageError
from sparseskin.messages.ranges import is_real, is_whole
from sparseskin.messages.topics import MAX_NAMES, MAX_PATCHES, check_name

from .errors import SettingsError, SparseskinError
from .lookup import did_you_mean, nearest_of


@dataclass(frozen=True)
class Range:
    """Meaning and allowed values of a setting, ends included.

    `known` are values to propose where others are allowed too; `live` is True if the setting can
    be changed while the graph runs, `decides` if it decides what others may be.
    """

    doc: str
    low: float = -math.inf
    high: float = math.inf
    choices: tuple[str, ...] = ()
    known: Collection[str] = ()
    live: bool = False
    decides: bool = False


def setting(default: Any, doc: str, **allowed: Any) -> Any:
    """Declare one setting: its default and its `Range`."""
    metadata = {"range": Range(doc, **allowed)}
    return dataclasses.field(default=default, metadata=metadata)


@dataclass(frozen=True)
class Settings:
    """Base of all settings; SettingsError if a value has the wrong type or is out of its range."""

    def __post_init__(self) -> None:
        hints = typing.get_type_hints(type(self))
        for field in dataclasses.fields(self):
            raw = getattr(self, field.name)
            value = _checked(field.name, raw, hints[field.name])
            _check_range(field.name, value, field.metadata["range"])
            # The dataclass is frozen.
            object.__setattr__(self, field.name, value)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Make settings from names and values of a launch file, or raise SettingsError."""
        keys = [field.name for field in dataclasses.fields(cls)]
        for key in values:
            if key not in keys:
                raise SettingsError(f"{key}: unknown key{did_you_mean(key, keys)}")
        return cls(**values)

    def changed(self, changes: Mapping[str, Any]) -> Self:
        """Copy with some live settings changed; SettingsError if a key or value is not allowed."""
        ranges: dict[str, Range] = {}
        for field in dataclasses.fields(self):
            ranges[field.name] = field.metadata["range"]
        live = [name for name, allowed in ranges.items() if allowed.live]
        for key, value in changes.items():
            if key not in ranges:
                raise SettingsError(f"{key}: unknown key{did_you_mean(key, ranges)}")
            if key not in live:
                raise SettingsError(
                    f"{key}: cannot be changed while the graph runs "
                    f"(allowed: {', '.join(live) or 'none'})"
                )

            # A module of the user's own is imported for a launch file only.
            registered = ranges[key].known
            if registered and value is not None and value not in registered:
                raise SettingsError(
                    f"{key}: {value!r} is not allowed while the graph runs"
                    f"{nearest_of(str(value), registered)}"
                )
        # Of the whole: a valid change may contradict another setting.
        settings = dataclasses.replace(self, **changes)
        settings.check()
        return settings

    def live_values(self) -> dict[str, Any]:
        """Values of the settings that can be changed while the graph runs."""
        live = [name for name, _, allowed in _declared(self) if allowed.live]
        return {name: getattr(self, name) for name in live}

    @classmethod
    def described(cls) -> list[dict[str, Any]]:
        """Each setting as plain data: key, type, doc, range or choices, live or not."""
        return [
            {
                "key": name,
                "type": type_text,
                "doc": allowed.doc,
                "low": _if_finite(allowed.low),
                "high": _if_finite(allowed.high),
                "choices": list(allowed.choices),
                "known": list(allowed.known),
                "live": allowed.live,
            }
            for name, type_text, allowed in _declared(cls)
        ]

    def check(self) -> None:
        """Raise SparseskinError if what the values name (files, scenes) does not exist."""


@dataclass(frozen=True)
class PatchSettings(Settings):
    """Settings of a node that serves one patch of skin."""

    patch: str = setting(
        "skin", "name of the patch of skin, the first part of its topics"
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_patch("patch", self.patch)


@dataclass(frozen=True)
class PatchesSettings(PatchSettings):
    """Settings of a node that serves one patch, or several equal ones in one message each way."""

    patches: tuple[str, ...] = setting(
        (),
        "names of several patches with the same skin; patch is then the name of them all",
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_patches("patches", self.patches)

    @property
    def n_patches(self) -> int:
        """Number of patches served."""
        return len(self.patches) or 1


@contextmanager
def naming(key: str) -> Iterator[None]:
    """Raise SettingsError of the setting `key` for any error within."""
    try:
        yield
    except SparseskinError as error:
        raise SettingsError(f"{key}: {error}") from error


def check_patch(place: str, name: str) -> None:
    """Raise SettingsError if a text is not the name of a patch."""
    try:
        check_name(place, name)
    except MessageError as error:
        raise SettingsError(str(error)) from error


def check_patches(place: str, names: tuple[str, ...]) -> None:
    """Raise SettingsError unless these can be the names of patches that are served together."""
    # The number first: it bounds the time of all that follows.
    if len(names) > MAX_PATCHES:
        raise SettingsError(f"{place}: {len(names)} names, at most {MAX_PATCHES}")
    for k, name in enumerate(names):
        check_patch(f"{place}[{k}]", name)
        if name in names[:k]:
            raise SettingsError(f"{place}[{k}]: '{name}' occurs twice")
    # As they travel: in one text, with spaces between them.
    if len(" ".join(names)) > MAX_NAMES:
        raise SettingsError(
            f"{place}: more than {MAX_NAMES} characters of names in all"
        )


def _if_finite(limit: float) -> float | None:
    # JSON, in which settings are described, has no infinity.
    if math.isfinite(limit):
        return limit
    return None


def _declared(cls: Any) -> Iterator[tuple[str, str, Range]]:
    """Name, type and range of every setting."""
    for field in dataclasses.fields(cls):
        # A text where the module postpones its annotations.
        text = str(field.type).replace("typing.", "")
        if isinstance(field.type, type):
            text = field.type.__name__
        yield field.name, text, field.metadata["range"]


def _checked(name: str, value: Any, hint: Any) -> Any:
    """Return the value as the declared type: a whole number as float, a list as tuple; or raise."""
    options: tuple[Any, ...] = (hint,)
    if isinstance(hint, types.UnionType):
        options = typing.get_args(hint)

    # Each of them returns if the value is of it: what is of none falls through to the error.
    for option in options:
        if option is type(None):
            if value is None:
                return None
        elif typing.get_origin(option) is tuple:
            if isinstance(value, list | tuple):
                with suppress(SettingsError):
                    kind = typing.get_args(option)[0]
                    return tuple(_checked(name, element, kind) for element in value)
        elif typing.get_origin(option) is dict:
            if isinstance(value, Mapping):
                return dict(value)
        elif option is float:
            if isinstance(value, float):
                return value
            # One that float does not hold is infinite: out of any range, not of another type.
            if is_whole(value):
                return float(value) if is_real(value) else math.inf
        elif option is int:
            if is_whole(value):
                return int(value)
        elif isinstance(value, option):
            return value
    names = [_TYPE_NAMES.get(option, str(option)) for option in options]
    expected = " or ".join(names)
    raise SettingsError(f"{name}: expected {expected}, got {value!r}")


_TYPE_NAMES: dict[Any, str] = {
    int: "a whole number",
    float: "a number",
    bool: "true or false",
    str: "a text",
    type(None): "nothing",
    tuple[str, ...]: "a list of texts",
    tuple[int, ...]: "a list of whole numbers",
    tuple[float, ...]: "a list of numbers",
    dict[str, Any]: "a table",
}


def _check_range(name: str, value: Any, allowed: Range) -> None:
    # Of a list each element has the range.
    if isinstance(value, tuple):
        for element in value:
            _check_range(name, element, allowed)
    # Not isinstance: True is an integer of Python, but has no range.
    elif isinstance(value, float) or is_whole(value):
        if not is_real(value, allowed.low, allowed.high):
            value_text = f"{value!r}"[:40]
            raise SettingsError(
                f"{name}: {value_text} is outside {allowed.low}..{allowed.high}"
            )
    elif allowed.choices and isinstance(value, str) and value not in allowed.choices:
        raise SettingsError(
            f"{name}: {value!r} is not allowed{nearest_of(value, allowed.choices)}"
        )
