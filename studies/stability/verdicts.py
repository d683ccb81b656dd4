"""Verdicts on drawn worlds: which frames are wrong, and which of these pass for right ones."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from sparseskin import Stream
from sparseskin.arrays import compress, make_solver, reconstruct
from sparseskin.messages import Measurements, Reconstruction, SkinState, Taxels
from sparseskin.messages.skin import PAPER_F_MAX_N, Skin
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import Compressor
from sparseskin.nodes.compressor.phi.base import make_phi
from sparseskin.nodes.compressor.phi.rotation import m_of
from sparseskin.nodes.node import Context
from sparseskin.nodes.numerics.arrays import TINY, Doubles, Floats, Mask
from sparseskin.nodes.reconstructor.bases.base import make_basis
from sparseskin.nodes.reconstructor.node import Reconstructor
from sparseskin.nodes.reconstructor.solvers.base import estimated_error
from sparseskin.nodes.sensor.noise import NoiseModel
from sparseskin.nodes.sensor.zero import Zero
from sparseskin.studies.evaluate import CLOSE, WRONG

from .worlds import Frame, World

GOOD = 0.2
"""Relative error below which a frame is right, and readings could be used. Chosen."""
LEAST_NORM = 0.1
"""Part of the largest frame's norm that errors are divided by at least: nothing is a relative error
of frames without a load. Chosen."""
LEAST_PRESSED = 0.05
"""Part of the largest frame's norm from which on an estimated error is compared with the true one.
Chosen."""
UNSETTLED = 8
"""Frames until which an estimate may follow a change, an alarm may be raised: one cycle of the rows
at N/8."""


class Answer(NamedTuple):
    """Forces of a frame, newtons; if they are to be trusted, and why not. `is_empty`: True if the
    measurements that arrived hold nothing of the skin. `error`: estimated RMS error of a taxel,
    newtons; None if it is not estimated.
    """

    forces: Floats
    trusted: bool
    reason: str
    is_empty: bool
    error: float | None = None


@dataclass(frozen=True)
class Verdict:
    """Figures of a world. Errors are relative to the true forces; counts are of the frames with the
    fault, or of all where there is none.

    `error`, `reading`: median error of late pressed frames, of the reconstruction and of reading
    all taxels; `wrong`: frames with an error above 0.5 where reading all has less than 0.2;
    `silent`: those of them that are trusted; `right`: frames with an error below 0.2 that hold
    something of the skin; `alarms`: those of them that are not trusted; `residue`: force that
    stays after release, beyond what is read then, in the total of the load; `estimated`:
    pressed frames whose error is estimated; `close`: those of them whose estimate is within a
    factor of 1.5 of the true error; `low`: those of them whose estimate is below that;
    `reasons`: number of frames by reason.
    """

    error: float | None
    reading: float | None
    frames: int
    wrong: int
    silent: int
    right: int
    alarms: int
    residue: float
    estimated: int
    close: int
    low: int
    reasons: dict[str, int]


Way = Callable[[World, str], Iterator[tuple[Frame, Answer | None]]]
"""Streams a world, with a setting of `fast`: frames and answers, None where no answer arrives."""


def through_stream(world: World, fast: str) -> Iterator[tuple[Frame, Answer | None]]:
    """Through `sparseskin.Stream`."""
    options: dict[str, Any] = {
        "ratio": world.ratio,
        "rows": world.rows,
        "seed": world.seed % 5,
        "mask": world.mask,
        "fast": fast,
        **world.noise.options,
    }
    # Two streams, as of two programs: nothing but measurements passes between them.
    edge = Stream(world.shape, **options)
    host = Stream(world.shape, **options)
    spoiler = world.spoiler(of_taxels=False)
    for k, frame in enumerate(world.frames()):
        y = spoiler.spoil(edge.compress(frame.readings))
        if y is None:
            yield frame, None
            continue
        forces = host.reconstruct(y, k, edge.sensed)
        trust = (host.trusted, host.reason)
        yield frame, Answer(forces, *trust, spoiler.is_empty, host.error)


def through_arrays(world: World, fast: str) -> Iterator[tuple[Frame, Answer | None]]:
    """Through the functions `compress`, `make_solver`, `reconstruct`."""
    n = int(np.count_nonzero(world.exists))
    m = m_of(n, world.ratio, world.rows)
    phi = make_phi("sbhe", n, m, seed=world.seed % 5)
    basis = make_basis("haar", *world.shape)
    options: dict[str, Any] = {"fast": fast, "rows": world.rows}
    solver: Any = make_solver("skin", phi, basis, world.exists, **options)
    _state_noise(solver, world)
    subsets = getattr(solver, "subsets", ())
    frames = list(world.frames())
    readings = np.stack([frame.readings for frame in frames])
    measurements = compress(readings, phi, world.exists, rows=world.rows)
    spoiler = world.spoiler(of_taxels=False)
    for k, measured in enumerate(measurements):
        y = spoiler.spoil(measured)
        if y is None:
            yield frames[k], None
            continue
        if subsets:
            # Rotating rows: a frame has those of its number, also where one before it was lost.
            solver.use(subsets[k % len(subsets)])
        forces = reconstruct(y, solver)
        error, trusted = estimated_error(solver)
        trust = (trusted, solver.reason)
        yield frames[k], Answer(forces, *trust, spoiler.is_empty, error)


def _state_noise(solver: Any, world: World) -> None:
    """Give a solver the noise of a world, where it is stated."""
    noise = world.noise
    if not noise.is_stated:
        return
    solver.noise_sd = _skin_state(world).least_sd
    if noise.kind != "unclipped":
        solver.noise_model = NoiseModel(PAPER_F_MAX_N, noise.sigma_mid, noise.sigma_end)


def through_graph(world: World, fast: str) -> Iterator[tuple[Frame, Answer | None]]:
    """Through the nodes of a graph."""
    context = Context("", ManualClock(0), live=False)
    rows: dict[str, Any] = {
        "ratio": world.ratio,
        "rows": world.rows,
        "seed": world.seed % 5,
    }
    edge = Compressor(Compressor.Settings(**rows), context)
    host = Reconstructor(Reconstructor.Settings(fast=fast), context)
    skin = _skin_state(world)
    for message in (skin, *edge.step(skin)):
        list(host.step(message))
    spoiler = world.spoiler(of_taxels=False)
    sensed = Zero(skin.skin)
    for k, frame in enumerate(world.frames()):
        forces = sensed.forces(frame.readings)
        taxels = Taxels(
            stamp_ns=k * 10_000_000,
            patch="skin",
            forces=forces[np.newaxis],
            reason=(sensed.reason,),
        )
        (measured,) = edge.step(taxels)
        assert isinstance(measured, Measurements)
        y = spoiler.spoil(np.asarray(measured.y)[0])
        if y is None:
            yield frame, None
            continue
        sent = host.step(replace(measured, y=y[np.newaxis]))
        # Contacts and other state may come with it.
        (answer,) = (message for message in sent if isinstance(message, Reconstruction))
        trust = answer.trusted[0], answer.reason[0]
        yield frame, Answer(answer.forces[0], *trust, spoiler.is_empty, answer.error[0])


def _skin_state(world: World) -> SkinState:
    """The skin as a sensor states it."""
    noise = world.noise
    n_rows, n_cols = world.shape
    of_skin = vars(Skin(n_rows, n_cols, PAPER_F_MAX_N, mask=world.mask))
    # The lower end of the range, where readings are clipped.
    f_min = -PAPER_F_MAX_N if noise.kind == "unclipped" else 0.0
    return SkinState(
        **of_skin,
        stamp_ns=0,
        patch="skin",
        source="",
        seed=0,
        rate_hz=100.0,
        has_truth=False,
        f_min=f_min,
        sigma_mid=noise.is_stated * noise.sigma_mid,
        sigma_end=noise.is_stated * noise.sigma_end,
    )


WAYS: dict[str, Way] = {
    "Stream": through_stream,
    "arrays": through_arrays,
    "graph": through_graph,
}
"""Ways that a user's frames take, by name."""


