"""Both ends of a topic of ROS 2, whichever library carries it."""

from collections.abc import Callable
from typing import NamedTuple


class Writer(NamedTuple):
    """A writer: the readers of its topic, or their number; and what publishes a message in CDR and
    returns False if it is dropped, as a reader is behind.
    """

    readers: Callable[[], object]
    write: Callable[[bytes], bool]


class Reader(NamedTuple):
    """A reader: what takes at most n messages in CDR, after a wait of some seconds for the first;
    and the number of messages that were lost on the way.
    """

    take: Callable[[float, int], list[bytes]]
    n_lost: Callable[[], int]
