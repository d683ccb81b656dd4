"""Pictures of forces, drawn by matplotlib."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from sparseskin.messages.errors import MessageError
from sparseskin.messages.skin import Skin
from sparseskin.nodes.arguments import checked
from sparseskin.nodes.errors import SparseskinError, not_installed
from sparseskin.nodes.numerics.arrays import LARGEST, Floats, Mask, real_floats

MAX_FRAMES = 24
"""Most frames of a picture; chosen: more are too small to see."""
MAX_COLUMNS = 6
SIDE_IN = 2.6
"""Width of the map of a frame, inches; chosen."""
LEAST_IN = 1.6
"""Least height of the picture, with room for the label of the colour bar, inches; chosen."""
BAR_IN = 0.12
"""Width of the colour bar, inches; chosen."""


@checked(SparseskinError)
def plot_forces(
    forces: Floats,
    titles: Sequence[str] = (),
    unit: str = "N",
    mask: Mask | None = None,
) -> list[Any]:
    """Draw a map of each frame, all on one colour scale from 0 to the largest force.

    It needs matplotlib (extra `charts`). A notebook shows the picture; elsewhere
    ``matplotlib.pyplot.savefig`` writes it, and ``matplotlib.pyplot.show`` opens it.

    Parameters
    ----------
    forces : ndarray of float32, shape (n_rows, n_cols) or (k, n_rows, n_cols)
        Forces of a frame, or of at most 24.
    titles : list of str
        A title for each frame; by default none.
    unit : str
        Unit of the forces, at the colour bar.
    mask : ndarray of bool, shape (n_rows, n_cols), optional
        True where a taxel exists; the others stay white.

    Returns
    -------
    list of matplotlib.axes.Axes
        The map of each frame; ``[0].figure`` is the whole picture.

    Raises
    ------
    SparseskinError
        If the arrays are no frames, their shapes do not fit, or matplotlib is not installed.
    """
    frames = _frames(forces)
    names = [titles] if isinstance(titles, str) else list(titles)
    if names and len(names) != len(frames):
        raise SparseskinError(
            f"plot_forces: {len(names)} titles; expected one for each of {len(frames)} frames"
        )
    _, n_rows, n_cols = frames.shape
    try:
        skin = Skin(n_rows, n_cols, f_max=1.0, mask=mask)
    except MessageError as error:
        raise SparseskinError(f"plot_forces: {error}") from error
    try:
        import matplotlib.pyplot as plt
    except ImportError as error:
        fault = not_installed("matplotlib", "charts")
        raise SparseskinError(f"plot_forces: {fault}") from error

    n_columns = min(len(frames), MAX_COLUMNS)
    n_lines = -(-len(frames) // n_columns)
    aspect = n_rows / n_cols
    height_in = max(LEAST_IN, SIDE_IN * aspect * n_lines + 0.4)
    size_in = (SIDE_IN * n_columns + 0.8, height_in)
    figure, axes = plt.subplots(
        n_lines, n_columns, figsize=size_in, squeeze=False, layout="constrained"
    )
    maps = np.where(skin.exists, frames, np.float32(np.nan))
    # A frame without a force has a scale, too.
    largest = float(np.nanmax(maps)) or 1.0
    panels = list(axes.flat)
    for panel, frame in zip(panels, maps, strict=False):
        image = panel.imshow(frame, vmin=0.0, vmax=largest)
        panel.set(xticks=[], yticks=[])
    for panel, name in zip(panels, names, strict=False):
        panel.set_title(name)
    for panel in panels[len(frames) :]:
        panel.remove()
    del panels[len(frames) :]
    style = {"aspect": height_in / BAR_IN, "pad": 0.01}
    figure.colorbar(image, ax=panels, label=f"force in {unit}", **style)
    return panels


def _frames(forces: Floats) -> Floats:
    """The forces as (k, n_rows, n_cols); SparseskinError if they are none, or too many."""
    frames = real_floats(forces, "plot_forces: forces", SparseskinError)
    if frames.ndim == 2:
        frames = frames[np.newaxis]
    is_frames = frames.ndim == 3 and 1 <= len(frames) <= MAX_FRAMES
    if not is_frames or not (np.abs(frames) <= LARGEST).all():
        raise SparseskinError(
            f"plot_forces: forces of shape {np.shape(forces)}; allowed: shape (n_rows, n_cols), "
            f"or (k, n_rows, n_cols) with k = 1..{MAX_FRAMES}, within +-{LARGEST:g}"
        )
    return frames
