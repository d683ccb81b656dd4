"""Where the vectors of frames are, and what a number of a frame is: of one patch, or of several.

The method is written once, for vectors of shape (..., n). Of one patch they are numpy arrays (n,),
and what it computes of a frame, such as a noise variance, is a float. Of p patches they are arrays
(p, n) of numpy or of torch, on any device, and such a number is an array of float64 (p, 1).
"""

from __future__ import annotations

import math
from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias

import numpy as np

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import one_line

Array: TypeAlias = Any
"""An array of numpy or of torch."""
Number: TypeAlias = Any
"""A float or bool, or of several patches an array (p, 1) of them."""

NUMPY = "numpy"
REMEDY = "pip install 'sparseskin[gpu]'"


def check_device(device: str) -> None:
    """Raise SettingsError if a device needs torch, which is not installed."""
    if device != NUMPY and find_spec("torch") is None:
        raise SettingsError(f"device: '{device}' needs torch: {REMEDY}")


def on_device(numbers: Any, device: str) -> Array:
    """The same numbers as an array of a device."""
    return numbers if device == NUMPY else import_module("torch").asarray(numbers, device=device)


class OnePatch:
    """Vectors are float32 (n,) of numpy, numbers are floats."""

    xp: Any = np
    device = NUMPY
    zero: Number = 0.0
    false: Number = False
    sqrt: Any = staticmethod(math.sqrt)
    exp: Any = staticmethod(math.exp)
    maximum: Any = staticmethod(max)
    minimum: Any = staticmethod(min)
    f32: Any = np.float32
    f64: Any = np.float64

    @staticmethod
    def where(condition: Number, yes: Number, no: Number) -> Number:
        """`yes` where the condition holds, else `no`."""
        return yes if condition else no

    @staticmethod
    def dot(a: Array, b: Array) -> Number:
        """Scalar product."""
        return float(a @ b)

    @staticmethod
    def total(a: Array) -> Number:
        """Sum of a vector."""
        return float(a.sum(dtype=np.float64))

    @staticmethod
    def largest(a: Array) -> Number:
        """Largest number of a vector."""
        return float(a.max())

    def array(self, numbers: Any) -> Array:
        """The same numbers as an array here."""
        return numbers

    def zeros(self, n: int) -> Array:
        """A vector of zeros."""
        return np.zeros(n, dtype=np.float32)


class ManyPatches:
    """Vectors are float32 (p, n), numbers are float64 (p, 1).

    Parameters
    ----------
    n_patches : int
        p.
    device : str
        `NUMPY`, or a device of torch: "cpu", "cuda", "cuda:1".

    Raises
    ------
    SettingsError
        If torch is not installed, or there is no such device.
    """

    def __init__(self, n_patches: int, device: str = NUMPY) -> None:
        check_device(device)
        self.n_patches, self.device = n_patches, device
        self.xp: Any = np
        if device != NUMPY:
            self.xp = import_module("torch")
            try:
                self.xp.zeros(1, device=device)
            except (RuntimeError, AssertionError) as error:  # of a build without the device, too
                allowed = "allowed: numpy, or a device of torch, such as cpu, cuda, cuda:1"
                raise SettingsError(f"device: '{device}': {one_line(error)}; {allowed}") from error
        self.zero = self.array(np.zeros((n_patches, 1)))
        self.false = self.zero > 0
        self.sqrt, self.exp, self.where = self.xp.sqrt, self.xp.exp, self.xp.where

    def maximum(self, a: Array, b: Array) -> Array:
        """The larger one of each two numbers."""
        return self.xp.where(a > b, a, b)

    def minimum(self, a: Array, b: Array) -> Array:
        """The smaller one of each two numbers."""
        return self.xp.where(a < b, a, b)

    def f32(self, a: Array) -> Array:
        """The same numbers as float32."""
        return self.xp.asarray(a, dtype=self.xp.float32)

    def f64(self, a: Array) -> Array:
        """The same numbers as float64."""
        return self.xp.asarray(a, dtype=self.xp.float64)

    def dot(self, a: Array, b: Array) -> Number:
        """Scalar product."""
        return self.total(a * b)

    def total(self, a: Array) -> Number:
        """Sum of a vector."""
        return self.xp.sum(a, axis=-1, keepdims=True, dtype=self.xp.float64)

    def largest(self, a: Array) -> Number:
        """Largest number of a vector."""
        return self.f64(self.xp.amax(a, axis=-1, keepdims=True))

    def array(self, numbers: Any) -> Array:
        """The same numbers as an array here."""
        return on_device(numbers, self.device)

    def host(self, a: Array) -> Any:
        """The same numbers as an array of numpy."""
        if "cuda" not in self.device:
            return np.asarray(a)
        return self.xp.empty(a.shape, dtype=a.dtype, pin_memory=True).copy_(a).numpy()

    def copy(self, a: Array) -> Array:
        """The same numbers in an array of their own."""
        return a.copy() if self.xp is np else a.clone()

    def zeros(self, n: int) -> Array:
        """A vector of zeros."""
        return self.array(np.zeros((self.n_patches, n), dtype=np.float32))


Backend: TypeAlias = OnePatch | ManyPatches
ONE = OnePatch()