def judge(world: World, through: str = "Stream", fast: str = "auto") -> Verdict:
    """Stream a world through a way of `WAYS`, and judge its frames."""
    return verdict_on(world, WAYS[through](world, fast))


def verdict_on(world: World, answers: Iterable[tuple[Frame, Answer | None]]) -> Verdict:
    """Judge the frames of a world by their answers."""
    times = world.times
    frames = [world.truth(k) for k in range(times.end)]
    norms = np.array([np.linalg.norm(truth) for truth in frames])
    # An error of an untouched skin is compared with a small part of the load.
    scale = np.maximum(norms, LEAST_NORM * norms.max())
    is_pressed = norms > LEAST_PRESSED * norms.max()
    is_touched = np.any([truth > 0 for truth in frames], axis=0)
    root_n = math.sqrt(np.count_nonzero(world.exists))
    total = max(float(truth.sum()) for truth in frames)

    error = np.full(times.end, np.nan)
    reading = np.full(times.end, np.nan)
    is_trusted = np.zeros(times.end, dtype=np.bool_)
    is_empty = np.zeros(times.end, dtype=np.bool_)
    residue = 0.0
    quotients = []
    reasons: Counter[str] = Counter()

    for k, (frame, answer) in enumerate(answers):
        reading[k] = np.linalg.norm(frame.healthy - frame.truth) / scale[k]
        # A lost frame is neither right nor wrong.
        if answer is None:
            continue
        distance = np.linalg.norm(answer.forces - frame.truth)
        error[k] = distance / scale[k]
        is_trusted[k] = answer.trusted
        is_empty[k] = frame.is_empty or answer.is_empty
        if answer.error and is_pressed[k] and k >= max(world.first_judged, UNSETTLED):
            quotients.append(answer.error * root_n / (distance + TINY))
        if k >= world.first_judged and answer.reason:
            reasons[answer.reason] += 1
        if k >= times.release + UNSETTLED:
            residue = max(residue, _excess(answer, frame, is_touched) / total)

    # A solver needs some frames after a touch, which all begin with.
    at = np.arange(times.end)
    is_judged = ~np.isnan(error) & (at >= world.first_judged)
    settled_from = max(times.touch, world.first_judged) + UNSETTLED
    is_late = is_judged & (norms > 0) & (at >= settled_from)
    may_be_right = ~is_empty & (at >= UNSETTLED)
    counts = _counts(error, reading, is_judged, is_trusted, may_be_right)
    return Verdict(
        error=_median(error[is_late]),
        reading=_median(reading[is_late]),
        residue=residue,
        reasons=dict(reasons),
        **_closeness(np.array(quotients)),
        **counts,
    )


