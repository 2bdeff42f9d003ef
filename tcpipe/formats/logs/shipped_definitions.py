"""Definitions of the robots' own messages, for logs that hold their bytes but not their text: .msg files beside `tcpipe.logs`.

Field for field as their packages define them: husky_msgs (husky/husky), clearpath_platform_msgs 0.2 and later
(clearpathrobotics/clearpath_msgs), jackal_msgs 0.x of ROS 1 (jackal/jackal), warthog_msgs (warthog-cpr/warthog), nmea_msgs
(ros-drivers/nmea_msgs), husarion_ugv_msgs (husarion/husarion_ugv_ros), panther_msgs (husarion/panther_msgs), unitree_go
(unitreerobotics/unitree_ros2), vesc_msgs of ROS 2 (f1tenth/vesc), scout_msgs of ROS 2 (agilexrobotics/scout_ros2); their licences stand
in NOTICE. Constants and comments are left out: they change no byte.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from importlib.resources import files


@cache
def shipped_definitions() -> Mapping[str, str]:
    """Return definition texts by type; what they refer to (std_msgs/Header, duration) belongs to every type store."""
    packages = sorted(files("tcpipe.logs").joinpath("definitions").iterdir(), key=lambda package: package.name)
    return {
        f"{package.name}/msg/{file.name.removesuffix('.msg')}": file.read_text(encoding="utf-8")
        for package in packages
        for file in sorted(package.joinpath("msg").iterdir(), key=lambda file: file.name)
    }
