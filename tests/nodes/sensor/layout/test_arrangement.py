"""Numbers of an item become the taxels of a frame."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sparseskin.nodes.errors import SettingsError, SourceError
from sparseskin.nodes.sensor.layout.arrangement import Axis, arrange, shapes_of
from sparseskin.nodes.sensor.layout.layout import Layout, UnstatedError

SIDES = st.integers(1, 5)


def numbered(n_rows, n_cols):
    """Readings that name their place: 100 row + column + 1."""
    return np.add.outer(100 * np.arange(n_rows), np.arange(n_cols)) + 1


def arranged(layout, axes, numbers, usable=None):
    return arrange(layout, axes, "f", usable).frames(np.asarray(numbers)[None])[0]


@given(SIDES, SIDES, st.data())
def test_names_with_rows_and_columns_give_the_grid_in_any_order(n_rows, n_cols, data):
    form = data.draw(
        st.sampled_from(
            ["r{r}c{c}", "c{c}_r{r}", "x{c}y{r}", "row{r}_col{c}", "s1_r{r}_c{c}"]
        )
    )
    base = data.draw(st.integers(0, 1))
    places = [(r, c) for r in range(n_rows) for c in range(n_cols)]
    places = data.draw(st.permutations(places))
    names = tuple(form.format(r=r + base, c=c + base) for r, c in places)
    grid = numbered(n_rows, n_cols)
    numbers = [grid[place] for place in places]
    layout = Layout(n_rows=n_rows, n_cols=n_cols)
    found = arranged(layout, [Axis(len(names), "", names)], numbers)
    np.testing.assert_array_equal(found, grid)


@given(SIDES, SIDES, st.sampled_from(["xyz", "zyx", "yzx"]), st.booleans(), st.data())
def test_of_three_axes_per_taxel_the_normal_one_is_read(
    n_rows, n_cols, letters, apart, data
):
    form = data.draw(
        st.sampled_from(["p{k}_{a}", "{a}_{k}", "taxels[{k}].{a}", "f{a}{k}"])
    )
    n = n_rows * n_cols
    cells = [(k, a) for k in range(n) for a in letters]
    if apart:
        cells = [(k, a) for a in letters for k in range(n)]
    names = tuple(form.format(k=k, a=a) for k, a in cells)
    numbers = [1000 * letters.index(a) + k for k, a in cells]
    axes = [Axis(len(names), "", names)]
    for channel in ("", *letters):
        layout = Layout(n_rows=n_rows, n_cols=n_cols, channel=channel)
        expected = np.arange(n) + 1000 * letters.index(channel or "z")
        np.testing.assert_array_equal(arranged(layout, axes, numbers).ravel(), expected)


@given(st.integers(1, 12), st.sampled_from(["x", "y", "z", "X", "Z"]))
def test_of_stated_columns_those_of_the_stated_channel_are_read(n, channel):
    names = tuple(f"{letter}{k}" for letter in "xyz" for k in range(n))
    layout = Layout(n_rows=1, n_cols=n, columns=",".join(names), channel=channel)
    frame = arranged(layout, [Axis(3 * n, "", names)], np.arange(3 * n))
    np.testing.assert_array_equal(
        frame.ravel(), n * "xyz".index(channel.lower()) + np.arange(n)
    )


@pytest.mark.parametrize(
    ("names", "columns", "may_be_others"),
    [
        (("s0", "s1", "s2", "s3"), "", False),
        (("a", "b", "c", "d"), "a,b,c,d", False),
        (("a", "b", "c", "d"), "", True),
    ],
)
def test_columns_are_asked_for_where_neither_names_nor_the_user_state_them(
    names, columns, may_be_others
):
    with pytest.raises(UnstatedError) as refusal:
        arranged(Layout(columns=columns), [Axis(4, "", names)], np.zeros(4))
    assert ("or columns if" in str(refusal.value)) == may_be_others


@given(SIDES, SIDES, st.data())
def test_names_are_ordered_by_their_numbers(n_rows, n_cols, data):
    n = n_rows * n_cols
    numbers = data.draw(st.permutations(range(n)))
    names = tuple(f"s{k}" for k in numbers)
    layout = Layout(n_rows=n_rows, n_cols=n_cols)
    found = arranged(layout, [Axis(n, "", names)], numbers)
    np.testing.assert_array_equal(found.ravel(), range(n))


@given(SIDES, SIDES, st.data())
def test_order_and_permutations_are_undone(n_rows, n_cols, data):
    grid = numbered(n_rows, n_cols)
    rows = data.draw(st.permutations(range(n_rows)))
    cols = data.draw(st.permutations(range(n_cols)))
    order = data.draw(st.sampled_from(["rows", "columns"]))
    sent = grid[np.ix_(rows, cols)]
    layout = Layout(
        n_rows=n_rows,
        n_cols=n_cols,
        order=order,
        row_order=",".join(map(str, rows)),
        col_order=",".join(map(str, cols)),
    )
    flat = (sent if order == "rows" else sent.T).ravel()
    np.testing.assert_array_equal(arranged(layout, [Axis(flat.size)], flat), grid)


@given(SIDES, SIDES, st.data())
def test_labels_of_axes_state_rows_columns_and_channel(n_rows, n_cols, data):
    sides = {"rows": n_rows, "cols": n_cols, "xyz": 3}
    labels = data.draw(st.permutations(list(sides)))
    values = np.zeros([sides[label] for label in labels])
    order = [labels.index(label) for label in ("rows", "cols", "xyz")]
    channels = np.moveaxis(values, order, (0, 1, 2))
    channels[..., 2] = numbered(n_rows, n_cols)
    axes = [Axis(sides[label], label) for label in labels]
    layout = Layout(n_rows=n_rows, n_cols=n_cols)
    np.testing.assert_array_equal(
        arranged(layout, axes, values), numbered(n_rows, n_cols)
    )


@pytest.mark.parametrize(
    ("stated", "axes", "usable", "message"),
    [
        (
            {},
            [Axis(6)],
            None,
            "shape is not stated: state n_rows and n_cols, 3 x 2, 2 x 3, 1 x 6",
        ),
        (
            {"n_rows": 4},
            [Axis(6)],
            None,
            "4 x 1 needs 4",
        ),
        ({"n_rows": 3}, [Axis(4), Axis(3)], None, "n_rows = 3 is stated, .* have 4"),
        (
            {},
            [Axis(4), Axis(3), Axis(3)],
            None,
            "each axis of 4 x 3 x 3 is, is not stated: state axes=rows,cols,channel or",
        ),
        (
            {"row_order": "0,0"},
            [Axis(2), Axis(2)],
            None,
            "row_order: '0,0' is not allowed",
        ),
        (
            {"columns": "q*"},
            [Axis(2, "", ("a", "b"))],
            None,
            "'q.' is none of 2 columns",
        ),
        (
            {"n_rows": 1, "n_cols": 3},
            [Axis(4, "", ("a", "b", "c", "d"))],
            None,
            "needs 3; state",
        ),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(stated, axes, usable, message):
    with pytest.raises(SourceError, match=message):
        arrange(Layout(**stated), axes, "f", usable)


def test_two_families_of_names_are_both_named():
    names = (*(f"a{k}" for k in range(4)), *(f"b{k}" for k in range(4)))
    layout = Layout(n_rows=2, n_cols=2)
    with pytest.raises(UnstatedError) as caught:
        arrange(layout, [Axis(8, "", names)], "f")
    assert [option["columns"] for option in caught.value.options] == ["1-4", "5-8"]


@given(st.integers(1, 4096))
def test_shapes_that_are_named_have_that_many_taxels(n):
    shapes = shapes_of(n).removesuffix(" or another")
    for shape in shapes.replace(" or ", ", ").split(", "):
        n_rows, n_cols = map(int, shape.split(" x "))
        assert n_rows * n_cols == n


@pytest.mark.parametrize(
    "stated", [{"axes": "rows,colums"}, {"channel": "-z"}, {"order": "z"}]
)
def test_a_layout_checks_its_values(stated):
    with pytest.raises(SettingsError, match=next(iter(stated))):
        Layout(**stated)
