"""Launch files; here the bundled ones, without all that reading one takes."""

from pathlib import Path

BUNDLED = Path(__file__).parent.parent
"""Folder of the launch files that come with the package."""


def bundled_names() -> list[str]:
    """Names of the launch files that come with the package."""
    return sorted(path.stem for path in BUNDLED.glob("*.toml"))
