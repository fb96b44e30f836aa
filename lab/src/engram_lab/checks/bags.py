"""Bags: equal to folders, as fast as they were recorded, in bounded memory, refused if damaged.

    python -m engram_lab.checks.bags same DATA/kitti_odometry/sequences/06
    python -m engram_lab.checks.bags euroc DATA/euroc/V1_01_easy_{sparse,at_rest}
    python -m engram_lab.checks.bags memory [--gigabytes 2]
    python -m engram_lab.checks.bags unreadable [--times 50]

same: a drive as a folder and as bags of every container has equal frames, and each localises the
other (48 of 51 frames). euroc: raw, distorted images with a Kalibr camchain match as many revisits
as from the folder; the pairs at rest, there and back at 20 Hz, are read, rectified and localised
three times as fast on one core. memory: it grows by 50 MB at most while a long bag is read.

unreadable: cut bags, bags of another robot, images declared 100,000 pixels wide, a kilobyte that
unpacks to gigabytes, YAML that doubles itself, pipes, circles of links. Each goes through `engram
map` in a process of its own, which ends with a message and an exit status within ten seconds of CPU
and a gigabyte. A cut bag may be mapped as far as it goes; it then ends with 3.

Ends with 1 if something is missed.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from engram.calibration.calibrated_pair import Cameras
from engram.calibration.toml import calibration_toml
from engram.frontend.frame import StereoPair
from engram.geometry.cameras import StereoCamera
from engram.maps.map import open_map
from engram.robot.localisers import DriveSequence
from engram.robot.mapping import map_drive
from engram.robot.settings import Settings
from engram.robot.starting import localise_drive
from engram.sequences.layouts import ImageSequence
from engram.sequences.opening import open_drive
from engram_lab.checks.accuracy import NEAR_M, Eyes, euroc_revisits, euroc_truth
from engram_lab.programs import command_line

_TOPICS = ("/cam0/image_raw", "/cam1/image_raw")
_KINDS = ("ros1", "sqlite3", "mcap")
_LEAST_SHARE, _LEAST_TIMES, _RATE_HZ = 48 / 51, 3.0, 20.0
_MOST_S, _MOST_BYTES, _MOST_GROWN_MB = 10.0, 1 << 30, 50.0
# A process that waits for ever.
_PATIENCE_S = 600.0

# Stamp in ns, left and right image.
Pictures = tuple[int, NDArray[np.uint8], NDArray[np.uint8]]


def write_bag(
    path: Path,
    pictures: Iterable[Pictures],
    kind: str = "mcap",
    *,
    declared: int | None = None,
    words: bool = False,
) -> Path:
    """A bag of raw grey pairs; returns its file or folder.

    Args:
        path: without ending.
        pictures: the pairs.
        kind: "ros1", "sqlite3" or "mcap".
        declared: width and height that the images claim to have; None for their own.
        words: write texts in place of the images, as images.
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


def noise(count: int, side: tuple[int, int] = (240, 320)) -> Iterator[Pictures]:
    """Pairs of noise at 20 Hz, ten pictures again and again."""
    rng = np.random.default_rng(0)
    known = [rng.integers(0, 256, side, np.uint8) for _ in range(10)]
    for number in range(count):
        yield 10**18 + number * 50_000_000, known[number % 10], known[(number + 1) % 10]


def localised(town: Path, live: DriveSequence) -> tuple[int, int]:
    """Frames localised in a map, and all frames."""
    with open_map(town) as opened:
        found = [one.localised for one in localise_drive(opened, live, Settings())]
    return sum(found), len(found)


