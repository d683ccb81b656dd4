"""Which rows of W a matrix has, and how they rotate from frame to frame."""

import numpy as np
import pytest
from bags import launched, only
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.checks import check_phi
from sparseskin.launch.launchfile.load import load
from sparseskin.messages import Measurements, Reconstruction
from sparseskin.nodes.clock import ManualClock
from sparseskin.nodes.compressor.node import CompressorSettings
from sparseskin.nodes.compressor.phi.base import (
    KINDS,
    RANDOM,
    RULES,
    SUMS,
    Phi,
    block_of,
    make_phi,
)
from sparseskin.nodes.compressor.phi.rotation import row_subsets
from sparseskin.nodes.compressor.phi.sbhe import SbhePhi, least_m
from sparseskin.nodes.errors import PhiError
from sparseskin.nodes.node import Context
from sparseskin.nodes.reconstructor.limits import OTHER_ROWS
from sparseskin.nodes.reconstructor.node import Reconstructor

SIZES = st.integers(1, 700)
BLOCKS = st.sampled_from([1, 2, 4, 8, 32, 64, 256, 1024])
SEEDS = st.integers(0, 2**32 - 1)


def sbhe(n, m, seed=0, block=256, rule=SUMS):
    return make_phi("sbhe", n, m, seed, block, rule)


@given(
    n=SIZES,
    data=st.data(),
    block=BLOCKS,
    seed=SEEDS,
    kind=st.sampled_from(["sbhe", "local:5"]),
)
def test_compiled_loops_measure_the_same_bits(n, data, block, seed, kind):
    pytest.importorskip("numba")
    m = data.draw(st.integers(1, n))
    plain, compiled = (make_phi(kind, n, m, seed, block) for _ in range(2))
    compiled.compile_loops()
    for phi in (plain, compiled):
        phi.lay_out(np.ones((1, n), np.bool_))
    x = np.random.default_rng(seed).standard_normal(n, dtype=np.float32)
    y = np.random.default_rng(seed).standard_normal(m, dtype=np.float32)
    for one, other in zip(
        row_subsets(plain, None), row_subsets(compiled, None), strict=True
    ):
        assert other.forward(x).tobytes() == one.forward(x).tobytes()
        assert other.adjoint(y).tobytes() == one.adjoint(y).tobytes()
        assert other.fingerprint == one.fingerprint


def starts(phi):
    """The sum of each block is its first row."""
    return np.cumsum(phi.sizes) - phi.sizes


def numbers_of(phi, rows):
    """Number of rows of each block."""
    blocks = np.searchsorted(np.cumsum(phi.sizes), rows, side="right")
    return np.bincount(blocks, minlength=len(phi.sizes))


@given(n=SIZES, data=st.data(), block=BLOCKS, seed=SEEDS)
def test_fixed_rows_are_the_sums_and_others_in_proportion(n, data, block, seed):
    m = data.draw(st.integers(1, n))
    phi = sbhe(n, m, seed, block)
    assert phi.rows.size == m
    assert np.diff(phi.rows).min(initial=1) > 0
    assert 0 <= phi.rows[0] <= phi.rows[-1] < n
    held = np.isin(first := starts(phi), phi.rows)
    sizes = np.array(phi.sizes)
    if m < len(sizes):
        assert held.sum() == m
        assert sizes[held].min() >= sizes[~held].max()
        return
    assert held.all()
    others = numbers_of(phi, phi.rows) - 1
    of_block = (sizes - 1) / max(1, n - len(sizes))
    small = sizes <= min(32, max(sizes) - 1)
    assert (small | (others < (m - len(sizes)) * of_block + 1)).all()
    assert (
        others > (m - len(sizes) - np.log2(sizes).sum(where=small)) * of_block - 1
    ).all()
    columns = phi.dense()[
        :, phi.permutation[np.repeat(least_m(phi.sizes)[first] <= m, sizes)]
    ]
    # none is like another
    assert np.unique(columns.round(9), axis=1).shape == columns.shape
    check_phi(phi)


