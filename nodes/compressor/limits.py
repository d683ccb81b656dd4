"""Settings of a compressor that work, and restore little: known from the study `stability`."""

from __future__ import annotations

#: Below N/16 a frame with more than one small pad is not restored, by any solver.
MAX_RATIO = 16.0
#: Smaller blocks lose more than 3 dB on the touched taxels, against blocks of 32.
MIN_BLOCK = 8
#: With fewer bits, the steps of a frame's largest measurement hide what its small ones say.
MIN_BITS = 5


def compression_warnings(
    kind: str, n: int, m: int, block: int, bits: int | None = None
) -> list[str]:
    """What is known to fail with a measurement matrix that can be made.

    Parameters
    ----------
    kind : str
        Kind of the measurement matrix, as `make_phi` knows it.
    n, m : int
        Number of taxels and of measurements.
    block : int
        Size of the Hadamard blocks; only "sbhe" has them.
    bits : int or None
        Bits of a measurement; None: it is sent as float32.

    Returns
    -------
    list of str
        One line each: what is set, what fails, what is advised.
    """
    warnings = []
    if n > MAX_RATIO * m:
        warnings.append(
            f"m = {m} of n = {n} taxels: more than one small contact is not restored; "
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
