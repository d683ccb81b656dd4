"""The command `sparseskin learn-basis`: a basis from a recording of one's own skin."""

from __future__ import annotations

import argparse
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from tqdm import tqdm

from sparseskin.messages import SkinState, Taxels, Truth
from sparseskin.messages.topics import split_topic
from sparseskin.nodes.compressor.phi.acts import force_threshold
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.reconstructor.bases.learned import (
    KEPT_FRACTION,
    MAX_ROUNDS,
    NoWindowError,
    draw_windows,
    fingerprint_of_atoms,
    learn_atoms,
)
from sparseskin.nodes.recorder.bag.frames import decoded, skin_of
from sparseskin.nodes.recorder.bag.reader import BagReader

SUFFIX = ".npz"
FRAMES = 500
FILE_VERSION = 1


class LearningError(SparseskinError):
    """A recording from which no basis can be learned."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `learn-basis`."""
    parser.description = (
        "Learn an orthonormal basis in which the frames of a recording are sparse, "
        "tile by tile; a launch file names it as basis = 'learned:B.npz'."
    )
    parser.add_argument("bag", metavar="REC.mcap", type=Path, help="recording")
    about = "file to write, a new one"
    parser.add_argument("--out", metavar="B.npz", type=Path, required=True, help=about)
    about = "side of a tile, taxels (default: 8)"
    parser.add_argument("--tile", metavar="T", type=int, default=8, help=about)
    about = "topic to learn from (default: the truth where there is one, else taxels)"
    parser.add_argument("--topic", help=about)
    about = f"how many frames, evenly spaced over the recording (default: {FRAMES})"
    parser.add_argument("--frames", metavar="K", type=int, default=FRAMES, help=about)
    parser.add_argument("--seed", type=int, default=0, help="which windows are drawn (default: 0)")
    parser.set_defaults(run=_learn_basis)


def _learn_basis(arguments: argparse.Namespace) -> int:
    out: Path = arguments.out
    if out.suffix != SUFFIX:
        raise SettingsError(f"--out {out}: expected a name that ends in {SUFFIX}")
    for name, value, low in (("--frames", arguments.frames, 1), ("--seed", arguments.seed, 0)):
        if value < low:
            raise SettingsError(f"{name} {value}: expected a whole number, {low} or more")
    with whole_file(out) as draft:
        held = learned_from(
            arguments.bag, arguments.topic, arguments.tile, arguments.frames, arguments.seed
        )
        np.savez(draft, **held)
    n_windows, topic = int(held["n_windows"]), str(held["topic"])
    print(f"{out}: {fingerprint_of_atoms(held['atoms'])}, from {n_windows} windows of {topic}")
    return 0


def learned_from(
    path: Path, topic: str | None, tile: int, n_frames: int, seed: int
) -> dict[str, Any]:
    """Arrays of a file of `learn-basis`: `atoms`, float64 (tile * tile, tile * tile), and facts.

    Parameters
    ----------
    topic : str or None
        Topic of frames of forces; None: truth, where there is exactly one, else taxels.
    tile : int
        Side of a tile, taxels.
    n_frames : int
        Number of frames, evenly spaced over the recording, 1 or more.

    Raises
    ------
    SparseskinError
        If the recording cannot be read, has no such frames, too few with a force in them, or its
        frames do not fit the tile.
    """
    with BagReader(path) as bag:
        chosen = topic or _topic(bag)
        state = skin_of(bag, split_topic(chosen)[0]) if chosen in bag.topics else None
        frames = _frames(bag, chosen, n_frames)
        n_recorded = bag.topics[chosen].n_messages
    f_max, is_read = _range(frames, state), chosen.endswith(f"/{Taxels.schema}")
    threshold = force_threshold(state.sigma_end if state and is_read else 0.0, f_max)
    try:
        mask = None if state is None else state.mask
        windows = draw_windows(frames, mask, tile, threshold, np.random.default_rng(seed))
    except NoWindowError as error:
        in_contact = any(frame.max() > threshold for frame in frames)
        few = _too_few(frames, threshold, tile, 0, n_recorded)
        why = f"{error}; try a smaller --tile" if in_contact else few
        raise LearningError(f"{path}: {chosen}: {why}") from error
    except SparseskinError as error:
        raise LearningError(f"{path}: {chosen}: {error}") from error
    if len(windows) < tile * tile:
        few = _too_few(frames, threshold, tile, len(windows), n_recorded)
        raise LearningError(f"{path}: {chosen}: {few}")
    with tqdm(total=MAX_ROUNDS, desc="learn", unit="round", disable=None, leave=False) as bar:
        atoms = learn_atoms(windows, KEPT_FRACTION * f_max, bar.update)
    n_rows, n_cols = frames[0].shape
    facts = {
        "tile": tile,
        "n_rows": n_rows,
        "n_cols": n_cols,
        "seed": seed,
        "n_windows": len(windows),
        "topic": chosen,
        "source": path.name,
        "file_version": FILE_VERSION,
        "sparseskin": version("sparseskin"),
    }
    return {"atoms": atoms} | {name: np.asarray(value) for name, value in facts.items()}


def _too_few(
    frames: list[npt.NDArray[np.float32]],
    threshold: float,
    tile: int,
    n_windows: int,
    n_recorded: int,
) -> str:
    """The line for too few windows: frames in contact, windows, the needed number, a remedy."""
    n_contact = sum(bool(frame.max() > threshold) for frame in frames)
    more = "" if len(frames) == n_recorded else f", or look at all: --frames {n_recorded}"
    return (
        f"{n_contact} of {len(frames)} frames are in contact (a force above {threshold:g}) "
        f"and give {n_windows} windows of {tile} x {tile} taxels; needed: {tile**2} windows, "
        f"of 1 to {tile**2} frames in contact. Press the skin and record longer: "
        f"sparseskin launch NAME --record F.mcap{more}"
    )


def _topic(bag: BagReader) -> str:
    """The topic of the truth where there is one, else of the taxels."""
    for schema in (Truth.schema, Taxels.schema):
        found = [t for t, info in bag.topics.items() if info.schema == schema and info.n_messages]
        if len(found) > 1:
            raise LearningError(f"{bag.path}: --topic: which of {', '.join(found)}?")
        if found:
            return found[0]
    raise LearningError(f"{bag.path}: holds no frames of truth or taxels")


def _frames(bag: BagReader, topic: str, n_frames: int) -> list[npt.NDArray[np.float32]]:
    recorded = bag.messages([topic])
    info = bag.topics[topic]
    if info.schema not in (Truth.schema, Taxels.schema) or not info.n_messages:
        raise LearningError(f"{bag.path}: {topic} holds no frames of truth or taxels")
    wanted = set(np.linspace(0, info.n_messages - 1, n_frames).astype(int).tolist())
    frames = []
    for k, one in enumerate(tqdm(recorded, total=info.n_messages, disable=None, leave=False)):
        message = decoded(bag, one) if k in wanted else None
        if isinstance(message, Truth | Taxels):
            frames.append(message.forces)
    if any(frame.shape != frames[0].shape for frame in frames):
        raise LearningError(f"{bag.path}: {topic}: the size of the frames changes")
    return frames


def _range(frames: list[npt.NDArray[np.float32]], state: SkinState | None) -> float:
    """Upper end of the range; of a recording that does not state it, the highest force."""
    return max(float(max(frame.max() for frame in frames)), 1e-6) if state is None else state.f_max
