"""Export of the calibration in a bag to skin.toml."""

from collections.abc import Iterable
from pathlib import Path

from sparseskin.messages import Calibration
from sparseskin.nodes.recorder.bag.format import BagError
from sparseskin.nodes.recorder.bag.frames import last_messages, patch_of, skin_of
from sparseskin.nodes.recorder.bag.reader import BagReader
from sparseskin.nodes.sensor.calibration.description import SkinFileError, of_messages
from sparseskin.nodes.sensor.skin_file import save_skin


def export_skin(
    bag: BagReader, out: Path, topics: Iterable[str] | None = None
) -> list[Path]:
    """Write the last calibration of each patch as skin.toml, `out` or OUT_PATCH.toml each for
    several patches; their paths.

    Raises BagError if there is none, or it is malformed, OutputError if a file exists or cannot be
    written.
    """
    calibrated = {
        topic for topic, info in bag.topics.items() if info.schema == Calibration.schema
    }
    if topics is not None:
        calibrated &= set(topics)
    if not calibrated:
        raise BagError(f"{bag.path}: holds no calibration of a skin")

    calibrations = last_messages(bag, sorted(calibrated))
    written = []
    for topic, message in calibrations.items():
        assert isinstance(message, Calibration)
        patch = patch_of(topic)
        path = out
        if len(calibrations) > 1:
            path = out.with_name(f"{out.stem}_{patch}{out.suffix}")
        state = skin_of(bag, patch)
        try:
            if state is None:
                raise SkinFileError("its skin is missing")
            written += save_skin(path, of_messages(state, message))
        except SkinFileError as error:
            raise BagError(f"{bag.path}: {topic}: {error}") from error
    return written
