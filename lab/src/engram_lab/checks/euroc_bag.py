"""EuRoC's raw images as a bag with a Kalibr camchain: the same result as from the folder, in time.

    python -m engram_lab.checks.euroc_bag DATA/euroc/V1_01_easy_sparse DATA/euroc/V1_01_easy_at_rest

The first drive becomes an MCAP bag of raw, distorted images, and both are matched revisit by
revisit. The second, ten pairs at 20 Hz, becomes a bag of `--seconds` of them there and back, which
is read, rectified and localised. Ends with 1 if a revisit within 0.25 m from the folder is missed
from the bag, or if the bag takes one core more than a third of its time.
"""

from __future__ import annotations

import argparse
import csv
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import Cameras
from engram.geometry.se3 import SE3
from engram.maps.map import open_map
from engram.monitor import QUIET
from engram.robot.mapping import map_drive
from engram.robot.settings import RobotOptions, Settings
from engram.robot.starting import robot_on
from engram.sequences.layouts import ImageSequence
from engram.sequences.opening import open_drive
from engram_lab.checks.accuracy import NEAR_M, error_of, frames_of, match

_TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
_LEAST_TIMES = 3.0
_RATE_HZ = 20.0

Pictures = tuple[int, NDArray[np.uint8], NDArray[np.uint8]]


def write_bag(
    path: Path,
    pictures: Iterable[Pictures],
    kind: str = "mcap",
    *,
    declared: int | None = None,
    words: bool = False,
) -> Path:
    """A bag of raw grey pairs: stamp, left and right each.

    Args:
        path: without ending.
        pictures: the pairs.
        kind: "ros1", "sqlite3" or "mcap".
        declared: width and height that the images claim to have; None for their own.
        words: write texts in place of the images, as images.

    Returns:
        The file or folder.
    """
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    is1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if is1 else Stores.ROS2_HUMBLE)
    serialise: Any = store.serialize_ros1 if is1 else store.serialize_cdr
    image_kind, types = "sensor_msgs/msg/Image", store.types
    made = path.with_suffix(".bag") if is1 else path
    opened: Any = (
        Writer1(made)
        if is1
        else Writer(made, version=9, storage_plugin=StoragePlugin[kind.upper()])
    )
    with opened as writer:
        topics = [writer.add_connection(topic, image_kind, typestore=store) for topic in _TOPICS]
        for stamp_ns, *both in pictures:
            at = types["builtin_interfaces/msg/Time"](stamp_ns // 10**9, stamp_ns % 10**9)
            header = types["std_msgs/msg/Header"](
                stamp=at, frame_id="", **({"seq": 0} if is1 else {})
            )
            for topic, image in zip(topics, both, strict=True):
                height, width = (declared,) * 2 if declared else image.shape
                message = types[image_kind](header, height, width, "mono8", 0, width, image.ravel())
                content = bytes(serialise(message, image_kind))
                writer.write(topic, stamp_ns, b"\1\0\0\0words" if words else content)
    return made


def camchain(cameras: Cameras) -> str:
    """Kalibr's camchain of a raw calibration with radtan lenses."""
    raw = cameras.raw
    assert raw is not None
    parts = []
    for number, (lens, topic) in enumerate(zip((raw.left, raw.right), _TOPICS, strict=True)):
        pose = "" if number == 0 else f"  T_cn_cnm1: {raw.right_from_left.matrix().tolist()}\n"
        parts.append(
            f"cam{number}:\n  camera_model: pinhole\n  distortion_model: radtan\n"
            f"  distortion_coeffs: {[float(one) for one in lens.coefficients]}\n"
            f"  intrinsics: {[lens.fx, lens.fy, lens.cx, lens.cy]}\n"
            f"  resolution: {[lens.width, lens.height]}\n{pose}  rostopic: {topic}\n"
        )
    return "".join(parts)


def _cameras(folder: Path) -> Cameras:
    drive = open_drive(folder)
    assert isinstance(drive, ImageSequence)
    return drive.cameras


def pictures_of(folder: Path) -> list[Pictures]:
    """The raw, distorted pairs of a drive in EuRoC's layout."""
    found = []
    for left in sorted((folder / "mav0" / "cam0" / "data").iterdir()):
        right = folder / "mav0" / "cam1" / "data" / left.name
        images = [cv2.imread(str(one), cv2.IMREAD_GRAYSCALE) for one in (left, right)]
        both = [np.asarray(one, np.uint8) for one in images if one is not None]
        if len(both) == len(images):
            found.append((int(left.stem), both[0], both[1]))
    return found


def revisits(folder: Path, drive: Path, **options: Any) -> dict[tuple[int, int], float | None]:
    """Error of each revisit, metres, by its two stamps; None where it is not matched."""
    lines = (folder / "poses_world_from_rectified_cam0.txt").read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith("#")]
    truth = {
        int(row[0]): SE3.from_matrix(np.array(row[1:], np.float64).reshape(3, 4)) for row in rows
    }
    frames = {frame.stamp_ns: frame for frame in frames_of(drive, **options)}
    with (folder / "revisit_pairs.csv").open() as file:
        pairs = [(int(row["earlier_ns"]), int(row["later_ns"])) for row in csv.DictReader(file)]
    errors = {}
    for earlier, later in pairs:
        found = match(frames[earlier], frames[later])
        error = error_of(found, truth[earlier].inverse() @ truth[later])
        errors[earlier, later] = None if error is None else error[0]
    return errors


