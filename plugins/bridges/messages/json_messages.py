"""Messages in JSON, as programs without ROS write them to MCAP."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from sparseskin.nodes.errors import SourceError

from .decoding import Message
from .definitions import HEADER, TIME

KIND = "JSON"
TIME_MEMBERS = (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs"))
"""Members of a time: of ROS 2, Foxglove and rosbridge."""


def message_of(data: bytes) -> Message:
    """Read a message, an object of JSON. Its lists of numbers become arrays, NaN for null. Raises
    SourceError if it is none.
    """
    try:
        content = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise SourceError("is no message in JSON") from error
    if not isinstance(content, dict):
        raise SourceError("is no object of JSON")
    message: Message = _value(content)
    return message


def _value(content: Any) -> Any:
    """A content of JSON as a part of a message."""
    if isinstance(content, list):
        return _list(content)
    if not isinstance(content, dict):
        return content
    for seconds, nanoseconds in TIME_MEMBERS:
        if {*content} == {seconds, nanoseconds}:
            time = Message(TIME)
            time["sec"] = content[seconds]
            time["nanosec"] = content[nanoseconds]
            return time
    message = Message(HEADER if {"stamp", "frame_id"} <= {*content} else KIND)
    for name, member in content.items():
        message[name] = _value(member)
    return message


def _list(content: list[Any]) -> Any:
    """Numbers as an array with an axis for each list within a list; else a list of values."""
    if any(isinstance(entry, dict | str) for entry in content):
        return [_value(entry) for entry in content]
    try:
        # Whole numbers, too: those of the next message may be none.
        return np.array(content, dtype=np.float64)
    except (ValueError, TypeError, OverflowError):
        return [_value(entry) for entry in content]
