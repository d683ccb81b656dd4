"""The export to LeRobot, read by the rules of its layout v3.0 alone, with pandas and pyarrow."""

import json

import numpy as np
import pandas as pd
import pytest
from bags import N_COLS, N_ROWS, PERIOD_NS, frame, make_bag, skin_state
from exported import contacts

pytest.importorskip("pyarrow", reason="pyarrow is not installed")
from sparseskin.launch.commands.cli import main
from sparseskin.messages import Reconstruction
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.plugins.bridges.exports.lerobot import export_lerobot

N_FRAMES = 60
FPS = 30
WINDOW = 5
DTYPES = {"float32": np.float32, "int64": np.int64}


class Dataset:
    """What LeRobotDataset reads of a folder: its info, episodes, tasks, statistics and rows."""

    def __init__(self, root):
        self.info = json.loads((root / "meta/info.json").read_text())
        self.stats = json.loads((root / "meta/stats.json").read_text())
        self.tasks = pd.read_parquet(root / "meta/tasks.parquet")
        (path,) = root.glob("meta/episodes/*/*.parquet")
        self.episode = pd.read_parquet(path).iloc[0]
        places = [
            self.info["data_path"].format(
                chunk_index=one["data/chunk_index"], file_index=one["data/file_index"]
            )
            for _, one in pd.read_parquet(path).iterrows()
        ]
        self.rows = pd.concat(
            [pd.read_parquet(root / data) for data in places], ignore_index=True
        )

    def column(self, key):
        """A feature as an array of its declared dtype and shape, a row each."""
        feature = self.info["features"][key]
        rows = [np.array(value.tolist() if hasattr(value, "tolist") else value)
                for value in self.rows[key]]  # fmt: skip
        shape = () if feature["shape"] == [1] else tuple(feature["shape"])
        return (
            np.stack(rows).astype(DTYPES[feature["dtype"]]).reshape(len(rows), *shape)
        )


@pytest.fixture
def bag(tmp_path):
    path = tmp_path / "some.mcap"
    make_bag(path, [skin_state(), *(m for k in range(N_FRAMES) for m in frame(k))])
    return path


@pytest.fixture
def exported(bag, tmp_path):
    with BagReader(bag) as reader:
        export_lerobot([reader], tmp_path / "out", fps=FPS, window=WINDOW)
    assert not list((tmp_path / "out").glob(".*"))
    return Dataset(tmp_path / "out")


KEY = "observation.tactile.skin"
FORCES = "observation.environment_state"


def test_rows_are_those_of_the_video_from_the_first_frame_to_the_last(exported):
    n = (N_FRAMES - 1) * PERIOD_NS * FPS // 10**9 + 1
    info = exported.info
    episode = exported.episode
    assert info["codebase_version"] == "v3.0"
    assert info["fps"] == FPS
    assert info["total_frames"] == n
    assert info["total_episodes"] == 1
    assert info["total_tasks"] == 1
    assert info["splits"] == {"train": "0:1"}
    assert set(exported.rows) == set(info["features"])
    for key in ("index", "frame_index"):
        assert np.array_equal(exported.column(key), np.arange(n))
    for key in ("episode_index", "task_index"):
        assert not exported.column(key).any()
    # LeRobot refuses timestamps that are more than 0.1 ms off the video's.
    assert np.abs(exported.column("timestamp") - np.arange(n) / FPS).max() < 1e-5
    assert exported.tasks.loc["touch", "task_index"] == 0
    assert episode["dataset_from_index"] == 0
    assert episode["dataset_to_index"] == n
    assert episode["episode_index"] == 0
    assert episode["length"] == n
    assert [*episode["tasks"]] == ["touch"]


