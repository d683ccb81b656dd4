"""One recording to reprocess: the graph that does it, and the result."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sparseskin.nodes.errors import SettingsError, SparseskinError

if TYPE_CHECKING:
    from sparseskin.launch.launchfile.spec import LaunchFile
    from sparseskin.nodes.recorder.bag.reader import BagReader


@dataclass(frozen=True)
class Job:
    """One recording to reprocess.

    Attributes
    ----------
    source, out : str
        Recording to read and to write; `source` may be an address, see `nodes.remote`.
    overrides : tuple of str
        Settings "NODE.KEY=VALUE" of the compressor and the reconstructor.
    start_from : str
        "taxels", "measurements", or "auto": measurements unless the compressor is changed.
    """

    source: str
    out: str
    overrides: tuple[str, ...]
    start_from: str


@dataclass(frozen=True)
class Outcome:
    """Result of a job: the monitor's summary by patch, lines about how it was computed, bytes of
    the recording read and seconds taken; or a line with the reason of its failure.
    """

    job: Job
    patches: dict[str, Any]
    error: str = ""
    notes: tuple[str, ...] = ()
    n_bytes: int = 0
    seconds: float = 0.0


def run_whole(job: Job, source: Path, progress: bool) -> dict[str, Any]:
    """Reprocess a recording in one pass; return the monitor's summary by patch.

    The result appears under its name when it is complete, or not at all.
    """
    from tqdm import tqdm

    from sparseskin.nodes.bus import Bus
    from sparseskin.nodes.clock import ManualClock
    from sparseskin.nodes.files import whole_file
    from sparseskin.nodes.recorder.bag.reader import BagReader
    from sparseskin.nodes.recorder.bag.writer import removing

    out, clock = checked_out(job), ManualClock()
    with BagReader(source, whole=False) as bag:
        total = max((info.n_messages for info in bag.topics.values()), default=0)
    with whole_file(out) as draft, removing(draft, out):
        launch = make_graph(job, source, out=draft)
        bus = Bus({n.name: (n.cls, n.settings) for n in launch.nodes.values()}, clock)
        bar = tqdm(total=total, disable=not progress, unit="frame", desc=Path(job.source).name)
        with bar, closing(bus):
            run_bus(bus, clock, bar.update)
        bus.check()
        return untimed(bus.reports()["monitor"]["patches"])


def checked_out(job: Job) -> Path:
    """Path of the result. Raises SettingsError if it is no name of a recording."""
    from sparseskin.nodes.recorder.bag.format import FILE_SUFFIX

    if Path(job.out).suffix != FILE_SUFFIX:
        raise SettingsError(f"--out {job.out}: expected a name that ends in {FILE_SUFFIX}")
    return Path(job.out)


def run_bus(bus: Any, clock: Any, count: Any = lambda: None) -> None:
    """Let the frames of a recording pass through a graph, at the times of their stamps.

    Offline a frame is done when it was acquired: no latency is invented.
    """
    for messages in bus.frames():
        newest_ns = max((message.stamp_ns for message in messages), default=0)
        clock.advance(max(0, newest_ns - clock.now_ns()))
        count()


def untimed(patches: dict[str, Any]) -> dict[str, Any]:
    """Summaries of patches without a latency."""
    return {name: patch | {"latency_ms": None} for name, patch in patches.items()}


def how(job: Job, made_by: str) -> str:
    """Provenance of a result, for its metadata: the command, then the text in the recording."""
    changes = " ".join(f"--set {text}" for text in job.overrides)
    command = f"# sparseskin reprocess {Path(job.source).name} {changes}".rstrip()
    return f"{command} --from {job.start_from}\n{made_by}"


def start_of(job: Job, bag: BagReader) -> tuple[str, str]:
    """Schema of the stream that a job starts from ("taxels" or "measurements"), and the patch.

    Raises SparseskinError if the recording has several patches, or the stream contradicts the
    settings.
    """
    from sparseskin.messages import Measurements
    from sparseskin.messages.topics import split_topic
    from sparseskin.nodes.recorder.bag.patches import names_of

    topics = [split_topic(topic) for topic in bag.topics]
    together, patches = names_of(bag), sorted({patch for patch, _ in topics})
    n_patches = sum(len(together.get(patch, (patch,))) for patch in patches)
    if together or n_patches != 1:
        batches = " in batches" if together else ""
        raise SparseskinError(
            f"holds {n_patches} patches{batches}; reprocess takes recordings of one"
        )
    present = {schema for _, schema in topics}
    changes_edge = any(text.startswith("compressor.") for text in job.overrides)
    start_from = job.start_from
    if start_from == "auto":
        known = Measurements.schema in present and not changes_edge
        start_from = "measurements" if known else "taxels"
    if start_from == "measurements" and changes_edge:
        raise SettingsError("--from measurements: the compressor cannot be changed then")
    return start_from, patches[0]


def make_graph(
    job: Job,
    source: Path,
    *,
    out: Path | None = None,
    span: tuple[float, float | None] = (0.0, None),
) -> LaunchFile:
    """The graph that reprocesses a recording: a launch file that is never written.

    It has a recorder and a monitor if there is an `out`; it plays a `span` of the recording: from
    so many seconds after its first frame, for so many seconds (None: to its end).
    """
    from sparseskin.launch.launchfile.load import load_tables
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
    from sparseskin.nodes.recorder.bag.frames import last_messages
    from sparseskin.nodes.recorder.bag.reader import BagReader

    with BagReader(source, whole=False) as bag:
        start_from, patch = start_of(job, bag)
        present = {split_topic(topic)[1] for topic in bag.topics}
        states = last_messages(bag, [topic_of(patch, SolverState.schema)])
        made_by = bag.metadata.get("launch", "")
    schemas = [SkinState.schema, Taxels.schema, Truth.schema]
    schemas += [Calibration.schema] if Calibration.schema in present else []
    player = {"type": "player", "file": str(source), "schemas": schemas, "keep_stamps": True}
    tables: dict[str, dict[str, Any]] = {
        "player": player | {"start_s": span[0], "duration_s": span[1]}
    }
    if start_from == "measurements":
        schemas += [PhiState.schema, Measurements.schema]
    else:
        tables["compressor"] = {"type": "compressor", "patch": patch}
    tables["reconstructor"] = {"type": "reconstructor", "patch": patch}
    recorded = next(iter(states.values()), None)
    changed = any(text.startswith("reconstructor.") for text in job.overrides)
    if isinstance(recorded, SolverState) and recorded.frame_ms and not changed:
        # Its number of iterations followed from the speed of the host that recorded it.
        tables["reconstructor"]["iterations"] = recorded.iterations
    if out is not None:
        tables["monitor"] = {"type": "monitor", "patches": [patch]}
        tables["recorder"] = {"type": "recorder", "out": str(out), "launch": how(job, made_by)}
    return load_tables(f"reprocess {Path(job.source).name}", tables, job.overrides)
