"""Topic names: /PATCH/SCHEMA."""

import functools
import re

from .errors import FieldError, OversizedError

NAME_PATTERN = r"[a-z][a-z0-9_]*"
"""Names of patches, nodes and schemas."""
MAX_NAME = 32
MAX_PATCHES = 256
"""Largest number of patches of a message."""
MAX_NAMES = 4096
"""Most characters of the names of all patches of a message, a space between each two."""
MAX_TOPIC_BYTES = 2 * MAX_NAME + 2


def topic_of(patch: str, schema: str) -> str:
    """Name "/PATCH/SCHEMA" of the topic of a patch's messages of one schema."""
    return f"/{patch}/{schema}"


def check_name(place: str, name: object) -> str:
    """Return the name of a patch or node, or raise a MessageError that begins with `place`."""
    # Names become parts of topics and file names: few characters are allowed.
    if not isinstance(name, str) or re.fullmatch(NAME_PATTERN, name) is None:
        raise FieldError(
            f"{place}: {name!r} is no name (allowed: a lower-case letter, "
            "then lower-case letters, digits and underscores)"
        )
    if len(name) > MAX_NAME:
        raise OversizedError(f"{place}: {len(name)} characters, at most {MAX_NAME}")
    return name


@functools.lru_cache(maxsize=1024)
def split_topic(topic: str) -> tuple[str, str]:
    """Split "/PATCH/SCHEMA" into (patch, schema), or raise MessageError."""
    # An absolute name begins with an empty part.
    parts = topic.split("/")
    if len(parts) != 3 or parts[0]:
        raise FieldError(f"topic {topic[:MAX_TOPIC_BYTES]!r}: expected /PATCH/SCHEMA")
    return check_name("topic", parts[1]), check_name("topic", parts[2])
