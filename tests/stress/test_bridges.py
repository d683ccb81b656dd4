"""Frames that bridges send at 1 kHz reach a real client, or are counted; at full size 10,000."""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from bags import skin_state
from stress.graphs import FULL, PYTHONPATH, GraphError
from stress.observers import DOMAIN

from sparseskin.messages import Reconstruction
from sparseskin.nodes.clock import SystemClock, wall_offset_ns
from sparseskin.nodes.node import Context
from sparseskin.nodes.registry import make_settings, node_class

#: Fewer than the client of each bridge may be behind.
N_FRAMES = 10_000 if FULL else 300
STEP_S, STAMP_NS = 0.001, 1_000_000
"""Time between two frames: the client keeps up with them."""
BEFORE_NS, BETWEEN_NS = 10**15, 10**8
"""Stamp of the first frame that is sent until the client reads, beyond all that it counts, and time
between two."""
HISTORY = 1000
"""Samples that DDS keeps, so that a reader which does not run for a second loses none."""
ENDS_S = 60.0
SKIN = skin_state(n_rows=64, n_cols=64, mask=None)


@contextlib.contextmanager
def connected(
    kind: str, *arguments: str
) -> Iterator[tuple[Callable[[int], int], subprocess.Popen[bytes]]]:
    """A bridge in this process, and a client in another that has read its first frame.

    Yields what sends a frame by its stamp in ns and returns the number of dropped ones, and the
    client.
    """
    values: dict[str, Any] = {"maps": ("reconstruction",)}
    values |= {"domain": DOMAIN, "history": HISTORY} if kind == "ros2" else {"port": 0}
    cls = node_class(kind)
    node: Any = cls(make_settings(cls, values), Context(kind, SystemClock(wall_offset_ns())))
    forces = np.random.default_rng(0).uniform(0, 2.5, (64, 64)).astype(np.float32)
    common: dict[str, Any] = {"patch": "skin", "forces": forces, "phi": "0" * 16, "iterations": 1}
    common |= {"residual": 0.0, "solve_ns": 0}

    def send(stamp_ns: int) -> int:
        list(node.step(Reconstruction(stamp_ns=stamp_ns, done_ns=stamp_ns, **common)))
        return int(node.n_dropped)

    client = None
    try:
        list(node.start())
        list(node.step(SKIN))
        where = str(DOMAIN) if kind == "ros2" else node.where()
        client = subprocess.Popen(
            [sys.executable, "-m", "stress.clients", kind, where, *arguments],
            env={**os.environ, "PYTHONPATH": PYTHONPATH},
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        )
        assert client.stdout is not None
        os.set_blocking(client.stdout.fileno(), False)
        for k in itertools.count():
            if client.stdout.read():
                break
            send(BEFORE_NS + k * BETWEEN_NS)
            if client.poll() is not None:
                raise GraphError(f"the client of {kind} has ended")
            time.sleep(STEP_S)
        os.set_blocking(client.stdout.fileno(), True)
        yield send, client
    finally:
        if client is not None:
            client.kill()
            client.wait()
        node.close({})


def counted(kind: str, note: Any) -> tuple[int, int]:
    """Frames at 1 kHz to a client that counts them: how many it has read, and how many the bridge
    has counted as dropped. The client sees all others by a gap of their stamps.
    """
    used_us: list[float] = []
    with connected(kind, str(N_FRAMES)) as (send, client):
        begin_s = time.perf_counter()
        for k in range(1, N_FRAMES + 1):
            time.sleep(max(0.0, begin_s + k * STEP_S - time.perf_counter()))
            began_ns = time.thread_time_ns()
            dropped = send(k * STAMP_NS)
            used_us.append((time.thread_time_ns() - began_ns) / 1e3)
        hz = N_FRAMES / (time.perf_counter() - begin_s)
        end_s = time.monotonic() + ENDS_S
        # The last frame ends the client: it is sent again in case it was replaced.
        while client.poll() is None and time.monotonic() < end_s:
            send(N_FRAMES * STAMP_NS)
            time.sleep(0.05)
        text = client.stdout.read() if client.stdout is not None else b""
        if client.poll() is None or not text:
            raise GraphError(f"{kind}: the client did not read the last frame")
    found = {"sent": N_FRAMES, "Hz": round(hz), "received": int(text), "dropped": dropped}
    note(bridge=kind, **found, us_a_call=round(float(np.median(used_us))))
    return int(text), dropped


@pytest.mark.parametrize(("kind", "module"), [("foxglove", "foxglove"), ("ros2", "cyclonedds")])
def test_every_frame_is_read_by_the_client_or_counted_as_dropped(
    kind: str, module: str, note: Any
) -> None:
    pytest.importorskip(module)
    assert counted(kind, note) == (N_FRAMES, 0)
