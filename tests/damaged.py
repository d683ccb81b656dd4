"""Damaged files, and the line that refuses them."""

from collections.abc import Callable

from sparseskin.nodes.errors import SparseskinError


def refusal(read: Callable[[], object]) -> str:
    """The line of a refusal; "" where there is none."""
    try:
        read()
    except SparseskinError as error:
        return str(error)
    return ""


def changed(raw: bytes, place: int, piece: bytes) -> bytes:
    at = place % len(raw)
    return raw[:at] + piece + raw[at + len(piece) :]
