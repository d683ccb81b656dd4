"""What a batch carries from frame to frame: vectors, and the numbers of each patch."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from sparseskin.nodes.numerics.arrays import Doubles
from sparseskin.nodes.reconstructor.skin.tuning import TUNING

from .backend import Array, Backend

State: TypeAlias = dict[str, Array]
"""Vectors, float32 (B, n) or (B, m), and `NUMBERS`, float64 (k, B), by name."""
Numbers: TypeAlias = dict[str, Array]
"""Numbers of each patch by name, float64 (B,), flags bool (B,); a list by row subset."""

NUMBERS = "numbers"
#: Numbers and their values before the first frame. Errors below 0 stand for none.
FIRST = {
    **{"bias": 0.0, "bias_frames": 0.0, "least_s2": np.inf},
    **{"s2": 0.0, "since_jump": 0.0, "trust": 1.0},
    **{"haar_error": -1.0, "smooth_error": -1.0},
    **{"error2": 0.0, "most_noise": np.inf},
    **{"wait": 0.0, "period": float(TUNING.often), "left": 0.0},
    **{"next_shift": 0.0, "subset": 0.0, "drift": 0.0, "remembered": 0.0},
}
FLAGS = {
    **{"begun": False, "settled": False, "known": False, "rotating": False},
    **{"has_estimate": False, "is_smooth": False, "exceeds": True, "has_other": False},
}
#: Of each row subset: differences since the last jump (-1: no frame), 1 if it was ever read, gain,
#: and the last frame that it was read in, as counted by `remembered` (0: none).
OF_SUBSET = {"differences": -1.0, "begun_in": 0.0, "gain": 1.0, "read_in": 0.0}


def first_numbers(n_patches: int, n_subsets: int) -> Doubles:
    """Return the numbers before the first frame, float64 (k, n_patches)."""
    column = [*FIRST.values(), *map(float, FLAGS.values())]
    column += [value for value in OF_SUBSET.values() for _ in range(n_subsets)]
    return np.repeat(np.array(column)[:, None], n_patches, axis=1)


def first_state(be: Backend, n_patches: int, n: int, m: int, n_subsets: int) -> State:
    """Return the state before the first frame."""
    state = {name: be.zeros(n_patches, n) for name in ("x", "other", "correction")}
    if n_subsets > 1:
        state |= {name: be.zeros(n_patches, n) for name in ("values", "known")}
    for subset in range(n_subsets):
        state |= {f"{name}{subset}": be.zeros(n_patches, m) for name in ("y", "step")}
    state[NUMBERS] = be.array(first_numbers(n_patches, n_subsets))
    return state


def unpack(packed: Array, n_subsets: int) -> Numbers:
    """Return the numbers of a state by name."""
    names = [*FIRST, *FLAGS]
    found: Numbers = {name: packed[k, :] for k, name in enumerate(names)}
    for name in FLAGS:
        found[name] = found[name] > 0.5
    start = len(names)
    for name in OF_SUBSET:
        found[name] = [packed[start + k, :] for k in range(n_subsets)]
        start += n_subsets
    return found


def pack(be: Backend, numbers: Numbers) -> Array:
    """Return numbers by name as one array, the inverse of `unpack`."""
    rows = [numbers[name] for name in FIRST]
    rows += [be.double(numbers[name]) for name in FLAGS]
    for name in OF_SUBSET:
        rows += numbers[name]
    return be.xp.stack(rows, axis=0)