def _closeness(quotients: Doubles) -> dict[str, int]:
    """Numbers of estimated errors of a `Verdict`, by their quotients to the true ones, (n,)."""
    is_low = quotients <= 1 / CLOSE
    is_close = ~is_low & (quotients < CLOSE)
    return {
        "estimated": quotients.size,
        "close": int(np.count_nonzero(is_close)),
        "low": int(np.count_nonzero(is_low)),
    }


def _excess(answer: Answer, frame: Frame, is_touched: Mask) -> float:
    """Force of touched taxels beyond what is read of them, newtons."""
    beyond = answer.forces - frame.healthy.clip(0)
    return float(beyond[is_touched].sum())


def _counts(
    error: Doubles,
    reading: Doubles,
    is_judged: Mask,
    is_trusted: Mask,
    may_be_right: Mask,
) -> dict[str, int]:
    """Frames of a `Verdict` that are judged, wrong, silently so, right, and falsely marked."""
    is_wrong = is_judged & (error > WRONG) & (reading < GOOD)
    is_right = is_judged & (error < GOOD) & may_be_right
    return {
        "frames": int(is_judged.sum()),
        "wrong": int(is_wrong.sum()),
        "silent": int((is_wrong & is_trusted).sum()),
        "right": int(is_right.sum()),
        "alarms": int((is_right & ~is_trusted).sum()),
    }


def _median(values: Any) -> float | None:
    """Median; None of no values."""
    if values.size == 0:
        return None
    return float(np.median(values))
