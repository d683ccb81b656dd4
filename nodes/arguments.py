"""Checks of what a Python program passes to a public function."""

import functools
import inspect
import os
import types
import typing
from collections.abc import Callable, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np

from sparseskin.messages.ranges import is_real, is_whole

from .errors import SparseskinError
from .numerics.arrays import has_masked

P = ParamSpec("P")
R = TypeVar("R")


def _is_of(*kinds: Any) -> Callable[[Any], bool]:
    """Test if a value is of one of the types."""
    return lambda value: isinstance(value, kinds)


def _is_list_of_texts(value: Any) -> bool:
    # A text alone is answered by the function, which knows what was meant.
    is_list = isinstance(value, str | list | tuple)
    return is_list and all(isinstance(item, str) for item in value)


_CHECKS: dict[Any, tuple[Callable[[Any], bool], str]] = {
    str: (_is_of(str), "a text"),
    bool: (_is_of(bool, np.bool_), "True or False"),
    int: (is_whole, "a whole number"),
    float: (is_real, "a finite number"),
    Sequence[str]: (_is_list_of_texts, "a list of texts"),
    os.PathLike[str]: (_is_of(os.PathLike), "a path"),
    type(None): (_is_of(type(None)), "None"),
}
"""Of each annotation that is checked: the test of a value, and the words for what is allowed."""


def checked(error: type[SparseskinError]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator of a public function: `error`, in one line, is raised for arguments that it does
    not take, and for values that are not of the types in its annotations.

    Texts, numbers, lists of texts and paths are checked, classes of this package where several
    types are allowed, and that no entry of an array is masked. Other arrays and objects are the
    function's to check.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        name = function.__name__
        signature = inspect.signature(function)

        # When it is first called: the names in annotations may be defined below the function.
        @functools.cache
        def hints() -> dict[str, Any]:
            return typing.get_type_hints(function)

        @functools.wraps(function)
        def call(*args: P.args, **kwargs: P.kwargs) -> R:
            # Python's own TypeError would be a traceback, and name no argument that there is.
            try:
                bound = signature.bind(*args, **kwargs)
            except TypeError as cause:
                expected = ", ".join(signature.parameters)
                raise error(f"{name}: {cause}; expected: {name}({expected})") from cause

            for key, value in bound.arguments.items():
                allowed = _what_is_allowed(value, hints()[key])
                if not allowed:
                    continue
                text = f"{value!r:.60}"
                # Its text has many lines.
                if has_masked(value):
                    text = "a masked array"
                raise error(
                    f"{name}: {key} = {text} is not allowed; allowed: {allowed}"
                )
            return function(*args, **kwargs)

        return call

    return decorate


def _what_is_allowed(value: object, hint: Any) -> str:
    """What an argument may be, in words, where this value is not allowed; "" where it is."""
    if has_masked(value):
        return "an array without masked entries, as of its method filled"
    is_union = isinstance(hint, types.UnionType)
    options = typing.get_args(hint) if is_union else (hint,)
    words = []
    for option in options:
        if option in _CHECKS:
            is_allowed, wording = _CHECKS[option]
        elif is_union and isinstance(option, type):
            is_allowed = _is_of(option)
            wording = f"a {option.__name__}"
        # Anything else is the function's own to check.
        else:
            return ""
        if is_allowed(value):
            return ""
        words.append(wording)
    return " or ".join(words)
