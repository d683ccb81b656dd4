"""Bytes and processor time of a body of which one patch is touched, by three ways to send it."""

from __future__ import annotations

import time
from statistics import NormalDist
from typing import Any

import numpy as np

from sparseskin.messages import Message, decode
from sparseskin.messages.frames import Taxels
from sparseskin.messages.state import SkinState
from sparseskin.messages.wire import received, wire_bytes
from sparseskin.nodes.compressor.change import FALSE_SENDS
from sparseskin.nodes.numerics.arrays import Floats
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.studies.presses import noisy_skin

from .bodies import made_node, timed_step

WAYS = ("all", "quiet", "delta")
PERIOD_NS = 1_000_000
QUIET_S = 0.5
WARM_UP = 100
"""Frames before those that are counted: 64 are sent before the first silence."""
EVENT_BYTES = 6
"""Bytes of one taxel that is sent alone: its number in 2, its force in 4."""
BODY_BYTES = 64
"""Bytes around the events of a frame: topic, stamp, run and number. Chosen, as of a message."""


def time_quiet(point: dict[str, Any]) -> dict[str, Any]:
    """Cost of one frame of a body, at 1 kHz, one patch of which is under a disc that slides.

    `point`: way, one of `WAYS`, where "delta" sends single taxels that differ from what was sent
    of them by more than the noise, as often in vain as "quiet"; patches; side; n_frames; seed.
    Returns bytes, edge_us and host_us of a frame (mean processor time), error: RMS error of the
    touched taxels, newtons.
    """
    rng = np.random.default_rng(point["seed"])
    noise = NoiseModel()
    names = [f"p{k}" for k in range(point["patches"])]
    side = point["side"]
    state = noisy_skin(
        side,
        patch="body",
        source="disc",
        pitch_m=0.005,
        seed=point["seed"],
        rate_hz=1e9 / PERIOD_NS,
    )
    way = _sender(state, names, point["way"])

    squares: list[float] = []
    n_bytes = 0
    for k in range(WARM_UP + point["n_frames"]):
        truth = _truth(len(names), side, k)
        forces = noise.apply(truth, rng)
        stamp_ns = (k + 1) * PERIOD_NS
        message = Taxels(
            stamp_ns=stamp_ns,
            patch="body",
            names=tuple(names),
            forces=forces,
        )
        sent = way.frame(message)
        if k >= WARM_UP:
            n_bytes += sent
            touched = truth[0] > 0
            errors = way.forces[0][touched] - truth[0][touched]
            squares.append(float(np.mean(errors**2)))
    return {
        "bytes": n_bytes / point["n_frames"],
        "edge_us": 1e6 * sum(way.edge_s[WARM_UP:]) / point["n_frames"],
        "host_us": 1e6 * (sum(way.host_s) - way.before_s) / point["n_frames"],
        "error": float(np.sqrt(np.mean(squares))),
    }


def _sender(state: SkinState, names: list[str], way: str) -> _Delta | _Nodes:
    if way == "delta":
        return _Delta(state, names)
    return _Nodes(state, names, way)


def _truth(n_patches: int, side: int, k: int) -> Floats:
    """Forces of frame k: a disc on the first patch, 0.02 taxels a frame."""
    truth = np.zeros((n_patches, side, side), dtype=np.float32)
    rows, cols = np.mgrid[:side, :side]
    place = side / 2 + side / 4 * np.sin(0.08 * k / side)
    distance = np.hypot(rows - side / 2, cols - place)
    truth[0] = np.clip(1 - (distance / 3) ** 2, 0, 1)
    return truth


class _Nodes:
    """Compressor and reconstructor; `way` "quiet" or "all"."""

    def __init__(self, state: SkinState, names: list[str], way: str) -> None:
        common = {"patch": "body", "patches": names}
        quiet = {"quiet": QUIET_S} if way == "quiet" else {}
        self._edge = made_node("compressor", {**common, **quiet})
        self._host = made_node("reconstructor", {**common, "skip_idle": True})
        for message in (state, *self._edge.step(state)):
            list(self._host.step(message))
        self.edge_s: list[float] = []
        self.host_s: list[float] = []
        self.before_s = 0.0
        self._by_name: dict[str, Floats] = {}
        self.forces = np.zeros((1, state.n_rows, state.n_cols), dtype=np.float32)

    def frame(self, taxels: Message) -> int:
        """Send one frame; return its bytes."""
        if len(self.edge_s) == WARM_UP:
            self.before_s = sum(self.host_s)
        n_bytes = 0
        for measured in timed_step(self._edge, wire_bytes(taxels), self.edge_s):
            n_bytes += len(measured)
            for answer in timed_step(self._host, measured, self.host_s):
                message: Any = decode(*received(answer))
                message.split(self._by_name)
                self.forces = self._by_name["p0"]
        return n_bytes


class _Delta:
    """Each taxel alone: sent where it differs from what was sent of it by more than the noise."""

    def __init__(self, state: SkinState, names: list[str]) -> None:
        self._noise = NoiseModel(state.f_max, state.sigma_mid, state.sigma_end)
        n_taxels = state.n_rows * state.n_cols
        # Two-sided, for one taxel; a change is the difference of two readings.
        chance = FALSE_SENDS / 2 / n_taxels
        self._z = -NormalDist().inv_cdf(chance) * np.sqrt(2)
        self.forces = np.zeros(
            (len(names), state.n_rows, state.n_cols), dtype=np.float32
        )
        self.edge_s: list[float] = []
        self.host_s: list[float] = []
        self.before_s = 0.0
        self._received = self.forces.copy()

    def frame(self, taxels: Taxels) -> int:
        """Send one frame; return its bytes."""
        if len(self.edge_s) == WARM_UP:
            self.before_s = sum(self.host_s)
        begin_s = time.process_time()
        limit = self._z * self._noise.sigma(self.forces)
        places = np.flatnonzero(np.abs(taxels.forces - self.forces) > limit)
        values = taxels.forces.reshape(-1)[places]
        self.forces.reshape(-1)[places] = values
        sent_s = time.process_time()
        self._received.reshape(-1)[places] = values
        self.edge_s.append(sent_s - begin_s)
        self.host_s.append(time.process_time() - sent_s)
        return places.size * EVENT_BYTES + BODY_BYTES * bool(places.size)
