"""Fingerprint of the code of the nodes, by which results of other code are told apart."""

import hashlib
from functools import cache
from pathlib import Path


@cache
def code_fingerprint() -> str:
    """16 hexadecimal characters that change with the code of the nodes."""
    digest = hashlib.sha256()
    root = Path(__file__).parent.parent
    for path in sorted(root.rglob("*.py")):
        digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]
