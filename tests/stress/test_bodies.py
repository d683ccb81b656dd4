"""The rate that a graph of a body of many patches holds while its page is open."""

import contextlib
import threading
import time
from http.client import HTTPConnection, HTTPException
from urllib.parse import urlsplit

import pytest
from stress.graphs import FULL, GraphRun

WARM_UP_S, WARM_UP_PATCH_S = 10.0, 0.1
"""Time at a low rate before that in question, and more of it a patch, for solvers to be set up, of
which no more than `DEPTH` frames wait; chosen."""
SLOW_HZ = 0.25
STEP, MAX_TRIALS = 0.75, 5
"""Factor from one rate that is tried to the next, and how many are tried; chosen."""
DEPTH = 4
"""Frames that may wait for the reconstructor, which others pause now and then on two cores."""


@contextlib.contextmanager
def open_page(url):
    """A page of all patches that reads its stream."""
    place = urlsplit(url)
    connection = HTTPConnection(place.netloc)
    connection.request("GET", f"/stream?{place.query}")
    answer = connection.getresponse()

    def read():
        with contextlib.suppress(OSError, HTTPException, AttributeError, ValueError):
            while answer.read(1 << 16):
                pass

    threading.Thread(target=read, daemon=True).start()
    yield
    connection.close()


def run_at(rate_hz, patches, active, seconds, warm_up_s):
    """Run a walking body at a rate, with its page open, and return its figures.

    rate_hz asked, held_hz (frames reconstructed a second after the warm-up), skipped, lost (of
    the worst patch), unchanged (part of all frames), p50_ms, p99_ms (of the worst patch).
    """
    settings = {
        **{"skin.patches": patches, "sensor.source": "scene:walk", "sensor.active": active},
        **{"sensor.rate_hz": SLOW_HZ, "monitor.port": 0, "reconstructor.depth": DEPTH},
    }
    changes = [part for key, v in settings.items() for part in ("--set", f"{key}={v}")]
    with GraphRun("body", *changes) as graph, open_page(graph.page()):
        time.sleep(warm_up_s)
        graph.ask("sensor", "set", {"rate_hz": rate_hz})
        begin_s = time.monotonic()
        time.sleep(seconds)
        passed_s = time.monotonic() - begin_s
        graph.end()
        every = graph.summary()["patches"].values()
    frames = [patch["frames"] for patch in every]
    least = min(one["reconstructed"] for one in frames)
    slowest = max((patch["latency_ms"] for patch in every), key=lambda ms: float(ms["p99"]))
    n_frames = max(1, sum(one["reconstructed"] for one in frames))
    return {
        **{"patches": patches, "active": active, "rate_hz": round(rate_hz, 1)},
        "held_hz": round(max(0.0, least - SLOW_HZ * warm_up_s) / passed_s, 1),
        "skipped": max(one["skipped"] for one in frames),
        "lost": max(one["lost"] for one in frames),
        "unchanged": round(sum(patch["unchanged"] for patch in every) / n_frames, 2),
        **{"p50_ms": round(slowest["p50"], 1), "p99_ms": round(slowest["p99"], 1)},
    }


@pytest.mark.parametrize(
    ("patches", "active", "first_hz"),
    [(16, 0.25, 100.0), (16, 0.1, 150.0), (244, 0.25, 8.0)] if FULL else [(3, 0.25, 2.0)],
)
def test_a_body_loses_no_frame_at_a_rate_that_it_holds(patches, active, first_hz, full, note):
    rate_hz, seconds = first_hz, 10.0 if full else 2.0
    warm_up_s = WARM_UP_S + WARM_UP_PATCH_S * patches if full else 4.0
    for _ in range(MAX_TRIALS):
        found = run_at(rate_hz, patches, active, seconds, warm_up_s)
        note(**found)
        if not found["skipped"]:
            break
        # What was held at too high a rate is the most that can be hoped for.
        rate_hz = min(rate_hz, max(found["held_hz"], 0.2)) * STEP
    assert found["lost"] == 0
    assert found["held_hz"] > 0
