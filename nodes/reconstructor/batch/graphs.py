"""Frames of a batch, kernel by kernel or, on a GPU, as CUDA graphs: one launch a frame."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from .backend import Array
from .begin import begin
from .finish import finish_smooth, tested
from .fused import FusedIterations, FusedSmooth, fits
from .haar import estimate, first_carry, iterate, mean_of
from .smooth import SmoothBatch
from .state import State
from .tables import Tables

#: How frames run on a GPU. eager: kernel by kernel; graph: as CUDA graphs; fused: also the
#: iterations and the smooth model as one kernel each; compiled: also all else, by torch.compile.
MODES = ("eager", "graph", "fused", "compiled")
#: Runs of a function before it is captured: libraries make their handles, numbers are cached.
WARM_UPS = 2

Ended = tuple[State, State]
"""Changed parts of the state, and the result, as of `finish`."""


class Frames(Protocol):
    """Frames of a batch."""

    def frame(self, state: State, y: Array, number: int, median: bool) -> Ended:
        """Compute a frame; parameters are as of `begin` and `finish`."""


class EagerFrames:
    """Frames kernel by kernel, on any device.

    Parameters
    ----------
    t : Tables
    smooth : SmoothBatch
    least, most : int
        Iterations of a frame.
    """

    def __init__(self, t: Tables, smooth: SmoothBatch, least: int, most: int) -> None:
        self._t, self._smooth, self._iterations = t, smooth, (least, most)

    def frame(self, state: State, y: Array, number: int, median: bool) -> Ended:
        """See `Frames`."""
        t = self._t
        frame = begin(t, state, y, number, *self._iterations)
        haar, needed, known = tested(t, frame, estimate(t, frame), number)
        x = self._smooth.estimate_some(known, needed, frame["nothing_known"])
        return finish_smooth(t, frame, haar, needed, x, number, median)


class GraphFrames:
    """Frames as CUDA graphs, captured when they are first needed; other parameters as there.

    With the kernels the host waits for nothing within a frame. Where they do not fit the skin, and
    in the mode "graph", it waits for the largest number of iterations, each a launch of a graph,
    and for the patches that need the smooth model, which then runs kernel by kernel.

    Parameters
    ----------
    mode : str
        "graph", "fused" or "compiled".
    """

    def __init__(self, t: Tables, smooth: SmoothBatch, least: int, most: int, mode: str) -> None:
        import torch

        self._torch, self._t, self._smooth = torch, t, smooth
        self._kernels: tuple[FusedIterations, FusedSmooth] | None = None
        if mode != "graph" and fits(t):
            self._kernels = FusedIterations(t), FusedSmooth(smooth)
        self._y: Array | None = None
        self._known: dict[tuple[int, bool], Callable[[], Ended]] = {}

        def begins(state: State, y: Array, number: int) -> State:
            return begin(t, state, y, number, least, most)

        def tests(frame: State, x: Array, number: int) -> Any:
            return tested(t, frame, x, number)

        def ends(
            frame: State, haar: State, needed: Array, x: Array, number: int, median: bool
        ) -> Ended:
            return finish_smooth(t, frame, haar, needed, x, number, median)

        self._parts: list[Callable[..., Any]] = [begins, tests, ends]
        #: The parts as they are captured.
        self._final = self._parts
        if mode == "compiled":
            compiler: Any = torch.compile
            self._final = [compiler(part, dynamic=False) for part in self._parts]

    def frame(self, state: State, y: Array, number: int, median: bool) -> Ended:
        """See `Frames`; the state has to be the same arrays in every call."""
        if self._y is None:
            self._y = self._torch.empty_like(y)
        self._y.copy_(y)
        key = (number, median)
        if key not in self._known:
            self._known[key] = self._captured(state, self._y, *key)
        return self._known[key]()

    def _captured(self, state: State, y: Array, number: int, median: bool) -> Callable[[], Ended]:
        if self._kernels is None:
            return self._in_parts(state, y, number, median)
        iterations, smooth = self._kernels

        def whole(parts: list[Callable[..., Any]]) -> Ended:
            begins, tests, ends = parts
            frame = begins(state, y, number)
            haar, needed, known = tests(frame, iterations.estimate(frame), number)
            x = smooth.estimate(known, needed, frame["nothing_known"])
            ended: Ended = ends(frame, haar, needed, x, number, median)
            return ended

        whole(self._parts)  # caches numbers, which a compiled function must find
        return self._capture(lambda: whole(self._final))

    def _in_parts(self, state: State, y: Array, number: int, median: bool) -> Callable[[], Ended]:
        t, (begins, tests, ends) = self._t, self._parts
        first = self._capture(lambda: begins(state, y, number))
        frame = first()
        begun = first_carry(t, frame["haar_start"])
        carry = {name: array.clone() for name, array in begun.items()}

        def step() -> None:
            for name, array in iterate(t, frame, carry).items():
                carry[name].copy_(array)

        again = self._capture(step)
        middle = self._capture(lambda: tests(frame, mean_of(t, frame, carry), number))
        none = self._torch.zeros_like(frame["x"])
        haar, needed, known = middle()
        last = self._capture(lambda: ends(frame, haar, needed, none, number, median))

        def run() -> Ended:
            first()
            for name, array in first_carry(t, frame["haar_start"]).items():
                carry[name].copy_(array)
            for _ in range(int(frame["n_haar"].max())):
                again()
            middle()
            if bool(needed.any()):
                x = self._smooth.estimate_some(known, needed, frame["nothing_known"])
                ended: Ended = ends(frame, haar, needed, x, number, median)
                return ended
            ended = last()
            return ended

        return run

    def _capture(self, function: Callable[[], Any]) -> Callable[[], Any]:
        """Return the function as a graph; what it returns is overwritten by the next call."""
        cuda = self._torch.cuda
        side = cuda.Stream()
        side.wait_stream(cuda.current_stream())
        with cuda.stream(side):
            for _ in range(WARM_UPS):
                function()
        cuda.current_stream().wait_stream(side)
        graph = cuda.CUDAGraph()
        with cuda.graph(graph):
            found = function()

        def replay() -> Any:
            graph.replay()
            return found

        return replay
