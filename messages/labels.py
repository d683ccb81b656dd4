"""Label of a frame: what a recogniser sees in it."""

from dataclasses import dataclass
from typing import ClassVar

from .base import Message
from .fields import Flag, Integer, Real, Text, omitted, wire

MAX_LABEL = 64
"""Most characters of a label. Chosen: it is a line of a page."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Labels(Message):
    """Label of a frame of one patch, by the node that recognises."""

    schema: ClassVar[str] = "labels"
    times: ClassVar[tuple[str, ...]] = ("stamp_ns", "done_ns")

    label: str = wire(Text(MAX_LABEL))
    """The label with the largest share; "" where that is too small, or nothing presses."""
    share: float = wire(Real(0.0, 1.0))
    """Share of that label in all, 0 to 1, as the model estimates it; of "" too."""
    age_s: float = wire(Real(0.0))
    """Time since the label is the same, seconds."""
    done_ns: int = wire(Integer())
    """Time of the label on the graph's clock, nanoseconds."""
    trusted: bool = omitted(Flag(), True)
    """False where the reconstruction that was read is not to be trusted."""
