"""What a table states of itself beside its numbers: skins, rates, times, lines that are taxels."""

import json

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sparseskin.nodes.errors import SourceError
from sparseskin.nodes.sensor.files.file_source import open_file
from sparseskin.nodes.sensor.layout.layout import Layout

FORGIVING = settings(
    suppress_health_check=[HealthCheck.function_scoped_fixture],
    deadline=None,
    max_examples=30,
)
RATE_LINES = ["Rate: {} Hz", "# fs = {}", "sample_rate,{}", "Frame rate\t{}"]
RATE_LINES += ["Sampling frequency (Hz): {}"]
SIDES = st.tuples(st.integers(1, 3), st.integers(2, 4))


def read(folder, text, shape, **stated):
    (folder / "log.csv").write_bytes(text.encode())
    n_rows, n_cols = shape
    return open_file(
        folder / "log.csv",
        Layout(unit="counts", n_rows=n_rows, n_cols=n_cols, **stated),
    )


def readings_of(n_frames, shape, seed):
    """Frames of whole numbers, (n_frames, n_rows, n_cols), that neither rise nor count."""
    frames = np.random.default_rng(seed).integers(1, 900, (n_frames, *shape))
    frames[-1] = frames[0] - 1
    return frames


def lines_of(frames):
    return [",".join(map(str, frame.ravel())) for frame in frames]


@FORGIVING
@given(
    shape=SIDES,
    n_skins=st.integers(2, 4),
    kind=st.sampled_from(["no names", "texts", "port", "id"]),
    seed=st.integers(0, 1000),
)
def test_skins_that_take_turns_are_never_one(tmp_path, shape, n_skins, kind, seed):
    frames = readings_of(4 * n_skins, shape, seed)
    skins = [str(k) if kind == "id" else f"COM{k}" for k in range(n_skins)]
    lines = [f"{skins[k % n_skins]},{line}" for k, line in enumerate(lines_of(frames))]
    if kind != "no names":
        names = ",".join(f"s{k}" for k in range(frames[0].size))
        lines.insert(0, f"{kind},{names}")
    text = "\n".join(lines) + "\n"
    with pytest.raises(SourceError, match="state frame_id"):
        read(tmp_path, text, shape)
    for k, skin in enumerate(skins):
        source = read(tmp_path, text, shape, frame_id=skin)
        np.testing.assert_array_equal(source.frames, frames[k::n_skins])


@FORGIVING
@given(shape=SIDES, seed=st.integers(0, 1000))
def test_lines_that_are_named_as_taxels_are_asked_for(tmp_path, shape, seed):
    n_taxels = shape[0] * shape[1]
    frames = readings_of(n_taxels, shape, seed)
    of_taxels = frames.reshape(-1, n_taxels).T
    lines = [f"s{k},{','.join(map(str, taxel))}" for k, taxel in enumerate(of_taxels)]
    text = "\n".join(lines) + "\n"
    with pytest.raises(SourceError, match=r"add axes=taxels,frames$"):
        read(tmp_path, text, shape)
    source = read(tmp_path, text, shape, axes="taxels,frames")
    np.testing.assert_array_equal(source.frames, frames)


@FORGIVING
@given(
    rate_hz=st.integers(1, 500),
    line=st.sampled_from(RATE_LINES),
)
def test_a_rate_before_the_table_is_that_of_its_frames(tmp_path, rate_hz, line):
    frames = readings_of(5, (1, 3), rate_hz)
    text = "\n".join([line.format(rate_hz), "s0,s1,s2", *lines_of(frames)])
    source = read(tmp_path, text + "\n", (1, 3))
    assert source.rate_hz == rate_hz
    np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(5) / rate_hz, atol=1e-9)


@pytest.mark.parametrize(
    ("line", "rate_hz"),
    [
        ("SECONDS_PER_FRAME 0.02", 50),
        ("Sample interval: 4 ms", 250),
        ("Baud rate: 115200", None),
        ("Heart rate: 72", None),
    ],
)
def test_lines_before_the_table_are_no_rates_of_others(tmp_path, line, rate_hz):
    text = "\n".join([line, "s0,s1,s2", *lines_of(readings_of(5, (1, 3), 0))])
    assert read(tmp_path, text + "\n", (1, 3)).rate_hz == rate_hz


