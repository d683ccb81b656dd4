"""Datasets of LeRobot on disk: rows, episodes and statistics in Parquet and JSON.

Source of the layout: huggingface/lerobot, `src/lerobot/datasets/`, codebase version v3.0, read in
lerobot 0.4.4 and 0.6.2.
"""

import contextlib
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from sparseskin.nodes.numerics.arrays import AnyArray, Floats
from sparseskin.nodes.recorder.bag.format import BagError

VERSION = "v3.0"
TASK = "touch"
STATE = "observation.state"
FORCES = "observation.environment_state"
ACTION = "action"
MAX_FPS = 1000
CHUNK = 1000
"""Files of a folder."""
TOLERANCE_S = 1e-4
"""Deviation of a timestamp from a multiple of 1 / fps that is rounding; as in LeRobot."""
BLOCK_BYTES = 1 << 26
"""Size of what is held in memory at once, bytes: a recording may be larger than the memory."""
QUANTILES = {
    "q01": 0.01,
    "q10": 0.1,
    "q50": 0.5,
    "q90": 0.9,
    "q99": 0.99,
}
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
INFO = "meta/info.json"
STATS = "meta/stats.json"
TASKS = "meta/tasks.parquet"
README = "README.md"
CARD = "---\ntask_categories:\n- robotics\ntags:\n- LeRobot\n- tactile\n---\n"
Times = npt.NDArray[np.int64]
"""Times after the begin of an episode, nanoseconds, shape (n_times,)."""
Stats = dict[str, Any]
"""Minimum, mean ... of a feature, each of the shape of a row, and the number of rows."""
Part = tuple[int, Callable[[Times, slice], Floats]]
"""Width of a block of columns, and some of its columns at some times, (n_times, n_columns)."""