@given(n=SIZES, data=st.data(), block=BLOCKS, seed=SEEDS)
def test_row_subsets_have_a_sum_and_others_and_together_nearly_all(
    n, data, block, seed
):
    m = data.draw(st.integers(-(-n // 64), n))
    phi = sbhe(n, m, seed, block)
    sums = starts(phi)[np.equal(phi.sizes, max(phi.sizes))]
    special = [*sums, *(small := np.flatnonzero(least_m(phi.sizes) <= m * (m >= 64)))]
    others = numbers_of(phi, np.setdiff1d(np.arange(n), special))
    subsets = row_subsets(phi, "rotating")
    assert -(-n // m) <= len(subsets) <= 64
    times = np.zeros(n, dtype=np.intp)
    n_sums = []
    for phi in subsets:
        assert phi.rows.size == m
        assert np.diff(phi.rows).min(initial=1) > 0
        n_sums.append(np.isin(sums, phi.rows).sum())
        assert np.isin(small, phi.rows).all()
        held = numbers_of(phi, np.setdiff1d(phi.rows, special))
        assert (np.abs(held - held.sum() * others / max(1, others.sum())) < 1).all()
        times[phi.rows] += 1
    assert np.count_nonzero(times == 0) <= 0.01 * n
    assert np.delete(times, special).max(initial=0) <= 2
    assert max(n_sums) - min(n_sums) <= 1
    assert min(n_sums) >= 1 or n - small.size - sums.size > 64 * (m - small.size - 1)
    check_phi(phi)


@given(n=SIZES, data=st.data(), block=BLOCKS, rule=st.sampled_from(RULES))
def test_fewer_rows_of_one_seed_are_among_the_more(n, data, block, rule):
    few, many = sorted(data.draw(st.tuples(st.integers(1, n), st.integers(1, n))))
    phis = [sbhe(n, m, 3, block, rule) for m in (few, many)]
    np.testing.assert_array_equal(phis[0].permutation, phis[1].permutation)
    assert set(phis[0].rows) <= set(phis[1].rows)


def test_rows_of_the_paper_and_default_blocks():
    for rows in ("fixed", "rotating"):
        first = row_subsets(sbhe(96, 30, 7, 32, RANDOM), rows)[0]
        assert first.fingerprint == "443e07fb12311131"
    assert {block_of(kind, None) for kind in KINDS} == {256}
    assert block_of("local:8", None) == 32
    assert block_of("local:8", 64) == 64
    phi = make_phi("sbhe", 1600, 533, 0)
    of_paper = CompressorSettings(rows="paper").rows_and_m(1600)
    assert phi.block == 256
    assert phi.rule == SUMS
    assert of_paper == ("fixed", 533)


@pytest.mark.parametrize("kind", ["sbhe", "subsample"])
@pytest.mark.parametrize("ratio", [1, 5])
def test_together_the_row_subsets_hold_each_row_of_w_once(kind, ratio):
    n = 240
    subsets = row_subsets(make_phi(kind, n, n // ratio, seed=1, block=32), "rotating")
    whole = np.concatenate([phi.dense() for phi in subsets])
    np.testing.assert_allclose(whole @ whole.T, np.eye(n), atol=1e-12)


@pytest.mark.parametrize(
    ("stated", "expected"),
    [
        ({}, ("rotating", 534)),
        ({"ratio": 4.0}, ("rotating", 400)),
        ({"phi": "subsample"}, ("rotating", 534)),
        ({"phi": "row_local"}, ("rotating", 534)),
        # No row is left to rotate to.
        ({"m": 1600}, ("fixed", 1600)),
        # 64 row subsets are allowed.
        ({"m": 25}, ("rotating", 25)),
        ({"m": 24}, ("fixed", 24)),
        # Their rows do not rotate.
        ({"phi": "gaussian"}, ("fixed", 533)),
        ({"phi": f"{__name__}:Halves"}, ("rotating", 534)),
        ({"phi": f"{__name__}:Unmoved"}, ("fixed", 533)),
        ({"phi": f"{__name__}:by_function"}, ("fixed", 533)),
        # What is stated stays.
        ({"rows": "fixed"}, ("fixed", 533)),
        ({"rows": "rotating", "m": 1600}, ("rotating", 1600)),
    ],
)
def test_rows_rotate_by_default_where_they_can(stated, expected):
    assert CompressorSettings(**stated).rows_and_m(1600) == expected


class Halves(SbhePhi):
    """A matrix of the user's own whose rows rotate."""

    kind = f"{__name__}:Halves"


class Unmoved(Phi):
    """One whose rows do not."""

    kind = f"{__name__}:Unmoved"


def by_function(n, m, seed, block):
    """One that a function makes."""
    return make_phi("sbhe", n, m, seed, block)


def test_what_cannot_rotate_is_named():
    for kind in ("gaussian", "full"):
        with pytest.raises(
            PhiError, match=f'rows: "rotating" is not allowed for phi "{kind}"'
        ):
            CompressorSettings(phi=kind, rows="rotating").check()
        with pytest.raises(PhiError, match="allowed: sbhe, subsample"):
            row_subsets(make_phi(kind, 64, 64, seed=0), "rotating")
    with pytest.raises(
        PhiError, match="rows: 'turning' is not allowed; allowed: fixed, rotating"
    ):
        row_subsets(make_phi("sbhe", 64, 16, seed=0), "turning")
    with pytest.raises(
        PhiError, match=r"m = 24 of n = 1600; allowed: m of 25 or more \(N/64\)"
    ):
        row_subsets(make_phi("sbhe", 1600, 24, seed=0), "rotating")


FIXED = "compressor.rows=fixed"
ROTATING = "compressor.rows=rotating"


def graph(*overrides):
    return launched("path_40", *overrides)


def states_of(bus):
    """The skin and Phi that the reconstructor received before the first frame."""
    node = bus.hosts["reconstructor"].node
    return [node._skin, node._announced]


def test_row_subsets_alternate_and_each_frame_is_inverted_by_its_own_matrix():
    bus = graph("compressor.ratio=4")  # rows rotate by default
    frames = list(bus.frames(10))
    prints = [
        phi.fingerprint
        for phi in row_subsets(make_phi("sbhe", 1600, 400, 0), "rotating")
    ]
    assert [state.rows for state in states_of(bus)[1:]] == ["rotating"]
    for k, messages in enumerate(frames):
        assert only(messages, Measurements).phi == prints[k % 4]
        assert only(messages, Reconstruction).phi == prints[k % 4]
    assert bus.hosts["reconstructor"].counts.refused == {}
    assert bus.hosts["compressor"].node.status() == "sbhe 400 x 1600, rotating rows"
    assert bus.hosts["compressor"].node.state()["rows"] == "rotating"


def test_frames_that_are_lost_cost_themselves_alone():
    """Any frames may be missing: no other is refused, and none is inverted by a wrong matrix."""
    bus = graph(ROTATING)
    messages = [m for f in bus.frames(60) for m in f]
    settings = load("path_40", []).nodes["reconstructor"].settings
    node = Reconstructor(settings, Context("reconstructor", ManualClock(1)))
    lost = np.random.default_rng(0).random(60) < 0.4
    for state in states_of(bus):
        list(node.step(state))
    for k, measured in enumerate(m for m in messages if isinstance(m, Measurements)):
        if not lost[k]:
            (restored,) = node.step(measured)
            assert restored.phi == measured.phi
            assert restored.residual[0] < 0.05


def test_it_can_be_switched_on_and_off_while_the_graph_runs():
    bus = graph(FIXED)
    frames = []
    said = []
    for k, messages in enumerate(bus.frames(24)):
        frames.append([*said, *messages])
        changes = {
            5: {"rows": "rotating"},
            11: {"ratio": 8.0},
            14: {"rows": "fixed", "ratio": 3.0},
            17: {"rows": None},  # the default
            20: {"m": 1600},  # no row is left to rotate to
        }
        said = (
            bus._deliver(bus.hosts["compressor"].change(changes[k]))
            if k in changes
            else []
        )
    assert bus.hosts["reconstructor"].counts.refused == {}
    prints = [only(messages, Measurements).phi for messages in frames]
    assert [len(set(part)) for part in (prints[:6], prints[6:12], prints[12:15])] == [
        1,
        3,
        3,
    ]
    assert set(prints[15:18]) == {prints[0]}
    assert prints[18:21] == prints[6:9]
    assert len(set(prints[21:])) == 1
    assert all(
        only(m, Reconstruction).phi == p for m, p in zip(frames, prints, strict=True)
    )


@pytest.mark.parametrize(
    ("preset", "rows", "warned"),
    [
        ("paper", "rotating", True),
        ("paper", "paper", False),
        ("skin", "rotating", False),
    ],
)
def test_the_papers_method_with_other_rows_than_its_own_is_warned_of(
    preset, rows, warned
):
    bus = graph(f"reconstructor.preset={preset}", f"compressor.rows={rows}")
    list(bus.frames(1))
    assert (f"[reconstructor] {OTHER_ROWS}" in bus.lines) == warned


@pytest.mark.parametrize(
    ("rows", "some_doubted"),
    [(FIXED, False), (ROTATING, False), ("compressor.ratio=8", True)],
)
def test_an_untouched_skin_at_the_start_logs_no_doubt(rows, some_doubted):
    bus = graph(rows, "reconstructor.iterations=8")
    doubted = [
        not only(messages, Reconstruction).trusted[0] for messages in bus.frames(40)
    ]
    assert any(doubted) == some_doubted
    assert not [line for line in bus.lines if "not to be trusted" in line]