@pytest.mark.parametrize(
    "title", ["# t={}", "Frame {} (20 ms)", "Time: 0.0{}", "10:15:02.{}"]
)
def test_times_between_the_frames_of_a_grid_are_not_lost(tmp_path, title):
    frames = readings_of(3, (2, 3), 0)
    parts = [
        "\n".join([title.format(k), *lines_of(rows)]) for k, rows in enumerate(frames)
    ]
    text = "\n".join(parts) + "\n"
    with pytest.raises(
        SourceError, match="states a time, which is not read; state rate_hz"
    ):
        read(tmp_path, text, (2, 3))
    source = read(tmp_path, text, (2, 3), rate_hz=50)
    np.testing.assert_array_equal(source.frames, frames)


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 3), st.integers(2, 4)), first=st.sampled_from([0, 1])
)
def test_names_that_count_columns_are_no_frame(tmp_path, shape, first):
    frames = readings_of(5, shape, first)
    names = ",".join(map(str, range(first, first + frames[0].size)))
    text = "\n".join([names, *lines_of(frames)]) + "\n"
    np.testing.assert_array_equal(read(tmp_path, text, shape).frames, frames)
    # As pandas writes a table, with a column that counts its lines.
    numbered = [f"{k},{line}" for k, line in enumerate(lines_of(frames))]
    text = "\n".join([f",{names}", *numbered]) + "\n"
    np.testing.assert_array_equal(read(tmp_path, text, shape).frames, frames)


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 3), st.integers(2, 4)),
    begin=st.integers(0, 1),
    is_pattern=st.booleans(),
    data=st.data(),
)
def test_names_that_count_columns_in_any_order_are_no_frame(
    tmp_path, shape, begin, is_pattern, data
):
    n_taxels = shape[0] * shape[1]
    order = data.draw(st.permutations(range(n_taxels)))
    frames = readings_of(5, shape, begin)
    if is_pattern:
        # Frames that count on are no names.
        steps = np.arange(begin, 5 * n_taxels + begin)
        frames = steps.reshape(5, *shape)
        lines = lines_of(frames.reshape(5, -1)[:, order])
        found = read(tmp_path, "\n".join(lines) + "\n", shape).frames
        np.testing.assert_array_equal(
            found.reshape(5, -1), frames.reshape(5, -1)[:, order]
        )
        return
    names = ",".join(str(k + begin) for k in order)
    text = "\n".join([names, *lines_of(frames.reshape(5, -1)[:, order])]) + "\n"
    np.testing.assert_array_equal(read(tmp_path, text, shape).frames, frames)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[
            ("fs", 50),
            ("Fs", 50),
            ("sampleRate", 50),
            ("FPS", 50.0),
            ("frame_rate_hz", 50),
        ],
        *[
            ("dt", 0.02),
            ("Ts", 0.02),
            ("sample_interval_ms", 20),
            ("frame_period_s", 0.02),
        ],
    ],
)
def test_a_number_beside_an_array_states_its_rate(tmp_path, name, value):
    path = tmp_path / "a.npz"
    np.savez(path, forces=np.ones((5, 4, 3)), **{name: value})
    assert open_file(path).rate_hz == pytest.approx(50)


def test_hexadecimal_numbers_are_not_read_as_decimal_ones(tmp_path):
    text = "04 11 09 00\n07 1F 22 10\n00 10 30 40\n"
    with pytest.raises(
        SourceError, match="line 2, column 2: '1F' is not a number, but may be"
    ):
        read(tmp_path, text, (2, 2))
    source = read(tmp_path, text, (2, 2), missing="1F")
    assert np.isnan(source.frames[1, 0, 1])


