"""Ages at which a program has each frame, one line each, in milliseconds.

python -m sparseskin.plugins.control_loop.ages WAY N_MESSAGES: a way of `WAYS`.
A process of its own, as a user's loop is one.
"""

import json
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import closing
from itertools import islice

import numpy as np

from sparseskin.launch.run.running import choose_graph
from sparseskin.nodes.clock import SystemClock

CONTACTS = "/skin/contacts"
RATE_HZ = 200
"""Frames per second of the graph, and of `stream`."""
DOMAIN = 77
LOOPBACK = "lo"
"""Domain of DDS and interface that the bridge of the study uses."""
_STAMP = struct.Struct("<4xiI")
"""Begin of a message with a header, in CDR: seconds and nanoseconds of its stamp."""


def subscribe() -> Generator[float]:
    """The newest contacts, in this process."""
    import sparseskin

    with sparseskin.subscribe(CONTACTS, newest=True) as contacts:
        for _ in contacts:
            yield contacts.age_s


def echo() -> Generator[float]:
    """Lines of `sparseskin topic echo --json`, read from a pipe."""
    clock = SystemClock(choose_graph(None).offset_ns)
    words = [sys.executable, "-m", "sparseskin", "topic", "echo", CONTACTS, "--json"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            # The age includes the parsing of the line, as a user's program has it.
            for line in process.stdout:
                yield (clock.now_ns() - json.loads(line)["stamp_ns"]) / 1e9
        finally:
            process.terminate()


def ros2() -> Generator[float]:
    """Wrenches of the bridge to ROS 2, by DDS."""
    from sparseskin.plugins.bridges.cdr import WRENCH
    from sparseskin.plugins.bridges.dds import Member

    clock = SystemClock(choose_graph(None).offset_ns)
    with closing(Member(DOMAIN, LOOPBACK, "ages")) as member:
        reader = member.reader(f"{CONTACTS}/wrench", WRENCH, 1, reliable=True)
        while True:
            for data in reader.take(0.1, 1):
                # Only the stamp is read: the rest would cost what a program need not do.
                seconds, nanoseconds = _STAMP.unpack_from(data)
                yield (clock.now_ns() - seconds * 1_000_000_000 - nanoseconds) / 1e9


def stream() -> Generator[float]:
    """Compression and reconstruction by `Stream`, in the loop itself; no contacts."""
    import sparseskin
    from sparseskin.studies.looped import path_40

    source = path_40()
    shape = source.skin.shape
    loop = sparseskin.Stream(shape)
    # The first frame may compile.
    loop.reconstruct(loop.compress(np.zeros(shape, np.float32)))
    loop.reset()
    begin_s = time.monotonic()
    for k, (_, frame) in enumerate(source):
        # An absolute target: the error of one wait does not add to the next.
        time.sleep(max(0.0, begin_s + k / RATE_HZ - time.monotonic()))
        came_s = time.monotonic()
        loop.reconstruct(loop.compress(frame))
        yield time.monotonic() - came_s


WAYS: dict[str, Callable[[], Generator[float]]] = {
    "stream": stream,
    "subscribe": subscribe,
    "echo": echo,
    "ros2": ros2,
}


def main(way: str, n_messages: str) -> None:
    """Print the ages of the first messages of a way."""
    with closing(WAYS[way]()) as ages_s:
        for age_s in islice(ages_s, int(n_messages)):
            print(f"{1e3 * age_s:.4f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
