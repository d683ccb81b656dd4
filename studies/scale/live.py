"""Bodies of many patches live: the rate that a graph of real processes holds with its page open."""

from __future__ import annotations

import contextlib
import re
import socket
import threading
import time
from typing import Any, Self
from urllib.parse import urlsplit

from sparseskin.studies.graph_run import GraphRun

WARM_UP_S, WARM_UP_PATCH_S = 10.0, 0.1
"""Time at a low rate before that in question, and more of it a patch, for solvers to be set up, of
which no more than `DEPTH` frames wait; chosen."""
SLOW_HZ = 0.25
STEP = 0.75
"""Factor from one rate that is tried to the next; chosen."""
MAX_TRIALS = 5
DEPTH = 4
"""Frames that may wait for the reconstructor, which others pause now and then on two cores."""


class OpenPage:
    """A reader of the overview, as an open page is one; it reads and draws nothing."""

    def __init__(self, url: str) -> None:
        place = urlsplit(url)
        self._socket = socket.create_connection((place.hostname, place.port), 30.0)
        request = f"GET /stream?{place.query} HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n"
        self._socket.sendall(request.encode())
        self.n_bytes = 0
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with contextlib.suppress(OSError):
            self._socket.shutdown(socket.SHUT_RDWR)
        self._thread.join()
        self._socket.close()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while data := self._socket.recv(1 << 16):
                self.n_bytes += len(data)


def run_at(rate_hz: float, patches: int, active: float, seconds: float) -> dict[str, Any]:
    """Run a walking body at a rate, with its page open, and return its figures.

    Returns
    -------
    dict
        rate_hz asked, held_hz (frames reconstructed a second after the warm-up), skipped, lost,
        refused (of the worst patch), unchanged (part of all frames), p50_ms, p99_ms (latency of the
        worst patch), page_bytes_s.
    """
    settings = {
        "skin.patches": patches,
        "sensor.source": "scene:walk",
        "sensor.active": active,
        "sensor.rate_hz": SLOW_HZ,
        "monitor.port": 0,
        "reconstructor.depth": DEPTH,
    }
    changes = [part for key, v in settings.items() for part in ("--set", f"{key}={v}")]
    with GraphRun("body", *changes) as run:
        found = re.search(r"http://\S+", run.wait_for("live page: "))
        assert found is not None
        with OpenPage(found[0]) as page:
            warm_up_s = WARM_UP_S + WARM_UP_PATCH_S * patches
            time.sleep(warm_up_s)
            run.ask("sensor", "set", {"rate_hz": rate_hz})
            n_bytes, begin_s = page.n_bytes, time.monotonic()
            time.sleep(seconds)
            passed_s = time.monotonic() - begin_s
            n_bytes = page.n_bytes - n_bytes
            run.end()
        every = run.summary()["patches"].values()
    least = min(patch["frames"]["reconstructed"] for patch in every)
    slowest = max((patch["latency_ms"] for patch in every), key=lambda ms: float(ms["p99"]))
    n_frames = sum(patch["frames"]["reconstructed"] for patch in every)
    return {
        "patches": patches,
        "active": active,
        "rate_hz": rate_hz,
        "held_hz": max(0.0, least - SLOW_HZ * warm_up_s) / passed_s,
        "skipped": max(patch["frames"]["skipped"] for patch in every),
        "lost": max(patch["frames"]["lost"] for patch in every),
        "unchanged": sum(patch["unchanged"] for patch in every) / max(1, n_frames),
        "p50_ms": slowest["p50"],
        "p99_ms": slowest["p99"],
        "page_bytes_s": n_bytes / passed_s,
    }


def rate_held(
    first_hz: float, patches: int, active: float, seconds: float, last_seconds: float = 0.0
) -> list[dict[str, Any]]:
    """Trials from a rate downwards, to the first one without a frame skipped or lost.

    That one is run again for `last_seconds`, where stated.
    """
    trials: list[dict[str, Any]] = []
    rate_hz = first_hz
    for _ in range(MAX_TRIALS):
        trials.append(run_at(rate_hz, patches, active, seconds))
        if not trials[-1]["skipped"] and not trials[-1]["lost"]:
            break
        # What was held at too high a rate is the most that can be hoped for.
        rate_hz = min(rate_hz, max(trials[-1]["held_hz"], 0.2)) * STEP
    if last_seconds:
        trials.append(run_at(trials[-1]["rate_hz"], patches, active, last_seconds))
    return trials
