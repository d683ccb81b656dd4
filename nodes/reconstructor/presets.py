"""Named sets of settings for the reconstructor."""

from __future__ import annotations

from typing import Any

#: "paper": exactly the method of the paper, sections IV and V-A, for a "sbhe" phi with
#: orthonormal rows of block 32; lambda_n is its 0.1 on rows of +1 and -1.
#: "skin": the best there is here; it takes noise and threshold from the measurements.
PRESETS: dict[str, dict[str, Any]] = {
    "paper": {
        "solver": "fista",
        "basis": "haar",
        "iterations": 30,
        "lambda_n": 0.003125,
    },
    "skin": {"solver": "skin", "basis": "haar"},
}
