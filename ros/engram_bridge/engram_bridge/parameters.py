"""Parameters of the node, and the command that they make."""

from __future__ import annotations

PARAMETERS = {
    "autostart": True,
    "command": ["engram"],
    "map": "",
    "robot": "robot",
    "mapping": False,
    "deadline_ms": 40.0,
    "settings": [""],
    "left": "left/image_rect",
    "right": "right/image_rect",
    "left_info": "left/camera_info",
    "right_info": "right/camera_info",
    "wheels": "",
    "gyro": "",
    "gps": "",
    "compressed": False,
    "rectified": True,
    "pair_tolerance_ms": 2.0,
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "camera_frame": "",
    "publish_odom_tf": True,
    "publish_map_tf": True,
    "base_from_camera": [0.0],
    "status_rate": 5.0,
}
# Those that may change while the node runs; the others are read when it is configured.
RUNNING = ("map", "mapping")


def checked(given):
    """The parameters, if they can be used.

    Raises:
        ValueError: one of them cannot: says which, and what is expected.
    """
    if not given["map"]:
        raise ValueError("the parameter map is empty: give the map file, map:=/maps/NAME.engram")
    mounting = list(given["base_from_camera"])
    if len(mounting) not in (1, 6):
        raise ValueError(
            f"base_from_camera has {len(mounting)} numbers: give x y z roll pitch yaw, or leave it "
            "out to use /tf_static"
        )
    for name in ("status_rate", "pair_tolerance_ms"):
        if not given[name] > 0:
            raise ValueError(f"{name} is {given[name]}: it must be above 0")
    return given


def live_command(given):
    """Arguments of the live process."""
    command = [*given["command"], "live", given["map"], "--robot", given["robot"]]
    if given["mapping"]:
        command.append("--map")
    if given["deadline_ms"] > 0:
        command += ["--deadline", str(given["deadline_ms"])]
    for setting in filter(None, given["settings"]):
        command += ["--set", setting]
    return command


def image_topic(given, side: str):
    """(topic, whether its images are compressed); by ROS's habit these lie under /compressed."""
    topic, ending = given[side], "/compressed"
    if topic.endswith(ending):
        return topic, True
    return (topic + ending, True) if given["compressed"] else (topic, False)
