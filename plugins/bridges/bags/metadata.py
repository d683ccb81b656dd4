"""The metadata.yaml of a bag of ROS 2."""

from pathlib import Path
from typing import Any, NamedTuple

MAX_BYTES = 1 << 22
"""Longest metadata.yaml that is read; chosen: ten times that of a bag with a thousand topics."""


class Metadata(NamedTuple):
    """What a metadata.yaml states: messages on each topic, names of the files, and compression."""

    counts: dict[str, int]
    files: frozenset[str]
    mode: str = ""
    form: str = ""


def metadata_of(folder: Path) -> Metadata | None:
    """The metadata of the bag in a folder; None where there are none, or they cannot be read, as of
    a recorder that was killed.
    """
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    path = folder / "metadata.yaml"
    # Any other form of its content is that of a file which cannot be read.
    try:
        if not path.is_file() or path.stat().st_size > MAX_BYTES:
            return None
        content = YAML(typ="safe").load(path.read_text("utf-8"))
        return _parsed(content["rosbag2_bagfile_information"])
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        RecursionError,
        YAMLError,
    ):
        return None


def _parsed(content: Any) -> Metadata:
    counts: dict[str, int] = {}
    for entry in content["topics_with_message_count"]:
        counts[str(entry["topic_metadata"]["name"])] = int(entry["message_count"])
    names = frozenset(Path(str(name)).name for name in content["relative_file_paths"])
    mode = str(content.get("compression_mode") or "").lower()
    form = str(content.get("compression_format") or "").lower()
    return Metadata(counts, names, mode, form)
