"""The array library of the batch solver: numpy, torch on a processor or a GPU, any other."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.lookup import did_you_mean, one_line
from sparseskin.nodes.numerics.arrays import Floats

Array: TypeAlias = Any
"""An array of the library in use; shapes and dtypes are stated beside it."""

DEVICES = ("numpy", "cpu", "cuda", "strict")
"""numpy; torch on the processor or on a GPU ("cuda:1": the second); the standard's strict
implementation, for tests."""
EXTRA = "pip install 'sparseskin[gpu]'"


class Backend:
    """One array library on one device, as the Python array API standard has it.

    Parameters
    ----------
    device : str
        One of `DEVICES`, or "cuda:K".

    Attributes
    ----------
    xp : module
        Functions of the standard.
    on_gpu : bool
        True if the host should not wait for values of arrays.
    name : str
        Name of the device, e.g. "NVIDIA H100 80GB HBM3"; "numpy" or "cpu" on the processor.

    Raises
    ------
    SettingsError
        If there is no such device, or its library is not installed.
    """

    def __init__(self, device: str = "numpy") -> None:
        kind = device.partition(":")[0]
        if kind not in DEVICES or (":" in device and kind != "cuda"):
            raise SettingsError(
                f"device: {device!r} is not known{did_you_mean(device, DEVICES)}; "
                "allowed: numpy, cpu, cuda, cuda:K"
            )
        self.on_gpu = kind == "cuda"
        self.name = device
        self._device: Any = None
        self._torch: Any = None
        if kind == "strict":
            self.xp = _module("array_api_strict", device)
        elif kind == "numpy":
            self.xp = _module("array_api_compat.numpy", device)
        else:
            torch = self._torch = _module("torch", device)
            if self.on_gpu:
                if not torch.cuda.is_available():
                    raise SettingsError(f"device: {device!r}: torch finds no GPU")
                if device != "cuda" and device[5:] not in map(
                    str, range(torch.cuda.device_count())
                ):
                    raise SettingsError(
                        f"device: {device!r}: allowed: cuda:0..cuda:{torch.cuda.device_count() - 1}"
                    )
                self.name = torch.cuda.get_device_name(device)
            self.xp = _module("array_api_compat.torch", device)
            self._device = torch.device(device)
        self.f32, self.f64, self.i64 = self.xp.float32, self.xp.float64, self.xp.int64
        self._numbers: dict[tuple[float, bool], Array] = {}
        self._counts: dict[int, Array] = {}
        self._buffers: dict[str, Any] = {}

    def array(self, values: npt.ArrayLike) -> Array:
        """Return a copy of values on the device, of the same dtype."""
        made = self.xp.asarray(np.array(values))
        return made if self._device is None else made.to(self._device)

    def zeros(self, *shape: int, double: bool = False) -> Array:
        """Return zeros, float32 or float64."""
        dtype = self.f64 if double else self.f32
        return self.xp.zeros(shape, dtype=dtype, device=self._device)

    def number(self, value: float, single: bool = False) -> Array:
        """Return an array () of float64 (float32) on the device, made once for each value."""
        key = (value, single)
        if key not in self._numbers:
            self._numbers[key] = self.array(np.array(value, np.float32 if single else np.float64))
        return self._numbers[key]

    def numpy(self, array: Array) -> npt.NDArray[Any]:
        """Return a copy of an array on the host; waits for it."""
        if hasattr(array, "cpu"):
            array = array.detach().cpu().numpy()
        return np.array(array)

    def count(self, n: int) -> Array:
        """Return 0..n-1, int64 (n,), made once for each n."""
        if n not in self._counts:
            self._counts[n] = self.array(np.arange(n, dtype=np.int64))
        return self._counts[n]

    def send(self, values: Floats) -> Array:
        """Return a copy of values on the device; to a GPU by memory that it reads itself."""
        if not self.on_gpu:
            return self.array(values)
        buffer = self._buffer("send", values.shape, self.f32)
        buffer.numpy()[...] = values
        return buffer.to(self._device, non_blocking=True)

    def fetch(self, arrays: list[Array]) -> list[npt.NDArray[Any]]:
        """Return arrays on the host after one wait; of a GPU, valid until the next call."""
        if not self.on_gpu:
            return [self.numpy(array) for array in arrays]
        found = []
        for place, array in enumerate(arrays):
            buffer = self._buffer(f"fetch {place}", array.shape, array.dtype)
            found.append(buffer.copy_(array, non_blocking=True))
        self._torch.cuda.current_stream(self._device).synchronize()
        return [one.numpy() for one in found]

    def _buffer(self, name: str, shape: tuple[int, ...], dtype: Any) -> Any:
        """Return memory of the host that a GPU reads and writes itself."""
        known = self._buffers.get(name)
        if known is None or known.shape != shape or known.dtype != dtype:
            known = self._torch.empty(tuple(shape), dtype=dtype, pin_memory=True)
            self._buffers[name] = known
        return known

    # Operations that the solver needs in the standard's bare form.

    def single(self, a: Array) -> Array:
        """Return a as float32."""
        return self.xp.astype(a, self.f32, copy=False)

    def double(self, a: Array) -> Array:
        """Return a, of bools too, as float64."""
        return self.xp.astype(a, self.f64, copy=False)

    def column(self, a: Array) -> Array:
        """Return one number a patch, (b,), as a factor of vectors: float32 (b, 1)."""
        return self.single(a)[:, None]

    def at_least(self, a: Array, low: float) -> Array:
        """Return the larger of a, float64, and a number."""
        return self.xp.maximum(a, self.number(low))

    def at_most(self, a: Array, high: float) -> Array:
        """Return the smaller of a, float64, and a number."""
        return self.xp.minimum(a, self.number(high))

    def positive(self, a: Array) -> Array:
        """Return max(0, a) of float32."""
        return self.xp.maximum(a, self.number(0.0, single=True))

    def dot(self, a: Array, b: Array) -> Array:
        """Return the products of vectors of each patch: float32 (b, k) twice to float64 (b,)."""
        return self.xp.sum(a * b, axis=1, dtype=self.f64)

    def choose(self, mask: Array, a: Array, b: Array) -> Array:
        """Return a where the mask (b,) is true, else b; both are (b,) or (b, k)."""
        return self.xp.where(mask if a.ndim == 1 else mask[:, None], a, b)

    def any(self, mask: Array) -> bool:
        """True if the mask holds a true value; on a GPU always: the host does not wait for it."""
        return self.on_gpu or bool(self.xp.any(mask))


def _module(name: str, device: str) -> Any:
    package = name.partition(".")[0]
    if find_spec(package) is None:
        raise SettingsError(f"device: {device!r} needs {package.replace('_', '-')}: {EXTRA}")
    try:
        return import_module(name)
    except ImportError as error:
        raise SettingsError(
            f"device: {device!r}: importing {package} failed: {one_line(error)}"
        ) from error