def test_each_row_holds_the_last_frames_at_or_before_its_time(exported):
    sent = [message for k in range(N_FRAMES) for message in frame(k)]
    recorded = [
        message.forces[0] for message in sent if isinstance(message, Reconstruction)
    ]
    windows = exported.column(KEY)
    ages = exported.column(f"{KEY}.age")
    assert windows.shape == (len(exported.rows), WINDOW, N_ROWS * N_COLS)
    for row in range(len(exported.rows)):
        at_ns = row * 10**9 // FPS
        for place in range(WINDOW):
            k = max(0, at_ns // PERIOD_NS - (WINDOW - 1 - place))
            assert np.array_equal(windows[row, place], recorded[k].ravel()), (
                row,
                place,
            )
            assert ages[row, place] == pytest.approx(
                (at_ns - k * PERIOD_NS) / 1e9, abs=1e-6
            )


def test_the_state_of_a_row_has_the_contacts_at_or_before_its_time(tmp_path):
    bag = tmp_path / "touched.mcap"
    out = tmp_path / "touched"
    make_bag(
        bag,
        [skin_state(), *(m for k in range(N_FRAMES) for m in [*frame(k), contacts(k)])],
    )
    options = ["--out", str(out), "--contacts", "2"]
    assert main(["recording", "export", str(bag), "--to", "lerobot", *options]) == 0
    made = Dataset(out)
    feature = made.info["features"]["observation.state"]
    rows = made.column("observation.state")
    assert rows.shape == (len(made.rows), len(feature["names"]))
    trusted, first, second = (
        feature["names"].index(f"skin.{name}")
        for name in ("trusted", "contact_1.total", "contact_2.total")
    )
    for row, values in enumerate(rows):
        k = row * 10**9 // FPS // PERIOD_NS
        n = k % 3
        assert values[trusted] == (k != 4)
        assert values[[first, second]].tolist() == [
            (0.5 + k) * (n > 0),
            (0.5 + k) * (n > 1),
        ]
    stats = made.stats["observation.state"]
    assert np.allclose(stats["mean"], rows.mean(axis=0, dtype="f8"), atol=1e-5)
    assert "/skin/contacts (2, N)" in (out / "README.md").read_text()


@pytest.fixture
def truths(bag, tmp_path):
    """A dataset of the truth of two episodes, and the words of a join of the reconstructions."""
    root = tmp_path / "truths"
    out = tmp_path / "joined"
    with BagReader(bag) as reader:
        export_lerobot([reader] * 2, root, ["/skin/truth"], fps=FPS, window=1)
    words = [
        "recording",
        "export",
        str(bag),
        str(bag),
        "--to",
        "lerobot",
        "--into",
        str(root),
    ]
    return root, [*words, "--out", str(out)]


def test_frames_are_joined_into_a_dataset_by_stamps(truths, bag, tmp_path, capsys):
    root, words = truths
    later = tmp_path / "later.mcap"  # begins earlier, ends later
    make_bag(
        later, [skin_state(), *(m for k in range(N_FRAMES + 107) for m in frame(k))]
    )
    words[3] = str(later)
    before = {path: path.read_bytes() for path in root.rglob("*.*") if path.is_file()}
    assert main([*words, "--offset", "0,0.07"]) == 0
    assert "later.mcap: its last 1.0" in capsys.readouterr().err
    assert {
        path: path.read_bytes() for path in root.rglob("*.*") if path.is_file()
    } == before
    old = Dataset(root)
    made = Dataset(tmp_path / "joined")
    n = old.info["total_frames"]
    assert set(made.info["features"]) == {*old.info["features"], KEY, f"{KEY}.age"}
    both = made.column(FORCES)
    truth = old.column(FORCES)
    assert both.shape == (n, 2 * N_ROWS * N_COLS)
    assert np.array_equal(both[:, : N_ROWS * N_COLS], truth)
    for row in range(n):
        k = row % (n // 2) * 10**9 // FPS // PERIOD_NS + 7 * (row >= n // 2)
        (sent,) = (
            m.forces[0].ravel() for m in frame(k) if isinstance(m, Reconstruction)
        )
        assert np.array_equal(made.column(KEY)[row, -1], sent), row
        assert np.array_equal(both[row, N_ROWS * N_COLS :], sent), row
    for name in ("min", "max", "mean", "std"):
        expected = getattr(both.astype("f8"), name)(axis=0)
        assert np.allclose(made.stats[FORCES][name], expected, atol=1e-5), name


@pytest.mark.parametrize(
    ("more", "broken", "fault"),
    [
        (
            ["--offset", "0.5"],
            None,
            "the rows of its episode are those of 0.500 to 1.067 s",
        ),
        (["--offset", "-1"], None, "lasts 0.590 s"),
        (["--offset", "1,2,3"], None, "or one for each of 2 recordings"),
        (["--fps", "30"], None, "--fps: is that of the dataset"),
        (
            ["--topics", "/skin/truth"],
            None,
            "has a feature observation.tactile.skin_truth",
        ),
        (["{bag}"], None, "has 2 episodes; state as many recordings, not 3"),
        ([], "meta/stats.json", "no dataset of LeRobot that can be read"),
        (
            [],
            "data/chunk-000/file-000.parquet",
            "no dataset of LeRobot that can be read",
        ),
        ([], {"fps": 0}, "fps 0 is outside"),
        ([], {"features": []}, "no dataset of LeRobot that can be read"),
        ([], {"codebase_version": "v2.1"}, "'v2.1'; allowed is 'v3.0'"),
        ([], {"total_episodes": 3}, "rows of 2 episodes"),
    ],
)
def test_what_cannot_be_joined_is_one_line_and_leaves_nothing(
    truths, bag, more, broken, fault,
    capsys,
):  # fmt: skip
    root, words = truths
    if isinstance(broken, dict):
        info = json.loads((root / "meta/info.json").read_text())
        (root / "meta/info.json").write_text(json.dumps(info | broken))
    elif broken:
        (root / broken).write_bytes((root / broken).read_bytes()[:-30])
    words[3:3] = [str(bag) for word in more if word == "{bag}"]
    assert main([*words, *(word for word in more if word != "{bag}")]) == 2
    error = capsys.readouterr().err
    assert fault in error
    assert error.count("\n") == 1
    assert not (root.parent / "joined").exists()


def test_statistics_are_those_of_the_rows(exported):
    for key in exported.info["features"]:
        rows = exported.column(key).astype(np.float64)
        rows = rows[:, None] if rows.ndim == 1 else rows
        found = exported.stats[key]
        assert found["count"] == [len(rows)]
        for name, value in (
            ("min", rows.min(axis=0)), ("max", rows.max(axis=0)), ("mean", rows.mean(axis=0)),
            ("std", rows.std(axis=0)), ("q50", np.median(rows, axis=0)),
        ):  # fmt: skip
            assert np.allclose(found[name], value, atol=1e-5), (key, name)
            stored = exported.episode[f"stats/{key}/{name}"]
            assert np.allclose(np.array(stored.tolist()).tolist(), value, atol=1e-5)


def test_defaults_and_other_maps_are_as_documented(bag, tmp_path, capsys):
    out = tmp_path / "default"
    assert (
        main(["recording", "export", str(bag), "--to", "lerobot", "--out", str(out)])
        == 0
    )
    printed = capsys.readouterr().out.split()
    assert sorted(printed) == sorted(
        str(path) for path in out.rglob("*") if path.is_file()
    )
    # 100 Hz at 30
    assert Dataset(out).info["features"][KEY]["shape"] == [
        4,
        N_ROWS * N_COLS,
    ]
    with BagReader(bag) as reader:
        export_lerobot(
            [reader], tmp_path / "o", ["/skin/truth", "/skin/taxels"], fps=10, window=1
        )
    features = Dataset(tmp_path / "o").info["features"]
    assert {"observation.tactile.skin_truth", "observation.tactile.skin_taxels"} <= set(
        features
    )


@pytest.mark.parametrize(
    ("more", "fault"),
    [
        (["--to", "csv", "--window", "3"], "--window: goes with --to lerobot"),
        (["--to", "lerobot", "--fps", "5000"], "--fps: 5000 is outside 1..1000"),
        (["--to", "lerobot", "--contacts", "101"], "--contacts: 101 is outside 1..100"),
        (
            ["--to", "lerobot", "--topics", "/skin/measurements"],
            "measurements are no map",
        ),
    ],
)
def test_what_makes_no_sense_is_one_line(bag, more, fault, capsys):
    assert main(["recording", "export", str(bag), *more]) == 2
    assert fault in capsys.readouterr().err
    assert not list(bag.parent.glob("*_lerobot"))
