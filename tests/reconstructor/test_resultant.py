"""Total force and centre of pressure are told before the frame, and how far they may be off."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from reconstructor.pressed import noisy, sliding_disc
from reconstructor.test_row_watch import SHAPE, Desk, N

from sparseskin.messages import FieldError, Reconstruction, Resultant
from sparseskin.nodes.compressor.phi import make_phi
from sparseskin.nodes.errors import SettingsError
from sparseskin.nodes.reconstructor.node import ReconstructorSettings
from sparseskin.studies.targets_bands import banded

Floats = npt.NDArray[np.float32]


def told(truth: Floats) -> list[Resultant]:
    phi = make_phi("sbhe", N, N // 3, seed=0)
    desk = Desk(phi, preset="skin", resultant=True)
    found = desk.messages(phi.forward(noisy(truth).reshape(-1, N)))
    order = [type(message) for message in found]
    assert order == [Resultant, Reconstruction] * len(truth)
    stamps = [message.stamp_ns for message in found]
    assert stamps[::2] == stamps[1::2]
    return [message for message in found if isinstance(message, Resultant)]


def test_total_and_centre_of_a_sliding_disc_are_within_their_bands() -> None:
    truth = sliding_disc(SHAPE, 80, touch_at=20)
    rows, cols = np.indices(SHAPE)
    off = []
    for frame, one in list(zip(truth, told(truth), strict=True))[30:]:
        total = float(frame.sum())
        assert one.row is not None
        assert one.col is not None
        assert one.row_sd is not None
        assert one.col_sd is not None
        off.append(abs(one.total - total) / one.total_sd)
        off.append(abs(one.row - (rows * frame).sum() / total) / one.row_sd)
        off.append(abs(one.col - (cols * frame).sum() / total) / one.col_sd)
        assert abs(one.total - total) < 0.03 * total
        assert abs(one.col - (cols * frame).sum() / total) < 0.2
    assert np.mean(np.array(off) < 1.645) > 0.8


def test_the_first_frame_of_a_contact_is_told_at_once() -> None:
    truth = sliding_disc(SHAPE, 21, touch_at=20, peak_n=2.0)
    one = told(truth)[-1]
    total = float(truth[-1].sum())
    assert one.total == pytest.approx(total, abs=3 * one.total_sd)
    assert one.total_sd < 0.3 * total
    assert one.row == pytest.approx(SHAPE[0] / 2, abs=3)


@pytest.mark.parametrize(
    ("scene", "rows", "told_of"),
    [("random 5", "rotating", ("row", "col")), ("random 7", "fixed", ("total",))],
)
def test_bands_hold_in_taps_and_where_most_rows_are_never_read(
    scene: str, rows: str, told_of: tuple[str, ...]
) -> None:
    # A tap's centre is told of its first frames, too; fixed rows leave parts of the sum unseen.
    point = {"scene": scene, "ratio": 8, "rows": rows, "n_frames": 300, "seed": 1}
    found = banded(point)
    assert min(found[name] for name in told_of) > 0.85


def test_an_untouched_skin_has_no_centre_and_next_to_no_force() -> None:
    for one in told(np.zeros((40, *SHAPE), np.float32))[20:]:
        assert one.row is None
        assert one.total <= 2 * one.total_sd
        assert one.total < 1.0


def test_a_solver_that_leaves_a_bias_has_no_resultant() -> None:
    with pytest.raises(SettingsError, match="resultant: is not told with solver fista"):
        ReconstructorSettings(preset="paper", resultant=True).check()


def test_a_centre_is_told_whole_or_not_at_all() -> None:
    with pytest.raises(FieldError, match="expected all of them or none"):
        Resultant(stamp_ns=0, patch="skin", total=1.0, total_sd=0.1, row=3.0, done_ns=0)