def same(source: Path, work: Path) -> bool:
    """One line for each container."""
    folder, passed = open_drive(source), True
    pairs = [one for one in folder if isinstance(one, StereoPair)]
    calibration = work / "calibration.toml"
    calibration.write_text(calibration_toml(Cameras(folder.camera)))
    map_drive(work / "folder.engram", folder)
    for kind in _KINDS:
        pictures = ((one.stamp_ns, one.left, one.right) for one in pairs)
        bag = write_bag(work / kind, pictures, kind)
        equal = all(
            isinstance(a, StereoPair)
            and isinstance(b, StereoPair)
            and a.stamp_ns == b.stamp_ns
            and np.array_equal(a.left, b.left)
            and np.array_equal(a.right, b.right)
            for a, b in zip_longest(folder, open_drive(bag, calibration=calibration))
        )
        there = localised(work / "folder.engram", open_drive(bag, calibration=calibration))
        town = work / f"{kind}.engram"
        map_drive(town, open_drive(bag, calibration=calibration))
        back = localised(town, folder)
        passed &= equal and min(there[0] / there[1], back[0] / back[1]) >= _LEAST_SHARE
        print(
            f"{kind}: frames {'equal' if equal else 'DIFFER'}; bag in the folder's map "
            f"{there[0]} of {there[1]}, folder in the bag's map {back[0]} of {back[1]}",
            flush=True,
        )
    return passed


def euroc(source: Path, at_rest: Path, work: Path, seconds: float = 20.0) -> bool:
    """Revisits from the folder and from the bag, then how fast a bag is localised."""
    drive = open_drive(source)
    assert isinstance(drive, ImageSequence)
    chain = work / "camchain.yaml"
    chain.write_text(camchain(drive.cameras))
    bag = write_bag(work / "drive", raw_pictures(source))
    near = [_near(source, Eyes(), source), _near(source, Eyes(), bag, calibration=chain)]
    print(f"revisits within {NEAR_M} m: {len(near[0])} from the folder, {len(near[1])} from the "
          f"bag, {len(near[0] - near[1])} missed")  # fmt: skip
    return not near[0] - near[1] and _times_real_time(work, at_rest, chain, seconds) >= _LEAST_TIMES


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


def raw_pictures(folder: Path) -> list[Pictures]:
    """The raw, distorted pairs of a drive in EuRoC's layout."""
    found = []
    for left in sorted((folder / "mav0" / "cam0" / "data").iterdir()):
        right = folder / "mav0" / "cam1" / "data" / left.name
        images = [cv2.imread(str(one), cv2.IMREAD_GRAYSCALE) for one in (left, right)]
        both = [np.asarray(one, np.uint8) for one in images if one is not None]
        if len(both) == len(images):
            found.append((int(left.stem), both[0], both[1]))
    return found


def _near(folder: Path, eyes: Eyes, drive: Path, **options: Any) -> set[tuple[int, int]]:
    """Stamps of the revisits that match within 0.25 m."""
    truth = euroc_truth(folder)
    frames = {frame.stamp_ns: frame for frame in eyes.frames(str(drive.resolve()), **options)}
    again = euroc_revisits(folder)
    errors_m = eyes.errors_m(
        [(frames[a], frames[b], truth[a].inverse() @ truth[b]) for a, b in again]
    )
    return {
        pair
        for pair, off_m in zip(again, errors_m, strict=True)
        if off_m is not None and off_m < NEAR_M
    }


def _times_real_time(work: Path, at_rest: Path, chain: Path, seconds: float) -> float:
    """How much faster than it was recorded a bag is read, rectified and localised by one core.

    By the CPU time of the process, which other work on the machine does not change.
    """
    pictures = raw_pictures(at_rest)
    there_and_back = [*range(len(pictures)), *range(len(pictures) - 2, 0, -1)]
    count, period_ns = int(seconds * _RATE_HZ), round(1e9 / _RATE_HZ)
    order = (there_and_back[number % len(there_and_back)] for number in range(count))
    bag = write_bag(
        work / "rest",
        ((number * period_ns + 10**9, *pictures[at][1:]) for number, at in enumerate(order)),
    )
    map_drive(work / "rest.engram", open_drive(at_rest))
    used = time.process_time()
    found, frames = localised(work / "rest.engram", open_drive(bag, calibration=chain))
    used_s = time.process_time() - used
    times = frames / _RATE_HZ / used_s
    print(f"{frames} pairs of 752×480, {found} localised: {used_s:.1f} s of CPU time, {times:.1f} "
          "times real time on one core")  # fmt: skip
    return times


