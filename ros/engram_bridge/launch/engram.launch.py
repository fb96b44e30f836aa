"""Starts the bridge: ros2 launch engram_bridge engram.launch.py map:=/maps/town.engram."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The bridge with its parameters."""
    shared = Path(get_package_share_directory("engram_bridge"))
    given = {name: LaunchConfiguration(name) for name in ("map", "mapping", "autostart")}
    return LaunchDescription(
        [
            DeclareLaunchArgument("map", description="The map file, NAME.engram."),
            DeclareLaunchArgument("mapping", default_value="false"),
            DeclareLaunchArgument("autostart", default_value="true"),
            DeclareLaunchArgument("config", default_value=str(shared / "config" / "engram.yaml")),
            Node(
                package="engram_bridge",
                executable="bridge",
                name="engram",
                parameters=[LaunchConfiguration("config"), given],
                output="screen",
            ),
        ]
    )