@dataclass(frozen=True)
class Feature:
    """A feature, float32: shape of a row, names of its numbers, and the blocks of its columns."""

    shape: tuple[int, ...]
    names: list[str] | None
    parts: Sequence[Part]

    def rows(self, times_ns: Times) -> Floats:
        """Values at each time, (n_times, *shape)."""
        # Blocks stand beside each other, in the order of the numbers of a row.
        parts = [take(times_ns, slice(None)) for _, take in self.parts]
        return np.concatenate(parts, axis=1).reshape(len(times_ns), *self.shape)

    def stats(self, times_ns: Times) -> Stats:
        """Statistics over the times, computed by blocks of columns."""
        # Statistics are computed in float64, eight bytes a number.
        block = max(1, BLOCK_BYTES // (8 * len(times_ns)))
        blocks = []
        for width, take in self.parts:
            for begin in range(0, width, block):
                blocks.append(_stats(take(times_ns, slice(begin, begin + block))))

        joined: Stats = {}
        for name in ("min", "max", "mean", "std", *QUANTILES):
            values = np.concatenate([of_block[name] for of_block in blocks])
            joined[name] = values.reshape(self.shape)
        joined["count"] = blocks[0]["count"]
        return joined


class Dataset:
    """The dataset in a folder: `fps`, rows a second, and `times_ns`, of each episode the times of
    its rows after its begin.

    Raises BagError if it is no dataset of codebase version v3.0.
    """

    def __init__(self, root: Path) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        self.root = root
        with self._refused():
            self._info = json.loads((root / INFO).read_text())
            self._stats = json.loads((root / STATS).read_text())
            # Other versions keep rows and episodes in other files.
            version = self._info["codebase_version"]
            if version != VERSION:
                raise ValueError(
                    f"codebase version {version!r:.20}; allowed is {VERSION!r}"
                )
            self.fps = self._info["fps"]
            self._features = {**self._info["features"]}
            if not 0 < self.fps <= MAX_FPS:
                raise ValueError(f"fps {self.fps} is outside 0..{MAX_FPS}")

            self._data = sorted(root.glob("data/*/*.parquet"))
            # Only these columns are read: images would fill the memory.
            names = ["episode_index", "timestamp"]
            tables = []
            for path in self._data:
                tables.append(pq.read_table(path, columns=names))
            table = pa.concat_tables(tables)
            episodes = table["episode_index"].to_numpy()
            seconds = table["timestamp"].to_numpy()
            indices, counts = np.unique(episodes, return_counts=True)
            if not np.array_equal(indices, np.arange(self._info["total_episodes"])):
                raise ValueError(
                    f"rows of {len(indices)} episodes, not of those that it states"
                )

            # Rows may stand in any file; those of one episode are in order.
            order = np.argsort(episodes, kind="stable")
            times_ns = self._in_ns(seconds[order])
            begins = np.cumsum(counts)[:-1]
            self.times_ns = np.split(times_ns, begins)

    def join(
        self, out: Path, added: Sequence[Mapping[str, Feature]], about: str
    ) -> None:
        """Write the dataset and features of each episode into the folder `out`. States are appended
        to those of the dataset, `about` to its README. Files that stay as they are become hard
        links where possible.

        Raises BagError if the dataset cannot be read, or has another of the features.
        """
        # State and forces are appended to; any other feature would be overwritten.
        for key in added[0].keys() & self._features.keys() - {STATE, FORCES}:
            raise BagError(f"{self.root}: has a feature {key} already")

        with self._refused():
            self._link_files(out)
            stats_of_episodes = []
            for features, times_ns in zip(added, self.times_ns, strict=True):
                stats = {}
                for key, feature in features.items():
                    stats[key] = feature.stats(times_ns)
                stats_of_episodes.append(stats)
            self._join_rows(out, added)
            self._join_episodes(out, stats_of_episodes)
            for key, feature in added[0].items():
                of_feature = [of_episode[key] for of_episode in stats_of_episodes]
                pooled = _pooled(of_feature)
                self._stats[key] = _appended(self._stats.get(key), pooled)
                self._features[key] = self._with(key, feature)
            readme = self.root / README
            text = CARD
            if readme.exists():
                text = readme.read_text(encoding="utf-8")

        info = self._info | {"features": self._features}
        (out / INFO).write_text(json.dumps(info, indent=4), encoding="utf-8")
        (out / STATS).write_text(json.dumps(self._stats, default=np.ndarray.tolist))
        (out / README).write_text(f"{text}\n{about}\n", encoding="utf-8")

    def _link_files(self, out: Path) -> None:
        """Link the files that stay as they are into the folder `out`."""
        names = (INFO, STATS, README, "data", "meta/episodes")
        replaced = {self.root / name for name in names}

        def ignored(folder: str, names: list[str]) -> list[str]:
            return [name for name in names if Path(folder, name) in replaced]

        shutil.copytree(
            self.root,
            out,
            ignore=ignored,
            copy_function=_link,
            dirs_exist_ok=True,
        )

    def _in_ns(self, seconds: AnyArray) -> Times:
        """Timestamps, float32, in nanoseconds: multiples of 1 / fps where they are."""
        wide = seconds.astype(np.float64)
        # A float32 of some minutes is exact to some 30 us: rounding would shift frames.
        row = np.rint(wide * self.fps)
        regular = np.abs(wide - row / self.fps) < TOLERANCE_S
        exact_ns = row.astype(np.int64) * 1_000_000_000 // self.fps
        stated_ns = np.rint(wide * 1e9)
        return np.where(regular, exact_ns, stated_ns).astype(np.int64)

    def _with(self, key: str, feature: Feature) -> dict[str, Any]:
        """A feature as info.json states it, appended to that of the dataset."""
        existing = self._features.get(key)
        names = feature.names
        if existing is None:
            return {
                "dtype": "float32",
                "shape": [*feature.shape],
                "names": names,
            }

        # Datasets that were converted have their names in a dict.
        names_before = existing["names"]
        if isinstance(names_before, dict) and len(names_before) == 1:
            (names_before,) = names_before.values()
        all_names = None
        if names and isinstance(names_before, list):
            all_names = [*names_before, *names]
        n = existing["shape"][0] + feature.shape[0]
        return {
            "dtype": "float32",
            "shape": [n],
            "names": all_names,
        }

    def _join_rows(self, out: Path, added: Sequence[Mapping[str, Feature]]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        # Of a feature all rows of a block are held at once.
        n_columns = 0
        for feature in added[0].values():
            n_columns += sum(width for width, _ in feature.parts)
        block = max(1, BLOCK_BYTES // (4 * n_columns))
        for path in self._data:
            writer = None
            for batch in pq.ParquetFile(path).iter_batches(block):
                # Without the description of the columns by the package `datasets`.
                table = pa.Table.from_batches([batch]).replace_schema_metadata(None)
                table = self._joined_rows(table, added)
                if writer is None:
                    # The schema is known with the first block.
                    target = _make(out / path.relative_to(self.root))
                    writer = pq.ParquetWriter(
                        target, table.schema, compression="snappy"
                    )
                writer.write_table(table)
            if writer is not None:
                writer.close()

    def _joined_rows(self, table: Any, added: Sequence[Mapping[str, Feature]]) -> Any:
        """Some rows with the features of their episodes."""
        import pyarrow as pa

        numbers = table["episode_index"].to_numpy()
        times_ns = self._in_ns(table["timestamp"].to_numpy())
        # Rows of one episode after each other.
        begins = np.flatnonzero(np.diff(numbers)) + 1
        borders = [0, *begins, len(numbers)]
        runs = [slice(*ends) for ends in itertools.pairwise(borders)]
        for key in added[0]:
            parts = []
            for run in runs:
                feature = added[numbers[run.start]][key]
                parts.append(feature.rows(times_ns[run]))
            rows = np.concatenate(parts)
            # States of the dataset stand before those that are added.
            if key in self._features:
                existing = table[key].combine_chunks()
                if pa.types.is_nested(existing.type):
                    existing = existing.flatten()
                wide = np.asarray(existing).reshape(len(rows), -1)
                rows = np.hstack([wide, rows]).astype(np.float32)
            table = _set(table, key, _nested(rows))
        return table

    def _join_episodes(
        self, out: Path, stats_of_episodes: Sequence[Mapping[str, Stats]]
    ) -> None:
        import pyarrow.parquet as pq

        for path in sorted(self.root.glob("meta/episodes/*/*.parquet")):
            table = pq.read_table(path)
            # A row for each episode, and a column for each of its statistics.
            numbers = table["episode_index"].to_pylist()
            for key in stats_of_episodes[0]:
                prefix = f"stats/{key}/"
                columns = [n for n in table.column_names if n.startswith(prefix)]
                rows_before = table.select(columns).to_pylist()
                rows = []
                for k, row in zip(numbers, rows_before, strict=True):
                    existing = {name.removeprefix(prefix): row[name] for name in row}
                    rows.append(_appended(existing, stats_of_episodes[k][key]))

                table = table.drop_columns(columns)
                for name in rows[0]:
                    column = [np.asarray(row[name]).tolist() for row in rows]
                    table = _set(table, prefix + name, [column])
            pq.write_table(table, _make(out / path.relative_to(self.root)))

    @contextlib.contextmanager
    def _refused(self) -> Iterator[None]:
        """Turn errors of reading and of contents into a BagError."""
        import pyarrow as pa

        # A file of another program may hold anything in the place of each value.
        kinds = (OSError, LookupError, TypeError, ValueError, AttributeError)
        try:
            yield
        except (*kinds, pa.ArrowException) as error:
            text = " ".join(f"{type(error).__name__}: {error}".split())[:200]
            raise BagError(
                f"{self.root}: no dataset of LeRobot that can be read: {text}"
            ) from error


def make_dataset(root: Path, lengths: Sequence[int], fps: int) -> Dataset:
    """Write a dataset of episodes of so many rows, without features of its own, into a folder."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    # Rows are numbered through all episodes.
    begins = np.cumsum([0, *lengths])
    episodes = []
    stats = []
    for k, n in enumerate(lengths):
        columns = {
            "timestamp": (np.arange(n) / fps).astype(np.float32),
            "frame_index": np.arange(n),
            "episode_index": np.full(n, k),
            "index": begins[k] + np.arange(n),
            "task_index": np.zeros(n, np.int64),
        }
        # A file of its own for each episode.
        places = {"chunk_index": k // CHUNK, "file_index": k % CHUNK}
        path = root / DATA_PATH.format(**places)
        pq.write_table(pa.table(columns), _make(path))
        of_columns = {}
        for name, values in columns.items():
            of_columns[name] = _stats(values[:, None])
        stats.append(of_columns)
        episode = {
            "episode_index": k,
            "tasks": [TASK],
            "length": n,
            "dataset_from_index": begins[k],
            "dataset_to_index": begins[k + 1],
        }
        episodes.append(episode | _places_and_stats(places, of_columns))

    features = {}
    pooled = {}
    for name, values in columns.items():
        features[name] = {
            "dtype": str(values.dtype),
            "shape": [1],
            "names": None,
        }
        pooled[name] = _pooled([of_episode[name] for of_episode in stats])
    info = _info_of(lengths, fps, features)
    table = pa.Table.from_pylist(episodes)
    pq.write_table(table, _make(root / "meta/episodes/chunk-000/file-000.parquet"))
    (root / INFO).write_text(json.dumps(info))
    (root / STATS).write_text(json.dumps(pooled, default=np.ndarray.tolist))
    (root / README).write_text(CARD)
    _write_tasks(root / TASKS)
    return Dataset(root)


def _places_and_stats(
    places: Mapping[str, int], stats: Mapping[str, Stats]
) -> dict[str, Any]:
    """Columns of an episode that state its files and its statistics."""
    columns: dict[str, Any] = {f"data/{name}": k for name, k in places.items()}
    # All episodes stand in one file of their own.
    columns |= {f"meta/episodes/{name}": 0 for name in places}
    for key, of_feature in stats.items():
        for name, value in of_feature.items():
            columns[f"stats/{key}/{name}"] = value
    return columns


def _info_of(
    lengths: Sequence[int], fps: int, features: Mapping[str, Any]
) -> dict[str, Any]:
    """Content of info.json of a dataset of episodes of so many rows."""
    return {
        "codebase_version": VERSION,
        "robot_type": None,
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": 1,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        "data_path": DATA_PATH,
        "video_path": None,
        "features": features,
    }


def _write_tasks(path: Path) -> None:
    """The task by its number; pandas reads the text as the index."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    kinds = {"task_index": ("int64", "int64"), "task": ("unicode", "object")}
    columns = []
    for name, (pandas_type, numpy_type) in kinds.items():
        types = {"pandas_type": pandas_type, "numpy_type": numpy_type}
        columns.append(
            {
                "name": name,
                "field_name": name,
                "metadata": None,
                **types,
            }
        )
    about = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
    }
    # LeRobot looks a task up by its text, which pandas restores as the index.
    text = json.dumps({**about, "pandas_version": "2.0.0"})
    table = pa.table({"task_index": [0], "task": [TASK]})
    pq.write_table(table.replace_schema_metadata({"pandas": text}), path)


def _stats(values: AnyArray) -> Stats:
    """Statistics over the rows (axis 0)."""
    wide = values.astype(np.float64)
    levels = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": wide.min(axis=0),
        "max": wide.max(axis=0),
        "mean": wide.mean(axis=0),
        "std": wide.std(axis=0),
        **dict(zip(QUANTILES, levels, strict=True)),
        "count": np.array([len(values)]),
    }


def _pooled(parts: Sequence[Stats]) -> Stats:
    """Statistics of the rows of all episodes; quantiles are means of theirs, as in LeRobot."""
    stacked = {name: np.stack([part[name] for part in parts]) for name in parts[0]}
    # Each episode weighs as many rows as it has.
    n = stacked["count"][:, 0]
    means = {
        name: np.average(stacked[name], axis=0, weights=n)
        for name in ("mean", *QUANTILES)
    }
    # Variance of all rows: within the episodes, and between their means.
    squares = stacked["std"] ** 2 + (stacked["mean"] - means["mean"]) ** 2
    variance = np.average(squares, axis=0, weights=n)
    return {
        "min": stacked["min"].min(axis=0),
        "max": stacked["max"].max(axis=0),
        "std": np.sqrt(variance),
        **means,
        "count": np.array([n.sum()]),
    }


def _appended(existing: Mapping[str, Any] | None, new: Stats) -> Stats:
    """Statistics of the numbers of a feature and of those that are appended to it."""
    if not existing:
        return new
    # Older datasets state no quantiles: those of a part would be wrong.
    names = [name for name in new if name in existing]
    appended = {name: np.append(existing[name], new[name]) for name in names}
    return appended | {"count": new["count"]}


def _set(table: Any, name: str, column: Any) -> Any:
    """A table of Arrow with a column in place of that of its name, or at the end."""
    if name not in table.column_names:
        return table.append_column(name, column)
    return table.set_column(table.column_names.index(name), name, column)


def _nested(values: Floats) -> Any:
    """An array of Arrow, of lists for each dimension after the first; rows of one number are no
    lists in LeRobot.
    """
    import pyarrow as pa

    if values.shape[1:] == (1,):
        values = values[:, 0]
    # Innermost lists first.
    nested = pa.array(values.ravel())
    for n in reversed(values.shape[1:]):
        nested = pa.FixedSizeListArray.from_arrays(nested, n)
    return nested


def _make(path: Path) -> Path:
    """The path, once its folder exists."""
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _link(source: str, target: str) -> None:
    """Link a file, or copy it to another file system."""
    # A dataset may itself consist of links.
    try:
        os.link(os.path.realpath(source), target)
    except OSError:
        shutil.copy2(source, target)
