"""The ROS 2 bridge under faults, or next to busy loops, with a real ROS 2 from wheels.

    python -m engram_lab.checks.ros_bridge faults --ros .venv-ros/bin/python [--times 50] [--lost]
    python -m engram_lab.checks.ros_bridge endure --ros .venv-ros/bin/python [--minutes 10]

`make test-ros` makes that environment. A camera of 640×480 drives ten metres of the hamlet and
back, again and again, at 20 Hz, in a map of the way there; its truth is known. `faults` injects
each fault so many times and waits until the robot localises again; `endure` measures frames
dropped, the age of the pose when another node hears it, and the shares of a core. Ends with 1 if a
row misses its limit.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.geometry.se3 import SE3
from engram.graph.model import Clock
from engram.maps.map import open_map
from engram.robot.mapping import map_drive
from engram.sequences.sequence import SequenceInfo
from engram_lab.town.campaigns import campaign_named
from engram_lab.town.drive import Pose, Robot
from engram_lab.town.session import SimulatedDrive

_BRIDGE = Path(__file__).parents[4] / "ros" / "engram_bridge"
_ROBOT = Robot("carrier", StereoCamera(502.3, 502.3, 319.5, 239.5, 0.24, 640, 480))
_RATE_HZ, _LAP_S, _WAY_M, _FROM_M = 20.0, 10.0, 10.0, 20.0
_LONGEST_SILENCE_S = 1.0
_MOST_DROPPED, _MEDIAN_MS, _LATE_MS, _CORE = 0.01, 40.0, 100.0, 0.25


class There:
    """A robot that drives ten metres of the hamlet and back, without a jolt, at 20 Hz.

    It sets off and stops gently, so that each lap can follow the one before.
    """

    def __init__(self, seconds: float, way_m: float) -> None:
        self.drive = SimulatedDrive(campaign_named("hamlet"), 0, robot=_ROBOT)
        count = round(seconds * _RATE_HZ)
        turn = 2 * np.pi * np.arange(count) / count
        along_m = _FROM_M + way_m * (1 - np.cos(turn)) / 2
        speed_m_s = way_m * np.pi / seconds * np.sin(turn)
        self.drive.poses = [
            _pose(self.drive.poses, float(at), float(speed), number / _RATE_HZ)
            for number, (at, speed) in enumerate(zip(along_m, speed_m_s, strict=True))
        ]
        self.pairs = list(self.drive)

    def mapped(self) -> MemorySequence:
        """The outward leg."""
        return MemorySequence(self.pairs[: len(self.pairs) // 2 + 1])


class MemorySequence:
    """Pairs as a drive."""

    def __init__(self, pairs: list[StereoPair]) -> None:
        self.info = SequenceInfo(name="there", format="simulated", clock=Clock.UTC, robot="there")
        self.camera, self.skipped, self._pairs = pairs[0].camera, 0, pairs

    def __len__(self) -> int:
        return len(self._pairs)

    def __iter__(self) -> Iterator[StereoPair]:
        return iter(self._pairs)


def _pose(poses: list[Pose], at_m: float, speed_m_s: float, elapsed_s: float) -> Pose:
    """The pose at a distance along a drive."""
    after = max(1, int(np.searchsorted([one.driven_m for one in poses], at_m)))
    one, other = poses[after - 1], poses[after]
    share = (at_m - one.driven_m) / (other.driven_m - one.driven_m)
    step = SE3.exp(share * (one.world_from_cam.inverse() @ other.world_from_cam).log())
    ahead = np.array([0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0])
    return Pose(one.world_from_cam @ step, at_m, elapsed_s, speed_m_s, ahead)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("what", choices=["faults", "endure"])
    parser.add_argument("--ros", type=Path, required=True, help="a Python with rclpy")
    parser.add_argument("--times", type=int, default=50, help="of each fault")
    parser.add_argument("--only", help="these faults, by comma")
    parser.add_argument("--lost", action="store_true", help="and lost for half a minute, twice")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--busy", type=int, default=2, help="busy loops")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="engram-ros-") as folder:
        town = _prepared(Path(folder))
        with _bridge(asked.ros, town) as bridge:
            given = ["--minutes", str(asked.minutes), "--busy", str(asked.busy)]
            if asked.what == "faults":
                given = ["--times", str(asked.times), *(["--lost"] if asked.lost else [])]
                given += ["--faults", asked.only] if asked.only else []
            said = _measured(asked.ros, asked.what, town, bridge, given)
    return _faults(said) if asked.what == "faults" else _endurance(said)


def _prepared(folder: Path) -> Path:
    """Writes the pairs of a lap, where they lie in the map frame, and a map of the outward leg."""
    there = There(_LAP_S, _WAY_M)
    town = folder / "town.engram"
    map_drive(town, there.mapped())
    camera = there.drive.camera
    np.savez(
        folder / "pairs.npz",
        left=[one.left for one in there.pairs],
        right=[one.right for one in there.pairs],
        camera=[camera.fx, camera.fy, camera.cx, camera.cy, camera.baseline_m],
        map_from_camera=_places(town, there),
    )
    live = folder / "engram"
    live.write_text(
        f"#!/bin/sh\nPYTHONPATH={os.pathsep.join(sys.path)} LD_LIBRARY_PATH= exec "
        f"{sys.executable} -c 'from engram.cli import main; main()' \"$@\"\n"
    )
    live.chmod(0o755)
    return town


def _places(town: Path, there: There) -> NDArray[np.float64]:
    """(pairs, 4, 4): true poses of the cameras, in the map frame by its first node."""
    truth = there.drive.world_from_cams()
    with open_map(town) as opened:
        first = opened.graph.nodes[0]
        at = [pair.stamp_ns for pair in there.pairs].index(first.stamp_ns)
        map_from_world = opened.frame.pose(first.id) @ truth[at].inverse()
    return np.array([(map_from_world @ one).matrix() for one in truth])


def _of_ros(python: Path) -> dict[str, str]:
    root = python.absolute().parents[1]  # a virtual environment's Python is a link: not resolved
    made = root / "messages"
    paths = [_BRIDGE, *made.glob("lib/*/site-packages")]
    return {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(map(str, paths)),
        "AMENT_PREFIX_PATH": f"{made}:{root}",
        "LD_LIBRARY_PATH": f"{made}/lib:{root}/lib",
        "FASTRTPS_DEFAULT_PROFILES_FILE": str(_BRIDGE / "config" / "fastdds.xml"),
        "ROS_DOMAIN_ID": str(os.getpid() % 100),
    }


@contextmanager
def _bridge(python: Path, town: Path) -> Iterator[int]:
    """A bridge that runs; its pid."""
    parameters = (f"map:={town}", f"command:=[{town.parent / 'engram'}]")
    given = [part for one in parameters for part in ("-p", one)]
    command = [str(python), "-m", "engram_bridge.node", "--ros-args", *given]
    with (
        (town.parent / "bridge.log").open("w") as log,
        subprocess.Popen(command, env=_of_ros(python), stdout=log, stderr=log) as process,
    ):
        try:
            yield process.pid
        finally:
            process.send_signal(signal.SIGINT)


def _measured(python: Path, what: str, town: Path, bridge: int, given: list[str]) -> dict[str, Any]:
    program = [str(python), str(_BRIDGE / "test" / "measure.py"), what]
    command = [*program, str(town.parent / "pairs.npz"), str(town), "--bridge", str(bridge), *given]
    ran = subprocess.run(
        command, env=_of_ros(python), stdout=subprocess.PIPE, text=True, check=False
    )
    if ran.returncode:
        sys.exit((town.parent / "bridge.log").read_text()[-2000:])
    said: dict[str, Any] = json.loads(ran.stdout.splitlines()[-1])
    return said


_COLUMNS = (
    "fault",
    "times",
    "longest silence, said / heard",
    "poses claimed wrongly",
    "jumps in odom",
    "small covariances",
    "localised again, median",
)


def _faults(said: dict[str, Any]) -> int:
    print(f"| {' | '.join(_COLUMNS)} |\n|{' --- |' * len(_COLUMNS)}")
    missed = False
    for row in said["rows"]:
        small = row.get("small_covariances", 0)
        print(
            f"| {row['fault']} | {row['times']} | {row['longest_silence_s']:.2f} / "
            f"{row['longest_unheard_s']:.2f} s | "
            f"{row['wrong_poses']} | {row['jumps']} | {small} | {row['median_recovery_s']:.1f} s |"
        )
        silent = row["longest_silence_s"] > _LONGEST_SILENCE_S
        missed |= silent or bool(row["wrong_poses"] or row["jumps"] or small)
    return int(missed)


def _endurance(said: dict[str, Any]) -> int:
    age_ms, shares = said["age_ms"], said["share_of_a_core"]
    print(
        f"{said['minutes']:g} minutes at {said['rate_hz']:.1f} Hz beside {said['busy_loops']} busy "
        f"loops, {said['sent']} frames\n"
        f"dropped: {said['dropped']} ({said['dropped_share']:.2%}); the live process took "
        f"{said['taken']} and dropped {said['dropped_by_process']}\n"
        f"age when heard, ms: {age_ms['50']:.1f} median, {age_ms['90']:.1f} of 90 %, "
        f"{age_ms['99']:.1f} of 99 %, {age_ms['100']:.0f} largest\n"
        f"share of a core: bridge {shares['bridge']:.1%}, live process {shares['live']:.1%}\n"
        f"localised: {said['localised_share']:.1%} of the reports"
    )
    late = age_ms["50"] > _MEDIAN_MS or age_ms["99"] > _LATE_MS
    return int(late or said["dropped_share"] > _MOST_DROPPED or sum(shares.values()) > _CORE)


if __name__ == "__main__":
    sys.exit(main())