def memory(gigabytes: float, work: Path) -> bool:
    """Memory at the end of a long bag, and at a tenth of it."""
    camera = StereoCamera(450, 450, 376, 240, 0.1, 752, 480)
    count = int(gigabytes * 1e9 / (2 * camera.width * camera.height))
    bag = write_bag(work / "bag", noise(count, (camera.height, camera.width)))
    calibration = work / "calibration.toml"
    calibration.write_text(calibration_toml(Cameras(camera)))
    at_tenth_mb, read = 0.0, 0
    for read, _ in enumerate(open_drive(bag, calibration=calibration), start=1):
        if read == count // 10:
            at_tenth_mb = _resident_mb()
    grown_mb = _resident_mb() - at_tenth_mb
    print(f"{read} of {count} pairs: {at_tenth_mb:.0f} MB after a tenth, {grown_mb:+.1f} MB after")
    return read == count and grown_mb <= _MOST_GROWN_MB


def _resident_mb() -> float:
    lines = Path("/proc/self/status").read_text().splitlines()
    return float(next(line for line in lines if "VmRSS" in line).split()[1]) / 1024


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended: exit status (negative if killed), messages, CPU and clock, memory."""

    status: int
    messages: str
    cpu_s: float
    wall_s: float
    most_bytes: int

    @property
    def fault(self) -> str:
        """What is wrong with it; "" if nothing is."""
        if self.status <= 0:
            return f"ended with {self.status}"
        if "Traceback" in self.messages or not self.messages.strip():
            return "a traceback" if self.messages.strip() else "no message"
        if self.cpu_s > _MOST_S:
            return f"{self.cpu_s:.1f} s"
        return f"{self.most_bytes >> 20} MB" if self.most_bytes > _MOST_BYTES else ""


def tried(*arguments: str) -> Ended:
    """Runs `engram` and waits for its end."""
    command = [sys.executable, "-c", "from engram.cli import main; main()", *arguments]
    began = time.monotonic()
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            ["timeout", str(_PATIENCE_S), *command], stdout=subprocess.DEVNULL, stderr=errors
        )
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        errors.seek(0)
        messages = errors.read().decode(errors="replace")
    wall_s = time.monotonic() - began
    code = -1 if process.returncode == 124 else process.returncode
    return Ended(code, messages, used.ru_utime + used.ru_stime, wall_s, used.ru_maxrss * 1024)


def cases(folder: Path, times: int) -> Iterator[tuple[str, list[str]]]:
    """Name, and arguments of `engram map`, of each input."""
    calibration = folder / "left.yaml"
    calibration.write_text(_INFO.format(0))
    (folder / "right.yaml").write_text(_INFO.format(-100))
    given = ["--calibration", str(calibration)]
    whole = {kind: _whole(folder, kind) for kind in _KINDS}
    rng = np.random.default_rng(1)
    for bag in whole.values():
        content = bag.read_bytes()
        for number in range(times):
            cut = folder / f"cut{number}{bag.suffix}"
            cut.write_bytes(content[: int(rng.integers(len(content)))])
            yield f"{bag.suffix} cut at a random place", [str(cut), *given]
    for kind, bag in whole.items():
        yield "topics of another robot", [str(bag), "--left", "/other", "--right", "/rig", *given]
        yield "no calibration", [str(bag)]
        huge = write_bag(folder / f"huge-{kind}", noise(10), kind, declared=100_000)
        yield "images declared 100,000 × 100,000", [str(huge), *given]
        other = write_bag(folder / f"other-{kind}", noise(10, (120, 160)), kind)
        yield "images of another size than the calibration", [str(other), *given]
        words = write_bag(folder / f"words-{kind}", noise(10), kind, words=True)
        yield "text in place of images", [str(words), *given]
    for name, made in _odd_files(folder):
        yield name, [str(made)]
        yield f"{name} as calibration", [str(whole["mcap"]), "--calibration", str(made)]


_INFO = """image_width: 320
image_height: 240
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [0, 0, 0, 0, 0]}}
camera_matrix: {{rows: 3, cols: 3, data: [200, 0, 160, 0, 200, 120, 0, 0, 1]}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
projection_matrix: {{rows: 3, cols: 4, data: [200, 0, 160, {}, 0, 200, 120, 0, 0, 0, 1, 0]}}
"""


def _whole(folder: Path, kind: str) -> Path:
    made = write_bag(folder / kind, noise(30), kind)
    return made if made.is_file() else next(one for one in made.iterdir() if one.suffix != ".yaml")


def _odd_files(folder: Path) -> Iterator[tuple[str, Path]]:
    """Files that are not what their names say."""
    doubling = ["a0: &a0 [0, 0, 0, 0, 0, 0, 0, 0, 0]"]
    doubling += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 30)]
    (folder / "bomb.yaml").write_text("\n".join(doubling))
    yield "YAML that doubles itself", folder / "bomb.yaml"
    for suffix in (".bag.zstd", ".mcap.zstd", ".db3.zstd"):
        bomb = folder / f"bomb{suffix}"
        with (
            bomb.open("wb") as file,
            subprocess.Popen(["zstd", "-q"], stdin=subprocess.PIPE, stdout=file) as packing,
        ):
            assert packing.stdin is not None
            for _ in range(4096):
                packing.stdin.write(b"\0" * (1 << 20))
            packing.stdin.close()
        yield "4 GB of zeros, packed", bomb
    for suffix in (".bag", ".mcap", ".db3", ".yaml"):
        pipe, circle, random, empty = (
            folder / f"{name}{suffix}" for name in ("pipe", "circle", "noise", "empty")
        )
        os.mkfifo(pipe)
        yield "a pipe without a writer", pipe
        circle.symlink_to(circle)
        yield "a link to itself", circle
        random.write_bytes(np.random.default_rng(2).bytes(1 << 20))
        yield "noise", random
        empty.touch()
        yield "an empty file", empty


def unreadable(times: int, work: Path) -> bool:
    """One row for each kind of input."""
    rows: dict[str, list[Ended]] = defaultdict(list)
    faults = 0
    for number, (kind, arguments) in enumerate(cases(work, times)):
        one = tried("map", str(work / f"{number}.engram"), *arguments)
        rows[kind].append(one)
        silent = " cut " in kind and not re.search(
            "lost|cut short|damaged|no message", one.messages
        )
        if one.fault or silent:
            faults += 1
            print(f"{kind}: {one.fault or 'nothing says so'}: {arguments}\n{one.messages[-600:]}")
    print("| input | times | exit status | s of CPU, most | s, most | MB, most |\n|" + " --- |" * 6)
    for kind, ended in rows.items():
        statuses = ", ".join(str(one) for one in sorted({one.status for one in ended}))
        most = [max(one.cpu_s for one in ended), max(one.wall_s for one in ended)]
        most_mb = max(one.most_bytes for one in ended) >> 20
        print(f"| {kind} | {len(ended)} | {statuses} | {most[0]:.1f} | {most[1]:.1f} | {most_mb} |")
    return not faults


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("what", choices=("same", "euroc", "memory", "unreadable"))
    parser.add_argument("drives", type=Path, nargs="*")
    parser.add_argument("--gigabytes", type=float, default=2.0)
    parser.add_argument("--times", type=int, default=50, help="cut bags of each container")
    asked = parser.parse_args()
    drives: Sequence[Path] = asked.drives
    if len(drives) != (wanted := {"same": 1, "euroc": 2}.get(asked.what, 0)):
        parser.error(f"{asked.what} takes {wanted} drives")
    with tempfile.TemporaryDirectory(prefix="engram-bags-") as name:
        work = Path(name)
        if asked.what == "same":
            passed = same(drives[0], work)
        elif asked.what == "euroc":
            passed = euroc(drives[0], drives[1], work)
        elif asked.what == "memory":
            passed = memory(asked.gigabytes, work)
        else:
            passed = unreadable(asked.times, work)
    sys.exit(not passed)


if __name__ == "__main__":
    main()