@FORGIVING
@given(
    shape=SIDES,
    form=st.sampled_from(["list", "grid", "names", "pairs", "log"]),
    encoding=st.sampled_from(["utf-8", "utf-16", "utf-8-sig"]),
    seed=st.integers(0, 1000),
)
def test_lines_that_name_their_values_are_frames(tmp_path, shape, form, encoding, seed):
    frames = readings_of(6, shape, seed)
    lines = []
    for k, frame in enumerate(frames.tolist()):
        flat = [reading for row in frame for reading in row]
        named = {f"s{at}": reading for at, reading in enumerate(flat)}
        time = {"time_s": k / 50}
        contents = {"list": time | {"data": flat}, "grid": time | {"data": frame}}
        pairs = " ".join(f"{name}={value}" for name, value in (time | named).items())
        clock = f"10:15:02.{20 * k:03d} -> "
        arrows = clock + ",".join(f"{name}:{value}" for name, value in named.items())
        texts = {"names": json.dumps(time | named), "pairs": pairs, "log": arrows}
        lines.append(texts.get(form) or json.dumps(contents[form]))
    path = tmp_path / "log.jsonl"
    path.write_bytes("\n".join(lines).encode(encoding))
    n_rows, n_cols = shape
    layout = Layout(unit="counts", n_rows=n_rows, n_cols=n_cols)
    source = open_file(path, layout)
    np.testing.assert_array_equal(source.frames, frames)
    np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(6) / 50, atol=1e-9)


@FORGIVING
@given(
    shape=SIDES,
    pitch=st.sampled_from(["0.5", "2.0", "1.25"]),
    decimals=st.sampled_from([0, 3]),
    seed=st.integers(0, 1000),
)
def test_positions_above_the_columns_are_no_frame(
    tmp_path, shape, pitch, decimals, seed
):
    frames = readings_of(6, shape, seed).reshape(6, -1)
    n_digits = len(pitch.partition(".")[2])
    places = [f"{k * float(pitch):.{n_digits}f}" for k in range(frames.shape[1])]
    rows = [[f"{reading:.{decimals}f}" for reading in frame] for frame in frames]
    text = "\n".join(",".join(row) for row in [places, *rows]) + "\n"
    if decimals and len(places) < 4:
        return  # nothing tells so few numbers from readings
    np.testing.assert_array_equal(
        read(tmp_path, text, shape).frames.reshape(6, -1), frames
    )


def test_a_column_that_counts_may_be_the_times(tmp_path):
    frames = readings_of(5, (1, 3), 0)
    lines = [f"{k},{line}" for k, line in enumerate(lines_of(frames))]
    text = "\n".join(lines) + "\n"
    with pytest.raises(SourceError, match=r"state time=none or time=first$"):
        read(tmp_path, text, (1, 3))
    for stated, period_s in (({"time": "none"}, 0.01), ({"time": "first"}, 1)):
        source = read(tmp_path, text, (1, 3), time_unit="s", **stated)
        np.testing.assert_array_equal(source.frames, frames)
        np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(5) * period_s)


@pytest.mark.parametrize("end", ["first", "last"])
def test_a_first_frame_at_a_whole_time_is_a_frame(tmp_path, end):
    frames = readings_of(6, (1, 3), 1)
    frames[0] = [[20, 30, 45]]
    lines = []
    for k, line in enumerate(lines_of(frames)):
        time = f"{10 + 50 * (end == 'last') + k / 8:g}"
        cells = [time, line] if end == "first" else [line, time]
        lines.append(",".join(cells))
    source = read(tmp_path, "\n".join(lines) + "\n", (1, 3), time=end, time_unit="s")
    np.testing.assert_array_equal(source.frames, frames)