def times_real_time(folder: Path, at_rest: Path, chain: Path, seconds: float) -> float:
    """How much faster than it was recorded a bag is read, rectified and localised by one core.

    By the CPU time of the process, which other work on the machine does not change.
    """
    pictures = pictures_of(at_rest)
    count = int(seconds * _RATE_HZ)
    there_and_back = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    period_ns = round(1e9 / _RATE_HZ)
    order = (there_and_back[number % len(there_and_back)] for number in range(count))
    bag = write_bag(
        folder / "rest",
        ((number * period_ns + 10**9, *pictures[at][1:]) for number, at in enumerate(order)),
    )
    town = folder / "rest.engram"
    map_drive(town, open_drive(at_rest))
    live = open_drive(bag, calibration=chain)
    began, used = time.perf_counter(), time.process_time()
    with open_map(town) as opened, robot_on(opened, live, Settings(), RobotOptions()) as robot:
        found = list(robot.drive(live, QUIET))
    took_s, used_s = time.perf_counter() - began, time.process_time() - used
    localised = sum(one.localised for one in found)
    print(
        f"{len(found)} pairs of 752×480, {localised} localised: {used_s:.1f} s of CPU time, "
        f"{len(found) / _RATE_HZ / used_s:.1f} times real time on one core; {took_s:.1f} s passed"
    )
    return len(found) / _RATE_HZ / used_s


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0])
    parser.add_argument("revisits", type=Path)
    parser.add_argument("at_rest", type=Path)
    parser.add_argument("--seconds", type=float, default=20.0)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="engram-euroc-") as name:
        folder = Path(name)
        chain = folder / "camchain.yaml"
        chain.write_text(camchain(_cameras(asked.revisits)))
        bag = write_bag(folder / "drive", pictures_of(asked.revisits))
        wanted = revisits(asked.revisits, asked.revisits)
        found = revisits(asked.revisits, bag, calibration=chain)
        near = [{pair for pair, error in one.items() if error is not None and error < NEAR_M}
                for one in (wanted, found)]  # fmt: skip
        print(f"revisits within {NEAR_M} m: {len(near[0])} of {len(wanted)} from the folder, "
              f"{len(near[1])} from the bag, {len(near[0] - near[1])} missed")  # fmt: skip
        fast = times_real_time(folder, asked.at_rest, chain, asked.seconds)
    return int(bool(near[0] - near[1]) or fast < _LEAST_TIMES)


if __name__ == "__main__":
    sys.exit(main())
