"""The versions that a recording names, so that it can be read years later."""

from __future__ import annotations

import json
import platform
from importlib.metadata import version

from sparseskin.messages.wire import SCHEMAS


def versions_json() -> str:
    """Versions of the program, of Python, of what writes the file, and of each schema."""
    return json.dumps(
        {
            "sparseskin": version("sparseskin"),
            "python": platform.python_version(),
            "numpy": version("numpy"),
            "mcap": version("mcap"),
            "messages": {name: cls.version for name, cls in SCHEMAS.items()},
        }
    )
