"""One recording to reprocess: the graph that does it, and the result."""

import time
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sparseskin.launch.launchfile.load import load_tables
from sparseskin.launch.launchfile.spec import LaunchFile
from sparseskin.messages import (
    Calibration,
    Measurements,
    PhiState,
    SkinState,
    SolverState,
    Taxels,
    Truth,
)
from sparseskin.messages.topics import split_topic, topic_of
from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.files import whole_file
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import last_messages
from sparseskin.nodes.recorder.bag.patches import names_of
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import removing
from sparseskin.nodes.recorder.node import metadata_of

from .pipeline import Pipeline


@dataclass(frozen=True)
class Job:
    """A recording `source` to reprocess into `out`, both .mcap, with settings "NODE.KEY=VALUE" of
    the compressor and the reconstructor. `start_from` is "taxels", "measurements", or "auto":
    measurements unless the compressor is changed.
    """

    source: str
    out: str
    overrides: tuple[str, ...]
    start_from: str

    def changes(self, node: str) -> bool:
        """True if the settings of a node are changed."""
        return any(text.startswith(f"{node}.") for text in self.overrides)


@dataclass(frozen=True)
class Outcome:
    """Result of a job: the monitor's summary by patch, bytes of the recording read and seconds
    taken; or a line with the reason of its failure; or `was_finished`: an earlier run has computed
    the same.
    """

    job: Job
    patches: dict[str, Any]
    error: str = ""
    n_bytes: int = 0
    seconds: float = 0.0
    was_finished: bool = False


def run_job(job: Job, progress: bool = False) -> Outcome:
    """Reprocess one recording, a task that any executor can run; with a progress bar if wanted.

    The result appears under its name when it is complete, or not at all.
    """
    begin_s = time.monotonic()
    try:
        source = Path(job.source)
        if is_finished(job, source):
            return Outcome(job, {}, was_finished=True)
        with whole_file(Path(job.out)) as draft, removing(draft, Path(job.out)):
            patches = _run(job, source, draft, progress)
        n_bytes = source.stat().st_size
    except SparseskinError as error:
        return Outcome(job, {}, str(error))
    return Outcome(job, patches, "", n_bytes, time.monotonic() - begin_s)


def is_finished(job: Job, source: Path) -> bool:
    """True if the result of a job exists, complete, and later than its source: made of a recording
    of the same name and origin, with the same settings, by the same versions of all programs.
    """
    out = Path(job.out)
    if not out.is_file():
        return False
    if out.stat().st_mtime_ns < source.stat().st_mtime_ns:
        return False
    with BagReader(source, whole=False) as bag:
        expected = metadata_of(origin_of(job, bag), "")
    try:
        with BagReader(out, whole=False) as bag:
            names = ("launch", "versions")
            is_same = all(bag.metadata.get(name) == expected[name] for name in names)
            return is_same and not bag.recovered
    except BagError:
        return False


def origin_of(job: Job, bag: BagReader) -> str:
    """Origin of the result of a job, as it is kept in it: the command and the launch file of its
    recording.
    """
    changes = " ".join(f"--set {text}" for text in job.overrides)
    command = f"# sparseskin reprocess {Path(job.source).name} {changes}".rstrip()
    return f"{command} --from {job.start_from}\n{bag.metadata.get('launch', '')}"


def _run(job: Job, source: Path, out: Path, progress: bool) -> dict[str, Any]:
    """Write the result of a job; return the monitor's summary by patch, without latencies."""
    with BagReader(source, whole=False) as bag:
        total = max((info.n_messages for info in bag.topics.values()), default=0)
        launch = make_graph(job, bag, out)
    # Offline a frame is done when it was acquired.
    bus = Pipeline({n.name: (n.cls, n.settings) for n in launch.nodes.values()})
    bar = tqdm(
        total=total, disable=not progress, unit="frame", desc=Path(job.source).name
    )
    with bar, closing(bus):
        for _ in bus.frames():
            bar.update()
    bus.check()
    patches = bus.reports()["monitor"]["patches"]
    return {name: patch | {"latency_ms": None} for name, patch in patches.items()}


def make_graph(job: Job, bag: BagReader, out: Path) -> LaunchFile:
    """The graph that reprocesses a recording: a launch file that is never written.

    Raises SparseskinError if the recording has several patches, or the stream to start from
    contradicts the settings.
    """
    topics = [split_topic(topic) for topic in bag.topics]
    together = names_of(bag)
    patches = sorted({patch for patch, _ in topics})
    n_patches = sum(len(together.get(patch, (patch,))) for patch in patches)
    if together or n_patches != 1:
        batches = " in batches" if together else ""
        raise SparseskinError(
            f"holds {n_patches} patches{batches}; reprocess takes recordings of one"
        )
    present = {schema for _, schema in topics}
    patch = patches[0]
    measured = job.start_from == "measurements" or (
        job.start_from == "auto"
        and Measurements.schema in present
        and not job.changes("compressor")
    )
    if measured and job.changes("compressor"):
        raise SettingsError(
            "--from measurements: the compressor cannot be changed then"
        )
    schemas = [SkinState.schema, Taxels.schema, Truth.schema]
    schemas += [Calibration.schema] if Calibration.schema in present else []
    schemas += [PhiState.schema, Measurements.schema] if measured else []
    player = {"file": str(bag.path), "schemas": schemas, "keep_stamps": True}
    tables: dict[str, dict[str, Any]] = {"player": {"type": "player", **player}}
    for name in ("reconstructor",) if measured else ("compressor", "reconstructor"):
        tables[name] = {"type": name, "patch": patch}
    states = last_messages(bag, [topic_of(patch, SolverState.schema)])
    recorded = next(iter(states.values()), None)
    if isinstance(recorded, SolverState) and not job.changes("reconstructor"):
        tables["reconstructor"] |= iterations_of(recorded)
    tables["monitor"] = {"type": "monitor", "patches": [patch]}
    tables["recorder"] = {
        "type": "recorder",
        "out": str(out),
        "launch": origin_of(job, bag),
    }
    return load_tables(f"reprocess {Path(job.source).name}", tables, job.overrides)


def iterations_of(recorded: SolverState) -> dict[str, Any]:
    """Settings of the reconstructor that give each frame the iterations that it had, where their
    number followed from the speed of the host that recorded it.
    """
    if recorded.frame_tiles:
        times = {"frame_tiles": recorded.frame_tiles, "step_tiles": recorded.step_tiles}
        return {"iterations": recorded.max_iterations, "options": times}
    return {"iterations": recorded.iterations} if recorded.frame_ms else {}
