"""Recordings whose messages hold several patches, read as those of single patches."""

import numpy as np
import pytest
from bags import N_COLS, N_ROWS, PHI, record, skin_state

from sparseskin import read_recording
from sparseskin.launch.commands.cli import main
from sparseskin.messages import Reconstruction, Taxels, decode
from sparseskin.nodes.errors import SparseskinError
from sparseskin.nodes.recorder.bag.patches import split_bag
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import BagWriter

NAMES = ("palm", "back", "sole")
N_FRAMES = 6
FORCES = np.random.default_rng(0).random(
    (N_FRAMES, 3, N_ROWS, N_COLS), dtype=np.float32
)
"""Of each frame and patch."""


def unchanged(k):
    """Of patch 1 every second frame is unchanged."""
    return (False, k % 2 == 1, False)


def reconstructed(k):
    solved = {"iterations": (k,) * 3, "residual": (0.5,) * 3, "solve_ns": (7,) * 3}
    solved |= {"error": (0.25, None, None), "trusted": (True, True, False)}
    return Reconstruction(
        **{
            "stamp_ns": k,
            "patch": "body",
            "names": NAMES,
            "seq": k,
            "done_ns": k + 5,
            "phi": PHI,
        },
        **{
            "forces": FORCES[k][~np.array(unchanged(k))],
            "unchanged": unchanged(k),
            **solved,
        },
    )


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "body.mcap"
    with BagWriter(path, {}) as writer:
        record(writer, skin_state("body"))
        for k in range(N_FRAMES):
            record(
                writer, Taxels(stamp_ns=k, patch="body", names=NAMES, forces=FORCES[k])
            )
            record(writer, reconstructed(k))
        writer.close({})
    return path


def test_messages_are_those_of_the_patches_with_what_is_unchanged(bag):
    with BagReader(bag) as whole:
        split = split_bag(whole)
        assert list(split.topics) == [
            f"/{name}/{schema}"
            for name in sorted(NAMES)
            for schema in ("reconstruction", "skin", "taxels")
        ]
        for p, name in enumerate(NAMES):
            topic = f"/{name}/reconstruction"
            assert split.topics[topic].n_messages == N_FRAMES
            found = [
                decode(m.topic.encode(), m.payload) for m in split.messages([topic])
            ]
            for k, message in enumerate(found):
                same = unchanged(k)[p]
                np.testing.assert_array_equal(message.forces[0], FORCES[k - same, p])
                assert message.stamp_ns == k
                assert message.error == (None if p else 0.25,)
                assert message.trusted == (p != 2,)
                assert message.unchanged == (same,)
        # A part of the time begins with the forces of the message before it.
        first = next(split.messages(["/back/reconstruction"], start_ns=3))
        message = decode(first.topic.encode(), first.payload)
        np.testing.assert_array_equal(message.forces[0], FORCES[2, 1])
        (state,) = split.messages(["/sole/skin"])
        assert decode(state.topic.encode(), state.payload).patch == "sole"


def test_exports_are_of_each_patch(bag, tmp_path, capsys):
    assert main(["recording", "export", str(bag), "--to", "npz"]) == 0
    assert main(["recording", "export", str(bag), "--to", "csv"]) == 0
    for p, name in enumerate(NAMES):
        with np.load(tmp_path / f"body_{name}.npz") as held:
            np.testing.assert_array_equal(held["forces"], FORCES[:, p])
            assert held["f_max"] == 2.5
        assert (tmp_path / "body_csv" / f"{name}_taxels.csv").is_file()
        np.testing.assert_array_equal(read_recording(bag, name)["forces"], FORCES[:, p])
    with pytest.raises(
        SparseskinError, match="has patches back, palm, sole: state one of them"
    ):
        read_recording(bag)
