"""Starts a camera's driver with the bridge.

ros2 launch engram_bridge camera.launch.py camera:=realsense map:=/maps/town.engram
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    GroupAction,
    IncludeLaunchDescription,
    OpaqueFunction,
)
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import SetParameter

# Package and launch file of each camera's driver.
DRIVERS = {
    "realsense": ("realsense2_camera", "rs_launch.py"),
    "zed": ("zed_wrapper", "zed_camera.launch.py"),
    "oak": ("depthai_ros_driver", "camera.launch.py"),
}


def driver_arguments(camera, model, config):
    """Arguments of a driver's launch file: a rectified grey pair, no projector, no odometry."""
    if camera == "realsense":
        return {
            "enable_infra1": "true",
            "enable_infra2": "true",
            "enable_sync": "true",
            "enable_color": "false",
        }
    if camera == "zed":
        return {
            "camera_model": model or "zed2i",
            "ros_params_override_path": str(config / "zed_driver.yaml"),
            "publish_tf": "false",
            "publish_map_tf": "false",
        }
    return {
        "camera_model": model or "OAK-D-PRO",
        "params_file": str(config / "oak_driver.yaml"),
    }


def driver_and_bridge(context):
    """What starts for the chosen camera."""
    camera, model, config = (
        LaunchConfiguration(name).perform(context) for name in ("camera", "model", "config")
    )
    shared = Path(get_package_share_directory("engram_bridge"))
    package, file = DRIVERS[camera]
    driver = Path(get_package_share_directory(package)) / "launch" / file
    given = {name: LaunchConfiguration(name) for name in ("map", "mapping")}
    given["config"] = config or str(shared / "config" / (camera + ".yaml"))
    return [
        GroupAction(
            [
                # RealSense's projector draws dots that move with the camera; its launch file has
                # no argument for it. Other nodes do not know the parameter.
                SetParameter(name="depth_module.emitter_enabled", value=0),
                included(driver, driver_arguments(camera, model, shared / "config")),
            ]
        ),
        included(shared / "launch" / "engram.launch.py", given),
    ]


def included(file, arguments):
    """Another launch file, with its arguments."""
    return IncludeLaunchDescription(
        PythonLaunchDescriptionSource(str(file)), launch_arguments=arguments.items()
    )


def generate_launch_description():
    """The driver of a camera, and the bridge with its topics."""
    return LaunchDescription(
        [
            DeclareLaunchArgument("camera", choices=sorted(DRIVERS)),
            DeclareLaunchArgument("model", default_value="", description="zed2i, OAK-D, ..."),
            DeclareLaunchArgument("map", description="The map file, NAME.engram."),
            DeclareLaunchArgument("mapping", default_value="false"),
            DeclareLaunchArgument("config", default_value="", description="Replaces CAMERA.yaml."),
            OpaqueFunction(function=driver_and_bridge),
        ]
    )
