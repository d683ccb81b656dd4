"""Settings of a compressor that are valid but reconstruct badly."""

from __future__ import annotations

# Measured on the six scenes by the study `stability`.
MAX_RATIO = 16.0
"""Largest ratio N / M: beyond it no solver reconstructs a frame with more than one small pad."""
MIN_BLOCK = 8
"""Least block size: smaller ones lose more than 3 dB on the touched taxels against blocks of 32."""
MIN_BITS = 5
"""Least bits of a measurement: with fewer, the quantiser's step exceeds the small measurements."""


def compression_warnings(
    kind: str, n: int, m: int, block: int, bits: int | None = None
) -> list[str]:
    """Warnings about a valid measurement matrix, with arguments of `make_phi`, that is known to
    reconstruct badly: a line each with the setting, its effect, the advised value.
    """
    warnings = []
    if n > MAX_RATIO * m:
        warnings.append(
            f"m = {m} of n = {n} taxels: more than one small contact is not reconstructed; "
            f"advised: m of {-(-n // int(MAX_RATIO))} or more (N/{MAX_RATIO:g})"
        )
    if kind == "subsample" and m < n:
        warnings.append(
            f"phi = subsample: a contact of fewer than {n / m:.3g} taxels may touch none that is "
            "read; advised: sbhe"
        )
    if kind == "sbhe" and block < MIN_BLOCK <= n:
        warnings.append(
            f"block = {block}: most measurements see no pressed taxel, which loses 3 to 10 dB on "
            f"those that are; advised: {MIN_BLOCK} or more"
        )
    if bits is not None and bits < MIN_BITS:
        warnings.append(
            f"bits = {bits}: the steps of the quantiser lose 2 to 5 dB; advised: {MIN_BITS} or more"
        )
    return warnings
