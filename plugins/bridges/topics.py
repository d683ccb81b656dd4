"""Topics of ROS 2: by rclpy where it can be imported, else by DDS alone."""

import os
import re
import sys
from importlib.util import find_spec
from typing import Any

from sparseskin.nodes.errors import SettingsError, SparseskinError
from sparseskin.nodes.lookup import one_line

from .base import check_installed

MAX_DOMAIN = 232
RANGES = {
    "LOCALHOST": "lo",
    "SUBNET": "",
    "SYSTEM_DEFAULT": "",
}
"""Interface of each range of discovery of ROS 2."""


def check(what: str, error: type[SparseskinError] = SettingsError) -> None:
    """Raise `error` unless messages of ROS 2 can be made and sent."""
    if _why_no_rclpy():
        text = f"{what}, outside of a terminal with ROS 2 (source /opt/ros/.../setup.bash),"
        check_installed(text, "ros2", "cyclonedds", error=error)
    check_installed(what, "ros2", "rosbags", error=error)


def join(domain: int | None, interface: str | None, name: str) -> Any:
    """Join a domain as a node of that name, by one network interface: "lo" for this host alone, ""
    as the configuration of DDS has it. Where None is stated, as the variables of ROS 2 have it.

    Raises SettingsError if that cannot be done.
    """
    # Not stated: that of the other nodes of ROS 2 in this terminal.
    if domain is None:
        domain = ros_domain()
    if interface is None:
        interface = ros_interface()
    # ROS 2 allows letters, digits and underscores in the name of a node.
    name = re.sub(r"\W", "_", f"sparseskin_{name}", flags=re.ASCII)
    why = _why_no_rclpy()
    if not why:
        from . import rcl

        return rcl.Member(domain, interface, name)
    # A terminal of ROS 2 whose rclpy is of another Python has none that can be imported.
    if find_spec("rclpy"):
        print(f"rclpy: {why}; messages go by cyclonedds", file=sys.stderr, flush=True)
    from . import dds

    return dds.Member(domain, interface, name)


def _why_no_rclpy() -> str:
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        # Also where it is that of another Python.
        return one_line(error)
    return ""


def ros_domain() -> int:
    """Domain of ROS_DOMAIN_ID, 0 where it is not set."""
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    # `isdecimal` alone accepts digits of other scripts.
    if not (text.isascii() and text.isdecimal() and int(text[:4]) <= MAX_DOMAIN):
        raise SettingsError(f"ROS_DOMAIN_ID: {text[:40]!r} is outside 0..{MAX_DOMAIN}")
    return int(text)


def ros_interface() -> str:
    """Interface of the range in which nodes of ROS 2 find each other, SUBNET where none is set.
    Source: docs.ros.org, "Improved Dynamic Discovery".
    """
    # The older variable, of Humble, goes first, as in ROS 2 itself.
    if os.environ.get("ROS_LOCALHOST_ONLY") == "1":
        return RANGES["LOCALHOST"]
    discovery_range = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE") or "SUBNET"
    if discovery_range not in RANGES:
        raise SettingsError(
            f"ROS_AUTOMATIC_DISCOVERY_RANGE: {discovery_range[:40]!r} is not allowed (allowed: "
            f"{', '.join(RANGES)}); or state interface"
        )
    return RANGES[discovery_range]
