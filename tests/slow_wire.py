"""A wire between two network namespaces that delays packets and loses some: two TUN devices and a
thread that carries packets from one to the other. It needs nothing of the kernel but those.
"""

from __future__ import annotations

import fcntl
import heapq
import os
import random
import select
import struct
import threading
import time
from collections.abc import Callable

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
MAX_PACKET_BYTES = 65536


class SlowWire:
    """Carries packets until it is closed.

    Parameters
    ----------
    place : callable
        Takes (end, device): moves a device to the namespace of end 0 or 1.
    delay_s : float
        How long a packet takes.
    loss : float
        Part of the packets that are lost, 0..1.
    seed : int
        Of the choice of those.

    Raises
    ------
    OSError
        If TUN devices are not permitted here.
    """

    def __init__(
        self, place: Callable[[int, str], None], delay_s: float, loss: float, seed: int = 0
    ) -> None:
        self._delay_s, self._loss, self._random = delay_s, loss, random.Random(seed)
        self.n_carried = self.n_lost = 0
        self._stopped = False
        self._ends: list[int] = []
        try:
            for end in (0, 1):
                fd = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
                self._ends.append(fd)
                name = f"slow{os.getpid()}e{end}"
                request = struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI)
                fcntl.ioctl(fd, TUNSETIFF, request)
                place(end, name)
        except OSError:
            self._close_ends()
            raise
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stopped = True
        self._thread.join()
        self._close_ends()

    def _close_ends(self) -> None:
        for fd in self._ends:
            os.close(fd)

    def _carry(self) -> None:
        under_way: list[tuple[float, int, int, bytes]] = []
        while not self._stopped:
            now_s = time.monotonic()
            wait_s = min(0.1, max(0.0, under_way[0][0] - now_s)) if under_way else 0.1
            for fd in select.select(self._ends, [], [], wait_s)[0]:
                packet = os.read(fd, MAX_PACKET_BYTES)
                other = self._ends[1 - self._ends.index(fd)]
                if self._random.random() < self._loss:
                    self.n_lost += 1
                    continue
                self.n_carried += 1
                due_s = time.monotonic() + self._delay_s
                heapq.heappush(under_way, (due_s, self.n_carried, other, packet))
            while under_way and under_way[0][0] <= time.monotonic():
                _, _, fd, packet = heapq.heappop(under_way)
                try:
                    os.write(fd, packet)
                except OSError:
                    self.n_lost += 1  # that end is down