def test_a_first_line_that_rises_alone_is_asked_about(tmp_path):
    frames = readings_of(6, (2, 4), 1)
    frames[0] = [[1, 2, 4, 8], [16, 32, 64, 128]]
    text = "\n".join(lines_of(frames)) + "\n"
    with pytest.raises(SourceError, match="line 1 rises, as none below: state skip"):
        read(tmp_path, text, (2, 4))
    source = read(tmp_path, text, (2, 4), axes="frames,taxels")
    np.testing.assert_array_equal(source.frames, frames)
    source = read(tmp_path, text, (2, 4), skip=1)
    np.testing.assert_array_equal(source.frames, frames[1:])


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 3), st.integers(2, 4)),
    levels=st.sampled_from(["words", "numbers", "texts", "merged"]),
    index=st.sampled_from(["", "time", "none"]),
    seed=st.integers(0, 1000),
)
def test_names_in_two_lines_are_no_frame(tmp_path, shape, levels, index, seed):
    frames = readings_of(6, shape, seed)
    n_rows, n_cols = shape
    has_index = index != "none"
    tops = [[], []]
    for row in range(n_rows):
        for col in range(n_cols):
            is_merged = levels == "merged" and col > 0
            finger = ["thumb", "ring", "palm"][row]
            tops[0].append("" if is_merged else finger)
            tops[1].append(f"s{col}" if levels == "texts" else str(col))
            if levels in ("words", "numbers"):
                tops[0][-1] = str(row)
    if levels == "numbers" and not has_index:
        return  # numbers alone are no names without an index
    named = levels == "words"
    lines = [",".join(line) for line in tops]
    if has_index:
        ends = ("row", "col") if named else ("", "")
        lines = [f"{end},{line}" for end, line in zip(ends, lines, strict=True)]
    elif named:
        return
    if index == "time":
        lines.append("time" + "," * frames[0].size)
    for k, line in enumerate(lines_of(frames)):
        begin = {"": f"{k},", "time": f"{k / 50},", "none": ""}[index]
        lines.append(begin + line)
    source = read(tmp_path, "\n".join(lines) + "\n", shape)
    np.testing.assert_array_equal(source.frames, frames)
    rate_hz = 50 if index == "time" else 100
    np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(6) / rate_hz)


@FORGIVING
@given(
    shape=SIDES,
    words=st.lists(
        st.sampled_from(["Mean", "max", "Min:", "Std. Dev.", "Total", "25%", "AVG"]),
        min_size=1,
        max_size=4,
        unique=True,
    ),
    column=st.sampled_from(["frame", "time_s", "note", ""]),
    has_blank=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_lines_that_sum_a_table_up_are_no_frames(
    tmp_path, shape, words, column, has_blank, seed
):
    frames = readings_of(6, shape, seed)
    lines = lines_of(frames)
    sums = lines_of(np.tile(frames.max(axis=0), (len(words), 1, 1)))
    names = ",".join(f"s{k}" for k in range(frames[0].size))
    table = [names, *lines, *[""] * has_blank, *sums]
    begins = [column, *map(str, range(6)), *[""] * has_blank, *words]
    is_last = column == "note"
    if is_last:
        begins[1:7] = [""] * 6
    rows = []
    for begin, line in zip(begins, table, strict=True):
        cells = [line, begin] if is_last else [begin, line]
        rows.append(",".join(cells) if line else "")
    source = read(tmp_path, "\n".join(rows) + "\n", shape, time_unit="s")
    np.testing.assert_array_equal(source.frames, frames)
    assert sum("summary line: " in note for note in source.notes) == 1

    # The same words above readings may be labels: these frames are not dropped.
    with pytest.raises(
        SourceError, match=r"below a line that would be left out|is not a number"
    ):
        read(tmp_path, "\n".join([*rows, rows[1]]) + "\n", shape, time_unit="s")


@FORGIVING
@given(shape=SIDES, place=st.sampled_from([0, -1]), seed=st.integers(0, 1000))
def test_labels_that_come_again_are_of_frames(tmp_path, shape, place, seed):
    frames = readings_of(6, shape, seed)
    labels = ["rest", "rest", "min", "min", "max", "max"]
    names = [f"s{k}" for k in range(frames[0].size)]
    rows = [names, *(line.split(",") for line in lines_of(frames))]
    for cells, label in zip(rows, ["grip", *labels], strict=True):
        cells.insert(len(cells) if place else 0, label)
    text = "\n".join(map(",".join, rows)) + "\n"
    np.testing.assert_array_equal(read(tmp_path, text, shape).frames, frames)


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 4), st.integers(2, 4)),
    letters_are=st.sampled_from(["rows", "cols"]),
    data=st.data(),
)
def test_letters_and_numbers_of_names_are_rows_and_columns(
    tmp_path, shape, letters_are, data
):
    frames = readings_of(5, shape, data.draw(st.integers(0, 1000)))
    n_rows, n_cols = shape
    if n_rows == n_cols and letters_are == "cols":
        return  # of a square the letters are the rows
    names = []
    for row in range(n_rows):
        for col in range(n_cols):
            letter, number = (row, col) if letters_are == "rows" else (col, row)
            names.append(f"{'ABCD'[letter]}{number + 1}")
    by_letter = sorted(range(len(names)), key=names.__getitem__)
    by_number = sorted(range(len(names)), key=lambda k: names[k][::-1])
    order = data.draw(st.sampled_from([by_letter, by_number]))
    rows = [[names[k] for k in order]]
    rows += [[str(frame.flat[k]) for k in order] for frame in frames]
    text = "\n".join(map(",".join, rows)) + "\n"
    np.testing.assert_array_equal(read(tmp_path, text, shape).frames, frames)


