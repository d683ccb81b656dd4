"""A long run of a graph: memory, open files, lost frames, contacts; at full size 30 min at 1 kHz.

`SPARSESKIN_SOAK_MINUTES` and `SPARSESKIN_SOAK_HZ` state another duration and rate: 720 and 50 are
12 hours at 50 Hz.
"""

import itertools
import os
import time

import numpy as np
from stress.graphs import GraphRun, launch_text

from sparseskin.messages import Contacts, decode
from sparseskin.nodes.compressor.phi.rotation import FIXED
from sparseskin.nodes.process import proc
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.studies.frames import scene_frames
from sparseskin.studies.looped import Looped

LAUNCHER = "launcher"
MAX_SAMPLES = 300
WARM_UP_S = 70.0
"""The monitor keeps the figures of the last minute: it grows until then."""
FLAT = 0.03
"""Relative growth of the memory after the warm-up that still counts as flat in half an hour."""

INDEX_MB_PER_H = 20.0
"""Growth of a recorder, which holds the index of its chunks, five a second, until the end."""
FLAT_MB = 3.0
"""Of 50 to 180 MB; a leak of 1 kB a frame would be 5 MB in the time that is looked at."""


NAMES = {LAUNCHER, "sensor", "compressor", "reconstructor", "monitor", "recorder"}


def measure(seconds, rate_hz, side):
    """Run a graph for a while, sample its processes at intervals, and end it.

    samples: time_s, and of each process, by name, memory_mb (resident), files (open
    descriptors) and cpu_s. frames: the monitor's count of sensed, reconstructed and lost.
    lost: messages that each node missed on its inputs. restarts, exit_code. contacts: of the
    first and the last minute, or fifth of a shorter run, means of number and total force.
    """
    source = f"sparseskin.studies.looped:truth_{side}"
    nodes = {
        "sensor": {"source": source, "rate_hz": rate_hz},
        "compressor": {"rows": FIXED},
        "reconstructor": {"preset": "skin", "contacts": True},
        "monitor": {"port": 0},
        "recorder": {"out": "soak.mcap", "topics": ["/skin/contacts"]},
    }
    with GraphRun(launch_text(nodes)) as graph:
        pids = {LAUNCHER: graph.process.pid, **graph.nodes()}
        found = {"time_s": []}
        for name in pids:
            found[name] = {"memory_mb": [], "files": [], "cpu_s": []}
        began_s = time.monotonic()
        while (now_s := time.monotonic() - began_s) < seconds:
            found["time_s"].append(round(now_s, 2))
            for name, pid in pids.items():
                found[name]["memory_mb"].append(proc.resident_bytes(pid) / 1e6)
                found[name]["files"].append(len(os.listdir(f"/proc/{pid}/fd")))
                found[name]["cpu_s"].append(proc.cpu_s(pid))
            time.sleep(max(1.0, seconds / MAX_SAMPLES))
        code = graph.end()
        summary = graph.summary()
        contacts = _contacts(graph.cwd / "soak.mcap", min(60.0, seconds / 5))
    return {
        "samples": found,
        "frames": summary["patches"]["skin"]["frames"],
        "lost": {
            name: sum(node["lost"].values()) for name, node in summary["nodes"].items()
        },
        "restarts": sum(node["restarts"] for node in summary["nodes"].values()),
        "exit_code": code,
        "contacts": contacts,
    }


def _contacts(path, part_s):
    """Mean number of contacts, and of their total force, in the first and in the last part."""
    with BagReader(path) as bag:
        found = [
            (message.stamp_ns, message.id.size, float(message.total.sum()))
            for message in (
                decode(read.topic.encode(), read.payload) for read in bag.messages()
            )
            if isinstance(message, Contacts)
        ]
    stamps_ns, counts, totals = np.array(found).T
    parts = (
        stamps_ns < stamps_ns[0] + 1e9 * part_s,
        stamps_ns > stamps_ns[-1] - 1e9 * part_s,
    )
    return [(float(counts[part].mean()), float(totals[part].mean())) for part in parts]


def verdict(samples, name):
    """Figures of one process after the warm-up, or after a third of a short run.

    before_mb, after_mb: medians over the first and the last fifth, which a queue that is long
    for some seconds does not change. files_before, files_after: the most before the last fifth
    and in it; a file may be open for a moment. cpu: cores.
    """
    time_s = np.array(samples["time_s"])
    after = time_s >= min(WARM_UP_S, time_s[-1] / 3)
    time_s = time_s[after]
    memory_mb, files, cpu_s = (
        np.array(samples[name][what])[after] for what in ("memory_mb", "files", "cpu_s")
    )
    fifth = max(1, len(time_s) // 5)
    before_mb, after_mb = (
        float(np.median(p)) for p in (memory_mb[:fifth], memory_mb[-fifth:])
    )
    return {
        **{"before_mb": before_mb, "after_mb": after_mb},
        **{
            "files_before": int(files[:-fifth].max()),
            "files_after": int(files[-fifth:].max()),
        },
        "cpu": float((cpu_s[-1] - cpu_s[0]) / (time_s[-1] - time_s[0])),
    }


def test_a_graph_that_runs_for_a_while_leaks_nothing_and_loses_nothing(full, note):
    minutes = float(os.environ.get("SPARSESKIN_SOAK_MINUTES", "30" if full else "0.4"))
    rate_hz = float(os.environ.get("SPARSESKIN_SOAK_HZ", "1000" if full else "100"))
    found = measure(60 * minutes, rate_hz, 40)
    for name in NAMES:
        v = verdict(found["samples"], name)
        note(process=name, **{key: round(value, 3) for key, value in v.items()})
        if full:
            index_mb = INDEX_MB_PER_H * minutes / 60 if name == "recorder" else 0.0
            assert v["after_mb"] < (1 + FLAT) * v["before_mb"] + index_mb, name
        else:
            assert v["after_mb"] - v["before_mb"] < FLAT_MB, name
        assert v["files_after"] <= v["files_before"], name
    frames = found["frames"]
    note(process="frames", **frames)
    note(process="contacts, mean number and force", first_last=str(found["contacts"]))
    assert (
        frames["sensed"] == frames["reconstructed"] + frames["skipped"] + frames["lost"]
    )
    assert found["restarts"] == 0
    first, last = found["contacts"]
    np.testing.assert_allclose(last, first, rtol=0.02)
    if not full:  # 1 kHz may be more than a host takes
        assert set(found["lost"].values()) == {0}


def test_a_looped_source_repeats_its_frames_with_stamps_that_go_on():
    first, n = 60, 5
    pairs = list(scene_frames("lift_box_40", 0, first, first + n))
    for delivers in ("truth", "taxels"):
        source = Looped("lift_box_40", first, n, delivers)
        stamps, forces = zip(*itertools.islice(source, 2 * n), strict=True)
        assert all(np.diff(stamps) > 0)
        expected = [pair[delivers == "taxels"] for pair in pairs]
        np.testing.assert_array_equal(forces, 2 * expected)
