"""Definitions of the ROS 2 messages that are exported, as common_interfaces of ROS 2 has them."""

from __future__ import annotations

IMAGE = "sensor_msgs/msg/Image"
FLOAT = "std_msgs/msg/Float32"
_LINE = "=" * 80

MSGDEFS = {
    IMAGE: f"""\
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
{_LINE}
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
{_LINE}
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
""",
    FLOAT: "float32 data\n",
}
