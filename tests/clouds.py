"""Skins of points for tests of the page: a torso, open above and below, pressed at a place."""

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import Floats

WIDTH_M, DEPTH_M, HEIGHT_M = 0.36, 0.22, 0.5


def torso(n_rows: int = 50, n_cols: int = 80, seed: int = 0) -> Floats:
    """A point of each cell around a torso, x to the front, z up: metres and outward normals."""
    rng = np.random.default_rng(seed)
    rows, cols = np.indices((n_rows, n_cols)).reshape(2, -1) + rng.uniform(0.3, 0.7, (2, 1))
    rows, cols = (each + rng.uniform(-0.2, 0.2, each.shape) for each in (rows, cols))
    angle = 2 * np.pi * cols / n_cols
    height = rows / n_rows
    # The shoulders close, the waist is narrower than the chest.
    wide = np.sqrt(np.clip(1 - (np.clip(height - 0.7, 0, 1) / 0.42) ** 2, 0, 1))
    wide *= 1 - 0.15 * np.cos(np.pi * np.clip(height - 0.3, -0.3, 0.4) / 0.4)
    x = DEPTH_M / 2 * wide * np.cos(angle)
    y = WIDTH_M / 2 * wide * np.sin(angle)
    z = HEIGHT_M * (height - 0.5)
    normals = np.stack([x / DEPTH_M**2, y / WIDTH_M**2, np.zeros_like(x)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[:, 2] = 1.2 * np.clip(height - 0.7, 0, 1) / 0.3
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.concatenate([np.stack([x, y, z], axis=1), normals], axis=1).astype(np.float32)


def pressed(
    points: Floats, at: tuple[float, float, float], peak_n: float, radius_m: float
) -> npt.NDArray[np.float32]:
    """Forces, float32 (n,): a cap of a peak at the point nearest to `at`, 0 beyond a radius."""
    nearest = np.argmin(np.linalg.norm(points[:, :3] - at, axis=1))
    distance = np.linalg.norm(points[:, :3] - points[nearest, :3], axis=1)
    return (peak_n * np.clip(1 - (distance / radius_m) ** 2, 0, 1)).astype(np.float32)
