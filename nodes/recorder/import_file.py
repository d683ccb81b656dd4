"""A file of frames as a bag: what a sensor that reads the file would have published."""

from __future__ import annotations

import hashlib
from pathlib import Path

from sparseskin.messages import Message, MessageError, SkinState, Taxels, encode
from sparseskin.nodes.sensor.node import DEFAULT_RATE_HZ
from sparseskin.nodes.sensor.recorded import open_file

from .bag import BagError
from .bag_frames import progress
from .bag_writer import BagWriter
from .node import metadata_of

_RUN_ID_BYTES = 8


def import_file(
    source: Path,
    out: Path,
    *,
    patch: str = "skin",
    n_rows: int | None = None,
    n_cols: int | None = None,
    unit: str | None = None,
    f_max: float | None = None,
    rate_hz: float | None = None,
) -> int:
    """Write a recording of any format that the sensor reads as a bag.

    /PATCH/skin comes first, then /PATCH/taxels; stamps begin at 0. The run id follows from the
    file's content, so the same file gives the same bag.

    Parameters
    ----------
    source : Path
        The recording.
    out : Path
        The bag, NAME.mcap; it must not exist.
    n_rows, n_cols, unit, f_max, rate_hz
        What the file does not say of itself, as in `open_file`.

    Returns
    -------
    int
        How many frames it has.

    Raises
    ------
    SourceError
        If the recording is missing or malformed, or a setting contradicts it.
    BagError
        If the bag exists or cannot be written.
    """
    frames = open_file(
        source, n_rows=n_rows, n_cols=n_cols, unit=unit, f_max=f_max, rate_hz=rate_hz
    )
    skin = frames.skin
    digest = hashlib.blake2b(source.read_bytes(), digest_size=_RUN_ID_BYTES)
    run_id = digest.hexdigest()
    try:
        state = SkinState(
            stamp_ns=0,
            patch=patch,
            n_rows=skin.n_rows,
            n_cols=skin.n_cols,
            f_max=skin.f_max,
            unit=skin.unit,
            pitch_m=skin.pitch_m,
            mask=skin.mask,
            source=frames.name,
            seed=0,
            rate_hz=frames.rate_hz if frames.rate_hz is not None else DEFAULT_RATE_HZ,
            has_truth=False,
            sigma_mid=0.0,
            sigma_end=0.0,
        )
    except MessageError as error:
        raise BagError(f"{str(source)!r}: {error}") from error
    metadata = metadata_of([state], launch="", graph="") | {"imported_from": source.name}
    writer = BagWriter(out, metadata)
    try:
        _write(writer, state.published(run_id, 0))
        for seq, (stamp_ns, forces) in enumerate(progress(frames, frames.n_frames or 0, "import")):
            taxels = Taxels(stamp_ns=stamp_ns, patch=patch, forces=forces)
            _write(writer, taxels.published(run_id, seq))
        writer.close({"lost": {}})
    except BaseException:
        # The recording itself is still there, so half of it as a bag is of no use.
        writer.discard()
        raise
    return writer.n_messages - 1


def _write(writer: BagWriter, message: Message) -> None:
    topic, payload = encode(message)
    writer.write(
        topic.decode(),
        payload,
        schema=message.schema,
        version=message.version,
        log_time_ns=message.stamp_ns,
        stamp_ns=message.stamp_ns,
    )
