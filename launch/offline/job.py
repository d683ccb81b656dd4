"""One recording to reprocess: the graph that does it, and the result."""

import time
from collections.abc import Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

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
from sparseskin.nodes.process.control import Document
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import last_messages
from sparseskin.nodes.recorder.bag.patches import names_of
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.recorder.bag.writer import removing
from sparseskin.nodes.recorder.node import metadata_of

from .blocks import BlockBus


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
    patches: Document
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
        out = Path(job.out)
        with whole_file(out) as draft, removing(draft, out):
            patches = _run(job, source, draft, progress)
        n_bytes = source.stat().st_size
    except SparseskinError as error:
        return Outcome(job, {}, str(error))
    seconds = time.monotonic() - begin_s
    return Outcome(job, patches, n_bytes=n_bytes, seconds=seconds)


def is_finished(job: Job, source: Path) -> bool:
    """True if the result of a job exists, complete, and later than its source: made of a recording
    of the same name and origin, with the same settings, by the same versions of all programs.
    """
    out = Path(job.out)
    if not out.is_file():
        return False
    # A source that was written again since has other frames.
    if out.stat().st_mtime_ns < source.stat().st_mtime_ns:
        return False
    with BagReader(source, whole=False) as bag:
        expected = metadata_of(origin_of(job, bag), "")
    try:
        with BagReader(out, whole=False) as bag:
            for name in ("launch", "versions"):
                if bag.metadata.get(name) != expected[name]:
                    return False
            return not bag.recovered
    except BagError:
        return False


def origin_of(job: Job, bag: BagReader) -> str:
    """Origin of the result of a job, as it is kept in it: the command and the launch file of its
    recording.
    """
    # By it, an earlier result of the same work is recognised.
    changes = " ".join(f"--set {text}" for text in job.overrides)
    command = f"# sparseskin reprocess {Path(job.source).name} {changes}".rstrip()
    return f"{command} --from {job.start_from}\n{bag.metadata.get('launch', '')}"


def _run(job: Job, source: Path, out: Path, progress: bool) -> Document:
    """Write the result of a job; return the monitor's summary by patch, without latencies."""
    with BagReader(source, whole=False) as bag:
        # The longest topic has a message a frame.
        counts = [info.n_messages for info in bag.topics.values()]
        launch = make_graph(job, bag, out)
    specs = {}
    for node in launch.nodes.values():
        specs[node.name] = (node.cls, node.settings)
    bus = BlockBus(specs)
    bar = tqdm(
        total=max(counts, default=0),
        disable=not progress,
        unit="frame",
        desc=source.name,
    )
    with bar, closing(bus):
        for _ in bus.frames():
            bar.update()
    bus.check()
    patches = bus.reports()["monitor"]["patches"]
    # Offline a frame is done when it was acquired: its latency would mean nothing.
    without_latency = {"latency_ms": None}
    return {name: patch | without_latency for name, patch in patches.items()}


def make_graph(job: Job, bag: BagReader, out: Path) -> LaunchFile:
    """The graph that reprocesses a recording: a launch file that is never written.

    Raises SparseskinError if the recording has several patches, or the stream to start from
    contradicts the settings.
    """
    topics = [split_topic(topic) for topic in bag.topics]
    patches = {patch for patch, _ in topics}
    patch = _only_patch(patches, names_of(bag))
    present = {schema for _, schema in topics}
    # Recorded measurements are of the compressor that made them.
    is_measured = job.start_from == "measurements"
    if is_measured and job.changes("compressor"):
        raise SettingsError(
            "--from measurements: the compressor cannot be changed then"
        )
    if job.start_from == "auto" and Measurements.schema in present:
        is_measured = not job.changes("compressor")

    # What the player publishes, and the nodes that compute the rest.
    schemas = [SkinState.schema, Taxels.schema, Truth.schema]
    stations = ["reconstructor"]
    if Calibration.schema in present:
        schemas.append(Calibration.schema)
    if is_measured:
        schemas += [PhiState.schema, Measurements.schema]
    else:
        stations.insert(0, "compressor")
    tables: dict[str, Document] = {
        "player": {
            "type": "player",
            "file": str(bag.path),
            "schemas": schemas,
            "keep_stamps": True,
        }
    }
    for name in stations:
        tables[name] = {"type": name, "patch": patch}

    topic = topic_of(patch, SolverState.schema)
    states = last_messages(bag, [topic])
    recorded = states.get(topic)
    # Unchanged settings are to give the recorded results again.
    if isinstance(recorded, SolverState) and not job.changes("reconstructor"):
        tables["reconstructor"] |= iterations_of(recorded)
    # Before the monitor, which counts the bytes of what was encoded last.
    tables["recorder"] = {
        "type": "recorder",
        "out": str(out),
        "launch": origin_of(job, bag),
    }
    tables["monitor"] = {"type": "monitor", "patches": [patch]}
    return load_tables(f"reprocess {Path(job.source).name}", tables, job.overrides)


def _only_patch(patches: set[str], batches: Mapping[str, Sequence[str]]) -> str:
    n_patches = 0
    for patch in patches:
        n_patches += len(batches.get(patch, (patch,)))
    if batches or n_patches != 1:
        fault = f"holds {n_patches} patches"
        if batches:
            fault += " in batches"
        raise SparseskinError(f"{fault}; reprocess takes recordings of one")
    (patch,) = patches
    return patch


def iterations_of(recorded: SolverState) -> Document:
    """Settings of the reconstructor that give each frame the iterations that it had, where their
    number followed from the speed of the host that recorded it.
    """
    # Each frame had as many as fitted into its time, of which tiles are the measure.
    if recorded.frame_tiles:
        times = {"frame_tiles": recorded.frame_tiles, "step_tiles": recorded.step_tiles}
        return {"iterations": recorded.max_iterations, "options": times}
    if recorded.frame_ms:
        return {"iterations": recorded.iterations}
    return {}