@FORGIVING
@given(
    shape=SIDES,
    titles=st.lists(
        st.sampled_from(["Messung 12", "Datum:;01.03.2026", "Mat;A"]), max_size=3
    ),
    n_empty=st.integers(0, 2),
    seed=st.integers(0, 1000),
)
def test_empty_cells_around_a_table_are_no_frames(
    tmp_path, shape, titles, n_empty, seed
):
    frames = readings_of(6, shape, seed)
    width = frames[0].size + 4
    table = [["time_s", *(f"s{k}" for k in range(width - 4))]]
    table += [[str(k / 50), *map(str, frames[k].flat)] for k in range(6)]
    rows = [*(title.split(";") for title in titles), *table, *[[]] * n_empty]
    padded = [row + [""] * (width - len(row)) for row in rows]
    text = "\n".join(map(";".join, padded)) + "\n"
    source = read(tmp_path, text, shape)
    np.testing.assert_array_equal(source.frames, frames)
    np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(6) / 50)


@pytest.mark.parametrize("error", ["#N/A", "#VALUE!", "#DIV/0!"])
def test_an_error_of_a_spreadsheet_is_no_comment(tmp_path, error):
    with pytest.raises(SourceError, match=f"add missing=.?{error}"):
        read(tmp_path, f"s0,s1\n1,2\n{error},3\n4,5\n", (1, 2))
    source = read(tmp_path, f"s0,s1\n1,2\n{error},3\n4,5\n", (1, 2), missing=error)
    assert np.isnan(source.frames[1, 0, 0])
    assert source.frames[1, 0, 1] == 3


