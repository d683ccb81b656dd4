"""A message as text and as plain data; of an array its shape, its extent and its first numbers."""

from __future__ import annotations

import re
import sys
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.messages import Message
from sparseskin.messages.base import wire_fields
from sparseskin.messages.quantised import Quantised
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean

from .text_table import printable, width

INDENT = "    "
"""What further lines of a field begin with."""
N_FIRST = 6
"""How many elements of an array stand in its summary."""
_FIELD = re.compile(r"(\w+)(?:\[(\d{1,7}(?:,\d{1,7})*)\])?")

Array = npt.NDArray[Any]


def plain(value: Any, full: bool) -> Any:
    """A field's value as JSON takes it; an array as a map of its dtype, its shape and `data`
    where it is wanted in full, else min, mean, max and the first elements.
    """
    if not isinstance(value, np.ndarray):
        return value.item() if isinstance(value, np.generic) else value
    told: dict[str, Any] = {"dtype": _dtype(value), "shape": list(value.shape)}
    if full:
        return told | {"data": value.tolist()}
    numbers = value.astype(np.float64)
    told |= {"min": float(numbers.min()), "mean": float(numbers.mean())}
    return told | {"max": float(numbers.max()), "first": value.ravel()[:N_FIRST].tolist()}


def text(value: Any, full: bool) -> str:
    """A field's value as text, on one line but for an array in full."""
    if value is None or isinstance(value, bool):
        return {None: "none", True: "true", False: "false"}[value]
    if not isinstance(value, np.ndarray):
        return printable(str(value))
    shape = " x ".join(map(str, value.shape))
    if full:
        lines = np.array2string(
            value,
            threshold=sys.maxsize,
            max_line_width=width() - len(INDENT),
            precision=4,
            suppress_small=True,
        )
        return f"{_dtype(value)}, {shape}\n{lines}"
    if value.dtype.kind == "b":
        return f"{_dtype(value)}, {shape}: {int(value.sum())} of {value.size} true"
    numbers = value.astype(np.float64)
    first = " ".join(f"{number:.4g}" for number in numbers.ravel()[:N_FIRST])
    more = " ..." if value.size > N_FIRST else ""
    return (
        f"{_dtype(value)}, {shape}: min {numbers.min():.4g}, mean {numbers.mean():.4g}, "
        f"max {numbers.max():.4g} [{first}{more}]"
    )


class FieldPath:
    """One field of a message, or one element of an array: "forces", "forces[12,7]".

    Parameters
    ----------
    path : str
        What was asked for.
    cls : type
        The class of the messages.

    Raises
    ------
    SettingsError
        If the message has no such field (with a did-you-mean), or it is not of that form.
    """

    def __init__(self, path: str, cls: type[Message]) -> None:
        match = _FIELD.fullmatch(path)
        if match is None:
            raise SettingsError(f"--field {path}: expected FIELD or FIELD[I,J]")
        self._path, self._name = path, match[1]
        self._index = tuple(int(k) for k in match[2].split(",")) if match[2] else None
        if self._name not in wire_fields(cls):
            hint = did_you_mean(self._name, wire_fields(cls))
            raise SettingsError(f"--field {path}: {cls.schema} has no such field{hint}")

    def of(self, message: Message) -> Any:
        """The value in a message.

        Raises
        ------
        SettingsError
            If there is no such element.
        """
        value = getattr(message, self._name)
        if self._index is None:
            return value
        shape = getattr(value, "shape", ())
        inside = len(shape) == len(self._index) and all(
            k < side for k, side in zip(self._index, shape, strict=True)
        )
        if not inside:
            sides = " x ".join(map(str, shape)) or "no array"
            raise SettingsError(f"--field {self._path}: {self._name} is {sides}")
        return value[self._index]


def _dtype(value: Array) -> str:
    if isinstance(value, Quantised):
        return f"{value.dtype} of {value.bits} bits"
    return str(value.dtype)