@FORGIVING
@given(n_frames=st.integers(4, 12), step=st.sampled_from([0.02, 20, 1.5]))
def test_an_array_that_rises_beside_the_frames_is_asked_about(tmp_path, n_frames, step):
    frames = readings_of(n_frames, (3, 4), 0)
    np.savez(tmp_path / "a.npz", step * np.arange(n_frames), frames)
    layout = Layout(axes="frames,rows,cols")
    with pytest.raises(SourceError, match="state time=arr_0 or time=none"):
        open_file(tmp_path / "a.npz", layout)


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 3), st.integers(2, 4)),
    place=st.sampled_from(["grid", "number", "name"]),
    order=st.sampled_from(["frames", "taxels", "none"]),
    names=st.sampled_from(["own", "other", "none"]),
    is_timed=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_a_line_for_each_taxel_is_read_in_any_order(
    tmp_path, shape, place, order, names, is_timed, seed
):
    frames = readings_of(5, shape, seed)
    rows = []
    for k, row, col in np.ndindex(frames.shape):
        number = row * shape[1] + col
        places = {
            "grid": f"{row},{col}",
            "number": f"{number}",
            "name": f"r{row}c{col}",
        }
        rows.append(
            f"{k / 50 if is_timed else k},{places[place]},{frames[k, row, col]}"
        )
    if order == "taxels":
        rows = [row for k in range(frames[0].size) for row in rows[k :: frames[0].size]]
    elif order == "none":
        np.random.default_rng(seed).shuffle(rows)
    forms = {"grid": "frames,rows,cols,value", "other": "frames,taxels,value"}
    axes = forms.get(place, forms["other"])
    stated = {"time": "1", "time_unit": "s"} if is_timed else {}
    if names == "own":
        time = "time_s" if is_timed else "frame"
        rows.insert(0, f"{time},{'row,col' if place == 'grid' else 'taxel'},value")
        stated = {}
    else:
        stated["axes"] = axes
        if names == "other":
            rows.insert(0, f"Bild,{'Zeile,Spalte' if place == 'grid' else 'Feld'},Wert")
    text = "\n".join(rows) + "\n"
    source = read(tmp_path, text, shape, **stated)
    np.testing.assert_array_equal(source.frames, frames)
    rate_hz = 50 if is_timed else 100
    np.testing.assert_allclose(source.stamp_ns / 1e9, np.arange(5) / rate_hz, atol=1e-9)

    # A line that is missing is a taxel that is.
    rows.pop(-1 - (seed % 3))
    with pytest.raises(SourceError, match="nan is not finite"):
        read(tmp_path, "\n".join(rows) + "\n", shape, **stated)


def test_columns_without_names_of_a_line_for_each_taxel_are_proposed(tmp_path):
    frames = readings_of(5, (2, 3), 1)
    rows = [
        f"{k},{row},{col},{frames[k, row, col]}" for k, row, col in np.ndindex(5, 2, 3)
    ]
    text = "\n".join(rows) + "\n"
    with pytest.raises(SourceError, match=r"; add axes=frames,rows,cols,value$"):
        read(tmp_path, text, (2, 3))
    with pytest.raises(SourceError, match="axes = frames,rows,value, of lines of 4"):
        read(tmp_path, text, (2, 3), axes="frames,rows,value")


@FORGIVING
@given(
    rate_hz=st.sampled_from([2, 4, 10]),
    n_seconds=st.integers(2, 3),
    has_part=st.booleans(),
    seed=st.integers(0, 1000),
)
def test_clocks_of_whole_seconds_are_no_times(
    tmp_path, rate_hz, n_seconds, has_part, seed
):
    frames = readings_of(n_seconds * rate_hz, (1, 3), seed)
    rows = ["time,ms,s0,s1,s2" if has_part else "time,s0,s1,s2"]
    for k, line in enumerate(lines_of(frames)):
        second, part = divmod(k, rate_hz)
        ms = f"{1000 * part // rate_hz}," if has_part else ""
        rows.append(f"10:15:{second:02},{ms}{line}")
    text = "\n".join(rows) + "\n"
    with pytest.raises(
        SourceError, match=r"repeat the one before|state time="
    ) as error:
        read(tmp_path, text, (1, 3))
    assert "; add " not in str(error.value)


@FORGIVING
@given(
    shape=st.tuples(st.integers(2, 3), st.integers(2, 3)),
    n_levels=st.integers(2, 3),
    has_missing=st.booleans(),
    seed=st.integers(0, 10_000),
)
def test_frames_of_small_numbers_are_no_names(
    tmp_path, shape, n_levels, has_missing, seed
):
    frames = np.random.default_rng(seed).integers(0, n_levels, (6, *shape))
    frames[-1] = n_levels
    lines = lines_of(frames)
    if has_missing:
        lines[0] = lines[0][1:]
    text = "\n".join(lines) + "\n"
    source = read(tmp_path, text, shape, nan="zero")
    np.testing.assert_array_equal(source.frames[1:], frames[1:])
    assert len(source.frames) == 6
